"""The folder of a run: its manifest, notes of workers, parts of a run, and how outputs are written."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import pathlib
import re
import shutil
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import IO, Any

import numpy as np

from ...core.checks import shown, warn_caller
from ...core.files import PathLike, atomic_path
from ...errors import InputError, file_error

#: States of an item in notes: it was begun; it is done; it failed and is not tried again; it failed and may be.
STARTED, DONE, FAILED, ERROR = "started", "done", "failed", "error"

#: Which of several notes of an item counts: the best news, and what is settled before what is not.
_RANKS = {STARTED: 0, ERROR: 1, FAILED: 2, DONE: 3}

#: What a full disk, a quota and a file system that cannot be written to report: no other item can be written either.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def id_key(item_id: str) -> int:
    """A whole number of 63 bits for an item's id. Of a million ids two share one with a chance of 1e-7."""
    return int.from_bytes(hashlib.blake2b(item_id.encode("utf-8"), digest_size=8).digest(), "little") >> 1


class Notes:
    """The file that one worker appends to, from any of its threads; its folder is there."""

    # Two lines an item: when it begins, so that what killed the worker is known, and when it is settled. They are
    # merged into the manifest at the end of a run, at an interrupt, and at the next start after a kill.

    def __init__(self, path: PathLike):
        self.path = pathlib.Path(path)
        self.file = open(self.path, "ab", buffering=0)
        self._lock = threading.Lock()

    def append(self, record: dict[str, Any]) -> None:
        """Append one line. A line that does not fit on the disk is taken away again."""
        line = json.dumps(record, separators=(",", ":"), ensure_ascii=False).encode("utf-8", "surrogatepass") + b"\n"
        with self._lock:
            written = self.file.write(line)
            if written != len(line):
                with contextlib.suppress(OSError):
                    self.file.truncate(self.file.tell() - (written or 0))
                raise file_error(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path)))

    def close(self) -> None:
        self.file.close()


def read_lines(path: PathLike) -> Iterator[tuple[int, bytes, dict[str, Any]]]:
    """The whole lines of a file of records: the place in bytes where each begins, the line, and its record; none where
    there is no file."""
    # Left out is what is no JSON object with an id and a state: what a killed worker or a full disk cut off.
    try:
        file = open(path, "rb")
    except FileNotFoundError:
        return
    with file:
        place = 0
        for line in file:
            record = _record(line)
            if record is not None:
                yield place, line, record
            place += len(line)


def _record(line: bytes) -> dict[str, Any] | None:
    if not line.endswith(b"\n"):
        return None
    try:
        record = json.loads(line)
    except ValueError:
        return None
    good = isinstance(record, dict) and isinstance(record.get("id"), str) and record.get("state") in _RANKS
    return record if good else None


def notes_of_chunk(path: PathLike, chunk: int) -> tuple[list[dict[str, Any]], list[str]]:
    """What a worker that died noted of a chunk: the records of items that were settled, and the ids of those that were
    begun and not settled, the newest last."""
    settled: list[dict[str, Any]] = []
    begun: dict[str, None] = {}
    for _, _, record in read_lines(path):
        if record["state"] == STARTED and record.get("lot") == chunk:
            begun[record["id"]] = None
        elif record["state"] != STARTED and record["id"] in begun:
            del begun[record["id"]]
            settled.append(record)
    return settled, list(begun)


class Manifest:
    """The records of all runs with one output folder; their file may not be there yet.
    It is read through an index of some 20 bytes a record, so that a driver can hold that of a million."""

    def __init__(self, path: PathLike):
        self.path = pathlib.Path(path)
        index = _index([self.path])
        index = index[np.argsort(index["key"], kind="stable")]
        self.keys, self._places = index["key"].copy(), index["place"].copy()  # keys: (n,) `id_key`, sorted
        self._file: IO[bytes] | None = None

    def __len__(self) -> int:
        return len(self.keys)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (record for _, _, record in read_lines(self.path))

    def find(self, item_id: str) -> dict[str, Any] | None:
        """The record of an item; None where there is none."""
        key = id_key(item_id)
        begin, end = np.searchsorted(self.keys, [key, key + 1])
        for place in self._places[begin:end]:
            self._file = self._file or self.path.open("rb")
            self._file.seek(int(place))
            record = _record(self._file.readline())
            if record is not None and record["id"] == item_id:
                return record
        return None

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def _index(files: Iterable[pathlib.Path]) -> np.ndarray:
    """Of each record of some files its key, its place in bytes, the number of its file and the rank of its state."""
    rows = (
        (id_key(record["id"]), place, source, _RANKS[record["state"]])
        for source, path in enumerate(files)
        for place, _, record in read_lines(path)
    )
    return np.fromiter(rows, [("key", np.int64), ("place", np.int64), ("source", np.int32), ("rank", np.int8)])


