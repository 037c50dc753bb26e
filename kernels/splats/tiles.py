"""Which splats each tile of a picture shows, from front to back."""

# Splats are sorted by depth and write an entry for every tile that their ellipse, not a box around it, touches; a
# stable sort by tile alone keeps the order of depth: two passes over entries instead of six for keys of both.

import warp as wp

from ..core.lanes import octet_count
from ..core.loads import vec4_entry
from .project import LOG2_MIN_ALPHA, band_columns

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

#: Pixels along each side of a tile.
TILE_SIDE = wp.constant(16)

#: Rows and columns of an ellipse are widened by this, pixels, so that rounding loses none of its pixels.
MARGIN = wp.constant(2.0e-3)


@wp.struct
class TileGrid:
    """Rows of tiles of a picture, or of several of one size, which are drawn at once."""

    columns: int
    rows: int
    first_row: int  # where they begin in the picture
    width: int  # of the picture, pixels
    height: int
    views: int  # pictures; their tiles, pixels and splats lie behind one another
    splats: int  # of each of several pictures


@wp.func
def first_tile(tiles: TileGrid, n: int):
    """Number of the first tile of the picture that splat n is seen in."""
    view = int(0)
    if tiles.views > 1:
        view = n // tiles.splats
    return view * tiles.rows * tiles.columns


@wp.func
def touched_rows(tiles: TileGrid, place: wp.vec4, shape: wp.vec4):
    """First and last row of tiles that a splat touches; the first is greater where it touches none."""
    reach = wp.sqrt(wp.max(place[2] - LOG2_MIN_ALPHA, 0.0)) / shape[1] + MARGIN
    # pixel i has its centre at i + 0.5
    low = wp.clamp(wp.ceil(place[1] - reach - 0.5), 0.0, float(tiles.height))
    high = wp.clamp(wp.floor(place[1] + reach - 0.5), -1.0, float(tiles.height - 1))
    first = int(1)
    last = int(0)
    if low <= high:
        first = wp.max(int(low) // TILE_SIDE, tiles.first_row)
        last = wp.min(int(high) // TILE_SIDE, tiles.first_row + tiles.rows - 1)
    return wp.vec2i(first, last)


@wp.func
def touched_columns(tiles: TileGrid, place: wp.vec4, shape: wp.vec4, row: int):
    """First and last column of the tiles that a splat touches in a row of them; the first is greater for none."""
    low = float(row * TILE_SIDE) + 0.5
    high = float(wp.min((row + 1) * TILE_SIDE, tiles.height)) - 0.5
    span = band_columns(place, shape, low - MARGIN, high + MARGIN)
    begin = wp.clamp(wp.ceil(span[0] - MARGIN - 0.5), 0.0, float(tiles.width))
    end = wp.clamp(wp.floor(span[1] + MARGIN - 0.5), -1.0, float(tiles.width - 1))
    first = int(1)
    last = int(0)
    if begin <= end:
        first = int(begin) // TILE_SIDE
        last = int(end) // TILE_SIDE
    return wp.vec2i(first, last)


@wp.kernel
def count_tiles(
    first: int,
    view: wp.array(dtype=wp.vec4),
    depths: wp.array(dtype=wp.float32),
    order: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    counts: wp.array(dtype=wp.int64),
):
    """view: (3 n,) of splats/project. depths: (n,) sorted, inf for what is not seen. order: (n,) splats in that order.
    counts: (n,) tiles that each touches, in that order."""
    i = first + wp.tid()
    count = int(0)
    if wp.isfinite(depths[i]):
        n = order[i]
        place = vec4_entry(view, 3 * n)
        shape = vec4_entry(view, 3 * n + 1)
        rows = touched_rows(tiles, place, shape)
        for row in range(rows[0], rows[1] + 1):
            columns = touched_columns(tiles, place, shape, row)
            count += wp.max(columns[1] + 1 - columns[0], 0)
    counts[i] = wp.int64(count)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned octet = 0xffu << (threadIdx.x & 24);
    int total = count;
    for (int reach = 1; reach < 8; reach <<= 1)
    {
        const int before = __shfl_up_sync(octet, total, reach, 8);
        if ((threadIdx.x & 7) >= reach)
            total += before;
    }
    return wp::vec_t<2, wp::int32>(total - count, __shfl_sync(octet, total, 7, 8));
#else
    return wp::vec_t<2, wp::int32>(0, count);
#endif
""")
def counts_of_octet(count: wp.int32) -> wp.vec2i:
    """Sums of the counts of the lanes of an octet before this one, and of all of them. All lanes of the octet."""
    ...


@wp.kernel
def write_entries(
    first: int,
    view: wp.array(dtype=wp.vec4),
    order: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int64),
    tiles: TileGrid,
    room: int,
    keys: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
):
    """An octet per splat, a lane of it per row of tiles. ends: (n,) running sums of the counts. keys, members: tile
    and splat of each entry, `room` of them at most."""
    item = first + wp.tid()
    lanes = octet_count()
    i = item // lanes
    lane = item % lanes
    at = int(0)
    if i > 0:
        at = int(wp.min(ends[i - 1], wp.int64(room)))
    end = int(wp.min(ends[i], wp.int64(room)))
    if at == end:
        return
    n = order[i]
    place = vec4_entry(view, 3 * n)
    shape = vec4_entry(view, 3 * n + 1)
    rows = touched_rows(tiles, place, shape)
    for begin in range(rows[0], rows[1] + 1, lanes):
        row = begin + lane
        count = int(0)
        columns = wp.vec2i(1, 0)
        if row <= rows[1]:
            columns = touched_columns(tiles, place, shape, row)
            count = wp.max(columns[1] + 1 - columns[0], 0)
        counts = counts_of_octet(count)
        for k in range(count):
            if at + counts[0] + k < end:
                tile = (row - tiles.first_row) * tiles.columns + columns[0] + k
                keys[at + counts[0] + k] = first_tile(tiles, n) + tile
                members[at + counts[0] + k] = n
        at += counts[1]
    at += lane
    while at < end:  # the two kernels may be compiled to round otherwise; these are behind all tiles
        keys[at] = tiles.views * tiles.rows * tiles.columns
        members[at] = n
        at += lanes


@wp.kernel
def find_tile_starts(first: int, keys: wp.array(dtype=wp.int32), count: int, starts: wp.array(dtype=wp.int32)):
    """keys: (count,) sorted. starts: (tiles + 1,) the first entry of each tile, and of those behind all tiles."""
    tile = first + wp.tid()
    low = int(0)
    high = count
    while low < high:
        middle = low + (high - low) // 2
        if keys[middle] < tile:
            low = middle + 1
        else:
            high = middle
    starts[tile] = low
