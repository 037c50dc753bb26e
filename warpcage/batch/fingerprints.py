"""Fingerprints of items: hashes of what they say and of all that they read, by which a changed input is known."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from ..core.files import NpyFile, PathLike, file_stamp
from ..core.memory import LRUCache
from .items import EvaluateItem, FitItem, FrameItem, Item, canonical
from .words import split_reference

#: Bytes that are hashed at once, and files whose hashes are kept.
CHUNK, MOST_FILES = 1 << 20, 200_000

#: Bytes from which on a file is hashed by a thread, beside whoever reads it too, and bytes of such a file that are
#: hashed at once: between two pieces the thread may wait for the interpreter, which others hold for up to 5 ms.
LARGE, LARGE_CHUNK = 1 << 22, 1 << 24

#: Bytes of a hash.
HASH_BYTES = 16


@dataclasses.dataclass(frozen=True)
class LargeHash:
    """The hash of a large file, which a thread makes."""

    path: pathlib.Path
    stamp: tuple[int, int]  # as it was when the hash was begun
    future: Future[str]

    def settled(self) -> str:
        """Wait for the hash: that of a file that is still as it was, so that who read it since read the same bytes."""
        try:
            found = self.future.result()
        except OSError as error:
            return _unreadable(error)
        with contextlib.suppress(OSError):
            if file_stamp(self.path) == self.stamp:
                return found
        return _changed(self.stamp, found)


class Begun:
    """A fingerprint of which some hashes may be under way; words: what the item says; inputs: of what it reads."""

    def __init__(self, words: str, inputs: list[str | LargeHash]):
        self._words, self._inputs = words, inputs

    @property
    def ready(self) -> bool:
        """Whether a call waits for nothing."""
        return all(isinstance(each, str) or each.future.done() for each in self._inputs)

    def __call__(self) -> str:
        """Wait for the hashes; returns the fingerprint."""
        parts = [self._words, *map(_settled, self._inputs)]
        return hashlib.blake2b("\n".join(parts).encode(), digest_size=HASH_BYTES).hexdigest()


class Fingerprints:
    """Hashes of items and their inputs. A file is read once while its size and its time stay the same.
    out: folder of a run, which is left out where it lies in a scene."""

    # What is hashed is the item's own JSON, with all that it takes from its file's defaults, and the contents of all
    # files that it names: of a row of a .npy file that row alone, of a scene the names and contents of its files.

    def __init__(self, base: PathLike, out: PathLike | None = None):
        self.base = pathlib.Path(base)
        self._out = None if out is None else os.path.realpath(out)
        self._hashes: LRUCache[str | LargeHash] = LRUCache(MOST_FILES)
        self._thread: ThreadPoolExecutor | None = None
        self._arrays: LRUCache[NpyFile] = LRUCache(32)

    def of(self, item: Item) -> str:
        """The fingerprint of an item, hexadecimal digits."""
        return self.begun(item)()  # a file that cannot be read counts as such: the item itself will say so

    def begun(self, item: Item) -> Begun:
        """The fingerprint of an item as its files are now, while large ones are hashed beside what the caller does.
        A call of it waits for the hashes, and returns what `of` does."""
        # A large file that changes before this is asked for gets a hash that it never has again.
        return Begun(canonical(item.to_json()), [self._of_reference(each) for each in references_of(item)])

    def expect(self, name: str) -> None:
        """Begin to hash a large file that items will name; does nothing where it is small or not there."""
        path = self.base / name
        with contextlib.suppress(OSError):
            if path.is_file() and file_stamp(path)[0] >= LARGE:
                self._hash(path)

    def of_inputs(self, item: Item) -> tuple[str, ...]:
        """The fingerprints of what an item reads, whatever it says beside: one for each of `references_of`."""
        return tuple(_settled(self._of_reference(each)) for each in references_of(item))

    def _of_reference(self, reference: str) -> str | LargeHash:
        name, place = split_reference(reference)
        try:
            path = self.base / name
            if path.is_dir():
                return self._of_folder(path)
            if place.isdigit() and name.lower().endswith(".npy"):
                return self._of_row(path, int(place))
            return self._of_file(path) if path.suffix.lower() == ".gltf" else self._hash(path)
        except (OSError, ValueError) as error:
            return _unreadable(error)

    def _of_file(self, path: pathlib.Path) -> str:
        """The hash of a file, and of the files beside it that a .gltf keeps its numbers in."""
        found = _settled(self._hash(path))
        if path.suffix.lower() == ".gltf":
            return " ".join([found, *(self._of_file(each) for each in _gltf_files(path))])
        return found

    def _hash(self, path: pathlib.Path) -> str | LargeHash:
        """The hash of a file alone; of a large one it may be under way."""
        stamp = file_stamp(path)

        def begin() -> str | LargeHash:
            if stamp[0] < LARGE:
                return file_hash(path)
            self._thread = self._thread or ThreadPoolExecutor(1, "warpcage-hashes")
            return LargeHash(path, stamp, self._thread.submit(_stamped_hash, path, stamp))

        return self._hashes.get((os.fspath(path), stamp), begin)

    def _of_row(self, path: pathlib.Path, index: int) -> str:
        array = self._arrays.get((os.fspath(path), file_stamp(path)), lambda: NpyFile(path))
        row = hashlib.blake2b(array.row_data(index), digest_size=HASH_BYTES).hexdigest()
        return f"{array.dtype.str} {array.shape[1:]} {row}"

    def _of_folder(self, folder: pathlib.Path) -> str:
        """The hash of a folder: names and contents of what is in it, hidden files and the run's own left out."""
        lines = [f"{path.relative_to(folder).as_posix()} {self._of_file(path)}" for path in self._files_in(folder)]
        return hashlib.blake2b("\n".join(lines).encode("utf-8", "surrogateescape"), digest_size=HASH_BYTES).hexdigest()

    def _files_in(self, folder: pathlib.Path) -> Iterator[pathlib.Path]:
        seen: set[str] = set()
        for place, folders, files in os.walk(folder, followlinks=True):
            real = os.path.realpath(place)
            if real in seen or real == self._out:  # a link that leads back
                folders.clear()
                continue
            seen.add(real)
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            for name in sorted(files):
                path = pathlib.Path(place, name)
                if not name.startswith(".") and path.is_file():
                    yield path


