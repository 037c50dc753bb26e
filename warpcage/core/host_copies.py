"""Copies to the host that nobody waits for yet: they follow what was launched, and other work goes on behind them."""

from __future__ import annotations

import functools
import threading
import time

import numpy as np
import warp as wp

from .arrays import array_view, empty_array
from .locks import device_turn

#: Bytes of page-locked memory for the copies of a device, at most. Further ones are waited for when they are made.
MOST_STAGED = 1 << 28

#: Sizes of pieces of that memory are multiples of this.
PIECE = 1 << 16

#: Seconds between two looks at a copy, and after which the device is asked whether it still works.
LOOK, PATIENCE = 2.0e-4, 2.0

#: Bytes at the beginning of a piece, where the number stands.
HEAD = 64

#: What the number is where nobody names another.
THERE = 1


class HostCopy:
    """A copy of a contiguous array on a CUDA device, as it is when all is done that was launched before.
    `state`, (1,) int32 on its device and not 0 by then, comes with the copy; None is THERE."""

    # Behind each copy the device writes a number into memory that the host reads. Whoever needs the copy looks at that
    # number, in any thread and without a word to the device: its turn (`device_turn`) stays with the thread that
    # launches.

    def __init__(self, array: wp.array, state: wp.array | None = None):
        assert array.device is not None
        self._device = array.device
        with device_turn(self._device):
            self._piece = _staging(self._device.ordinal).take(array.capacity)
            if self._piece is None:
                self._found = array.numpy(), THERE if state is None else int(state.numpy()[0])
                return
            self._piece.send(array, state)

    def wait(self) -> tuple[np.ndarray, int]:
        """Wait until it is there: (bytes,) uint8, and the number of `state`; RuntimeError where the device failed.
        The memory is given to other copies once nothing refers to the array."""
        if self._piece is None:
            array, state = self._found
            return array.reshape(-1).view(np.uint8), state
        patience = time.monotonic() + PATIENCE
        while not self._piece.state:
            time.sleep(LOOK)
            if time.monotonic() > patience:
                with device_turn(self._device):
                    _staging(self._device.ordinal).there.numpy()  # waits, and raises where the device failed
                patience = time.monotonic() + PATIENCE
        return np.asarray(self._piece), self._piece.state


class _Piece:
    """A piece of page-locked memory, for one copy. It is given back when nothing refers to it or to its array."""

    def __init__(self, staging: _Staging, block: wp.array, size: int):
        self._staging, self._block, self._size = staging, block, size
        assert block.ptr is not None
        self.__array_interface__ = {"version": 3, "shape": (size,), "typestr": "|u1", "data": (block.ptr + HEAD, False)}

    @property
    def state(self) -> int:
        """The number behind the copy; 0 until it is there."""
        return _state(self._block)

    def send(self, array: wp.array, state: wp.array | None) -> None:
        """Launch the copy."""
        self._block.numpy()[:HEAD] = 0
        wp.copy(array_view(self._block, wp.uint8, self._size, offset=HEAD), array_view(array, wp.uint8, self._size))
        wp.copy(array_view(self._block, wp.int32, 1), self._staging.there if state is None else state)

    def __del__(self):
        self._staging.give_back(self._block)


class _Staging:
    """Page-locked memory for copies from a device, used again and again."""

    def __init__(self, ordinal: int):
        self._lock = threading.Lock()
        self._free: dict[int, list[wp.array]] = {}
        self._made = 0  # bytes
        self.there = wp.full(1, THERE, dtype=wp.int32, device=f"cuda:{ordinal}")

    def take(self, size: int) -> _Piece | None:
        """A piece of so many bytes; None where there is no more memory for one."""
        rounded = -(-(HEAD + size) // PIECE) * PIECE
        with self._lock:
            free = self._free.setdefault(rounded, [])
            # one that nobody waited for may still be written to
            place = next((place for place, block in enumerate(free) if _state(block)), None)
            if place is not None:
                return _Piece(self, free.pop(place), size)
            if self._made + rounded > MOST_STAGED:
                self._drop_free()
            if self._made + rounded > MOST_STAGED:
                return None
            self._made += rounded
        return _Piece(self, empty_array(rounded, wp.uint8, "cpu", pinned=True), size)

    def give_back(self, block: wp.array) -> None:
        """Take a piece for used no more. It may be called in any thread, wherever something is freed."""
        self._free[block.size].append(block)

    def _drop_free(self) -> None:
        """Let go of pieces that nobody uses, which may be of other sizes."""
        for size, free in self._free.items():
            for place in reversed(range(len(free))):  # others may come at the end meanwhile
                if _state(free[place]):
                    del free[place]
                    self._made -= size


def _state(block: wp.array) -> int:
    """The number at the beginning of a piece."""
    return int(block.numpy()[:4].view(np.int32)[0])


@functools.cache
def _staging(ordinal: int) -> _Staging:
    return _Staging(ordinal)