def merge_notes(manifest: PathLike, notes: Iterable[PathLike], into: PathLike | None = None) -> None:
    """Merge the notes of workers into the manifest, which is replaced at once, and take them away.
    into: another file to write, while manifest and notes stay as they are."""
    # Notes count whatever the manifest said, also of an item begun and not settled, whose outputs may be new or old. A
    # kill at any moment leaves the notes or a manifest that has them; merged twice they give the same.
    manifest = pathlib.Path(manifest)
    files = sorted(map(pathlib.Path, notes))
    if not files and into is None:
        return
    index = _index(files)
    keys = np.append(np.unique(index["key"]), np.iinfo(np.int64).max)  # with an end, so that each has a place in it
    if len(index) or into is not None:
        with atomic_path(manifest if into is None else into) as temporary, temporary.open("wb") as out:
            for _, line, record in read_lines(manifest):
                key = id_key(record["id"])
                if keys[np.searchsorted(keys, key)] != key:
                    out.write(line)
            out.writelines(_settled(files, index))
    for path in files if into is None else ():
        path.unlink(missing_ok=True)


def _settled(files: list[pathlib.Path], index: np.ndarray) -> Iterator[bytes]:
    """The lines that the manifest takes, file by file: the best of each item, the last of several."""
    index = index[np.lexsort((index["rank"], index["key"]))]
    best = index[np.append(index["key"][1:] != index["key"][:-1], True)[: len(index)]]
    best = best[best["rank"] >= _RANKS[FAILED]]
    for source, path in enumerate(files):
        places = np.sort(best["place"][best["source"] == source])
        if len(places):
            with path.open("rb") as file:
                for place in places.tolist():
                    file.seek(place)
                    yield file.readline()


def newest_seconds(manifest: Manifest, most: int = 1000) -> dict[str, float]:
    """The median of the seconds that items took, by their kind, of the first records that say so."""
    found: dict[str, list[float]] = collections.defaultdict(list)
    for record in manifest:
        if record["state"] == DONE and isinstance(record.get("seconds"), int | float):
            found[str(record.get("kind", "frame"))].append(float(record["seconds"]))
    return {kind: float(np.median(seconds[:most])) for kind, seconds in found.items()}


#: Folders of a run: files stand in the first until they are whole, and what is left there may be removed once no
#: worker runs; the second holds the progress of fits, from which they go on.
PARTS, CHECKPOINTS = ".warpcage/parts", ".warpcage/checkpoints"

#: Writes an output to a file that is not yet in its place. Any thread may call it: it uses main memory alone, or takes
#: the turn of its device.
Writer = Callable[[pathlib.Path], object]


@dataclasses.dataclass(frozen=True)
class MadeItem:
    """An item that is made, and not yet written."""

    writers: Mapping[str, Writer]  # by the paths of its outputs
    held_bytes: int = 0  # of main memory, that the writers hold


def write_outputs(writers: Mapping[str, Writer], out: pathlib.Path, parts: pathlib.Path) -> dict[str, int]:
    """Write files below `out`, all of them or none; returns their bytes by path.
    parts: folder for files that are not whole yet, on the same file system."""
    sizes: dict[str, int] = {}
    placed: list[pathlib.Path] = []
    parts.mkdir(parents=True, exist_ok=True)
    stem = uuid.uuid4().hex
    names = {
        path: parts / f"{stem}-{number}{pathlib.PurePosixPath(path).suffix}" for number, path in enumerate(writers)
    }
    try:
        for path, write in writers.items():
            write(names[path])
            sizes[path] = names[path].stat().st_size
        for path in writers:
            _put(names[path], out / path)
            placed.append(out / path)
    except BaseException:
        for each in placed:
            each.unlink(missing_ok=True)
        raise
    finally:
        for name in names.values():
            with contextlib.suppress(OSError):
                name.unlink()
    return sizes


