"""Server: brings a session to pages over HTTP and WebSockets.

Everything lies under `/TOKEN/`, a random word in the address that is printed: whoever does not know it gets nothing.
Requests from pages of other origins, and those that come under a foreign host name, are refused all the same.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import pathlib
import urllib.parse
from typing import Any

from aiohttp import BodyPartReader, WSMsgType, web

from . import timeline
from .access import Access
from .checked import MAX_SECONDS, checked_between, checked_name, checked_vertices, checked_whole
from .clients import Client, unpacked_vertices
from .commands import COMMANDS
from .document import checked_view
from .inspection import inspect
from .jobs import Jobs
from .renderer import Renderer, Request
from .session import PARTS, Session
from .tasks import Tasks

PAGE = pathlib.Path(__file__).with_name("page")
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}

#: Bytes of a message and of a file that a page may send, and pages that may be connected.
MAX_MESSAGE, MAX_UPLOAD, MAX_PAGES = 4 << 20, 64 << 20, 32

#: Pixels of a picture's side.
MAX_SIDE = 4096

#: Seconds between looks at whether the session is saved, and from a change to the check of the cage.
SAVE_SECONDS, CHECK_SECONDS = 1.0, 0.3

#: The shortest time between two pictures of a film that plays, seconds.
PLAY_SECONDS = 1.0 / 60.0


class Server:
    """An editor's server. Its methods run in the thread of its event loop, unless they say otherwise.

    Args:
        session: The session.
        folder: Files that pages may load and that they make lie here.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        allowed_hosts: Names under which pages may come, beside those of this machine's loopback and `host`.

    Attributes:
        session: As given.
        token: The word in the address.
        clients: Connected pages by number.
    """

    def __init__(
        self,
        session: Session,
        folder: pathlib.Path,
        host: str = "127.0.0.1",
        port: int = 0,
        allowed_hosts: tuple[str, ...] = (),
    ):
        self.session, self.folder, self.host, self.port = session, folder, host, port
        self.access = Access(host, allowed_hosts)
        self.token = self.access.token
        self.clients: dict[int, Client] = {}
        self._number = 0
        self._sizer: Client | None = None
        self._mover: Client | None = None
        self._changed: set[str] = set()
        self._flush: asyncio.Handle | None = None
        self._view_moves = False
        self._playing: asyncio.Task | None = None
        self._checking: asyncio.TimerHandle | None = None
        self._check: dict[str, Any] | None = None
        self._frame: tuple[int, bytes] | None = None
        self._shown = asyncio.Event()
        self._background: list[asyncio.Task] = []

    async def start(self) -> str:
        """Begin to serve. Returns the address of the page; raises OSError where the port is taken."""
        self._loop = asyncio.get_running_loop()
        self.jobs = Jobs(self._on_job)
        self.tasks = Tasks(self.session, self.jobs, self.folder, self._loop)
        self.session.listeners.append(self._on_change)
        app = web.Application(middlewares=[self.access.guard], client_max_size=MAX_UPLOAD)
        app.router.add_get("/{token}", self._to_page)
        app.router.add_get("/{token}/", self._page_file)
        app.router.add_get("/{token}/socket", self._socket)
        app.router.add_get("/{token}/download/{name}", self._download)
        app.router.add_post("/{token}/upload", self._upload)
        app.router.add_get("/{token}/{name}", self._page_file)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await self._runner.setup()
        site = web.TCPSite(self._runner, self.host, self.port)
        try:
            await site.start()
        except OSError:
            await self._runner.cleanup()
            raise
        assert self._runner.addresses
        self.port = self._runner.addresses[0][1]
        self.renderer = Renderer(self.session.field, self._deliver)
        self._background.append(asyncio.create_task(self._save_often()))
        return self.address

    @property
    def address(self) -> str:
        """The page's address, with the token."""
        host = "127.0.0.1" if self.host in ("0.0.0.0", "::", "") else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/{self.token}/"

    async def stop(self) -> None:
        """End all that goes on; the session is saved."""
        self._stop_playing()
        for task in self._background:
            task.cancel()
        await asyncio.gather(*self._background, return_exceptions=True)
        if self._checking is not None:
            self._checking.cancel()
        self.session.end_gesture()
        self.session.listeners.remove(self._on_change)
        for client in list(self.clients.values()):
            await client.end()
        await self._runner.cleanup()
        await self._loop.run_in_executor(None, self._stop_threads)

    def _stop_threads(self) -> None:
        self.renderer.close()
        self.jobs.close()
        if self.session.unsaved:
            self.session.save(self.session.document)

    def _on_job(self) -> None:
        """A job changed; called from its thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._on_change, {"jobs"})

    # -- Files

    async def _to_page(self, request: web.Request) -> web.StreamResponse:
        raise web.HTTPFound(f"/{self.token}/")

    async def _page_file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info.get("name", "index.html")
        path = {file.name: file for file in PAGE.iterdir() if file.suffix in KINDS}.get(name)
        if path is None:
            raise web.HTTPNotFound
        return web.Response(body=path.read_bytes(), content_type=KINDS[path.suffix], charset="utf-8")

    async def _download(self, request: web.Request) -> web.StreamResponse:
        path = self.tasks.downloads.get(request.match_info["name"])
        if path is None or not path.is_file():
            raise web.HTTPNotFound(text="There is no such file; it may have been moved.")
        name = urllib.parse.quote(path.name)
        return web.FileResponse(path, headers={"Content-Disposition": f"attachment; filename*=UTF-8''{name}"})

    async def _upload(self, request: web.Request) -> web.StreamResponse:
        part = await (await request.multipart()).next()
        if not isinstance(part, BodyPartReader):
            raise web.HTTPBadRequest(text="an upload needs one file")
        content = bytearray()
        while chunk := await part.read_chunk(1 << 16):
            content += chunk
            if len(content) > MAX_UPLOAD:
                raise web.HTTPRequestEntityTooLarge(MAX_UPLOAD, len(content))
        try:
            name = await self._loop.run_in_executor(
                None, self.tasks.keep_upload, str(part.filename or ""), bytes(content)
            )
        except (ValueError, OSError) as error:
            raise web.HTTPBadRequest(text=str(error)) from None
        return web.json_response({"file": name})

    # -- Pages

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if len(self.clients) >= MAX_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{MAX_PAGES} pages are connected already: close one.")
        socket = web.WebSocketResponse(max_msg_size=MAX_MESSAGE, heartbeat=20.0, compress=False)
        await socket.prepare(request)
        self._number += 1
        client = Client(self._number, socket)
        names = ("session", *PARTS, "playback", "history", "check", "jobs")
        sections = {name: self._section(name) for name in names}
        hello = {"type": "hello", "client": client.number, "session": sections["session"], "sections": sections}
        self.clients[client.number] = client
        await socket.send_str(json.dumps(hello))
        if self._frame is not None:
            client.show(*self._frame)
        self._on_change({"session"})
        writer = asyncio.create_task(client.write())
        try:
            async for message in socket:
                await client.keep_pace(len(message.data) if message.type in (WSMsgType.TEXT, WSMsgType.BINARY) else 0)
                await self._hear(client, message.type, message.data)
        finally:
            del self.clients[client.number]
            writer.cancel()
            self.session.end_gesture(client)  # what the hand had moved when the page went is kept
            self._view_moves = False
            self._on_change({"session", "edits"})
        return socket

    async def _hear(self, client: Client, kind: WSMsgType, data: Any) -> None:
        """Take one message of a page."""
        if kind == WSMsgType.BINARY:
            try:
                self._move(client, data)
                client.mistakes = 0
            except ValueError as error:
                await client.mistake(str(error))
            return
        if kind != WSMsgType.TEXT:
            return
        try:
            message = json.loads(data)
            if not isinstance(message, dict) or not isinstance(message.get("do"), str):
                raise ValueError('a message must be a dictionary with a word "do"')
        except (ValueError, RecursionError) as error:
            await client.mistake(f"a message makes no sense: {str(error)[:200]}")
            return
        number = message.get("n")
        number = number if isinstance(number, int) else None
        try:
            result = await self._obey(client, message)
            client.mistakes = 0
            if number is not None:
                client.tell({"type": "reply", "n": number, "result": result})
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, OSError, MemoryError) as error:
            text = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())
            text = text[:500] or type(error).__name__
            client.mistakes += 1
            if number is None:
                await client.mistake(text)
            else:
                client.tell({"type": "reply", "n": number, "error": text})

    def _move(self, client: Client, data: bytes) -> None:
        """Vertices that a hand moves."""
        kind, sequence, edit, vertices = unpacked_vertices(data)
        self._touched(client)
        self._mover = client
        try:
            self.session.move(client, edit, vertices, rest=kind == 3)
            client.sequence = sequence
        finally:
            self._mover = None

    async def _obey(self, client: Client, message: dict[str, Any]) -> Any:
        """Carry out a page's command and return what its reply says."""
        do, session = message["do"], self.session
        if do == "size":
            client.size = (
                checked_whole(message["width"], 1, 16384, "width"),
                checked_whole(message["height"], 1, 16384, "height"),
            )
            self._touched(client)
            self._on_change({"view"})
            return None
        if do == "seen":
            client.saw(checked_whole(message["frame"], 0, 2**53, "frame"))
            return None
        if do in self.tasks.commands:
            return await self.tasks.obey(message)
        self._touched(client)
        if do == "view":
            self._view_moves = message.get("moving") is True
            if "seq" in message:
                client.sequence = checked_whole(message["seq"], 0, 2**32, "seq")
            session.look(checked_view(message))
            return None
        if do != "play" and do not in ("settings", "select"):
            self._stop_playing()
        if do in COMMANDS:
            session.run(message)
        elif do == "drag.begin":
            session.begin_gesture(client, message["edit"], checked_name(message.get("label", "move")))
        elif do == "preset.begin":
            edit = session.document.edit(message["edit"])
            given = message.get("vertices")
            chosen = None if given is None else checked_vertices(given, len(edit.rest))
            session.begin_gesture(client, edit.id, "preset", chosen)
        elif do == "preset.set":
            session.move_preset(client, message)
        elif do in ("drag.end", "preset.end"):
            session.end_gesture(client, cancel=message.get("cancel") is True)
        elif do == "undo":
            return session.undo()
        elif do == "redo":
            return session.redo()
        elif do == "time":
            session.scrub(checked_between(message["time"], 0.0, MAX_SECONDS, "time"))
        elif do == "play":
            self._play(message["on"] is True)
        else:
            raise ValueError(f"there is no command {do[:40]!r}")
        return None

    def _touched(self, client: Client) -> None:
        """The page that was touched last says how large pictures are."""
        if client.size is not None:
            self._sizer = client

    # -- Film

    def _play(self, on: bool) -> None:
        self._stop_playing()
        if on:
            self._playing = asyncio.create_task(self._play_film())
        self._on_change({"playback"})

    def _stop_playing(self) -> None:
        if self._playing is not None:
            self._playing.cancel()
            self._playing = None
            self._on_change({"playback"})

    async def _play_film(self) -> None:
        film = self.session.document.timeline
        begin = 0.0 if film.loop == "once" and self.session.document.time >= film.length else self.session.document.time
        started = self._loop.time()
        while True:
            elapsed = begin + self._loop.time() - started
            film = self.session.document.timeline
            ended = film.loop == "once" and elapsed >= film.length
            self._shown.clear()
            self.session.scrub(timeline.looped_time(film, elapsed))
            if ended:
                break
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._shown.wait(), 1.0)
            await asyncio.sleep(PLAY_SECONDS / 4)
        self._playing = None
        self._on_change({"playback"})

    # -- What changed

    def _on_change(self, names: set[str]) -> None:
        """Collect what changed until the loop is free again."""
        self._changed |= names
        if "vertices" in names:
            self._send_vertices()
        if names & {"edits", "vertices", "selection"}:
            self._plan_check()
        if self._flush is None:
            self._flush = self._loop.call_soon(self._flush_changes)

    def _flush_changes(self) -> None:
        self._flush, changed, self._changed = None, self._changed, set()
        pictured = changed & {"edits", "vertices", "settings", "view", "playback"}
        if pictured:
            self._request_picture()
        sections = {name: self._section(name) for name in changed - {"vertices"}}
        if sections:
            for client in self.clients.values():
                client.tell_sections(sections)

    def _send_vertices(self) -> None:
        """Tell pages where the vertices are, but for the page whose hand moves them."""
        for client in self.clients.values():
            if client is not self._mover:
                for edit in self.session.document.edits:
                    client.tell_vertices(2, edit.id, edit.posed)
                    if self._mover is not None:
                        client.tell_vertices(3, edit.id, edit.rest)

    def _section(self, name: str) -> Any:
        session = self.session
        if name == "session":
            field = session.field
            return {
                "name": session.path.name if session.path is not None else "not kept",
                "field": {
                    "name": session.field_path.name if session.field_path else "field",
                    "bounds": field.bounds.tolist(),
                }
                | {"up": [float(x) for x in field.up], "voxels": int(field.voxel_count)},
                "device": str(field.device),
                "saved": session.saved,
                "save_error": session.save_error,
                "pages": len(self.clients),
            }
        if name == "playback":
            return {"time": session.document.time, "playing": self._playing is not None}
        if name == "check":
            return self._check
        if name == "jobs":
            return self.jobs.section()
        return session.section(name)

    # -- Pictures

    def _request_picture(self) -> None:
        if self._sizer is None or self._sizer.size is None:
            return
        width, height = self._sizer.size
        share = min(1.0, MAX_SIDE / max(width, height))
        self.renderer.request(
            Request(
                self.session.document,
                max(1, round(width * share)),
                max(1, round(height * share)),
                self.session.moving or self._view_moves or self._playing is not None,
                {client.number: client.sequence for client in self.clients.values()},
            )
        )

    def _deliver(self, header: dict[str, Any], message: bytes) -> None:
        """A frame is there; called from a thread of the renderer."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._show, header["frame"], message)

    def _show(self, number: int, message: bytes) -> None:
        self._frame = (number, message)
        self._shown.set()
        for client in self.clients.values():
            client.show(number, message)

    # -- Checks and the session's file

    def _plan_check(self) -> None:
        """Look at the active cage once the hand rests."""
        if self._checking is not None:
            self._checking.cancel()
        self._checking = self._loop.call_later(CHECK_SECONDS, self._start_check)

    def _start_check(self) -> None:
        self._checking = None
        self._background = [task for task in self._background if not task.done()]
        if self.session.moving or self._playing is not None:
            self._plan_check()
        else:
            self._background.append(asyncio.create_task(self._run_check()))

    async def _run_check(self) -> None:
        document = self.session.document
        number = document.selection.edit
        if number is None:
            self._check = None
        else:
            if self._check is not None:
                self._check = {**self._check, "pending": True}
            found = await self._loop.run_in_executor(None, inspect, document, number, self.session.field)
            if self.session.document.edits is not document.edits:
                return  # another check is on its way
            self._check = found
        self._on_change({"check"})

    async def _save_often(self) -> None:
        while True:
            await asyncio.sleep(SAVE_SECONDS)
            if self.session.unsaved and not self.session.moving and self._playing is None:
                await self._loop.run_in_executor(None, self.session.save, self.session.document)
                self._on_change({"session"})
