"""What a session does with files, and work that takes a while, as jobs beside it."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import os
import pathlib
import threading
import urllib.parse
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from ...cage.cage import Cage
from ...cage.generate.focus import MAX_FINER
from ...cage.up_axis import UpAxis, load_standing
from ...core.checks import checked_flag, checked_number, checked_whole
from ...core.names import checked_choice, counted
from ...errors import InputError
from ...render.surface_mesh import SurfaceMesh
from ...select.selection import NodeSelection, visible_mask, visible_nodes
from ...splats.io import SPLAT_ENDINGS
from ...splats.splat_field import field_size
from ..films.checks import checked_id, checked_vertices
from ..films.document import Document, Step
from ..films.session import exports, timeline
from ..films.session.exports import requested_film
from ..films.session.session_file import ENDING, MAX_EXPORTS, Export, Stamp, file_stamp
from . import commands
from .objects import ObjectTasks, clicked
from .session import Session
from .steps.losses import losses
from .work.jobs import Cancelled, Jobs, Outcome, Progress
from .work.uploads import MAX_NAME_BYTES, Uploads, loadable, shown

#: Share of what is visible below which a click may have met a scrap of the object that was meant.
SMALL_SHARE = 0.005

#: What can be exported, and the endings of its files.
EXPORTS = {
    "mp4": (".mp4",),
    "mov": (".mov",),
    "webm": (".webm",),
    "gif": (".gif",),
    "png": ("",),
    "cage": exports.CAGE_ENDINGS,
    "poses": (".json",),
    "bake": (".npz", *SPLAT_ENDINGS),
}

#: Those of them that are films, or pictures of one.
FILMS = ("mp4", "gif", "mov", "webm", "png")

#: Files that are listed at most.
MAX_FILES = 1000

#: Vertices that a cage may be made with.
COUNTS = (8, 2000)

#: Largest margin of a generated cage, voxels.
MAX_MARGIN = 64.0

#: How often a cage is made anew because the scene has changed meanwhile, before all others must wait for it.
ATTEMPTS = 4

#: Seconds between looks at whether a drag has ended, or the editor is being closed.
LOOK_SECONDS = 0.1

Result = TypeVar("Result")


class Tasks:
    """Long work for a session, and its files. All in the thread of the server's loop, but for the work itself.
    `folder`: files that pages may load and that they make lie here; no name from a page leads out of it."""

    def __init__(self, session: Session, jobs: Jobs, folder: pathlib.Path, loop: asyncio.AbstractEventLoop):
        self.session, self.jobs, self.folder, self.loop = session, jobs, folder, loop
        self._made: dict[str, Stamp | None] = {}  # files that this editor wrote, by name, and may replace
        self.uploads = Uploads(folder, self.path_of)
        self._noting, self._closed = threading.Lock(), threading.Event()
        self.field_path = session.field_path
        self._list_exports()
        self.commands: dict[str, Callable[[dict[str, Any]], Any]] = {  # what `handle` carries out, by `do`
            "files": self._files,
            "upload.drop": lambda message: self.uploads.drop(message["file"]),
            "cage.generate": self._generate,
            "cage.simplify": self._simplify,
            "cage.load": self._load_cage,
            "pose.load": self._load_pose,
            "poses.load": self._load_poses,
            "poses.save": self._save_poses,
            "export": self._export,
            "export.command": self._export_command,
            "job.cancel": lambda message: self.jobs.cancel(checked_id(message["id"], "the number of a job")),
            "job.clear": self._clear_job,
            **ObjectTasks(self).commands,
        }

    def handle(self, message: dict[str, Any]) -> Any:
        """Carry out one of `commands`; returns its result, or a coroutine that does, where files are touched."""
        return self.commands[message["do"]](message)

    def close(self) -> None:
        """The editor ends: jobs no longer wait for their turn to change the scene."""
        self._closed.set()

    # -- Files

    def path_of(self, name: Any) -> pathlib.Path:
        """The path of a file in the session's folder by its name, which may not lead elsewhere, also not by a link."""
        if not isinstance(name, str) or not name or name != pathlib.PurePosixPath(name).name or "\\" in name:
            raise InputError(f"{str(name)[:100]!r}: use a name without folders, such as film.mp4")
        if name.startswith(".") or not name.isprintable():
            raise InputError(f"{name[:100]!r}: use a printable name that begins with no dot, such as film.mp4")
        path = self.folder / name
        if path.resolve().parent != self.folder.resolve():
            raise InputError(f"{name[:100]!r} is no file of the session's folder: it leads out of it")
        return path

    def download(self, name: str) -> pathlib.Path | None:
        """The path of a file that the editor made, by its name; None where there is no such file."""
        with contextlib.suppress(ValueError, OSError):
            if name in [export.name for export in self.session.exports] and (path := self.path_of(name)).is_file():
                return path
        return None

    async def _files(self, message: dict[str, Any]) -> dict[str, Any]:
        def look() -> list[dict[str, str]]:
            found = []
            for path in sorted(self.folder.iterdir()):
                kind = next((kind for kind, endings in loadable().items() if path.suffix.lower() in endings), None)
                if kind and path.is_file() and not path.name.startswith(".") and not path.name.endswith(ENDING):
                    found.append({"name": path.name, "kind": kind})
            return found[:MAX_FILES]

        return {"files": await self.read(look)}

    def note(self, path: pathlib.Path, text: str) -> Outcome:
        """Note a file or folder that was just written, with a line of what it is; returns what its job leaves."""
        with self._noting:
            if path.is_file():
                self._made[path.name] = file_stamp(path)
            others = [export for export in self.session.exports if export.name != path.name]
            self.session.exports = (*others, Export.of(path, text))[-MAX_EXPORTS:]
        return _outcome(path, text)

    def note_done(self, path: pathlib.Path, text: str) -> dict[str, str | None]:
        """`note`, for what needed no job: it is listed as one. Returns the reply to the page."""
        outcome = self.note(path, text)
        self.jobs.add(_title(path.name), outcome)
        return {"download": outcome.download}

    def _list_exports(self) -> None:
        """List what earlier runs wrote and what is still there."""
        for export in self.session.exports:
            with contextlib.suppress(ValueError, OSError):  # a name that leads elsewhere by now
                if export.is_there(path := self.path_of(export.name)):
                    self.jobs.add(_title(export.name), _outcome(path, export.text))

    def _clear_job(self, message: dict[str, Any]) -> None:
        """Take a job off the list, for good with what it wrote."""
        job = self.jobs.job(checked_id(message["id"], "the number of a job"))
        self.jobs.clear(job.id)
        if all(other["name"] != job.name for other in self.jobs.section()):
            with self._noting:
                exports = self.session.exports
                self.session.exports = tuple(export for export in exports if _title(export.name) != job.name)

    # -- Cages

    def _generate(self, message: dict[str, Any]) -> int:
        """A cage around what the field shows, for an edit or as a new one."""
        number = message.get("edit")
        if number is not None:
            self.session.document.edit(number)
        count = checked_whole(message.get("count", 100), "count", *COUNTS)
        method = checked_choice(message.get("method", "auto"), "method", ("auto", "shell", "voxel"))
        symmetry = _axis(message, "symmetry", ("x", "y", "z", "auto"))
        detail = checked_choice(message.get("detail", "even"), "detail", ("even", "parts"))
        faces = checked_choice(message.get("faces", "triangles"), "faces", ("triangles", "quads"))
        finer = checked_number(message.get("finer", 2.0), "finer", 1.0, MAX_FINER)
        focus = _focus(self.session.document, message.get("focus"))
        margin = message.get("margin")
        if margin is not None:
            margin = checked_number(margin, "margin", 0.0, MAX_MARGIN)
        document, field = self.session.document, self.session.active_field
        choose, owner = clicked(document, field, message.get("click")), document.selection.object_id

        def work(progress: Progress) -> Outcome:
            progress(None, "looks for the surface and draws a cage around it")
            around: Any = choose()
            make: Any = Cage.from_mesh if isinstance(around, SurfaceMesh) else Cage.from_field
            where = _onto(around, focus) if isinstance(focus, np.ndarray) else focus
            options = {"method": method, "symmetry": symmetry, "detail": detail, "focus": where, "finer": finer}
            cage = make(around, count, margin=margin, faces=faces, **options)
            progress(0.95, "adds it to the scene")
            self._apply(lambda document: commands.with_cage(document, number, cage, "generate cage", owner))
            return Outcome(f"a cage of {len(cage.vertices)} vertices{_around(around)}")

        return self.jobs.start(f"Cage of {count} vertices", "cage", work)

    def _simplify(self, message: dict[str, Any]) -> int:
        edit = self.session.document.edit(message["edit"])
        if len(edit.rest) <= COUNTS[0]:
            raise InputError(f"this cage has {len(edit.rest)} vertices: it cannot be made simpler")
        count = checked_whole(message["count"], "count", COUNTS[0], min(COUNTS[1], len(edit.rest) - 1))

        def work(progress: Progress) -> Outcome:
            progress(None, "joins faces")
            cage = edit.rest_cage.simplify(count)
            progress(0.9, "carries the pose over")
            self._apply(lambda document: commands.replace_cage(document, edit.id, cage, "simplify"))
            return Outcome(f"{len(cage.vertices)} vertices")

        return self.jobs.start(f"Simplify {edit.name}", "cage", work)

    async def _load_cage(self, message: dict[str, Any]) -> None:
        """A cage from a file, for an edit or as a new one."""
        path, number = self.uploads.find(message["file"]), message.get("edit")
        field, owner = self.session.active_field, self.session.document.selection.object_id
        up = _axis(message, "up", ("y", "z"))
        if number is not None:
            self.session.document.edit(number)

        def load() -> tuple[Cage, UpAxis]:
            cage, standing = load_standing(Cage, path, up=up, reference=field, anywhere=True)
            cage.require_usable(f"cage {shown(path.name)!r}")
            return cage, standing

        cage, standing = await self.read(load)
        with self.uploads.taken(path) as kept:
            label = _loaded(kept, standing)
            await self.change(lambda document: commands.with_cage(document, number, cage, label, owner))

    async def _load_pose(self, message: dict[str, Any]) -> None:
        """A posed cage from a file, in any order that `Cage.match` takes."""
        path = self.uploads.find(message["file"])
        edit = self.session.document.edit(message.get("edit", self.session.document.selection.edit))
        up = _axis(message, "up", ("y", "z"))
        loaded, standing = await self.read(lambda: load_standing(Cage, path, up=up, reference=edit.rest_cage))

        def pose(document: Document) -> Step:
            now = document.edit(edit.id)
            content = {"edit": now.id, "vertices": now.rest_cage.match(loaded).vertices}
            return _loaded(kept, standing), commands.set_pose(document, content)[1]

        with self.uploads.taken(path) as kept:
            await self.change(pose)

    async def _load_poses(self, message: dict[str, Any]) -> None:
        path = self.uploads.find(message["file"])
        document = self.session.document
        number = document.edit(message.get("edit", document.selection.edit)).id
        await self.read(lambda: timeline.load_poses(document, number, str(path)))  # taken once it was read
        with self.uploads.taken(path) as kept:
            await self.change(lambda now: (f"load {kept.name}", timeline.load_poses(now, number, str(kept))))

    async def _save_poses(self, message: dict[str, Any]) -> dict[str, str | None]:
        path = self.free_path(message["file"], (".json",))
        document = self.session.document
        number = document.edit(message.get("edit", document.selection.edit)).id
        await self.read(lambda: timeline.pose_file(document, number).save(self.free_path(path.name, (".json",))))
        return self.note_done(path, path.name)

    # -- Exports

    def free_path(self, name: Any, endings: tuple[str, ...]) -> pathlib.Path:
        """The path of a file or folder to write; what the editor did not write itself is never replaced."""
        path = self.path_of(name)
        if len(os.fsencode(path.name)) > 2 * MAX_NAME_BYTES:
            raise InputError(f"{path.name[:40]!r}... is too long for the name of a file")
        if path.name.lower().endswith(ENDING):
            raise InputError(f"{path.name!r} is the name of a session's file: give another name")
        if path.suffix.lower() not in endings:
            raise InputError(f"{path.name!r} must end in {' or '.join(endings) if any(endings) else 'no ending'}")
        if os.path.lexists(path) and not (path.name in self._made and self._made[path.name] == file_stamp(path)):
            raise InputError(f"{path.name!r} is there already: give another name")
        return path

    def _export(self, message: dict[str, Any]) -> int:
        """Write a film, a cage, poses or a baked field into the session's folder."""
        document, what = self.session.document, checked_choice(message["what"], "what", tuple(EXPORTS))
        path = self.free_path(message["file"], EXPORTS[what])
        number = message.get("edit", document.selection.edit)
        if what in ("cage", "poses"):
            number = document.edit(number).id
        rest = checked_flag(message.get("rest", False), "rest")
        film = requested_film(message) if what in FILMS else None

        def work(progress: Progress) -> Outcome:
            self.free_path(path.name, EXPORTS[what])  # it may have waited for others
            text = path.name
            with self.uploads.unfinished(path) as written:
                if film is not None:
                    count = exports.export_film(document, self.session.fields, written, film, progress)
                    text += f": {counted(count, 'frame')} of {film.width}x{film.height}"
                elif what == "bake":
                    baked = exports.export_baked(document, self.session.fields, written, progress)
                    text += f": a scene file of {field_size(baked)}"
                elif what == "cage":
                    exports.export_cage(document, number, written, rest=rest)
                    text += f": a cage of {len(document.edit(number).rest)} vertices"
                else:
                    exports.export_poses(document, number, written)
            return self.note(path, text)

        return self.jobs.start(_title(path.name), "film" if film or what == "bake" else "file", work)

    async def _export_command(self, message: dict[str, Any]) -> dict[str, str]:
        """The command line that makes the film of the session as it is, which is saved for it."""
        session = self.session
        if session.path is None or self.field_path is None:
            raise InputError("a scene without a file has no command line: export the film here")
        film, output = requested_film(message), message.get("file") or "film.mp4"
        if not isinstance(output, str) or not output.isprintable():
            raise InputError("file must be the name of a film")
        await self.read(session.save)
        if session.save_error:
            raise InputError(f"the session could not be saved: {session.save_error}")
        line = exports.export_command(
            session.path, self.field_path, film, output=output, scene_scale=session.scene_scale
        )
        return {"command": line}

    async def read(self, read: Callable[[], Result]) -> Result:
        """Work with files, in another thread so that pages are served meanwhile."""
        return await self.loop.run_in_executor(None, read)

    async def change(self, step: Callable[[Document], Step]) -> None:
        """Change the document by what takes long, in another thread."""
        await self.read(lambda: self._apply(step, patient=False))

    def _apply(self, step: Callable[[Document], Step], patient: bool = True) -> None:
        """Change the document from another thread; raises what the change raises, or Cancelled.
        `patient`: wait for a drag to end; otherwise it ends now."""
        # Made here, so that the server's loop goes on meanwhile; and anew where the scene has changed since.
        for _ in range(ATTEMPTS):
            before = self.session.settled
            label, made = step(before)
            adopt = functools.partial(self.session.adopt, before, label, made, losses(before, made))
            if self._in_loop(adopt, patient):
                return
        self._in_loop(functools.partial(self.session.change, step), patient)

    def _in_loop(self, function: Callable[[], Result], patient: bool) -> Result:
        """Call a function in the loop's thread, if patient once nothing is dragged, and wait for its result."""
        done: concurrent.futures.Future[Result] = concurrent.futures.Future()

        def apply() -> None:
            if self._closed.is_set():
                done.cancel()
            elif patient and self.session.moving:
                self.loop.call_later(LOOK_SECONDS, apply)
            elif done.set_running_or_notify_cancel():
                try:
                    done.set_result(function())
                except BaseException as error:  # goes on in the other thread
                    done.set_exception(error)

        try:
            self.loop.call_soon_threadsafe(apply)
        except RuntimeError:  # the loop has ended
            raise Cancelled from None
        while True:
            try:
                return done.result(LOOK_SECONDS)
            except concurrent.futures.CancelledError:
                raise Cancelled from None
            except concurrent.futures.TimeoutError:
                if done.done() and not done.cancelled():
                    return done.result()  # it came just now, or is a TimeoutError of the function itself
                if self._closed.is_set():
                    done.cancel()  # the loop may have ended


