"""The tiles of a picture in the order of how long they took in the view before, the longest first."""

# A GPU starts tiles one after the other, and idles where the longest come last. So each tile notes its clock ticks, and
# the next view of as many tiles begins with the longest (Graham, "Bounds on multiprocessing timing anomalies", SIAM J.
# Appl. Math. 17, 1969). Each tile is followed once in any order, so no picture changes.

import warp as wp

from ..core.lanes import count_up
from .rays import TILE_SIZE

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Tiles are sorted by the logarithm of their ticks: so many bins, and so many for a factor of two.
TILE_BINS = wp.constant(256)
BINS_PER_OCTAVE = wp.constant(8.0)

#: Ticks are counted in 32 bits; the largest number of them.
MAX_TICKS = wp.constant(0x7FFFFFFF)


@wp.struct
class TileOrder:
    """In which order tiles are followed; of no arrays, as they lie in the picture, on a CPU."""

    tiles: wp.array(dtype=wp.int32)  # (tiles,), each once
    ticks: wp.array(dtype=wp.int32)  # (tiles,), of the view that is being made


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned ticks;
    asm volatile("mov.u32 %0, %clock;" : "=r"(ticks) :: "memory");
    return (int)ticks;
#else
    return 0;
#endif
""")
def clock_ticks() -> int:
    """Ticks of a multiprocessor's clock, modulo 2^32; 0 on a CPU."""
    ...


@wp.func
def ordered_item(order: TileOrder, item: int):
    """Which item of a picture, tile by tile, an item of a launch follows."""
    result = int(item)
    if order.tiles.shape[0] > 0:
        result = order.tiles[item // TILE_SIZE] * TILE_SIZE + item % TILE_SIZE
    return result


@wp.func
def note_ticks(order: TileOrder, item: int, begin: int):
    """Note how long the tile of an item took at least, since `begin`."""
    if order.ticks.shape[0] > 0:
        wp.atomic_max(order.ticks, item // TILE_SIZE, (clock_ticks() - begin) & MAX_TICKS)


@wp.func
def tile_bin(ticks: int):
    """Bin of a tile; those of long ones come first."""
    return TILE_BINS - 1 - wp.min(int(wp.log2(float(wp.max(ticks, 1))) * BINS_PER_OCTAVE), TILE_BINS - 1)


@wp.kernel
def count_tiles(first: int, tiles: int, ticks: wp.array(dtype=wp.int32), bins: wp.array(dtype=wp.int32)):
    """How many tiles of each launch are in each bin. One item a tile, launch by launch.
    tiles: of a launch; ticks: (launches * tiles,); bins: (launches * 2 * TILE_BINS,), 0 before."""
    n = first + wp.tid()
    count_up(bins, 2 * TILE_BINS * (n // tiles) + tile_bin(ticks[n]))


@wp.kernel
def sort_tiles(
    first: int,
    tiles: int,
    bins: wp.array(dtype=wp.int32),
    spare: wp.array(dtype=wp.int32),
    ticks: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
):
    """Put the tiles of each launch in the order of their bins, and set ticks and the bins of the next view to 0.
    bins: what count_tiles counted, and how many of each bin have their place, 0 before. spare: as many."""
    n = first + wp.tid()
    launch = n // tiles
    own = tile_bin(ticks[n])
    begin = 2 * TILE_BINS * launch
    place = count_up(bins, begin + TILE_BINS + own)
    for bin in range(own):
        place += bins[begin + bin]
    order[launch * tiles + place] = n - launch * tiles
    ticks[n] = 0
    for i in range(n, spare.shape[0], order.shape[0]):
        spare[i] = 0