def references_of(item: Item) -> list[str]:
    """What an item reads, relative to the folder of its file: files, rows of arrays ("poses.npy#17"), folders of
    scenes."""
    if isinstance(item, FrameItem):
        return [item.field, *_files_of_frame(item)]
    if isinstance(item, FitItem):
        return [item.scene, *([item.cameras] if item.cameras else [])]
    if isinstance(item, EvaluateItem):
        return [item.field, item.scene, *([item.cameras] if item.cameras else [])]
    return []


def _files_of_frame(item: FrameItem) -> Iterator[str]:
    values: list[Any] = [item.camera] if isinstance(item.camera, str) else []
    for edit in item.edits:
        values += edit.cage.values() if isinstance(edit.cage, dict) else [edit.cage]
        values.append(edit.posed)
    yield from (value for value in values if isinstance(value, str))


def file_hash(path: pathlib.Path) -> str:
    """The hash of a file's bytes, hexadecimal digits."""
    found = hashlib.blake2b(digest_size=HASH_BYTES)
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        while chunk := file.read(CHUNK if size < LARGE else LARGE_CHUNK):
            found.update(chunk)
    return found.hexdigest()


def _stamped_hash(path: pathlib.Path, stamp: tuple[int, int]) -> str:
    """The hash of a file that is still as it was when another thread began to read it."""
    found = file_hash(path)
    return found if file_stamp(path) == stamp else _changed(stamp, found)


def _changed(stamp: tuple[int, int], found: str) -> str:
    return f"changed while it was read: {stamp}, {found}"


def _settled(found: str | LargeHash) -> str:
    return found if isinstance(found, str) else found.settled()


def _unreadable(error: Exception) -> str:
    return f"cannot be read: {type(error).__name__}"


def _gltf_files(path: pathlib.Path) -> list[pathlib.Path]:
    """The files that a .gltf names beside it."""
    try:
        buffers = json.loads(path.read_bytes()).get("buffers", [])
        names = [each["uri"] for each in buffers if not each.get("uri", "data:").startswith("data:")]
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError):
        return []
    return [path.parent / name for name in names if (path.parent / name).is_file()]
