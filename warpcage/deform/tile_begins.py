"""Where the rays of a picture's tiles begin to meet anything."""

from __future__ import annotations

from typing import Any

import warp as wp

from ..core.devices import RepeatedLaunch
from ..kernels.deform.tile_begins import find_tile_begins
from ..lattice.capture import Buffer, BufferPool, SideStream

#: Streams whose buffers are kept.
MOST_KEPT = 4


class TileBegins:
    """Looks once for each tile of a view how far its rays go through what is empty.

    Args:
        side: The stream on which it looks, beside what is launched until that joins.
    """

    def __init__(self, side: SideStream):
        self._side, self._launch = side, RepeatedLaunch(find_tile_begins, side.device)
        self._kept: dict[int, Buffer] = {}

    def find(self, edit: Any, grid: Any, pinhole: Any, tiles: int) -> wp.array:
        """Of a view of one edit whose fine cells are told, or forked; after what came before the side stream's mark.

        Args:
            edit: The FlatEdit.
            grid: VoxelGrid of the field as it is marched.
            pinhole: The PinholeCamera, relative to the field's origin.
            tiles: Of the picture.

        Returns:
            (tiles,) float, distance before which the rays of a tile meet nothing; until the next view on the same
            stream.
        """
        begins = self._buffer().take(tiles)
        with self._side.fork(marked=True):
            self._launch(tiles, [grid, edit, pinhole], [begins])
        return begins

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