def _title(name: str) -> str:
    """What the job that writes a file is called."""
    return f"Write {name}"


def _outcome(path: pathlib.Path, text: str) -> Outcome:
    """What writing a file leaves: a line, and its address; of a folder, where it is."""
    if path.is_dir():
        return Outcome(f"{text}, in {path}")
    return Outcome(text, f"download/{urllib.parse.quote(path.name)}")


def _loaded(path: pathlib.Path, standing: UpAxis) -> str:
    """What loading a cage is called, with the axis that points up in its file where that was found out."""
    return f"load {path.name}" + (f" ({standing.up} up)" if standing.turned else "")


def _around(chosen: Any) -> str:
    """How much of what is visible a cage of a click goes around, as text; empty where that is all."""
    if not isinstance(chosen, NodeSelection):
        return ""
    share = np.count_nonzero(chosen.mask) / np.count_nonzero(visible_mask(chosen.field))
    more = ": undo it and paint over the object with the brush if that is too little" if share < SMALL_SHARE else ""
    return f" around {share:.1%} of what is visible{more}"


def _focus(document: Document, given: Any) -> list[Cage] | np.ndarray | None:
    """Where a new cage has shorter edges: where the poses of an edit bend it, or about vertices of it, at rest."""
    if given is None:
        return None
    if not isinstance(given, dict) or "edit" not in given:
        raise InputError("a focus must be {edit, vertices} or the {edit} whose poses bend it")
    edit = document.edit(given["edit"])
    if edit.object_id != document.selection.object_id:
        raise InputError(f"{edit.name!r} is of another object than the cage: its focus must be of the same")
    cage, moved = edit.rest_cage, [edit.posed]
    if "vertices" not in given:
        moved += [key.poses[edit.id] for key in document.timeline.keys if key.poses and edit.id in key.poses]
        return [cage, *map(cage.with_vertices, moved)]
    chosen = np.array(checked_vertices(given["vertices"], len(edit.rest)), dtype=np.int64)
    if not len(chosen):
        raise InputError("nothing is selected: select the vertices about which the new cage shall be finer")
    between = cage.edges[np.isin(cage.edges, chosen).all(axis=1)]
    return np.concatenate([edit.rest[chosen], edit.rest[between].mean(axis=1)])


def _onto(around: Any, points: np.ndarray) -> np.ndarray:
    """The points of an object that are nearest to those of a cage (n, 3), which lie off it."""
    from scipy.spatial import KDTree

    places = np.asarray(around.vertices) if isinstance(around, SurfaceMesh) else visible_nodes(around)
    return places[KDTree(places).query(points)[1]] if len(places) else points


def _axis(message: dict[str, Any], name: str, axes: tuple[str, ...]) -> str | None:
    """The axis of this name in a message, or None."""
    axis = message.get(name)
    return None if axis is None else checked_choice(axis, name, axes)
