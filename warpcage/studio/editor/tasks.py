"""Work that takes a while, beside the session: jobs with progress that can be cancelled."""

from __future__ import annotations

import asyncio
import collections
import concurrent.futures
import contextlib
import dataclasses
import functools
import logging
import os
import pathlib
import re
import threading
import time
import urllib.parse
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from ...cage.cage import Cage
from ...cage.up_axis import UpAxis, load_standing
from ...core.files import atomic_path
from ...core.names import counted, error_line
from ...errors import InputError
from ...mesh.io import ENDINGS
from ...render.surface_mesh import SurfaceMesh
from ...select.selection import NodeSelection, visible_mask
from ...splats.io import SPLAT_ENDINGS
from ...splats.splat_field import field_size
from . import commands, exports, timeline
from .checks import checked_between, checked_choice, checked_flag, checked_id, checked_whole
from .commands import Step
from .document import Document
from .exports import requested_film
from .session import ENDING, Session, Stamp, file_stamp
from .steps.losses import losses
from .things import ThingTasks, clicked

#: Jobs that are kept, finished ones included, and jobs that may wait or run at once.
MAX_JOBS, MAX_UNFINISHED = 40, 12

#: Letters of a failed job's line, and of what a job says of its progress.
MAX_TEXT = 400

#: Share of what is visible below which a click may have met a scrap of the object that was meant.
SMALL_SHARE = 0.005

_log = logging.getLogger(__name__)


class Cancelled(Exception):
    """Raised inside a job's work, at its next sign of progress, once somebody has cancelled the job."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a job leaves: a line, and the address of the file that it wrote, if any."""

    text: str | None = None
    download: str | None = None


@dataclasses.dataclass(frozen=True)
class Job:
    """A job as pages see it."""

    id: int  # that no other job of the session has had
    name: str
    share: float | None = None  # how much of it is done, 0 to 1; None is not known
    text: str = ""  # what is done right now
    state: str = "running"  # "running" (or waiting for others of its kind), "done", "failed" or "cancelled"
    download: str | None = None  # address of the file that came of it
    result: str | None = None  # what came of it or went wrong, in one line


class Progress:
    """What a job's work calls between its steps; `report` takes share and text of what has changed."""

    def __init__(self, report: Callable[[float | None, str], None]):
        self._report = report
        self._cancelled = threading.Event()

    def __call__(self, share: float | None, text: str = "") -> None:
        """Say how far the work is, 0 to 1 (None is not known), and what is done next; raises Cancelled if the job was.
        Work lets it pass, after it has removed what is half written."""
        if self._cancelled.is_set():
            raise Cancelled
        self._report(None if share is None else min(max(float(share), 0.0), 1.0), text[:MAX_TEXT])

    def cancel(self) -> None:
        """Make the next call raise."""
        self._cancelled.set()

    @property
    def cancelled(self) -> bool:
        """Whether the job was cancelled."""
        return self._cancelled.is_set()


#: What a job does.
Work = Callable[[Progress], Outcome | None]


