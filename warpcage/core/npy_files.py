"""Rows of large .npy files, one at a time."""

from __future__ import annotations

import math

import numpy as np

from .files import PathLike, file_stamp, read_npy_header, require_file
from .memory import require_host_memory

#: Kinds of numbers that are read: floats, and whole numbers with a sign or without.
NUMBERS = "fiu"


class NpyFile:
    """An array in a .npy file, of which a row is read at a time by its place in the file."""

    # Of millions of poses none but the one that is asked for is in memory. A mapped file would do the same, but a file
    # that is cut off under it kills the process.

    def __init__(self, path: PathLike):
        self.path = require_file(path, "array file")
        # size and time, by which a changed file is known
        self.stamp = file_stamp(self.path)
        with self.path.open("rb") as file:
            try:
                self.shape, columns_first, self.dtype = read_npy_header(file, self.path.name)
            except Exception as error:
                reason = " ".join(str(error).split()) or type(error).__name__
                raise ValueError(f"{self.path} is not an .npy file of numbers: {reason}") from None
            self._start = file.tell()
        if self.dtype.kind not in NUMBERS or min(self.shape, default=0) < 0:
            raise ValueError(f"{self.path} must hold numbers, got {self.dtype} of shape {self.shape}")
        if columns_first and len(self.shape) > 1:
            raise ValueError(f"{self.path} holds columns first: save it by np.save(path, np.ascontiguousarray(array))")
        claimed = math.prod(self.shape) * self.dtype.itemsize
        if claimed != self.stamp[0] - self._start:
            raise ValueError(
                f"{self.path} claims {claimed} bytes {self.shape}, it has {self.stamp[0] - self._start}: it is cut off "
                "or damaged"
            )

    @property
    def row_bytes(self) -> int:
        """Bytes of a row."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    def row(self, index: int) -> np.ndarray:
        """The array's part at a place of its first axis, from 0."""
        return self._array(self.row_data(index), self.shape[1:])

    def row_data(self, index: int) -> bytes:
        """The bytes of a row; see `row`."""
        if not self.shape or not 0 <= index < self.shape[0]:
            rows = self.shape[0] if self.shape else 0
            raise ValueError(
                f"{self.path} has rows 0 to {rows - 1}, got {index}" if rows else f"{self.path} has no rows"
            )
        return self._read(self._start + index * self.row_bytes, self.row_bytes)

    def read(self) -> np.ndarray:
        """The whole array. Raises ValueError where there is no memory for it, or the file was cut off."""
        size = math.prod(self.shape) * self.dtype.itemsize
        require_host_memory(size, f"{self.path}: its array needs")
        return self._array(self._read(self._start, size), self.shape)

    def _read(self, start: int, size: int) -> bytes:
        require_host_memory(size, f"{self.path}: a row needs")
        with self.path.open("rb") as file:
            file.seek(start)
            data = file.read(size)
        if len(data) != size:
            raise ValueError(f"{self.path} was cut off while it was in use")
        return data

    def _array(self, data: bytes, shape: tuple[int, ...]) -> np.ndarray:
        return np.frombuffer(data, self.dtype).reshape(shape)
