"""The server of the editor: its page, files and one WebSocket a client, on this machine alone unless asked."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import pathlib
from collections.abc import Coroutine
from typing import Any

import numpy as np
from aiohttp import WSMsgType, web

from ...core.checks import checked_flag, checked_number, checked_whole
from ...core.names import error_line
from ...core.spec import schema
from ...easings import EASING_KINDS
from ...errors import InputError
from ...field.voxel_field import VoxelField
from ..films.checks import MAX_LINE, MAX_SECONDS, checked_name, checked_vertices, parsed_json
from ..films.document import Edit, checked_view
from ..films.session.timeline import framed_views
from ..spec.settings import Settings
from .commands import COMMANDS
from .inspection import Checker
from .landmarks import Puller
from .renderer import Renderer, Request
from .session import PARTS, Session
from .tasks import Tasks
from .web.access import Access, Files
from .web.clients import MAX_SLOW, Client, packed_vertices, unpacked_vertices
from .web.player import Player
from .work.jobs import Jobs
from .work.uploads import loadable, shown

#: Bytes of a message and of a file that a page may send, and pages that may be connected.
MAX_MESSAGE, MAX_UPLOAD, MAX_PAGES = 4 << 20, 64 << 20, 32

#: Pixels of a picture's side.
MAX_SIDE = 4096

#: Seconds between looks at whether the session is saved.
SAVE_SECONDS = 1.0

#: What messages may cause, with values that are missing, wrong or huge, and files that are not as they should be.
EXPECTED = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, OSError, MemoryError)

#: Notice for a page that goes on with a step that has ended.
STRAYED = "Another page, or another command, changed the scene meanwhile: this move has ended."

_log = logging.getLogger(__name__)


class Server:
    """An editor's server; its methods run in the thread of its event loop, unless they say otherwise.
    `folder`: files that pages may load and that they make lie here. Port 0 takes a free one."""

    def __init__(
        self,
        session: Session,
        folder: pathlib.Path,
        host: str = "127.0.0.1",
        port: int = 0,
        allowed_hosts: tuple[str, ...] = (),
    ):
        self.session, self.folder, self.host, self.port = session, folder, host, port
        self.access = Access(host, allowed_hosts, session.path)
        self.token = self.access.token
        self.clients: dict[int, Client] = {}
        self.page_total = self.connected = 0  # pages that were ever let in, and connections of now
        self._sizer: Client | None = None
        self._mover: Client | None = None
        self.lookers: set[Client] = set()  # pages that turn the view
        self._changed: set[str] = set()
        self._flush: asyncio.Handle | None = None
        self._sent: dict[tuple[int, int], np.ndarray] = {}  # vertices that pages know, by kind and edit
        self._frame: tuple[int, bytes] | None = None

    async def start(self) -> str:
        """Begin to serve. Returns the address of the page; raises OSError where the port is taken."""
        self._loop = asyncio.get_running_loop()
        self.jobs = Jobs(self._on_job)
        self.tasks = Tasks(self.session, self.jobs, self.folder, self._loop)
        self.player = Player(self.session, lambda: self._on_change({"playback"}))
        self.checker = Checker(self.session, lambda: self._moving, lambda: self._on_change({"check"}))
        app = web.Application(middlewares=[self.access.guard], client_max_size=MAX_UPLOAD)
        app.router.add_get("/{token}/socket", self._socket)
        Files(self.tasks, MAX_UPLOAD).add_to(app)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await self._runner.setup()
        site = web.TCPSite(self._runner, self.host, self.port)
        try:
            await site.start()
        except BaseException:
            await self._runner.cleanup()
            raise
        assert self._runner.addresses
        self.port = self._runner.addresses[0][1]
        self.renderer = Renderer(self.session.fields, self._deliver)
        self.puller = Puller(self.session, self.renderer, lambda: self._on_change({"view"}))
        self.session.listeners.append(self._on_change)
        self.session.notify = self._notify
        self._saver = asyncio.create_task(self._save_often())
        self.checker.plan()
        return self.address

    @property
    def address(self) -> str:
        """The page's address, with the token."""
        host = "127.0.0.1" if self.host in ("0.0.0.0", "::", "") else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/{self.token}/"

    async def stop(self) -> None:
        """End all that goes on; the session is saved."""
        self.player.stop()
        self.tasks.close()
        self.puller.stop()
        self.session.end_gesture()
        self.session.listeners.remove(self._on_change)
        self._saver.cancel()
        slow = [task for client in self.clients.values() for task in client.slow]
        for task in slow:
            task.cancel()
        pages = [client.end() for client in self.clients.values()]
        await asyncio.gather(self._saver, self.checker.stop(), *slow, *pages, return_exceptions=True)
        await self._runner.cleanup()
        await self._loop.run_in_executor(None, self._stop_threads)

    def _stop_threads(self) -> None:
        self.renderer.close()
        self.jobs.close()
        self.tasks.uploads.close()
        self.session.save_changes()

    def _on_job(self) -> None:
        """A job changed; called from its thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._on_change, {"jobs"})

    # -- Pages

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if self.connected >= MAX_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{MAX_PAGES} pages are connected already: close one.")
        self.connected += 1
        try:
            socket = web.WebSocketResponse(timeout=2.0, max_msg_size=MAX_MESSAGE, heartbeat=20.0, compress=False)
            await socket.prepare(request)
            self.page_total += 1
            await self._serve(Client(self.page_total, socket), socket)
        finally:
            self.connected -= 1
        return socket

    async def _serve(self, client: Client, socket: web.WebSocketResponse) -> None:
        """Talk with a page until it goes."""
        names = ("session", *PARTS, "playback", "history", "check", "jobs")
        self.clients[client.number] = client
        sections = {name: self._section(name) for name in names}
        client.greet({"type": "hello", "client": client.number, "session": sections["session"], "sections": sections})
        if self._frame is not None:
            client.show(*self._frame)
        if self.session.lost:
            client.notice("warning", self.session.lost)
            self.session.lost = None
        self._on_change({"session"})
        writer = asyncio.create_task(client.write())
        try:
            async for message in socket:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    await client.keep_pace(len(message.data))
                    await self._take(client, message.data)
        finally:
            self._forget(client)
            writer.cancel()
            await asyncio.gather(writer, return_exceptions=True)

    def _forget(self, client: Client) -> None:
        """A page has gone. What it had moved stays."""
        del self.clients[client.number]
        self.session.end_gesture(client)
        self.lookers.discard(client)
        ended = asyncio.gather(*client.slow, return_exceptions=True)  # which may still take what it has sent
        ended.add_done_callback(lambda _: self.tasks.uploads.drop_of(client.number))
        if self._sizer is client:
            self._sizer = next((one for one in self.clients.values() if one.size is not None), None)
        if not self.clients:
            self.player.stop()
        self._on_change({"session", "view"})

    async def _take(self, client: Client, data: str | bytes) -> None:
        """Take one message of a page."""
        if isinstance(data, bytes):
            try:
                self._move(client, data)
                client.mistakes = 0
            except ValueError as error:
                await client.mistake(error_line(error, MAX_LINE, folders=False))
            return
        try:
            message = parsed_json(data)
            if not isinstance(message, dict) or not isinstance(message.get("do"), str):
                raise InputError('a message must be a dictionary with a command "do"')
            number = message.get("n")
            if number is not None:
                checked_whole(number, "n", 0, 2**53)
        except ValueError as error:
            await client.mistake(f"a message makes no sense: {error_line(error, MAX_LINE, folders=False)}")
            return
        try:
            result = self._obey(client, message)
            if asyncio.iscoroutine(result):
                self._go_on(client, number, result)
                return
            answer = {"result": result}
            client.mistakes = 0
        except Exception as error:
            answer = {"error": error_text(error)}
        if number is not None:
            client.send({"type": "reply", "n": number, **answer})
        elif "error" in answer:
            await client.mistake(answer["error"])

    def _go_on(self, client: Client, number: int | None, work: Coroutine[Any, Any, Any]) -> None:
        """Carry out what takes a while, and take further messages meanwhile."""

        async def answer() -> None:
            try:
                reply = {"type": "reply", "n": number, "result": await work}
            except Exception as error:
                reply = {"type": "reply", "n": number, "error": error_text(error)}
            if number is not None:
                client.send(reply)
            elif "error" in reply:
                client.notice("error", reply["error"])

        task = asyncio.create_task(answer())
        client.slow.add(task)
        task.add_done_callback(client.slow.discard)

    def _move(self, client: Client, data: bytes) -> None:
        """Vertices that are dragged."""
        kind, sequence, edit, vertices = unpacked_vertices(data)
        self._touched(client)
        self._mover = client
        try:
            moved = self.session.move(client, edit, vertices, rest=kind == 3)
            client.sequence = sequence
        finally:
            self._mover = None
        if not moved:
            self._stray(client)

    def _stray(self, client: Client) -> None:
        """A page goes on with a gesture that has ended, as another page changed something: say so once."""
        if not client.strayed:
            client.strayed = True
            client.notice("warning", STRAYED)

    def _obey(self, client: Client, message: dict[str, Any]) -> Any:
        """Carry out a page's command and return what its reply says, or a coroutine that does."""
        do, session = message["do"], self.session
        if do == "size":
            client.resize(message)
            self._touched(client)
            self._on_change({"view"})
            return None
        if do == "seen":
            client.saw(checked_whole(message["frame"], "frame", 0, 2**53))
            return None
        if do in self.tasks.commands:
            if len(client.slow) >= MAX_SLOW:
                raise InputError(f"{MAX_SLOW} commands of this page are under way already: wait for them")
            return self.tasks.handle(message)
        if do == "object.pick":
            return self._pick(message)
        if do == "camera.outside":
            return {"keys": len(framed_views(session.document, session.fields, message["aspect"]))}
        self._touched(client)
        if do == "view":
            self._look(client, message)
            return None
        if do != "play" and do not in ("settings", "select"):
            self.player.stop()
        if do == "camera.move":
            return session.move_camera(message)
        if do == "camera.frame":
            return session.frame_keys(message)
        if do in COMMANDS:
            session.run(message)
        elif do in ("drag.begin", "preset.begin", "place.begin"):
            self._begin(client, message)
        elif do == "place.set":
            self._place(client, message)
        elif do == "landmark.begin":
            client.strayed = False
            return self.puller.begin(client, message)
        elif do == "landmark.set":
            self._pull(client, message)
        elif do == "preset.set":
            if not session.move_preset(client, message):
                self._stray(client)
        elif do in ("drag.end", "preset.end", "place.end", "landmark.end"):
            cancel = checked_flag(message.get("cancel", False), "cancel")
            if not session.is_moved_by(client):
                raise InputError(STRAYED)
            if do == "landmark.end":
                return self.puller.end(client, cancel)
            session.end_gesture(client, cancel)
        elif do == "undo":
            return session.undo()
        elif do == "redo":
            return session.redo()
        elif do == "time":
            session.scrub(checked_number(message["time"], "time", 0.0, MAX_SECONDS))
        elif do == "play":
            if checked_flag(message["on"], "on"):
                self.player.play()
            else:
                self.player.stop()
        else:
            raise InputError(f"there is no command {do[:40]!r}")
        return None

    def _begin(self, client: Client, message: dict[str, Any]) -> None:
        """A drag of a cage or an object begins."""
        client.strayed = False
        if message["do"] == "place.begin":
            self.session.begin_placing(client, message["object"], checked_name(message.get("label", "move")))
            return
        edit = self.session.document.edit(message["edit"])
        if message["do"] == "drag.begin":
            self.session.begin_gesture(client, edit.id, checked_name(message.get("label", "move")))
            return
        given = message.get("vertices")
        chosen = None if given is None else checked_vertices(given, len(edit.rest))
        self.session.begin_gesture(client, edit.id, "preset", chosen)

    def _place(self, client: Client, message: dict[str, Any]) -> None:
        """An object is dragged."""
        if self.session.place(client, message["object"], message["matrix"]):
            client.sequence = checked_whole(message["seq"], "seq", 0, 2**32 - 1)
        else:
            self._stray(client)

    def _pull(self, client: Client, message: dict[str, Any]) -> None:
        """A landmark is dragged."""
        number = checked_whole(message["seq"], "seq", 0, 2**32 - 1)
        if not self.puller.set(client, message, lambda: setattr(client, "sequence", number)):
            self._stray(client)

    async def _pick(self, message: dict[str, Any]) -> dict[str, int | None]:
        """Which object a click meets, in the scene of the last picture."""
        across, down = (checked_number(message[name], name, 0.0, 1.0) for name in ("across", "down"))
        aspect, view = checked_number(message["aspect"], "aspect", 0.05, 20.0), self.session.document.view
        answer = self.renderer.ask(lambda scene: scene.object_at(view, across, down, aspect))
        return {"object": await asyncio.wrap_future(answer)}

    def _look(self, client: Client, message: dict[str, Any]) -> None:
        """A page looks from somewhere else."""
        view, moving = checked_view(message), checked_flag(message.get("moving", False), "moving")
        if "seq" in message:
            client.sequence = checked_whole(message["seq"], "seq", 0, 2**32 - 1)
        (self.lookers.add if moving else self.lookers.discard)(client)
        self.session.look(view)

    def _touched(self, client: Client) -> None:
        """The page that was touched last says how large pictures are, and what is behind the scene in them."""
        if client.size is not None:
            self._sizer = client

    # -- What changed

    def _notify(self, text: str) -> None:
        """Show a warning in all pages."""
        for client in self.clients.values():
            client.notice("warning", text)

    @property
    def _moving(self) -> bool:
        """Whether something is dragged, or the film plays."""
        return self.session.moving or self.player.playing

    @property
    def _edits(self) -> tuple[Edit, ...]:
        """The edits that pages know: those of the active object."""
        return self.session.document.edits_of(self.session.document.selection.object_id)

    def _on_change(self, names: set[str]) -> None:
        """Collect what changed until the loop is free again."""
        self._changed |= names
        if "vertices" in names:
            self._send_vertices()
        if names & {"edits", "vertices", "selection", "settings"}:
            self.checker.plan()
        if self._flush is None:
            self._flush = self._loop.call_soon(self._flush_changes)

    def _flush_changes(self) -> None:
        self._flush, changed, self._changed = None, self._changed, set()
        if changed & {"edits", "vertices", "settings", "view", "playback", "objects"}:
            self._request_picture()
        if not self.clients:
            return
        named = sorted(changed - {"vertices", "places"})
        sections = {name: json.dumps(self._section(name), allow_nan=False) for name in named}
        if "edits" in sections:
            self._sent = {key: array for edit in self._edits for key, array in _places(edit)}
        if sections:
            for client in self.clients.values():
                client.send_sections(sections)

    def _send_vertices(self) -> None:
        """Send the vertices that have moved, but not to the page that drags them."""
        for edit in self._edits:
            for (kind, number), array in _places(edit):
                if self._sent.get((kind, number)) is not array:
                    self._sent[kind, number] = array
                    message = packed_vertices(kind, number, array)
                    for client in self.clients.values():
                        if client is not self._mover:
                            client.send_vertices(kind, number, message)

    def _section(self, name: str) -> Any:
        session = self.session
        if name == "session":
            field = session.field
            count = {"voxels": field.voxel_count} if isinstance(field, VoxelField) else {"splats": field.splat_count}
            return {
                "name": session.path.name if session.path is not None else "not kept",
                "field": {
                    "name": session.field_path.name if session.field_path else "field",
                    "bounds": field.bounds.tolist(),
                }
                | {"up": [float(x) for x in field.up], "layers": field.background_model is not None, **count},
                "folder": str(self.folder),
                "device": str(field.device),
                "settings": schema(Settings, lambda option: option.label)["properties"],
                "easings": [[name, kind.label, kind.curve] for name, kind in EASING_KINDS.items()],
                "endings": loadable(),
                "saved": session.saved,
                "save_error": session.save_error,
                "pages": len(self.clients),
            }
        if name == "playback":
            now = {"time": session.document.time, "playing": self.player.playing}
            return now | {"unkeyed": not self.player.playing and session.unkeyed, "left": session.left_time}
        if name == "check":
            return self.checker.section
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
                self._moving or bool(self.lookers),
                {client.number: client.sequence for client in self.clients.values()},
                self._sizer.ground,
            )
        )

    def _deliver(self, header: dict[str, Any], message: bytes) -> None:
        """A frame is there; called from a thread of the renderer."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._show, header["frame"], message)

    def _show(self, number: int, message: bytes) -> None:
        self._frame = (number, message)
        self.player.picture_shown()
        for client in self.clients.values():
            client.show(number, message)

    # -- The session's file

    async def _save_often(self) -> None:
        session = self.session
        while True:
            await asyncio.sleep(SAVE_SECONDS)
            if session.unsaved_steps if self.player.playing else session.unsaved:
                path = session.path
                await self._loop.run_in_executor(None, session.save)
                if path is not None and session.path is not None and session.path != path:
                    text = (
                        f"{path.name} was changed by another program: this session is now kept in {session.path.name}"
                    )
                    self._notify(text)
                self._on_change({"session"})


def error_text(error: Exception) -> str:
    """A line on an error for a page. One that no input should cause is logged too."""
    line = shown(error_line(error, MAX_LINE, folders=False))
    if not isinstance(error, EXPECTED):
        _log.exception("a page's command failed", exc_info=error)
        return f"this went wrong in the editor: {type(error).__name__}: {line}"
    return line


def _places(edit: Edit) -> tuple[tuple[tuple[int, int], np.ndarray], ...]:
    """Vertices of an edit by kind of message and edit."""
    return ((2, edit.id), edit.posed), ((3, edit.id), edit.rest)
