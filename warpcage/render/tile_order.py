"""The order of tiles of a picture on a GPU that keeps it busy until the last one ends."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view
from ..core.devices import RecordedLaunch
from ..kernels.view.tile_order import TILE_BINS, TileOrder, count_tiles, sort_tiles

#: Kinds of views that are kept: of a size, through as many launches, on a stream.
MAX_KEPT = 4


class BalancedTiles:
    """The tiles of views that follow each other, sorted by how long each took in the one before."""

    def __init__(self, device: wp.Device):
        self._device = device
        self._kept: dict[tuple[int, int, int], SortedTiles] = {}
        self._begun: tuple[tuple[int, int, int], SortedTiles] | None = None

    def begin(self, launches: int, tiles: int) -> list[Any]:
        """A TileOrder for each launch of a view of so many tiles; call `end` behind the last of them."""
        if self._device.is_cpu:  # tiles are followed as they lie in the picture
            return launches * [TileOrder()]
        # frames of one stream follow each other, those of several need not
        key = launches, tiles, int(self._device.stream.cuda_stream or 0)
        kept = self._kept.pop(key, None)  # an interrupt leaves none
        if kept is None:
            kept = SortedTiles(launches, tiles, self._device)
        self._begun = key, kept
        return kept.orders

    def end(self) -> None:
        """Sort the tiles by how long the view took."""
        begun, self._begun = self._begun, None
        if begun is not None:
            key, kept = begun
            kept.sort()
            while len(self._kept) >= MAX_KEPT:
                del self._kept[next(iter(self._kept))]  # used longest ago
            self._kept[key] = kept


class SortedTiles:
    """Orders of the launches of a view on CUDA, as the tiles lie in the picture until they are sorted."""

    def __init__(self, launches: int, tiles: int, device: wp.Device):
        self._device, self._tiles = device, tiles
        order = np.tile(np.arange(tiles, dtype=np.int32), launches)
        self._order = wp.array(order, dtype=wp.int32, device=device)
        self._ticks = wp.zeros(launches * tiles, dtype=wp.int32, device=device)
        # counts for the next sort, all 0 before it, and those of the last one
        self.bins = [wp.zeros(launches * 2 * int(TILE_BINS), dtype=wp.int32, device=device) for _ in range(2)]
        self._count, self._sort = (RecordedLaunch(kernel, device) for kernel in (count_tiles, sort_tiles))
        self.orders = [self._order_of(number) for number in range(launches)]

    def _order_of(self, number: int) -> Any:
        result = TileOrder()
        arrays = (self._order, self._ticks)
        begin = number * self._tiles * wp.types.type_size_in_bytes(wp.int32)
        result.tiles, result.ticks = (array_view(each, wp.int32, self._tiles, offset=begin) for each in arrays)
        return result

    def sort(self) -> None:
        bins, spare = self.bins
        count = self._ticks.shape[0]
        self._count(count, [self._tiles, self._ticks], [bins])
        self._sort(count, [self._tiles, bins], [spare, self._ticks, self._order])
        self.bins = [spare, bins]
