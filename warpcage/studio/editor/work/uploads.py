"""Unfinished files of an editor, hidden in the session's folder: uploads that no command has read, and exports."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import pathlib
import re
import secrets
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import IO, Any

from ....core.files import file_errors
from ....errors import InputError
from ....mesh.io.formats import mesh_endings
from ....render.surface_file import SURFACE_ENDINGS
from ....splats.io.formats import endings_read
from ...films.session.session_file import ENDING

#: Bytes of an uploaded file's name.
MAX_NAME_BYTES = 120

#: How the hidden names of an editor's uploads and of its folders of exports begin, and how that of its lock ends.
MARK = re.compile(r"(\.warpcage-upload-[0-9a-f]{16}-)(?:export-\w+[/\\])?")
LOCK = "lock"


@functools.cache
def loadable() -> dict[str, tuple[str, ...]]:
    """Endings of files that pages may load, by what is in them; those of cages may hold objects of the scene too."""
    cages = tuple(dict.fromkeys(mesh_endings()))
    splats = (pathlib.Path(ending).suffix or ending for ending in endings_read() if ending.startswith("."))
    return {"cage": cages, "object": tuple(dict.fromkeys((".npz", *splats, *SURFACE_ENDINGS))), "poses": (".json",)}


class Uploads:
    """The uploads of an editor that no command has taken yet, and its unfinished exports. Methods may be called from
    any thread. `path_of`: gives the path in the folder for a name, which it checks."""

    # They lie in the folder itself, as files beside them may belong to them. A lock says that the editor still runs:
    # the next one removes the files of a killed one.

    def __init__(self, folder: pathlib.Path, path_of: Callable[[Any], pathlib.Path]):
        self._folder, self._path_of = folder, path_of
        self._naming = threading.Lock()
        self._waiting: dict[str, tuple[pathlib.Path, int | None]] = {}  # by the name that they get, with the page's
        self._lock: IO[bytes] | None = None  # held once there was a hidden file
        self._mark = ""
        _remove_leftovers(folder)

    def keep(self, name: str, content: bytes, page: int | None = None) -> str:
        """Keep what a page has sent, hidden; returns the name that it gets in the folder, where it replaces none."""
        plain = re.sub(r"[^\w.\- ]", "_", pathlib.PurePosixPath(name.replace("\\", "/")).name).lstrip(". ")
        stem, ending = os.path.splitext(plain)
        known = dict.fromkeys(itertools.chain(*loadable().values()))
        if ending.lower() not in known or plain.lower().endswith(ENDING):
            raise InputError(f"{plain[:100]!r} is not a cage, pose or scene file; takes {' '.join(known)}")
        stem = stem.encode()[:MAX_NAME_BYTES].decode(errors="ignore")
        with self._naming:  # two pages may send files of one name
            kept = self._free_name(stem + ending)
            path = self._hidden(kept)
            self._waiting[kept] = path, page
        try:
            with file_errors():
                path.write_bytes(content)
        except BaseException:
            self.drop(kept)
            raise
        return kept

    def find(self, name: Any) -> pathlib.Path:
        """The path of a file to read by its name: an upload's that waits, else that in the folder."""
        waiting = self._waiting.get(name) if isinstance(name, str) else None
        return self._path_of(name) if waiting is None else waiting[0]

    @contextlib.contextmanager
    def taken(self, path: pathlib.Path) -> Iterator[pathlib.Path]:
        """The path that a file which was read keeps: an upload gets its name, and waits again after an error."""
        name = shown(path.name)
        if path.name == name:
            yield path
            return
        with self._naming:
            kept = self._path_of(name if not os.path.lexists(self._path_of(name)) else self._free_name(name))
            os.rename(path, kept)
        try:
            yield kept
        except Exception:  # not where the command is cut off: the scene may hold the file by then
            os.rename(kept, path)
            raise
        with self._naming:
            self._waiting.pop(name, None)

    def drop(self, name: Any) -> None:
        """Remove an upload, where it still waits."""
        with self._naming:
            path, _ = self._waiting.pop(name, (None, None)) if isinstance(name, str) else (None, None)
        if path is not None:
            path.unlink(missing_ok=True)

    def drop_of(self, page: int) -> None:
        """Remove the uploads of a page that has gone."""
        for name in [name for name, (_, owner) in list(self._waiting.items()) if owner == page]:
            self.drop(name)

    @contextlib.contextmanager
    def unfinished(self, path: pathlib.Path) -> Iterator[pathlib.Path]:
        """A path of the same name for a file or folder, which gets its own when the block ends without an error."""
        try:
            with self._naming:
                prefix = self._hidden("export-").name
            folder = tempfile.TemporaryDirectory(prefix=prefix, dir=self._folder, ignore_cleanup_errors=True)
        except OSError as error:
            error.filename = str(path)  # which the user knows
            raise
        with folder as hidden:
            written = pathlib.Path(hidden, path.name)
            yield written
            if path.is_file():
                shutil.copymode(path, written)
            os.replace(written, path)

    def close(self) -> None:
        """Remove all that waits; nothing is kept afterwards."""
        with self._naming:
            if self._lock is not None:
                _remove(self._folder, self._mark)
                self._lock.close()
            self._lock = None
            self._waiting.clear()

    def _hidden(self, name: str) -> pathlib.Path:
        """The hidden path of a name. Needs the lock of names."""
        if self._lock is None:
            self._lock, self._mark = _new_lock(self._folder)
        return self._folder / f"{self._mark}{name}"

    def _free_name(self, name: str) -> str:
        """A name, or with a number, that no file and no other upload has."""
        stem, ending = os.path.splitext(name)
        number, free = 1, name
        while free in self._waiting or os.path.lexists(self._path_of(free)):
            number += 1
            free = f"{stem}-{number}{ending}"
        return free


def shown(text: str) -> str:
    """A text with uploads and exports by the names that users know."""
    return MARK.sub("", text)


def _new_lock(folder: pathlib.Path) -> tuple[IO[bytes], str]:
    """A lock that ends with this process, and how the names of its uploads begin."""
    while True:
        mark = f".warpcage-upload-{secrets.token_hex(8)}-"
        path = folder / f"{mark}{LOCK}"
        file = path.open("xb")
        if _is_locked(file) is not False and path.exists():  # else another editor takes it for a leftover
            return file, mark
        file.close()


def _is_locked(file: IO[bytes]) -> bool | None:
    """Lock an open file until it is closed; False where another editor holds it, None where there are no locks."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        return None
    return True


def _remove_leftovers(folder: pathlib.Path) -> None:
    """Remove the hidden files of editors that were killed, known by their locks, which are free."""
    with contextlib.suppress(OSError):  # a folder that cannot be read or written keeps them
        for path in list(folder.iterdir()):
            mark = MARK.match(path.name)
            if mark is None or path.name != f"{mark[1]}{LOCK}" or path.is_symlink() or not path.is_file():
                continue
            with path.open("rb") as file:
                if _is_locked(file):
                    _remove(folder, mark[1])


def _remove(folder: pathlib.Path, mark: str) -> None:
    """Remove the files and folders whose names begin like this, the lock last."""
    lock = folder / f"{mark}{LOCK}"
    for path in [path for path in folder.iterdir() if path.name.startswith(mark) and path != lock] + [lock]:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
