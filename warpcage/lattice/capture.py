"""Buffers, constants and streams that poses share, so that launches can be captured."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import warp as wp

_WARP_TYPES = {int: wp.int32, float: wp.float32, bool: wp.bool}


class Buffers:
    """Named flat arrays that only grow, so that a new pose of about the same shape allocates nothing.

    A CUDA graph captured over them stays valid while `generation` stays the same.
    """

    def __init__(self, device):
        self.device = wp.get_device(device)
        self.generation = 0
        self._arrays: dict[str, wp.array] = {}

    def get(self, name: str, shape, dtype) -> wp.array:
        """An uninitialised contiguous array of `shape`, a view of the buffer of that name (grown where too small)."""
        shape = (shape,) if isinstance(shape, int) else tuple(int(side) for side in shape)
        count = math.prod(shape)
        dtype = _WARP_TYPES.get(dtype, dtype)  # as arrays name theirs
        held = self._arrays.get(name)
        if held is None or held.size < count or held.dtype != dtype:
            spare = 0 if held is None else count // 16  # poses of one cage differ by little
            self._arrays[name] = held = None  # the old one goes before the new one comes
            held = self._arrays[name] = wp.empty(max(count + spare, 1), dtype=dtype, device=self.device)
            self.generation += 1
        if count == 0:
            return wp.empty(shape, dtype=dtype, device=self.device)
        view = held if held.size == count else held[:count]
        return view.reshape(shape) if len(shape) > 1 else view

    @property
    def bytes(self) -> int:
        """Bytes held on the device."""
        return sum(array.capacity for array in self._arrays.values() if array is not None)


def roomier(sections: np.ndarray) -> np.ndarray:
    """Lengths for launches and lists that serve other poses of the same cage as well."""
    return sections + sections // 8 + 32


WORD = 4  # bytes; all slots are of 32-bit numbers


class PoseConstants:
    """Small named arrays on a device that are written on the host and sent together.

    slots: {name: (count, dtype)}, dtype int, float, wp.vec3 or wp.vec3i. `host[name]` are NumPy views of the staging
    buffer to be filled, `arrays[name]` the Warp arrays that `send` copies them to. Their addresses never change, so a
    CUDA graph can hold the copy.
    """

    def __init__(self, slots: dict, device):
        self.device = wp.get_device(device)
        words = sum(count * wp.types.type_size(dtype) for count, dtype in slots.values())
        pinned = self.device.is_cuda
        self._staging = wp.zeros(words, dtype=wp.int32, device="cpu" if pinned else self.device, pinned=pinned)
        self._buffer = wp.zeros(words, dtype=wp.int32, device=self.device) if pinned else self._staging
        self.host: dict[str, np.ndarray] = {}
        self.arrays: dict[str, wp.array] = {}
        begin = 0
        for name, (count, dtype) in slots.items():
            width = wp.types.type_size(dtype)
            scalar = np.int32 if dtype in (int, wp.int32, wp.vec3i) else np.float32
            view = self._staging.numpy()[begin : begin + count * width].view(scalar)
            self.host[name] = view if width == 1 else view.reshape(count, width)
            self.arrays[name] = wp.array(
                ptr=self._buffer.ptr + WORD * begin, dtype=dtype, shape=(count,), device=self.device
            )
            begin += count * width

    def send(self) -> None:
        """Copy all of them to the device; on the CPU they are there already."""
        if self._buffer is not self._staging:
            wp.copy(self._buffer, self._staging)


class SideStream:
    """A second stream of a CUDA device; on a CPU launches run in the order of the program.

    `fork` orders what is launched under it after all that came before; what comes after it need not wait, until `join`.
    """

    def __init__(self, device):
        self.device = wp.get_device(device)
        self._stream = wp.Stream(self.device) if self.device.is_cuda else None

    @contextlib.contextmanager
    def fork(self):
        """Launches under this run beside those that follow."""
        if self._stream is None:
            yield
            return
        with wp.ScopedStream(self._stream, sync_enter=True):
            yield

    def join(self) -> None:
        """What follows waits for all that was forked."""
        if self._stream is not None:
            self.device.stream.wait_stream(self._stream)