class Jobs:
    """Jobs of a session, one at a time of each kind. All methods may be called from any thread.
    `listener` is called after each change, from the thread that made it."""

    def __init__(self, listener: Callable[[], None] = lambda: None):
        self._listener = listener
        self._lock = threading.Lock()
        self._jobs: dict[int, Job] = {}
        self._progress: dict[int, Progress] = {}  # of jobs that are not finished
        self._waiting: dict[str, collections.deque[tuple[int, Work]]] = {}  # by kind, while it has a thread
        self._threads: list[threading.Thread] = []
        self._next, self._closed = 1, False

    def start(self, name: str, kind: str, work: Work) -> int:
        """Begin a job in a thread, or let it wait for those of its kind that came before; returns its number."""
        with self._lock:
            if self._closed:
                raise InputError("the session is closing: nothing new is begun")
            if len(self._progress) >= MAX_UNFINISHED:
                raise InputError(f"{MAX_UNFINISHED} jobs are unfinished already: cancel one, or wait")
            number = self._next
            self._next += 1
            self._jobs[number] = Job(number, name)
            self._progress[number] = Progress(lambda share, text: self._change(number, share=share, text=text))
            for old in [old for old in self._jobs if old not in self._progress]:
                if len(self._jobs) > MAX_JOBS:
                    del self._jobs[old]
            if kind in self._waiting:
                self._jobs[number] = dataclasses.replace(self._jobs[number], text="waits for the one before")
                self._waiting[kind].append((number, work))
            else:
                self._waiting[kind] = collections.deque([(number, work)])
                thread = threading.Thread(target=self._run_kind, args=(kind,), name=f"warpcage {kind}", daemon=True)
                self._threads = [one for one in self._threads if one.is_alive()] + [thread]
                thread.start()
        self._tell()
        return number

    def section(self) -> list[dict[str, Any]]:
        """The jobs as pages see them, the oldest first: dictionaries of the fields of Job."""
        with self._lock:
            return [dataclasses.asdict(job) for job in self._jobs.values()]

    def job(self, number: int) -> Job:
        """A job by its number. Raises ValueError where there is none."""
        with self._lock:
            return self._job(number)

    def cancel(self, number: int) -> None:
        """Ask a job to stop: one that waits does at once, one that runs at its next sign of progress."""
        with self._lock:
            job = self._job(number)
            if number not in self._progress:
                return
            self._progress[number].cancel()
            for queue in self._waiting.values():
                for entry in [entry for entry in queue if entry[0] == number]:
                    queue.remove(entry)
                    self._finish(number, state="cancelled", text="")
                    break
            if number in self._progress:
                self._jobs[number] = dataclasses.replace(job, text="is being cancelled")
        self._tell()

    def clear(self, number: int) -> None:
        """Forget a finished job."""
        with self._lock:
            if self._job(number).state == "running":
                raise InputError("the job is still running: cancel it first")
            del self._jobs[number]
        self._tell()

    def close(self, timeout: float = 10.0) -> bool:
        """Cancel all jobs, begin none, and wait so many seconds for their threads; returns whether all have ended."""
        with self._lock:
            self._closed = True
            numbers = list(self._progress)
        for number in numbers:
            self.cancel(number)
        return self.wait(timeout)

    def wait(self, timeout: float) -> bool:
        """Wait, so many seconds at most, until no job is left to run; returns whether all threads have ended."""
        end = time.monotonic() + timeout
        with self._lock:
            threads = list(self._threads)
        for thread in threads:
            thread.join(max(0.0, end - time.monotonic()))
        return not any(thread.is_alive() for thread in threads)

    def _job(self, number: int) -> Job:
        if number not in self._jobs:
            raise InputError(f"there is no job {number!r}: it may have been cleared")
        return self._jobs[number]

    def _run_kind(self, kind: str) -> None:
        """Run the jobs of a kind until none is left."""
        while True:
            with self._lock:
                queue = self._waiting[kind]
                if not queue:
                    del self._waiting[kind]
                    return
                number, work = queue.popleft()
                progress = self._progress[number]
                self._jobs[number] = dataclasses.replace(self._jobs[number], text="")
            self._run(number, work, progress)

    def _run(self, number: int, work: Work, progress: Progress) -> None:
        try:
            outcome = work(progress) or Outcome()
            changes = {"state": "done", "share": 1.0, "result": outcome.text, "download": outcome.download}
        except Cancelled:
            changes = {"state": "cancelled"}
        except (ValueError, OSError, MemoryError) as error:  # what a person's input or machine can cause
            changes = {"state": "failed", "result": error_line(error, MAX_TEXT)}
        except BaseException as error:  # also what calls itself an exit: it would be lost in a thread
            _log.exception("job %s failed", number)
            changes = {"state": "failed", "result": error_line(error, MAX_TEXT, named=True)}
        with self._lock:
            self._finish(number, text="", **changes)
        self._tell()

    def _finish(self, number: int, **changes: Any) -> None:
        """Note how a job ended. Needs the lock."""
        del self._progress[number]
        self._jobs[number] = dataclasses.replace(self._jobs[number], **changes)

    def _change(self, number: int, share: float | None, text: str) -> None:
        """Note how far a job is, and tell of it where a page would show the difference."""
        with self._lock:
            before = self._jobs[number]
            self._jobs[number] = dataclasses.replace(before, share=share, text=text)
        if text != before.text or _percent(share) != _percent(before.share):
            self._tell()

    def _tell(self) -> None:
        try:
            self._listener()
        except Exception:  # the work goes on whether or not somebody hears of it
            _log.exception("a listener of jobs failed")


