"""Tasks: what a page asks for that takes longer or touches files: cages, uploads, exports."""

from __future__ import annotations

import asyncio
import concurrent.futures
import pathlib
import re
import urllib.parse
from collections.abc import Callable
from typing import Any

from ..cage.cage import Cage
from ..core.files import atomic_path
from ..mesh.files.files import ENDINGS
from . import commands, exports, timeline
from .checked import checked_choice, checked_whole
from .document import Document
from .jobs import Jobs, Outcome, Progress
from .session import Session

#: Endings of files that pages may load, and what is in them.
LOADABLE = {**dict.fromkeys(ENDINGS, "cage"), ".json": "poses", ".npz": "field"}

#: What can be exported, and the endings of its files.
EXPORTS = {
    "mp4": (".mp4",),
    "gif": (".gif",),
    "png": ("",),
    "cage": exports.CAGE_ENDINGS,
    "poses": (".json",),
    "bake": (".npz",),
}

#: Files that are listed at most.
MAX_FILES = 1000


class Tasks:
    """Long work for a session, and its files. All in the thread of the server's loop, but for the work itself.

    Args:
        session: The session.
        jobs: Runs the work.
        folder: Files that pages may load and that they make lie here; no name from a page leads out of it.
        loop: The server's loop.

    Attributes:
        commands: What `obey` carries out, by the word in `do`.
        downloads: Files that exports made, by the last part of their address.
    """

    def __init__(self, session: Session, jobs: Jobs, folder: pathlib.Path, loop: asyncio.AbstractEventLoop):
        self.session, self.jobs, self.folder, self.loop = session, jobs, folder, loop
        self.downloads: dict[str, pathlib.Path] = {}
        self.field_path = session.field_path
        self.commands: dict[str, Callable[[dict[str, Any]], Any]] = {
            "files": self._files,
            "cage.generate": self._generate,
            "cage.simplify": self._simplify,
            "cage.load": self._load_cage,
            "pose.load": self._load_pose,
            "poses.load": self._load_poses,
            "poses.save": self._save_poses,
            "export": self._export,
            "export.command": self._export_command,
            "job.cancel": lambda message: self.jobs.cancel(message["id"]),
            "job.clear": lambda message: self.jobs.clear(message["id"]),
        }

    async def obey(self, message: dict[str, Any]) -> Any:
        """Carry out one of `commands`. Raises ValueError or OSError in one line."""
        result = self.commands[message["do"]](message)
        return await result if asyncio.iscoroutine(result) else result

    # -- Files

    def path_of(self, name: Any) -> pathlib.Path:
        """The path of a file in the session's folder.

        Args:
            name: Its name, without folders.

        Returns:
            The path.

        Raises:
            ValueError: For a name that leads elsewhere, also by a link.
        """
        if not isinstance(name, str) or not name or name != pathlib.PurePosixPath(name).name or "\\" in name:
            raise ValueError(f"{str(name)[:100]!r} is no name of a file in the session's folder")
        path = self.folder / name
        if name.startswith(".") or "\0" in name or path.resolve().parent != self.folder.resolve():
            raise ValueError(f"{name[:100]!r} is no file of the session's folder")
        return path

    def _files(self, message: dict[str, Any]) -> dict[str, Any]:
        found = []
        for path in sorted(self.folder.iterdir()):
            kind = LOADABLE.get(path.suffix.lower())
            if kind and path.is_file() and not path.name.startswith(".") and not path.name.endswith(".session.json"):
                found.append({"name": path.name, "kind": kind})
        return {"files": found[:MAX_FILES]}

    def keep_upload(self, name: str, content: bytes) -> str:
        """Write an uploaded file into the session's folder. No file that is there is replaced.

        Args:
            name: Name that the page gave.
            content: What is in it.

        Returns:
            The name that it got.

        Raises:
            ValueError: For a kind of file that cannot be loaded.
            OSError: If it cannot be written.
        """
        plain = re.sub(r"[^\w.\- ]", "_", pathlib.PurePosixPath(name.replace("\\", "/")).name).lstrip(".")[:100]
        path = self.path_of(plain or "upload")
        if LOADABLE.get(path.suffix.lower()) not in ("cage", "poses"):
            raise ValueError(f"{plain!r} is no cage or pose file: {' '.join(e for e in LOADABLE if e != '.npz')}")
        number = 1
        while path.exists():
            number += 1
            path = self.path_of(f"{pathlib.PurePosixPath(plain).stem}-{number}{path.suffix}")
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
        return path.name

    # -- Cages

    def _generate(self, message: dict[str, Any]) -> int:
        """A cage around what the field shows, for an edit or as a new one."""
        number = message.get("edit")
        if number is not None:
            self.session.document.edit(number)
        count = checked_whole(message.get("count", 100), 8, 2000, "count")
        method = checked_choice(message.get("method", "auto"), ("auto", "shell", "voxel"), "method")
        symmetry = message.get("symmetry")
        if symmetry is not None:
            checked_choice(symmetry, ("x", "y", "z"), "symmetry")
        margin = message.get("margin")

        def work(progress: Progress) -> Outcome:
            progress(None, "looks for the surface and draws a cage around it")
            cage = Cage.from_field(self.session.field, count, margin=margin, method=method, symmetry=symmetry)
            progress(0.95, "puts it into the scene")
            self._hand_over(lambda document: self._with_cage(document, number, cage, "generate cage"))
            return Outcome(f"a cage of {len(cage.vertices)} vertices")

        return self.jobs.start(f"Cage of {count} vertices", "cage", work)

    def _simplify(self, message: dict[str, Any]) -> int:
        edit = self.session.document.edit(message["edit"])
        count = checked_whole(message["count"], 4, len(edit.rest) - 1, "count")

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
        cage = await self._read(lambda: Cage.load(path, up=message.get("up")))
        cage.require_usable(f"cage {path.name!r}")
        self.session.apply(*self._with_cage(self.session.document, number, cage, f"load {path.name}"))

    async def _load_pose(self, message: dict[str, Any]) -> None:
        """A posed cage from a file, in any order that `Cage.match` takes."""
        path = self.path_of(message["file"])
        edit = self.session.document.edit(message.get("edit", self.session.document.selection.edit))
        posed = await self._read(lambda: edit.rest_cage.match(Cage.load(path, up=message.get("up"))))
        content = {"edit": edit.id, "vertices": posed.vertices, "label": f"load {path.name}"[:100]}
        self.session.apply(*commands.set_pose(self.session.document, content))

    async def _load_poses(self, message: dict[str, Any]) -> None:
        path = self.path_of(message["file"])
        document = self.session.document
        number = document.edit(message.get("edit", document.selection.edit)).id
        loaded = await self._read(lambda: timeline.load_poses(document, number, str(path)))
        if self.session.document is not document:
            loaded = timeline.load_poses(self.session.document, number, str(path))
        self.session.apply(f"load {path.name}", loaded)

    async def _save_poses(self, message: dict[str, Any]) -> dict[str, str]:
        path = self.path_of(message["file"])
        if path.suffix.lower() != ".json":
            raise ValueError(f"poses are kept in .json files, got {path.name!r}")
        document = self.session.document
        number = document.edit(message.get("edit", document.selection.edit)).id
        await self._read(lambda: timeline.pose_file(document, number).save(path))
        return self._downloadable(path)

    # -- Exports

    def free_path(self, name: Any, endings: tuple[str, ...]) -> pathlib.Path:
        """The path of a file or folder to write. What the editor did not write itself is never replaced."""
        path = self.path_of(name)
        if path.suffix.lower() not in endings:
            raise ValueError(f"{path.name!r} must end in {' or '.join(endings) if any(endings) else 'no ending'}")
        if path.exists() and path.name not in self.downloads:
            raise ValueError(f"{path.name!r} is there already: give another name")
        return path

    def _export(self, message: dict[str, Any]) -> int:
        """Write a film, a cage, poses or a baked field into the session's folder."""
        document, what = self.session.document, checked_choice(message["what"], tuple(EXPORTS), "what")
        path = self.free_path(message["file"], EXPORTS[what])
        number = message.get("edit", document.selection.edit)
        if what in ("cage", "poses"):
            number = document.edit(number).id
        film = _film(message) if what in ("mp4", "gif", "png") else None

        def work(progress: Progress) -> Outcome:
            if film is not None:
                count = exports.export_film(document, self.session.field, path, film, progress)
                text = f"{path.name}: {count} frames of {film.width}x{film.height}"
            elif what == "bake":
                baked = exports.export_baked(document, self.session.field, path, progress)
                text = f"{path.name}: a field of {baked.voxel_count} voxels"
            elif what == "cage":
                exports.export_cage(document, number, path, rest=message.get("rest") is True)
                text = f"{path.name}: a cage of {len(document.edit(number).rest)} vertices"
            else:
                exports.export_poses(document, number, path)
                text = path.name
            if path.is_dir():
                return Outcome(f"{text}, in {path}")
            self.downloads[path.name] = path
            return Outcome(text, f"download/{urllib.parse.quote(path.name)}")

        return self.jobs.start(f"Write {path.name}", "film" if film or what == "bake" else "file", work)

    async def _export_command(self, message: dict[str, Any]) -> dict[str, str]:
        """The command line that makes the film of the session as it is, which is saved for it."""
        session = self.session
        if session.path is None or self.field_path is None:
            raise ValueError("a field without a file has no command line: export the film here")
        await self._read(lambda: session.save(session.document))
        if session.save_error:
            raise ValueError(f"the session could not be saved: {session.save_error}")
        output = str(message.get("file") or "film.mp4")
        return {"command": exports.export_command(session.path, self.field_path, _film(message), output=output)}

    def _downloadable(self, path: pathlib.Path) -> dict[str, str]:
        self.downloads[path.name] = path
        return {"download": f"download/{urllib.parse.quote(path.name)}"}

    async def _read(self, read: Callable[[], Any]) -> Any:
        """Work with files, in another thread so that pages are served meanwhile."""
        return await self.loop.run_in_executor(None, read)

    @staticmethod
    def _with_cage(document: Document, number: int | None, cage: Cage, label: str) -> tuple[str, Document]:
        if number is None:
            return commands.with_new_edit(document, cage)
        return commands.replace_cage(document, number, cage, label)

    def _hand_over(self, change: Callable[[Document], tuple[str, Document]]) -> None:
        """Change the document from a job's thread; raises what the change raises, or Cancelled."""
        done: concurrent.futures.Future = concurrent.futures.Future()

        def apply() -> None:
            try:
                self.session.apply(*change(self.session.document))
                done.set_result(None)
            except BaseException as error:  # goes on in the job's thread
                done.set_exception(error)

        self.loop.call_soon_threadsafe(apply)
        done.result(timeout=60.0)


def _film(message: dict[str, Any]) -> exports.Film:
    """Size and kind of a film's pictures."""
    options = {
        name: message[name] for name in ("width", "height", "overlay", "transparent") if message.get(name) is not None
    }
    return exports.Film(**options)
