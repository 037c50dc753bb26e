"""Where the rays of a picture's tiles begin to meet anything."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from ..core.arrays import array_view, struct_array
from ..core.devices import RepeatedLaunches
from ..kernels.edits.structs import FlatEdit
from ..kernels.render.beams import find_tile_begins, find_tile_begins_of_edits
from ..lattice.buffers import Buffer, BufferPool, SideStream

#: Streams whose buffers are kept.
MOST_KEPT = 4

#: Bytes of a distance.
DISTANCE_BYTES = wp.types.type_size_in_bytes(wp.float32)


class TileBegins:
    """Looks once for each tile of a view how far its rays go through what is empty.
    It looks on the stream `side`, beside what is launched until that joins."""

    def __init__(self, side: SideStream):
        self._side, self._launch = side, RepeatedLaunches(side.device)
        self._kept: dict[int, Buffer] = {}
        self._edits: tuple[list[Any], wp.array] | None = None
        self._ready: tuple[wp.array | None, wp.array | None] = None, None

    def find(self, edits: Sequence[Any], grid: Any, pinhole: Any, tiles: int) -> list[wp.array]:
        """(tiles,) float of each FlatEdit: distance before which a tile's rays meet nothing, until the stream's next
        view. Fine cells are told by now, or forked; it looks after what came before the side stream's mark."""
        is_single = len(edits) == 1  # an argument takes the host less time than an array
        needed = self._buffer().take(len(edits) * tiles), None if is_single else self._array_of(edits)
        if any(array is not before for array, before in zip(needed, self._ready, strict=True)):
            self._side.mark()  # what is new was made behind the mark
            self._ready = needed
        begins, array = needed
        stream = self._side.behind_mark()
        if is_single:
            self._launch(find_tile_begins, tiles, [grid, edits[0], pinhole], [begins], stream=stream)
            return [begins]
        inputs = [tiles, grid, array, pinhole]
        self._launch(find_tile_begins_of_edits, begins.size, inputs, [begins], stream=stream)
        return [
            array_view(begins, wp.float32, tiles, offset=number * tiles * DISTANCE_BYTES)
            for number in range(len(edits))
        ]

    def _array_of(self, edits: Sequence[Any]) -> wp.array:
        """The edits on the device, once for those of a pose in their order."""
        kept = self._edits
        if kept is None or [id(edit) for edit in kept[0]] != [id(edit) for edit in edits]:
            self._edits = kept = list(edits), struct_array(edits, FlatEdit, self._side.device)
        return kept[1]

    def _buffer(self) -> Buffer:
        """Of the current stream: frames of one follow each other, those of several need not."""
        device = self._side.device
        key = int(device.stream.cuda_stream or 0) if device.is_cuda else 0
        kept = self._kept.pop(key, None)
        if kept is None:
            kept = BufferPool(device).buffer(wp.float32)
            while len(self._kept) >= MOST_KEPT:
                del self._kept[next(iter(self._kept))]  # used longest ago
        self._kept[key] = kept
        return kept
