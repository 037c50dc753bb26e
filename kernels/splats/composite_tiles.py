"""Draw the splats of each tile over each other, a tile at a time: what a CPU does best.

The equation is that of splats/composite. Each splat is drawn over the pixels of the tile that its ellipse covers, eight
of a row at once, so that a splat of a few pixels costs no more than these.
Needs: splats/tiles.
"""

import warp as wp

from .tiles import TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: C++ that the pass over the slopes of tiles shares: the pixels of a tile; a splat and the rows that it reaches; and,
#: of each of these, the pixels, eight at once, with two to the power of the exponent there.
PIXELS_OF_TILE = """    const int x0 = (tile % tiles.columns) * 16, y0 = (tiles.first_row + tile / tiles.columns) * 16;
    const int width = tiles.width - x0 < 16 ? tiles.width - x0 : 16;
    const int height = tiles.height - y0 < 16 ? tiles.height - y0 : 16;
"""
ROWS_OF_MEMBER = """        const float* p = reinterpret_cast<const float*>(view.data) + 12 * (size_t)members.data[e];
        const float u = p[0] - (float)x0, v = p[1] - (float)y0, strength = p[2], l0 = p[3], l1 = p[4], l2 = p[5];
        const float reach = strength - least;
        const float high = sqrtf(reach) / l2 + 0.002f;
        const float from = ceilf(v - high - 0.5f), to = floorf(v + high - 0.5f);
"""
RAISED_IN_ROW = """            const float dy = (float)y + 0.5f - v, s = l2 * dy;
            const float half = sqrtf(wp::max(reach - s * s, 0.0f)) * wide + 0.002f, middle = u - l1 * dy * wide;
            if (middle + half < 0.5f || middle - half > 15.5f)
                continue;
            const int first_part = middle - half > 7.5f ? 1 : 0, last_part = middle + half < 8.5f ? 0 : 1;
            const float kept = strength - s * s, shift = l1 * dy;
            for (int part = first_part; part <= last_part; ++part)
            {
                const lanes dx = steps + ((float)(8 * part) - u);
                const lanes w = l0 * dx + shift;
                const lanes power = kept - w * w;
                const bits drawn = (power >= least) & (left[y][part] > stop);
                // 2^power by its whole part, and a polynomial of the rest in [0, 1)
                const lanes held = power >= least ? power : (lanes)0.0f;
                const bits down = __builtin_convertvector(held - 1.0f, bits);
                const lanes f = held - __builtin_convertvector(down, lanes);
                lanes e2 = f * 1.87757513e-3f + 8.98934449e-3f;
                e2 = e2 * f + 5.58263136e-2f;
                e2 = e2 * f + 2.40153619e-1f;
                e2 = e2 * f + 6.93153073e-1f;
                e2 = e2 * f + 9.99999925e-1f;
                const lanes raised = (lanes)((bits)e2 + (down << 23));
"""


@wp.func_native(
    """
#if !defined(__CUDA_ARCH__)
    typedef float lanes __attribute__((ext_vector_type(8)));
    typedef int bits __attribute__((ext_vector_type(8)));
    const lanes steps = {0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
    const float least = -7.994353437f;
    lanes left[16][2], red[16][2], green[16][2], blue[16][2], far[16][2];
"""
    + PIXELS_OF_TILE
    + """    for (int y = 0; y < 16; ++y)
        for (int part = 0; part < 2; ++part)
        {
            const lanes x = steps + (float)(8 * part);
            const bits there = (x < (float)width) & (bits)(y < height ? -1 : 0);
            left[y][part] = (lanes)(there & (bits)((lanes)1.0f));
            red[y][part] = green[y][part] = blue[y][part] = far[y][part] = (lanes)0.0f;
        }
    int top = 0, bottom = height - 1;  // rows that still see something
    for (int e = begin; e < end; ++e)
    {
        if (((e - begin) & 15) == 15)
        {
            for (; top <= bottom; ++top)
            {
                float most = 0.0f;
                for (int x = 0; x < 8; ++x)
                    most = wp::max(most, wp::max(left[top][0][x], left[top][1][x]));
                if (most > stop)
                    break;
            }
            for (; bottom > top; --bottom)
            {
                float most = 0.0f;
                for (int x = 0; x < 8; ++x)
                    most = wp::max(most, wp::max(left[bottom][0][x], left[bottom][1][x]));
                if (most > stop)
                    break;
            }
            if (top > bottom)
                break;
        }
"""
    + ROWS_OF_MEMBER
    + """        const int first_row = from > (float)top ? (from > 16.0f ? 16 : (int)from) : top;
        const int last_row = to < (float)bottom ? (to < 0.0f ? -1 : (int)to) : bottom;
        const float wide = 1.0f / l0;
        for (int y = first_row; y <= last_row; ++y)
        {
"""
    + RAISED_IN_ROW
    + """                lanes alpha = raised < 0.999f ? raised : (lanes)0.999f;
                alpha = (lanes)((bits)alpha & drawn);
                const lanes weight = alpha * left[y][part];
                red[y][part] += weight * p[6];
                green[y][part] += weight * p[7];
                blue[y][part] += weight * p[8];
                far[y][part] += weight * (p[9] + p[11] * dy + p[10] * dx);
                left[y][part] -= weight;
            }
        }
    }
    float* colours = reinterpret_cast<float*>(rgb.data);
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
        {
            const int part = x >> 3, lane = x & 7;
            const size_t at = (size_t)(y0 + y) * tiles.width + x0 + x;
            const float rest = left[y][part][lane], opacity = 1.0f - rest;
            colours[3 * at] = red[y][part][lane] + rest * background.c[0];
            colours[3 * at + 1] = green[y][part][lane] + rest * background.c[1];
            colours[3 * at + 2] = blue[y][part][lane] + rest * background.c[2];
            alpha.data[at] = opacity;
            depth.data[at] = opacity > 1.0e-3f ? far[y][part][lane] / opacity : INFINITY;
        }
#endif
"""
)
def draw_tile(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    tiles: TileGrid,
    tile: int,
    background: wp.vec3,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """Draw a tile of 16x16 pixels, on the CPU alone. Arrays without gaps. Alphas are those of splats/project."""
    ...


@wp.kernel
def composite_tiles(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    background: wp.vec3,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """One item per tile. view: (3 n,) of splats/project. members: splats of all tiles, tile by tile from front to back.
    starts: (tiles + 1,) where each begins. Outputs (h * w,), row by row; depth: expected distance along the ray, world
    units, inf where almost nothing is seen."""
    tile = first + wp.tid()
    draw_tile(view, members, starts[tile], starts[tile + 1], tiles, tile, background, stop, rgb, alpha, depth)
