"""Slopes of a loss by what splats/project says of each splat, from those by the pixels of a picture.

The picture is drawn once more, front to back, as in splats/composite. With T the light that is left before a splat, g
the slope by the pixel's colour C, P what the splats up to this one have added to C . g, and l = c . g of its colour,

    dL/dalpha = T l - (C . g - P) / (1 - alpha),

as what lies behind is the rest of the picture: nothing need be kept of the pixels but their colour. An alpha that is
held at 0.999 has no slope. With q = dL/dpower = dL/dalpha alpha ln 2, power = strength - w^2 - s^2, w = l_0 dx + l_1 dy
and s = l_2 dy, nine sums over the pixels are all that the slopes of a splat are made of:

    q    q w    q s    q w dx    q w dy    q s dy    T alpha g (3)

For CUDA; on the CPU it is splats/composite_slopes_tiles. A warp has 8x4 pixels to itself, sums what its lanes have, by
halves that lanes exchange, and adds nine numbers a splat.
Needs: splats/composite, splats/tiles.
"""

import warp as wp

from .composite import PIXELS_OF_WARP, POWER_AT_PIXEL, REACHING_MEMBERS
from .tiles import TILE_SIDE, TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 256})

#: Sums of a splat.
SUMS = wp.constant(9)


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    __shared__ float4 rows[8][32][3];
    const int warp = (threadIdx.x >> 5) & 7, lane = threadIdx.x & 31;
    const float gx = slope.c[0], gy = slope.c[1], gz = slope.c[2];
    if (__ballot_sync(0xffffffffu, gx != 0.0f || gy != 0.0f || gz != 0.0f) == 0u)
        return;
    const float4* rows_of = reinterpret_cast<const float4*>(view.data);
    const int* member = reinterpret_cast<const int*>(members.data);
    float* sum_of = reinterpret_cast<float*>(sums.data);
"""
    + PIXELS_OF_WARP
    + """    float T = inside ? 1.0f : 0.0f, behind = colour.c[0] * gx + colour.c[1] * gy + colour.c[2] * gz;
    for (int base = begin; base < end; base += 32)
    {
        if (__ballot_sync(0xffffffffu, T > stop) == 0u)
            break;
        bool touched = false;
        float4 a, b;
        const float4* row = rows_of;
        int number = 0;
        if (base + lane < end)
        {
            number = member[base + lane];
            row += 3u * (unsigned)number;
            a = row[0];
            b = row[1];
"""
    + REACHING_MEMBERS
    + """            slot[2] = make_float4(row[2].x, __int_as_float(number), 0.0f, 0.0f);
        }
        __syncwarp();
        const int count = __popc(which);
        for (int k = 0; k < count; ++k)
        {
"""
    + POWER_AT_PIXEL
    + """            const bool drawn = power >= -7.994353437f && T > stop;
            if (__ballot_sync(0xffffffffu, drawn) == 0u)
                continue;
            const float4 c = rows[warp][k][2];
            float q = 0.0f, weight = 0.0f;
            if (drawn)
            {
                const float raw = exp2f(power), alpha = fminf(raw, 0.999f);
                const float lit = b.z * gx + b.w * gy + c.x * gz;
                weight = alpha * T;
                behind -= weight * lit;
                if (raw < 0.999f)
                    q = 0.6931471806f * alpha * (T * lit - behind / (1.0f - alpha));
                T -= weight;
            }
            // eight sums: lanes keep a half, then a quarter, then one of them; lane l has sum l / 4
            const bool half = lane & 16, quarter = lane & 8, eighth = lane & 4;
            const float qw = q * w, qs = q * s;
            const float v0 = q, v1 = qw, v2 = qs, v3 = qw * dx, v4 = qw * dy, v5 = qs * dy, v6 = weight * gx,
                        v7 = weight * gy;
            const float a0 = (half ? v4 : v0) + __shfl_xor_sync(0xffffffffu, half ? v0 : v4, 16);
            const float a1 = (half ? v5 : v1) + __shfl_xor_sync(0xffffffffu, half ? v1 : v5, 16);
            const float a2 = (half ? v6 : v2) + __shfl_xor_sync(0xffffffffu, half ? v2 : v6, 16);
            const float a3 = (half ? v7 : v3) + __shfl_xor_sync(0xffffffffu, half ? v3 : v7, 16);
            const float b0 = (quarter ? a2 : a0) + __shfl_xor_sync(0xffffffffu, quarter ? a0 : a2, 8);
            const float b1 = (quarter ? a3 : a1) + __shfl_xor_sync(0xffffffffu, quarter ? a1 : a3, 8);
            float one = (eighth ? b1 : b0) + __shfl_xor_sync(0xffffffffu, eighth ? b0 : b1, 4);
            one += __shfl_xor_sync(0xffffffffu, one, 2);
            one += __shfl_xor_sync(0xffffffffu, one, 1);
            float last = weight * gz;
            for (int reach = 16; reach > 0; reach >>= 1)
                last += __shfl_xor_sync(0xffffffffu, last, reach);
            if ((lane & 3) == 0 || lane == 1)
                atomicAdd(sum_of + 9 * (size_t)__float_as_int(c.y) + (lane == 1 ? 8 : lane >> 2),
                          lane == 1 ? last : one);
        }
        __syncwarp();
    }
#endif
"""
)
def add_pixel_slopes(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    x: float,
    y: float,
    inside: int,
    stop: float,
    colour: wp.vec3,
    slope: wp.vec3,
    sums: wp.array(dtype=wp.float32),
):
    """Add the sums of a pixel with its centre at x, y: its colour, with what is behind the splats, and the slope by it.

    All lanes of a warp, which has 8x4 pixels, row by row; blocks of up to 256 threads."""
    ...


@wp.kernel
def add_slopes(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    sums: wp.array(dtype=wp.float32),
):
    """One thread per pixel of the tiles, as splats/composite, whose inputs and picture these are. slopes: (h * w,) of
    the loss by the picture. sums: (SUMS n,) are added to."""
    n = first + wp.tid()
    tile = n // (TILE_SIDE * TILE_SIDE)
    block = (n // 32) % (TILE_SIDE * TILE_SIDE // 32)
    lane = n % 32
    across = TILE_SIDE // 8
    column = (tile % tiles.columns) * TILE_SIDE + (block % across) * 8 + lane % 8
    row = (tiles.first_row + tile // tiles.columns) * TILE_SIDE + (block // across) * 4 + lane // 8
    inside = 0
    colour = wp.vec3()
    slope = wp.vec3()
    if column < tiles.width and row < tiles.height:
        inside = 1
        colour = rgb[row * tiles.width + column]
        slope = slopes[row * tiles.width + column]
    add_pixel_slopes(
        view,
        members,
        starts[tile],
        starts[tile + 1],
        float(column) + 0.5,
        float(row) + 0.5,
        inside,
        stop,
        colour,
        slope,
        sums,
    )
