"""Device buffers that are kept from one pose to the next."""

from __future__ import annotations

import math

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
