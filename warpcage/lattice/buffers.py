"""Buffers, constants and streams that poses share, so that launches can be captured."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..core.arrays import array_view, empty_array

#: Views of a buffer that are kept, of poses of different shapes.
MAX_VIEWS = 64

WORD = 4  # bytes; all constants are 32-bit numbers


class BufferPool:
    """The buffers of one owner on a device."""

    def __init__(self, device: wp.DeviceLike):
        self.device = wp.get_device(device)
        self.generation = 0  # goes up whenever a buffer moves: a CUDA graph captured over them is valid while it stays
        self._buffers: list[Buffer] = []

    def buffer(self, dtype) -> Buffer:
        """A new buffer for items of a type, still empty."""
        self._buffers.append(Buffer(self, dtype))
        return self._buffers[-1]

    @property
    def bytes(self) -> int:
        """Bytes held on the device."""
        return sum(buffer.bytes for buffer in self._buffers)


class Buffer:
    """A flat array that only grows, so that a new pose of about the same shape allocates nothing; see
    `BufferPool.buffer`."""

    def __init__(self, pool: BufferPool, dtype):
        self._pool, self._dtype = pool, dtype
        self._held: wp.array | None = None
        self._views: dict[tuple[int, ...], wp.array] = {}

    def take(self, shape: int | tuple[int, ...]) -> wp.array:
        """A contiguous view of what the buffer holds; it grows where it is too small, and loses its contents then."""
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        view = self._views.get(shape)  # views of one shape are the same object: making one takes a few microseconds
        if view is None:
            view = self._view(shape)
            if len(self._views) >= MAX_VIEWS:
                self._views.clear()
            self._views[shape] = view
        return view

    def _view(self, shape: tuple[int, ...]) -> wp.array:
        count = math.prod(shape)
        if count == 0:
            return empty_array(shape, self._dtype, self._pool.device)
        held = self._held
        if held is None or held.size < count:
            spare = 0 if held is None else count // 16  # poses of one cage differ by little
            self._held = held = None  # the old array goes before the new one comes
            self._views.clear()
            self._held = held = empty_array(count + spare, self._dtype, self._pool.device)
            self._pool.generation += 1
        return array_view(held, self._dtype, shape)

    @property
    def bytes(self) -> int:
        """Bytes held on the device."""
        return 0 if self._held is None else self._held.capacity


@dataclass(frozen=True, eq=False)
class Constant:
    """A small array that the host writes in `host` and the device reads in `array`, once it is sent."""

    host: np.ndarray
    array: wp.array


class PoseConstants:
    """Small arrays, each of a length and a type (int, float, wp.vec3 or wp.vec3i), written on the host and sent
    together. Their addresses never change, so a CUDA graph can hold the copy."""

    def __init__(self, device: wp.DeviceLike, slots: Sequence[tuple[int, type]]):
        device = wp.get_device(device)
        widths = [wp.types.type_size(dtype) for _, dtype in slots]
        length = sum(count * width for (count, _), width in zip(slots, widths, strict=True))
        pinned = device.is_cuda
        self._staging = wp.zeros(length, dtype=wp.int32, device="cpu" if pinned else device, pinned=pinned)
        self._buffer = wp.zeros(length, dtype=wp.int32, device=device) if pinned else self._staging
        self.slots: list[Constant] = []
        begin = 0
        for (count, dtype), width in zip(slots, widths, strict=True):
            scalar = np.int32 if dtype in (int, wp.int32, wp.vec3i) else np.float32
            host = self._staging.numpy()[begin : begin + count * width].view(scalar)
            array = array_view(self._buffer, dtype, count, offset=WORD * begin)
            self.slots.append(Constant(host if width == 1 else host.reshape(count, width), array))
            begin += count * width

    def send(self) -> None:
        """Copy all of them to the device; on the CPU they are there already."""
        if self._buffer is not self._staging:
            wp.copy(self._buffer, self._staging)


class HostNumbers:
    """Numbers that a device writes where the host reads them, without a copy."""

    def __init__(self, count: int, device: wp.DeviceLike):
        self._device = wp.get_device(device)
        held = wp.zeros(count, dtype=wp.float32, device="cpu", pinned=self._device.is_cuda)
        self._host = held.numpy()
        self.array = array_view(held, wp.float32, count, device=self._device)  # (count,) float, for kernels

    def wait(self) -> np.ndarray:
        """Wait for all that was launched; (count,) float32 as the device wrote them, until it writes again."""
        if self._device.is_cuda:
            wp.synchronize_stream(self._device.stream)
        return self._host


class SideStream:
    """A second stream of a CUDA device; on a CPU launches run in the order of the program.
    Priority -1 lets its launches start before blocks of the program's stream that have not."""

    def __init__(self, device: wp.DeviceLike, priority: int = 0):
        self.device = wp.get_device(device)
        is_cuda = self.device.is_cuda
        self._stream = wp.Stream(self.device, priority=priority) if is_cuda else None
        self._mark = wp.Event(self.device) if is_cuda else None

    def mark(self) -> None:
        """Remember what came before, for `behind_mark`."""
        if self._mark is not None:
            self.device.stream.record_event(self._mark)

    def behind_mark(self) -> wp.Stream | None:
        """The stream, None on a CPU, for launches after all that came before `mark`, and after what was forked since.
        They run beside those that follow until `join`."""
        if self._stream is not None and self._mark is not None:
            self._stream.wait_event(self._mark)
        return self._stream

    @contextlib.contextmanager
    def fork(self) -> Iterator[None]:
        """Launches under this run after all that came before, beside those that follow until `join`."""
        if self._stream is None:
            yield
            return
        with wp.ScopedStream(self._stream, sync_enter=True):
            yield

    def join(self) -> None:
        """What follows waits for all that was forked."""
        if self._stream is not None:
            self.device.stream.wait_stream(self._stream)


class StreamOrder:
    """Lets work of one owner on several streams of a CUDA device follow each other."""

    def __init__(self, device: wp.DeviceLike):
        self._device = wp.get_device(device)
        self._last: wp.Stream | None = None

    def follow(self) -> None:
        """What is launched next on the current stream waits for what was on the one that was current at the last
        call."""
        if self._device.is_cuda:
            stream = self._device.stream
            if self._last is not None and self._last is not stream:
                stream.wait_stream(self._last)
            self._last = stream
