"""The sums of splats/composite_slopes, a tile at a time: what a CPU does best."""

# Each entry of a splat in a tile has a row of sums of its own, so that no two tiles write to the same place, and the
# rows of a splat, which lie side by side in the order in which they were written before they were sorted by tile, are
# summed afterwards: on any number of threads the sums are the same to the bit.

import warp as wp

from ..core.native import native_source
from .tiles import TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func_native(native_source(__file__, "composite_slopes_tiles.h"))
def sum_tile_slopes(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    tiles: TileGrid,
    tile: int,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    entry_sums: wp.array(dtype=wp.float32),
):
    """The sums of the entries of a tile, on the CPU alone. Arrays without gaps."""
    ...


@wp.kernel
def sum_slopes_of_tiles(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    entry_sums: wp.array(dtype=wp.float32),
):
    """One item per tile; inputs and picture of splats/composite_tiles. sources: (entries,) place of each sorted entry
    among those that were written. slopes: (h * w,) of the loss by the picture. entry_sums: (9 entries,), by place."""
    tile = first + wp.tid()
    sum_tile_slopes(view, members, sources, starts[tile], starts[tile + 1], tiles, tile, stop, rgb, slopes, entry_sums)


@wp.kernel
def sum_slopes_of_splats(
    first: int,
    order: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int64),
    entry_sums: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
):
    """order: (n,) splats as they wrote their entries. ends: (n,) where the entries of each end. sums: (9 n,)."""
    i = first + wp.tid()
    begin = int(0)
    if i > 0:
        begin = int(ends[i - 1])
    end = int(ends[i])
    n = order[i]
    for k in range(9):
        total = float(0.0)
        for e in range(begin, end):
            total += entry_sums[9 * e + k]
        sums[9 * n + k] = total
