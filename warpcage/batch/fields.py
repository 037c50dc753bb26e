"""Fields that a worker keeps loaded, and the one that is loaded ahead."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from ..core.arrays import array_bytes
from ..core.files import file_stamp
from ..core.memory import LRUCache, free_bytes
from ..splats.splat_field import AnyField, read_field
from .references import References

#: Makes a field on a device, of what was read.
OnDevice = Callable[[wp.DeviceLike], AnyField]


class PrefetchedField:
    """A field whose file a thread reads before anybody asks for it, beside whatever else a worker begins with."""

    def __init__(self, path: str, scene_scale: float):
        self._path, self._scene_scale = path, scene_scale
        thread = ThreadPoolExecutor(1, "warpcage-field")
        self._reading = thread.submit(self._read)
        thread.shutdown(wait=False)  # it ends with its task

    def _read(self) -> tuple[tuple[int, int], OnDevice]:
        stamp = file_stamp(self._path)
        found = read_field(self._path, scene_scale=self._scene_scale)
        if file_stamp(self._path) != stamp:
            raise ValueError(f"{self._path} was changed while it was read")
        return stamp, found

    def take(self, path: str, stamp: tuple[int, int], scene_scale: float) -> OnDevice | None:
        """What makes the field on a device, once it is read; stamp: the `file_stamp` of `path` as it is now.
        None for another field, a file that has changed since, and where reading failed."""
        if (path, scene_scale) != (self._path, self._scene_scale) or self._reading.exception() is not None:
            return None  # where reading failed, whoever asked reads it then, and learns what is wrong
        read, found = self._reading.result()
        return found if read == stamp else None


#: Most fields that stay loaded, and the share of the memory that is free at first for them and what is bound to them.
MOST_FIELDS, MEMORY_SHARE = 8, 0.5


class LoadedFields:
    """Fields by their files, of which those stay loaded that were used last.
    memory: bytes that they may take together, but one stays whatever it takes; None is a quarter of what is free."""

    def __init__(
        self,
        references: References,
        device: wp.Device,
        memory: int | None = None,
        expected: PrefetchedField | None = None,
    ):
        self.references, self.device, self.read_count = references, device, 0
        self.dropped: Callable[[AnyField], Any] = lambda field: None  # called with a field that is let go, before it is
        self._expected = expected
        limit = int(MEMORY_SHARE * free_bytes(device)) // 2 if memory is None else memory
        self.kept: LRUCache[AnyField] = LRUCache(MOST_FIELDS, limit, array_bytes, lambda field: self.dropped(field))

    @property
    def held_bytes(self) -> int:
        """Bytes that the fields take."""
        return self.kept.held_bytes

    def get(self, name: str, scene_scale: float) -> tuple[Hashable, AnyField]:
        """A key that is another where the file has changed, and the field; scene_scale: as `VoxelField.load` has it."""
        path, stamp = self.references.stamped(name, "field file")

        def load() -> AnyField:
            self.read_count += 1
            expected, self._expected = self._expected, None  # what nobody asked for is let go
            found = None if expected is None else expected.take(path, stamp, scene_scale)
            return (found or read_field(path, scene_scale=scene_scale))(self.device)

        key = path, stamp, scene_scale
        return key, self.kept.get(key, load)

    def settle(self, key: Hashable) -> None:
        """Measure a field anew, once it was rendered, and let go of others where it has grown too large."""
        self.kept.settle(key)

    def forget(self) -> None:
        """Let go of all fields."""
        self._expected = None
        self.kept.clear()
