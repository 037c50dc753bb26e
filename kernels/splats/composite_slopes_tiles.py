"""The sums of splats/composite_slopes, a tile at a time: what a CPU does best.

Each entry of a splat in a tile has a row of sums of its own, so that no two tiles write to the same place, and the rows
of a splat, which lie side by side in the order in which they were written before they were sorted by tile, are summed
afterwards: on any number of threads the sums are the same to the bit.
Needs: splats/composite_tiles, splats/tiles.
"""

import warp as wp

from .composite_tiles import PIXELS_OF_TILE, RAISED_IN_ROW, ROWS_OF_MEMBER
from .tiles import TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func_native(
    """
#if !defined(__CUDA_ARCH__)
    typedef float lanes __attribute__((ext_vector_type(8)));
    typedef int bits __attribute__((ext_vector_type(8)));
    const lanes steps = {0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
    const float least = -7.994353437f;
    lanes left[16][2], behind[16][2], slope[3][16][2];
"""
    + PIXELS_OF_TILE
    + """    const float* colours = reinterpret_cast<const float*>(rgb.data);
    const float* given = reinterpret_cast<const float*>(slopes.data);
    for (int y = 0; y < 16; ++y)
        for (int x = 0; x < 16; ++x)
        {
            const int part = x >> 3, lane = x & 7;
            const bool there = x < width && y < height;
            const size_t at = 3 * ((size_t)(y0 + y) * tiles.width + x0 + x);
            float rest = 0.0f;
            for (int c = 0; c < 3; ++c)
            {
                const float g = there ? given[at + c] : 0.0f;
                slope[c][y][part][lane] = g;
                rest += there ? g * colours[at + c] : 0.0f;
            }
            behind[y][part][lane] = rest;
            left[y][part][lane] = there ? 1.0f : 0.0f;
        }
    for (int e = begin; e < end; ++e)
    {
"""
    + ROWS_OF_MEMBER
    + """        const int first_row = from > 0.0f ? (from > 16.0f ? 16 : (int)from) : 0;
        const int last_row = to < (float)(height - 1) ? (to < 0.0f ? -1 : (int)to) : height - 1;
        const float wide = 1.0f / l0;
        lanes found[9];
        for (int i = 0; i < 9; ++i)
            found[i] = (lanes)0.0f;
        for (int y = first_row; y <= last_row; ++y)
        {
"""
    + RAISED_IN_ROW
    + """                const bits free = drawn & (raised < 0.999f);
                lanes alpha = raised < 0.999f ? raised : (lanes)0.999f;
                alpha = (lanes)((bits)alpha & drawn);
                const lanes weight = alpha * left[y][part];
                const lanes gx = slope[0][y][part], gy = slope[1][y][part], gz = slope[2][y][part];
                const lanes lit = gx * p[6] + gy * p[7] + gz * p[8];
                behind[y][part] -= weight * lit;
                lanes q = 0.6931471806f * alpha * (left[y][part] * lit - behind[y][part] / (1.0f - alpha));
                q = (lanes)((bits)q & free);
                left[y][part] -= weight;
                const lanes qw = q * w, qs = q * s;
                found[0] += q;
                found[1] += qw;
                found[2] += qs;
                found[3] += qw * dx;
                found[4] += qw * dy;
                found[5] += qs * dy;
                found[6] += weight * gx;
                found[7] += weight * gy;
                found[8] += weight * gz;
            }
        }
        float* row = reinterpret_cast<float*>(entry_sums.data) + 9 * (size_t)sources.data[e];
        for (int i = 0; i < 9; ++i)
        {
            float total = 0.0f;
            for (int lane = 0; lane < 8; ++lane)
                total += found[i][lane];
            row[i] = total;
        }
    }
#endif
"""
)
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
