"""Where the rays of a picture's tiles begin to meet anything."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from ..core.devices import RepeatedLaunches
from ..kernels.deform.tile_begins import find_tile_begins
from ..lattice.capture import Buffer, BufferPool, SideStream

#: Streams whose buffers are kept.
MOST_KEPT = 4


class TileBegins:
    """Looks once for each tile of a view how far its rays go through what is empty.

    Args:
        edit_count: Number of edits.
        side: The stream on which it looks, beside what is launched until that joins.
    """

    def __init__(self, edit_count: int, side: SideStream):
        self._side, self._count = side, edit_count
        self._launch = RepeatedLaunches(side.device)
        self._kept: dict[int, list[Buffer]] = {}

    def find(self, edits: Sequence[Any], grid: Any, pinhole: Any, tiles: int) -> list[wp.array]:
        """Of a view whose fine cells are told, or forked; after what came before the side stream's mark.

        Args:
            edits: The FlatEdits, each marched by itself.
            grid: VoxelGrid of the field as it is marched.
            pinhole: The PinholeCamera, relative to the field's origin.
            tiles: Of the picture.

        Returns:
            (tiles,) float of each edit, distance before which the rays of a tile meet nothing; until the next view on
            the same stream.
        """
        found = [buffer.take(tiles) for buffer in self._buffers()[: len(edits)]]
        with self._side.fork(marked=True):
            for number, (edit, begins) in enumerate(zip(edits, found, strict=True)):
                self._launch(find_tile_begins, tiles, [grid, edit, pinhole], [begins], number=number)
        return found

    def _buffers(self) -> list[Buffer]:
        """Of the current stream: frames of one follow each other, those of several need not."""
        device = self._side.device
        key = int(device.stream.cuda_stream or 0) if device.is_cuda else 0
        kept = self._kept.pop(key, None)
        if kept is None:
            pool = BufferPool(device)
            kept = [pool.buffer(wp.float32) for _ in range(self._count)]
            while len(self._kept) >= MOST_KEPT:
                del self._kept[next(iter(self._kept))]  # used longest ago
        self._kept[key] = kept
        return kept
