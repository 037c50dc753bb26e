"""The folder of a run: its lock, the notes of its workers, and what killed ones leave there."""

from __future__ import annotations

import contextlib
import errno
import os
import pathlib
import re
import shutil
import time
from collections.abc import Iterator
from typing import IO, Any

from ..core.checks import warn_caller
from ..core.files import PathLike
from .manifest import Manifest, Notes, merge_notes
from .outputs import PARTS
from .part import Part

#: The run's own folder in the output folder, and its manifest.
OWN_FOLDER, MANIFEST = ".warpcage", "manifest.jsonl"

#: What files of the run itself are called before they are whole.
_TEMPORARY = re.compile(r"\.(manifest|transforms|shard-\d+)-[0-9a-f]{16}\.(jsonl|json|tar)")

#: Seconds that the workers of a driver that was killed are waited for.
PATIENCE = 30.0

#: What a file system without locks says.
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)


class OutputFolder:
    """Where a run writes; `prepare` makes the folder. part: None is the whole job."""

    # A part is made beside runs of other parts: it leaves its notes for a run of the whole job to merge.

    def __init__(self, path: PathLike, part: Part | None = None):
        self.path, self.part = pathlib.Path(path).absolute(), part
        self.own = self.path / OWN_FOLDER
        self.notes = self.own / "notes"
        self._made: list[pathlib.Path] = []  # folders that were not there, the innermost first

    @property
    def manifest(self) -> pathlib.Path:
        """The manifest."""
        return self.path / MANIFEST

    def prepare(self) -> None:
        """Make the folder."""
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{str(self.path)!r} is a file: -o takes a folder")
        inner_first = (self.notes, self.own, self.path, *self.path.parents)
        self._made = [each for each in inner_first if not each.exists()]
        self.notes.mkdir(parents=True, exist_ok=True)

    def new_notes(self, name: str) -> Notes:
        """A file of notes of its own; name: which no other file of this run has."""
        return Notes(self.notes / f"{name}.jsonl")

    @contextlib.contextmanager
    def driven(self) -> Iterator[None]:
        """Be the only driver of the folder, or of a part. The lock frees itself where the driver is killed."""
        with contextlib.ExitStack() as held:
            driver = held.enter_context(open(self.own / "driver.lock", "a+b"))
            free = _lock(driver, exclusive=self.part is None)
            if free and self.part is not None:
                free = _lock(held.enter_context(open(self.own / f"{self.part.name}.lock", "a+b")), exclusive=True)
            if not free:
                raise ValueError(f"another run writes to {str(self.path)!r}: wait for its end, or give another folder")
            if self.part is not None:
                yield
                return
            workers = held.enter_context(open(self.own / "workers.lock", "a+b"))
            end = time.monotonic() + PATIENCE
            while not _lock(workers, exclusive=True):
                if time.monotonic() > end:
                    raise ValueError(
                        f"workers of an earlier run still write to {str(self.path)!r}: end them, or give another folder"
                    )
                time.sleep(0.05)
            workers.close()  # for the workers of this run
            yield

    @contextlib.contextmanager
    def nothing_left(self) -> Iterator[None]:
        """Where the block fails before anything was made, take the folders away that `prepare` made.
        To be entered in `driven`: nobody else writes here then."""
        try:
            yield
        except BaseException:
            if self.own in self._made and not any(self.notes.iterdir()) and not self.manifest.exists():
                with contextlib.suppress(OSError):  # what others put there stays
                    for path in self.own.glob("*.lock"):
                        path.unlink(missing_ok=True)
                    for each in self._made:
                        each.rmdir()
            raise

    def worked_in(self) -> IO[bytes]:
        """What a worker holds open as long as it may write here."""
        file = open(self.own / "workers.lock", "a+b")
        _lock(file, exclusive=False)
        return file

    def merge(self) -> None:
        """Merge all notes into the manifest, and remove what workers that were killed left half-written.
        No worker may be at work. A part does not merge: others may be."""
        if self.part is not None:
            return
        shutil.rmtree(self.path / PARTS, ignore_errors=True)
        for path in self.path.glob(".*-*"):
            if _TEMPORARY.fullmatch(path.name):
                path.unlink(missing_ok=True)
        merge_notes(self.manifest, self.notes.glob("*.jsonl"))
        for path in self.own.glob("part-*"):
            path.unlink(missing_ok=True)

    def read_manifest(self) -> Manifest:
        """The records of earlier runs; for a part, with the notes that nobody has merged."""
        if self.part is None:
            return Manifest(self.manifest)
        merged = self.own / f"{self.part.name}.jsonl"
        merge_notes(self.manifest, self.notes.glob("*.jsonl"), into=merged)
        return Manifest(merged)

    def holds(self, outputs: Any) -> bool:
        """Whether all files of a record are there in the size that it says; outputs: bytes by name."""
        if not isinstance(outputs, dict) or not outputs:
            return False
        try:
            return all(os.stat(self.path / name).st_size == size for name, size in outputs.items())
        except (OSError, ValueError):
            return False


def _lock(file: IO[bytes], *, exclusive: bool) -> bool:
    """Lock an open file until it is closed; returns False where another process has it."""
    try:
        import fcntl
    except ImportError:  # Windows
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        warn_caller(f"the file system of {str(file.name)!r} has no locks: nothing keeps a second run away")
    return True
