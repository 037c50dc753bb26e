"""The manifest of a run: what became of each item, one line each; and the notes that workers write meanwhile."""

from __future__ import annotations

import collections
import contextlib
import errno
import hashlib
import json
import os
import pathlib
import threading
from collections.abc import Iterable, Iterator
from typing import IO, Any

import numpy as np

from ..core.files import PathLike, atomic_path

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

    # A worker appends two lines for each item: one when it begins, so that what it was making is known if it dies, and
    # one when that is settled. They are merged into the manifest at the end of a run, at an interrupt, and at the next
    # start after a kill.

    def __init__(self, path: PathLike):
        self.path = pathlib.Path(path)
        self._file = open(self.path, "ab", buffering=0)
        self._lock = threading.Lock()

    def append(self, record: dict[str, Any]) -> None:
        """Append one line. A line that does not fit on the disk is taken away again."""
        line = json.dumps(record, separators=(",", ":"), ensure_ascii=False).encode("utf-8", "surrogatepass") + b"\n"
        with self._lock:
            written = self._file.write(line)
            if written != len(line):
                with contextlib.suppress(OSError):
                    self._file.truncate(self._file.tell() - (written or 0))
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_lines(path: PathLike) -> Iterator[tuple[int, dict[str, Any]]]:
    """The whole lines of a file of records, with the places in bytes where they begin; none where there is no file."""
    # What is no JSON object with an id and a state is left out: the last line of a worker that was killed, or what a
    # full disk left.
    try:
        file = open(path, "rb")
    except FileNotFoundError:
        return
    with file:
        place = 0
        for line in file:
            record = _record(line)
            if record is not None:
                yield place, record
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


def notes_of_lot(path: PathLike, lot: int) -> tuple[list[dict[str, Any]], list[str]]:
    """What a worker that died noted of a lot: the records of items that were settled, and the ids of those that were
    begun and not settled, the newest last."""
    settled: list[dict[str, Any]] = []
    begun: dict[str, None] = {}
    for _, record in read_lines(path):
        if record["state"] == STARTED and record.get("lot") == lot:
            begun[record["id"]] = None
        elif record["state"] != STARTED and record["id"] in begun:
            del begun[record["id"]]
            settled.append(record)
    return settled, list(begun)


class Manifest:
    """The records of all runs with one output folder; their file may not be there yet."""

    # It is read through an index that takes some 20 bytes a record, so that a driver can hold that of a million.

    def __init__(self, path: PathLike):
        self.path = pathlib.Path(path)
        keys, places = [], []
        for place, record in read_lines(self.path):
            keys.append(id_key(record["id"]))
            places.append(place)
        unsorted = np.array(keys, np.int64)
        order = np.argsort(unsorted, kind="stable")
        # (n,) `id_key` of each record's item, sorted
        self.keys, self._places = unsorted[order], np.array(places, np.int64)[order]
        self._file: IO[bytes] | None = None

    def __len__(self) -> int:
        return len(self.keys)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (record for _, record in read_lines(self.path))

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
        """Close the file, if it is open."""
        if self._file is not None:
            self._file.close()
            self._file = None


class _Merge:
    """The newest note of each item, in arrays: a million take 30 MB."""

    def __init__(self, files: list[pathlib.Path]):
        keys, sources, places, ranks = [], [], [], []
        for source, path in enumerate(files):
            for place, record in read_lines(path):
                keys.append(id_key(record["id"]))
                sources.append(source)
                places.append(place)
                ranks.append(_RANKS[record["state"]])
        key, rank = np.array(keys, np.int64), np.array(ranks, np.int8)
        order = np.lexsort((np.arange(len(key)), rank, key))
        last = np.append(key[order][1:] != key[order][:-1], True)[: len(order)]  # the best of each item
        chosen = order[last]
        self.files = files
        self.keys, self.ranks = key[chosen], rank[chosen]
        self.sources, self.places = np.array(sources, np.int32)[chosen], np.array(places, np.int64)[chosen]

    def __contains__(self, key: int) -> bool:
        index = int(np.searchsorted(self.keys, key))
        return index < len(self.keys) and int(self.keys[index]) == key

    def settled(self) -> Iterator[bytes]:
        """The lines that the manifest takes, file by file."""
        with contextlib.ExitStack() as opened:
            file, held = None, -1
            for index in np.lexsort((self.places, self.sources)):
                if self.ranks[index] < _RANKS[FAILED]:
                    continue
                if self.sources[index] != held:
                    held = int(self.sources[index])
                    opened.close()
                    file = opened.enter_context(self.files[held].open("rb"))
                assert file is not None
                file.seek(int(self.places[index]))
                yield file.readline()


def merge_notes(manifest: PathLike, notes: Iterable[PathLike], into: PathLike | None = None) -> None:
    """Merge the notes of workers into the manifest, which is replaced at once, and take them away.
    into: another file to write, while manifest and notes stay as they are."""
    # What is in the notes counts, whatever the manifest said before: also of an item that was begun and not settled,
    # whose outputs may be new or old. An interrupt or a kill at any moment leaves either the notes or a manifest that
    # has them; merged twice they give the same.
    manifest = pathlib.Path(manifest)
    files = sorted(map(pathlib.Path, notes))
    if not files and into is None:
        return
    merge = _Merge(files)
    if len(merge.keys) or into is not None:
        with atomic_path(manifest if into is None else into) as temporary, temporary.open("wb") as out:
            if manifest.exists():
                with manifest.open("rb") as before:
                    for line in before:
                        record = _record(line)
                        if record is not None and id_key(record["id"]) not in merge:
                            out.write(line)
            for line in merge.settled():
                out.write(line)
    for path in files if into is None else ():
        path.unlink(missing_ok=True)


def newest_seconds(manifest: Manifest, most: int = 1000) -> dict[str, float]:
    """The median of the seconds that items took, by their kind, of the first records that say so."""
    found: dict[str, list[float]] = collections.defaultdict(list)
    for record in manifest:
        if record["state"] == DONE and isinstance(record.get("seconds"), int | float):
            table = found[str(record.get("kind", "frame"))]
            if len(table) < most:
                table.append(float(record["seconds"]))
    return {kind: float(np.median(seconds)) for kind, seconds in found.items()}
