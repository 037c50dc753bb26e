"""What a pose uploads, in one transfer."""

from __future__ import annotations

import numpy as np
import warp as wp

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
