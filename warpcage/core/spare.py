"""Memory of frames that a GPU's pool keeps for the next one, instead of giving it back to the driver each time."""

from __future__ import annotations

import weakref

import warp as wp

#: Frames of one size that may be dropped and made again without the driver.
SPARE_FRAMES = 2

#: Bytes that are kept at least, as a pool reserves memory in large pieces.
LEAST_SPARE = 64 << 20

#: The release threshold that was set last for each CUDA device, by ordinal.
_set: dict[int, int] = {}


class SpareMemory:
    """What one owner of frames lets the pool of its device keep."""

    # Whenever the host waits for a GPU, its pool gives back to the driver what it holds beyond its release threshold,
    # which is nothing by default. To get it anew takes the next frame longer than a launch. So the threshold follows
    # the memory in use, and leaves room for a few frames beside that. It goes back to nothing with the owner. A
    # threshold that a program has set itself stays as it is.

    def __init__(self, device: wp.Device):
        self._device = device if device.is_cuda and device.is_mempool_enabled else None
        if self._device is not None:
            weakref.finalize(self, _give_back, self._device).atexit = False

    def keep(self, size: int) -> None:
        """Keep memory for frames of so many bytes each, once they are dropped."""
        device = self._device
        if device is None:
            return
        room = max(SPARE_FRAMES * size, LEAST_SPARE)
        wanted, last = wp.get_mempool_used_mem_current(device) + room, _set.get(device.ordinal, 0)
        if abs(wanted - last) > room // 2 and wp.get_mempool_release_threshold(device) == last:
            wp.set_mempool_release_threshold(device, wanted)
            _set[device.ordinal] = wanted


def _give_back(device: wp.Device) -> None:
    """Let the pool of a device keep nothing, unless a program wants it to."""
    last = _set.pop(device.ordinal, 0)
    if last and wp.get_mempool_release_threshold(device) == last:
        wp.set_mempool_release_threshold(device, 0)
