"""Client: one page that is connected. What it is sent waits here, and old frames are left out."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from aiohttp import WSCloseCode, web

from ....core.checks import checked_whole
from ....errors import InputError
from ...spec.settings import Background, Settings, checked_settings

#: Frames that may be on their way to a page.
FRAMES_UNDER_WAY = 2

#: A page that has not said for this long that it saw a frame gets the next one all the same, seconds.
PATIENCE = 2.0

#: Messages and bytes per second that are taken of a page, and those that may come at once.
MESSAGE_RATE, MESSAGE_BURST = 300.0, 600.0
BYTE_RATE, BYTE_BURST = 20e6, 40e6

#: Messages in a row that nothing can be made of, until the page is let go.
MAX_MISTAKES = 50

#: Texts that may wait for a page. One that reads none is not listened to before it does.
MAX_WAITING = 200

#: Slow commands of a page that may be under way at once.
MAX_SLOW = 16

#: Vertices of a message: kind, sequence number, edit and count, little-endian.
VERTICES = struct.Struct("<4I")


class Client:
    """A connected page."""

    def __init__(self, number: int, socket: web.WebSocketResponse):
        self.number, self.sequence = number, 0  # sequence: the number of its newest pose or view
        self.size: tuple[int, int] | None = None  # width and height of its viewport, pixels
        self.ground: Background = None  # behind the scene in its viewport, in place of a field's one colour
        self.mistakes, self.strayed = 0, False  # wrong messages in a row; whether it knows that its gesture has ended
        self.slow: set[asyncio.Task] = set()  # its commands that are under way
        self._socket, self._closed = socket, False
        self._sections: dict[str, str] = {}
        self.texts: list[str] = []  # that wait to be sent, like the next two
        self.vertices: dict[tuple[int, int], bytes] = {}  # by kind and edit
        self.frame: tuple[int, bytes] | None = None  # with its number
        self.sent_frames: dict[int, float] = {}  # when frames that the page has not seen yet were sent, by number
        self._news, self._written = asyncio.Event(), asyncio.Event()
        self._allowed = {"messages": MESSAGE_BURST, "bytes": BYTE_BURST}
        self._counted = time.monotonic()

    def resize(self, message: dict[str, Any]) -> None:
        """Take what the page says of its viewport."""
        width, height = (checked_whole(message[name], name, 1, 16384) for name in ("width", "height"))
        ground = checked_settings(Settings(), {"background": message.get("ground")}).background
        self.size, self.ground = (width, height), ground

    # -- To the page

    def greet(self, message: dict[str, Any]) -> None:
        """Send the message that comes before all others."""
        self._greeting = json.dumps(message)
        self._news.set()

    def send(self, message: dict[str, Any]) -> None:
        """Send a message."""
        self.texts.append(json.dumps(message, allow_nan=False))
        self._news.set()

    def notice(self, level: str, text: str) -> None:
        """Send a line that the page shows."""
        self.send({"type": "notice", "level": level, "text": text})

    def send_sections(self, sections: Mapping[str, str]) -> None:
        """Send sections, written as JSON. Where some wait already, the newer ones take their place."""
        self._sections.update(sections)
        if "edits" in sections:
            self.vertices.clear()  # they are older than the edits, and would be sent after them
        self._news.set()

    def send_vertices(self, kind: int, edit: int, message: bytes) -> None:
        """Send where an edit's vertices are. Where some wait already, the newer ones take their place."""
        self.vertices[kind, edit] = message
        self._news.set()

    def show(self, number: int, message: bytes) -> None:
        """Send a frame, once there are few enough on their way. A frame that waits is left out for a newer one."""
        self.frame = (number, message)
        self._news.set()

    def saw(self, number: int) -> None:
        """The page has shown a frame, and all before it."""
        self.sent_frames = {frame: when for frame, when in self.sent_frames.items() if frame > number}
        self._news.set()

    async def end(self) -> None:
        """Say goodbye: the server ends."""
        await self._socket.close(code=WSCloseCode.GOING_AWAY, message=b"the editor was closed")

    async def write(self) -> None:
        """Send what waits, until the connection ends."""
        try:
            while not self._socket.closed:
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self._news.wait(), PATIENCE)
                self._news.clear()
                await self.write_all()
        except (ConnectionError, RuntimeError):  # it has ended in between
            pass
        finally:
            self.texts, self._closed = [], True
            self._written.set()

    async def write_all(self) -> None:
        """Send all that waits."""
        greeting, self._greeting = self._greeting, None
        if greeting is not None:
            await self._socket.send_str(greeting)
        texts, self.texts = self.texts, []
        sections, self._sections = self._sections, {}
        vertices, self.vertices = self.vertices, {}
        if sections:
            parts = ", ".join(f'"{name}": {content}' for name, content in sections.items())
            await self._socket.send_str(f'{{"type": "state", "sections": {{{parts}}}}}')
        for text in texts:
            await self._socket.send_str(text)
        for message in vertices.values():
            await self._socket.send_bytes(message)
        self._written.set()
        now = time.monotonic()
        self.sent_frames = {frame: when for frame, when in self.sent_frames.items() if now - when < PATIENCE}
        if self.frame is not None and len(self.sent_frames) < FRAMES_UNDER_WAY:
            (number, message), self.frame = self.frame, None
            self.sent_frames[number] = now
            await self._socket.send_bytes(message)

    # -- From the page

    async def keep_pace(self, size: int) -> None:
        """Count a message of so many bytes; wait where a page sends more than a drag can, or reads too little.
        TCP then holds it back."""
        now = time.monotonic()
        passed, self._counted = now - self._counted, now
        for name, rate, burst, used in (
            ("messages", MESSAGE_RATE, MESSAGE_BURST, 1.0),
            ("bytes", BYTE_RATE, BYTE_BURST, float(size)),
        ):
            self._allowed[name] = min(burst, self._allowed[name] + rate * passed) - used
            if self._allowed[name] < 0.0:
                await asyncio.sleep(-self._allowed[name] / rate)
        while len(self.texts) > MAX_WAITING and not self._closed:
            self._written.clear()
            await self._written.wait()

    async def mistake(self, text: str) -> None:
        """Say what is wrong with a message; after too many in a row let the page go."""
        self.mistakes += 1
        self.notice("error", text)
        if self.mistakes >= MAX_MISTAKES:
            await self._socket.close(code=WSCloseCode.POLICY_VIOLATION, message=b"too many messages make no sense")


def packed_vertices(kind: int, edit: int, vertices: np.ndarray) -> bytes:
    """A message that says where the vertices (count, 3) of an edit are: kind 2 posed, 3 at rest."""
    return VERTICES.pack(kind, 0, edit, len(vertices)) + np.ascontiguousarray(vertices, "<f8").tobytes()


def unpacked_vertices(message: bytes) -> tuple[int, int, int, np.ndarray]:
    """The parts of a page's message: kind (2 posed, 3 at rest), sequence number, edit, and vertices (count, 3).
    It is `VERTICES`, then float64 (count, 3), little-endian."""
    if len(message) < VERTICES.size:
        raise InputError(f"a message of {len(message)} bytes is too short for vertices")
    kind, sequence, edit, count = VERTICES.unpack_from(message)
    if kind not in (2, 3) or len(message) != VERTICES.size + 24 * count:
        raise InputError(f"a message of kind {kind} with {len(message)} bytes holds no {count} vertices")
    return kind, sequence, edit, np.frombuffer(message, "<f8", offset=VERTICES.size).reshape(count, 3)
