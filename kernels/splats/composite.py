"""Draw the splats of each tile over each other, from front to back.

C = sum_i T_i alpha_i c_i + T_end background, T_i = prod_{j<i} (1 - alpha_j) (Kerbl et al. 2023, Eq. 3), and in the same
way the expected distance sum_i T_i alpha_i t_i / (1 - T_end). A pixel ends where its T falls below `stop`.

For CUDA; on the CPU it is splats/composite_tiles. A warp has 8x4 pixels of a tile to itself: its lanes look at 32
splats of the tile's list at once and put those whose ellipse touches these pixels side by side, in order; then each
lane draws them over its pixel, one after the other.
Needs: splats/tiles.
"""

import warp as wp

from .tiles import TILE_SIDE, TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 256})

#: A pixel has a depth where it is at least this opaque.
DEPTH_MIN_ALPHA = wp.constant(1.0e-3)

vec5 = wp.types.vector(length=5, dtype=wp.float32)


#: C++ that the pass over the slopes of pixels shares: the box of a warp's pixels; which of the members that its lanes
#: have read reach that, and where they are kept; and the exponent of a kept one at a pixel.
PIXELS_OF_WARP = """    const float left = x - (float)(lane & 7), top = y - (float)(lane >> 3);
    const float low = top - 0.002f, high = top + 3.002f, right = left + 7.002f;
"""
REACHING_MEMBERS = """            const float reach = a.z + 7.994353437f;
            const float root = sqrtf(fmaxf(reach, 0.0f)), lean = b.x / b.y;
            const float from = fmaxf(b.y * (low - a.y), -root), to = fminf(b.y * (high - a.y), root);
            const float extreme = lean * root * rsqrtf(1.0f + lean * lean);
            const float p = fminf(fmaxf(-extreme, from), to), q = fminf(fmaxf(extreme, from), to);
            const float greatest = sqrtf(fmaxf(reach - p * p, 0.0f)) - lean * p;
            const float least = sqrtf(fmaxf(reach - q * q, 0.0f)) + lean * q;
            touched = from <= to && a.w * (left - 0.002f - a.x) <= greatest && a.w * (a.x - right) <= least;
        }
        const unsigned which = __ballot_sync(0xffffffffu, touched);
        if (touched)
        {
            float4* slot = rows[warp][__popc(which & ((1u << lane) - 1u))];
            slot[0] = a;
            slot[1] = b;
"""
POWER_AT_PIXEL = """            const float4 a = rows[warp][k][0], b = rows[warp][k][1];
            const float dx = x - a.x, dy = y - a.y;
            const float w = a.w * dx + b.x * dy, s = b.y * dy;
            const float power = a.z - w * w - s * s;
"""


@wp.func_native(
    """
    wp::vec_t<5, wp::float32> seen;
#if defined(__CUDA_ARCH__)
    __shared__ float4 rows[8][32][3];
    const int warp = (threadIdx.x >> 5) & 7, lane = threadIdx.x & 31;
    const float4* rows_of = reinterpret_cast<const float4*>(view.data);
    const int* member = reinterpret_cast<const int*>(members.data);
"""
    + PIXELS_OF_WARP
    + """    float T = inside ? 1.0f : 0.0f, red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f;
    for (int base = begin; base < end; base += 32)
    {
        if (__ballot_sync(0xffffffffu, T > stop) == 0u)
            break;
        bool touched = false;
        float4 a, b;
        const float4* row = rows_of;
        if (base + lane < end)
        {
            row += 3u * (unsigned)member[base + lane];
            a = row[0];
            b = row[1];
"""
    + REACHING_MEMBERS
    + """            slot[2] = row[2];
        }
        __syncwarp();
        const int count = __popc(which);
        for (int k = 0; k < count; ++k)
        {
"""
    + POWER_AT_PIXEL
    + """            if (power >= -7.994353437f && T > stop)
            {
                const float4 c = rows[warp][k][2];
                const float alpha = fminf(exp2f(power), 0.999f);
                const float weight = alpha * T;
                red += weight * b.z;
                green += weight * b.w;
                blue += weight * c.x;
                depth += weight * (c.y + c.z * dx + c.w * dy);
                T -= weight;
            }
        }
        __syncwarp();
    }
    seen.c[0] = red;
    seen.c[1] = green;
    seen.c[2] = blue;
    seen.c[3] = depth;
    seen.c[4] = T;
#endif
    return seen;
"""
)
def drawn_pixel(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    x: float,
    y: float,
    inside: int,
    stop: float,
) -> vec5:
    """Red, green, blue and depth, weighted, and what is left of the light, of a pixel with its centre at x, y.

    All lanes of a warp, which has 8x4 pixels, row by row; blocks of up to 256 threads."""
    ...


@wp.kernel
def composite_pixels(
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
    """One thread per pixel of the tiles, 32 of them 8x4 pixels. view: (3 n,) of splats/project. members: splats of all
    tiles, tile by tile from front to back. starts: (tiles + 1,) where each begins. Outputs (h * w,), row by row; depth:
    expected distance along the ray, world units, inf where almost nothing is seen."""
    n = first + wp.tid()
    tile = n // (TILE_SIDE * TILE_SIDE)
    block = (n // 32) % (TILE_SIDE * TILE_SIDE // 32)
    lane = n % 32
    across = TILE_SIDE // 8
    column = (tile % tiles.columns) * TILE_SIDE + (block % across) * 8 + lane % 8
    row = (tiles.first_row + tile // tiles.columns) * TILE_SIDE + (block // across) * 4 + lane // 8
    inside = 0
    if column < tiles.width and row < tiles.height:
        inside = 1
    seen = drawn_pixel(
        view, members, starts[tile], starts[tile + 1], float(column) + 0.5, float(row) + 0.5, inside, stop
    )
    if inside == 1:
        at = row * tiles.width + column
        left = seen[4]
        opacity = 1.0 - left
        rgb[at] = wp.vec3(seen[0], seen[1], seen[2]) + left * background
        alpha[at] = opacity
        depth[at] = wp.where(opacity > DEPTH_MIN_ALPHA, seen[3] / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)