def _percent(share: float | None) -> int | None:
    return None if share is None else int(100 * share)


#: Endings of files that pages may load, and what is in them.
LOADABLE = {
    ".npz": "field",
    **{pathlib.Path(f"x{ending}").suffix: "field" for ending in SPLAT_ENDINGS if ending},
    **dict.fromkeys(ENDINGS, "cage"),
    ".json": "poses",
}

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

#: Bytes of an uploaded file's name.
MAX_NAME_BYTES = 120

#: Vertices that a cage may be made with.
COUNTS = (8, 2000)

#: Largest margin of a generated cage, voxels.
MAX_MARGIN = 64.0

#: How often a cage is made anew because somebody has changed the scene meanwhile, before all others must wait for it.
ATTEMPTS = 4

#: Seconds between looks at whether the hand has come to rest, or the editor is being closed.
LOOK_SECONDS = 0.1

Result = TypeVar("Result")


class Tasks:
    """Long work for a session, and its files. All in the thread of the server's loop, but for the work itself.
    `folder`: files that pages may load and that they make lie here; no name from a page leads out of it."""

    def __init__(self, session: Session, jobs: Jobs, folder: pathlib.Path, loop: asyncio.AbstractEventLoop):
        self.session, self.jobs, self.folder, self.loop = session, jobs, folder, loop
        self._made: dict[str, Stamp | None] = {}  # files that the editor wrote, by name
        self._naming, self._closed = threading.Lock(), threading.Event()
        self.field_path = session.field_path
        self.commands: dict[str, Callable[[dict[str, Any]], Any]] = {  # what `handle` carries out, by `do`
            "files": self._files,
            "cage.generate": self._generate,
            "cage.simplify": self._simplify,
            "cage.load": self._load_cage,
            "pose.load": self._load_pose,
            "poses.load": self._load_poses,
            "poses.save": self._save_poses,
            "export": self._export,
            "export.command": self._export_command,
            "job.cancel": lambda message: self.jobs.cancel(checked_id(message["id"], "the number of a job")),
            "job.clear": lambda message: self.jobs.clear(checked_id(message["id"], "the number of a job")),
            **ThingTasks(self).commands,
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
            if name in self._made and (path := self.path_of(name)).is_file():
                return path
        return None

    async def _files(self, message: dict[str, Any]) -> dict[str, Any]:
        def look() -> list[dict[str, str]]:
            found = []
            for path in sorted(self.folder.iterdir()):
                kind = LOADABLE.get(path.suffix.lower())
                if kind and path.is_file() and not path.name.startswith(".") and not path.name.endswith(ENDING):
                    found.append({"name": path.name, "kind": kind})
            return found[:MAX_FILES]

        return {"files": await self.read(look)}

    def keep_upload(self, name: str, content: bytes) -> str:
        """Write an uploaded file into the session's folder, where it replaces none; returns the name that it got."""
        plain = re.sub(r"[^\w.\- ]", "_", pathlib.PurePosixPath(name.replace("\\", "/")).name).lstrip(". ")
        stem, ending = os.path.splitext(plain)
        if ending.lower() not in LOADABLE or plain.lower().endswith(ENDING):
            raise InputError(f"{plain[:100]!r} is not a cage, pose or scene file; takes {' '.join(LOADABLE)}")
        stem = stem.encode()[:MAX_NAME_BYTES].decode(errors="ignore")
        with self._naming:  # two pages may send files of one name
            number, path = 1, self.path_of(stem + ending)
            while os.path.lexists(path):
                number += 1
                path = self.path_of(f"{stem}-{number}{ending}")
            with atomic_path(path) as temporary:
                temporary.write_bytes(content)
        return path.name

    # -- Cages

    def _generate(self, message: dict[str, Any]) -> int:
        """A cage around what the field shows, for an edit or as a new one."""
        number = message.get("edit")
        if number is not None:
            self.session.document.edit(number)
        count = checked_whole(message.get("count", 100), *COUNTS, "count")
        method = checked_choice(message.get("method", "auto"), ("auto", "shell", "voxel"), "method")
        symmetry = _axis(message, "symmetry", ("x", "y", "z"))
        margin = message.get("margin")
        if margin is not None:
            margin = checked_between(margin, 0.0, MAX_MARGIN, "margin")
        document, field = self.session.document, self.session.active_field
        choose, thing = clicked(document, field, message.get("click")), document.selection.thing

        def work(progress: Progress) -> Outcome:
            progress(None, "looks for the surface and draws a cage around it")
            around: Any = choose()
            make: Any = Cage.from_mesh if isinstance(around, SurfaceMesh) else Cage.from_field
            cage = make(around, count, margin=margin, method=method, symmetry=symmetry)
            progress(0.95, "adds it to the scene")
            self._hand_over(lambda document: commands.with_cage(document, number, cage, "generate cage", thing))
            return Outcome(f"a cage of {len(cage.vertices)} vertices{_around(around)}")

        return self.jobs.start(f"Cage of {count} vertices", "cage", work)

    def _simplify(self, message: dict[str, Any]) -> int:
        edit = self.session.document.edit(message["edit"])
        if len(edit.rest) <= COUNTS[0]:
            raise InputError(f"this cage has {len(edit.rest)} vertices: it cannot be made simpler")
        count = checked_whole(message["count"], COUNTS[0], min(COUNTS[1], len(edit.rest) - 1), "count")

        def work(progress: Progress) -> Outcome:
            progress(None, "joins faces")
            cage = edit.rest_cage.simplify(count)
            progress(0.9, "carries the pose over")
            self._hand_over(lambda document: commands.replace_cage(document, edit.id, cage, "simplify"))
            return Outcome(f"{len(cage.vertices)} vertices")

        return self.jobs.start(f"Simplify {edit.name}", "cage", work)

    async def _load_cage(self, message: dict[str, Any]) -> None:
        """A cage from a file, for an edit or as a new one."""
        path, number = self.path_of(message["file"]), message.get("edit")
        field, thing = self.session.active_field, self.session.document.selection.thing
        up = _axis(message, "up", ("y", "z"))
        if number is not None:
            self.session.document.edit(number)

        def load() -> tuple[Cage, UpAxis]:
            cage, standing = load_standing(Cage, path, up=up, reference=field, anywhere=True)
            cage.require_usable(f"cage {path.name!r}")
            return cage, standing

        cage, standing = await self.read(load)
        await self.change(lambda document: commands.with_cage(document, number, cage, _loaded(path, standing), thing))

    async def _load_pose(self, message: dict[str, Any]) -> None:
        """A posed cage from a file, in any order that `Cage.match` takes."""
        path = self.path_of(message["file"])
        edit = self.session.document.edit(message.get("edit", self.session.document.selection.edit))
        up = _axis(message, "up", ("y", "z"))
        loaded, standing = await self.read(lambda: load_standing(Cage, path, up=up, reference=edit.rest_cage))

        def pose(document: Document) -> Step:
            now = document.edit(edit.id)
            content = {"edit": now.id, "vertices": now.rest_cage.match(loaded).vertices}
            return _loaded(path, standing), commands.set_pose(document, content)[1]

        await self.change(pose)

    async def _load_poses(self, message: dict[str, Any]) -> None:
        path = self.path_of(message["file"])
        document = self.session.document
        number = document.edit(message.get("edit", document.selection.edit)).id
        await self.change(lambda document: (f"load {path.name}", timeline.load_poses(document, number, str(path))))

    async def _save_poses(self, message: dict[str, Any]) -> dict[str, str]:
        path = self.free_path(message["file"], (".json",))
        document = self.session.document
        number = document.edit(message.get("edit", document.selection.edit)).id
        await self.read(lambda: timeline.pose_file(document, number).save(self.free_path(path.name, (".json",))))
        return {"download": self.note(path)}

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
        document, what = self.session.document, checked_choice(message["what"], tuple(EXPORTS), "what")
        path = self.free_path(message["file"], EXPORTS[what])
        number = message.get("edit", document.selection.edit)
        if what in ("cage", "poses"):
            number = document.edit(number).id
        rest = checked_flag(message.get("rest", False), "rest")
        film = requested_film(message) if what in FILMS else None

        def work(progress: Progress) -> Outcome:
            self.free_path(path.name, EXPORTS[what])  # it may have waited for others
            if film is not None:
                count = exports.export_film(document, self.session.fields, path, film, progress)
                text = f"{path.name}: {counted(count, 'frame')} of {film.width}x{film.height}"
            elif what == "bake":
                baked = exports.export_baked(document, self.session.fields, path, progress)
                text = f"{path.name}: a scene file of {field_size(baked)}"
            elif what == "cage":
                exports.export_cage(document, number, path, rest=rest)
                text = f"{path.name}: a cage of {len(document.edit(number).rest)} vertices"
            else:
                exports.export_poses(document, number, path)
                text = path.name
            if path.is_dir():
                return Outcome(f"{text}, in {path}")
            return Outcome(text, self.note(path))

        return self.jobs.start(f"Write {path.name}", "film" if film or what == "bake" else "file", work)

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

    def note(self, path: pathlib.Path) -> str:
        """Note that the editor wrote a file. Returns its address."""
        self._made[path.name] = file_stamp(path)
        return f"download/{urllib.parse.quote(path.name)}"

    async def read(self, read: Callable[[], Result]) -> Result:
        """Work with files, in another thread so that pages are served meanwhile."""
        return await self.loop.run_in_executor(None, read)

    async def change(self, step: Callable[[Document], Step]) -> None:
        """Change the document by what takes long, in another thread."""
        await self.read(lambda: self._hand_over(step, patient=False))

    def _hand_over(self, step: Callable[[Document], Step], patient: bool = True) -> None:
        """Change the document from another thread; raises what the change raises, or Cancelled.
        `patient`: wait for a hand that moves; otherwise its gesture ends."""
        # Made here, so that the server's loop goes on meanwhile; and anew where somebody has changed the scene since.
        for _ in range(ATTEMPTS):
            before = self.session.settled
            label, made = step(before)
            adopt = functools.partial(self.session.adopt, before, label, made, losses(before, made))
            if self._in_loop(adopt, patient):
                return
        self._in_loop(functools.partial(self.session.change, step), patient)

    def _in_loop(self, function: Callable[[], Result], patient: bool) -> Result:
        """Call a function in the loop's thread, if patient once no hand moves, and wait for its result."""
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


def _loaded(path: pathlib.Path, standing: UpAxis) -> str:
    """What loading a cage is called, with the axis that points up in its file where that was found out."""
    return f"load {path.name}" + (f" ({standing.up} up)" if standing.turned else "")


def _around(chosen: Any) -> str:
    """How much of what is visible a cage of a click goes around, in words; nothing of one that goes around all."""
    if not isinstance(chosen, NodeSelection):
        return ""
    share = np.count_nonzero(chosen.mask) / np.count_nonzero(visible_mask(chosen.field))
    more = ": undo it and paint over the object with the brush if that is too little" if share < SMALL_SHARE else ""
    return f" around {share:.1%} of what is visible{more}"


def _axis(message: dict[str, Any], word: str, axes: tuple[str, ...]) -> str | None:
    """The axis that a word of a message names; None where it has no such word."""
    axis = message.get(word)
    return None if axis is None else checked_choice(axis, axes, word)
