"""A field that a worker will probably need first, read while the worker starts."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import warp as wp

from ..core.files import file_stamp
from ..splats.splat_field import AnyField, read_field

#: Makes a field on a device, of what was read.
OnDevice = Callable[[wp.DeviceLike], AnyField]


class ExpectedField:
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
        # Where reading failed, whoever asked reads it then, and learns what is wrong.
        if (path, scene_scale) != (self._path, self._scene_scale) or self._reading.exception() is not None:
            return None
        read, found = self._reading.result()
        return found if read == stamp else None