def _put(part: pathlib.Path, path: pathlib.Path) -> None:
    """Put a whole file into its place, also where that is on another disk, to which a link in the folder leads."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.replace(part, path)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        with atomic_path(path) as temporary:
            shutil.copyfile(part, temporary)


def write_array(path: pathlib.Path, array: np.ndarray) -> None:
    """Write a .npy file that is not yet in its place."""
    numbers = np.ascontiguousarray(array)
    with path.open("wb") as file:  # np.save reports a full disk without its error number
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(numbers))
        file.write(numbers.data.cast("B") if numbers.size else b"")


@dataclasses.dataclass(frozen=True)
class Part:
    """One of the parts of a job: `number`, from 1, of `count`."""

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise InputError(f"there is no part {self.number} of {self.count}: they are numbered from 1")

    @classmethod
    def named(cls, text: str) -> Part:
        """The part of a text such as "3/16". Raises ValueError for others."""
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None:
            raise InputError(f"a part must be a number of how many, such as 3/16, got {shown(text)}")
        return cls(int(found[1]), int(found[2]))

    @property
    def name(self) -> str:
        """Names its files."""
        return f"part-{self.number}-of-{self.count}"

    def range(self, total: int, unit: int = 1) -> range:
        """Numbers of its items, of `total`; unit: items that stay together, those of a shard."""
        units = -(-total // unit)  # parts together have each item once, and as equal numbers of units as can be
        begin, end = (min(total, unit * (units * part // self.count)) for part in (self.number - 1, self.number))
        return range(begin, end)


#: The run's own folder in the output folder, and its manifest.
OWN_FOLDER, MANIFEST = ".warpcage", "manifest.jsonl"

#: What files of the run itself are called before they are whole.
_TEMPORARY = re.compile(r"\.(manifest|transforms|shard-\d+)-[0-9a-f]{16}\.(jsonl|json|tar)")

#: Seconds that the workers of a driver that was killed are waited for.
PATIENCE = 30.0

#: What a file system without locks says.
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)


class OutputFolder:
    """Where a run writes; `prepare` makes the folder. part: None is the whole job.
    A part runs beside others, and leaves its notes for a run of the whole job to merge."""

    def __init__(self, path: PathLike, part: Part | None = None):
        self.path, self.part = pathlib.Path(path).absolute(), part
        self.own = self.path / OWN_FOLDER
        self.notes, self.manifest = self.own / "notes", self.path / MANIFEST
        self._made: list[pathlib.Path] = []  # folders that were not there, the innermost first

    def prepare(self) -> None:
        """Make the folder."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{str(self.path)!r} is a file: -o takes a folder")
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
            # whether each is held by this driver alone
            locks = {"driver.lock": self.part is None} | ({f"{self.part.name}.lock": True} if self.part else {})
            files = ((held.enter_context(open(self.own / name, "a+b")), alone) for name, alone in locks.items())
            if not all(_lock(file, exclusive=alone) for file, alone in files):
                raise InputError(f"another run writes to {str(self.path)!r}: wait for its end, or give another folder")
            if self.part is not None:
                yield
                return
            workers = held.enter_context(open(self.own / "workers.lock", "a+b"))
            end = time.monotonic() + PATIENCE
            while not _lock(workers, exclusive=True):
                if time.monotonic() > end:
                    raise InputError(
                        f"workers of an earlier run still write to {str(self.path)!r}: end them, or give another folder"
                    )
                time.sleep(0.05)
            workers.close()  # for the workers of this run
            yield

    @contextlib.contextmanager
    def nothing_left(self) -> Iterator[None]:
        """Where the block fails before anything was made, take the folders away that `prepare` made.
        To be entered in `driven`: no other process writes here then."""
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
        """The records of earlier runs; for a part, with the notes that are not merged."""
        if self.part is None:
            return Manifest(self.manifest)
        merged = self.own / f"{self.part.name}.jsonl"
        merge_notes(self.manifest, self.notes.glob("*.jsonl"), into=merged)
        return Manifest(merged)

    def holds(self, outputs: Any) -> bool:
        """Whether all files of a record are there in the size that it says; outputs: bytes by name."""
        return are_there(outputs, lambda name: file_size(self.path / name))


def are_there(outputs: Any, size_of: Callable[[str], int]) -> bool:
    """Whether all files of a record have the size that it says; outputs: bytes by name."""
    return isinstance(outputs, dict) and bool(outputs) and all(size_of(name) == outputs[name] for name in outputs)


def file_size(path: pathlib.Path, otherwise: int = -1) -> int:
    """Bytes of a file; `otherwise` where there is none."""
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return otherwise


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
        warn_caller(f"the file system of {str(file.name)!r} has no locks: do not start a second run there")
    return True
