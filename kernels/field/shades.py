"""What a camera sees of each voxel: its colour towards the camera and its optical depth, evaluated once per view.

A march then reads eight numbers of 8 bytes a sample instead of 8 x 27 harmonics. Trilinear weights blend the directions
to the eight nodes to the direction to the sample, but for the square of a voxel's angle from the camera, so that
sum_i w_i c_i . Y(d_i) differs from (sum_i w_i c_i) . Y(d) by the change of c over a voxel times that angle.
Needs: field/columns, field/grid, field/harmonics.
"""

import warp as wp

from .columns import Columns
from .grid import VoxelGrid
from .harmonics import sh_basis, vec9

wp.set_module_options({"enable_backward": False, "block_dim": 128})


@wp.struct
class ShadedGrid:
    """The rows of a grid in memory order, as one camera sees them."""

    columns: Columns
    shades: wp.array2d(dtype=wp.uint32)  # (rows, words): red, green, blue and optical depth of a step


@wp.func_native("""
    constexpr int N = sizeof(basis) / sizeof(wp::float32);
#if defined(__CUDA_ARCH__)
    // the rows of a warp are read as runs of memory, and turned over in shared memory
    __shared__ float staged[4][32 * 3 * N];
    const int lane = threadIdx.x & 31;
    float* rows = staged[(threadIdx.x >> 5) & 3];
    __syncwarp();
    #pragma unroll 9
    for (int part = 0; part < 3 * N; ++part)
    {
        const int entry = part * 32 + lane;
        const int owner = entry / (3 * N);
        const int place = entry - owner * 3 * N;
        const int source = __shfl_sync(0xffffffffu, row, owner);
        rows[entry] = reinterpret_cast<const float*>(sh.data)[(size_t)source * (3 * N) + place];
    }
    __syncwarp();
    const float* c = rows + lane * 3 * N;
#else
    const float* c = reinterpret_cast<const float*>(sh.data) + (size_t)row * (3 * N);
#endif
    float sums[3];
    for (int channel = 0; channel < 3; ++channel)
    {
        float sum = 0.0f;
        for (int b = 0; b < N; ++b)
            sum += basis.c[b] * c[channel * N + b];
        sums[channel] = sum + 0.5f;
    }
    return wp::vec_t<3, wp::float32>(sums[0], sums[1], sums[2]);
""")
def shade_colour(sh: wp.array2d(dtype=vec9), row: wp.int32, basis: vec9) -> wp.vec3:
    """Harmonics of a row times a basis, + 0.5. All lanes, in blocks of at most 128 threads."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 2;
#else
    return 4;
#endif
""")
def shade_words() -> wp.int32:
    """32-bit words of a shade: halves on CUDA, floats on a CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float limit = 65504.0f;
    const unsigned r = wp::float_to_half(fminf(fmaxf(value.c[0], -limit), limit)).u;
    const unsigned g = wp::float_to_half(fminf(fmaxf(value.c[1], -limit), limit)).u;
    const unsigned b = wp::float_to_half(fminf(fmaxf(value.c[2], -limit), limit)).u;
    const unsigned d = wp::float_to_half(fminf(fmaxf(value.c[3], -limit), limit)).u;
    reinterpret_cast<uint2*>(shades.data)[row] = make_uint2(r | (g << 16), b | (d << 16));
#else
    float* shade = reinterpret_cast<float*>(shades.data) + 4 * (size_t)row;
    for (int i = 0; i < 4; ++i)
        shade[i] = value.c[i];
#endif
""")
def write_shade(shades: wp.array2d(dtype=wp.uint32), row: wp.int32, value: wp.vec4):
    """Keep red, green, blue and optical depth of a row."""
    ...


@wp.kernel
def shade_rows(
    first: int,
    grid: VoxelGrid,
    columns: Columns,
    nodes: wp.array(dtype=wp.int32),
    centre: wp.vec3,
    step: float,
    shades: wp.array2d(dtype=wp.uint32),
):
    """One thread per row, their number rounded up to whole warps. nodes: (rows,) of field/columns."""
    item = first + wp.tid()
    n = wp.min(item, nodes.shape[0] - 1)
    node = nodes[n]
    k = node % grid.links.shape[2]
    j = (node // grid.links.shape[2]) % grid.links.shape[1]
    i = node // (grid.links.shape[2] * grid.links.shape[1])
    row = int(n)
    if columns.order.shape[0] > 0:
        row = columns.order[n]
    place = grid.lower + wp.cw_mul(grid.voxel_size, wp.vec3(float(i), float(j), float(k)))
    colour = shade_colour(grid.sh, row, sh_basis(wp.normalize(place - centre)))
    if item < nodes.shape[0]:
        write_shade(shades, n, wp.vec4(colour[0], colour[1], colour[2], grid.density[row] * step))


@wp.func_native("""
    const int block = k / 31;
    const int place = k - 31 * block;
    const unsigned low = (1u << place) - 1u;
    const int blocks = shaded.columns.blocks.shape[1];
    float r = 0.0f, g = 0.0f, b = 0.0f, d = 0.0f;
    for (int column = 0; column < 4; ++column)
    {
        const int di = column >> 1, dj = column & 1;
        const int at = ((i + di) * shaded.columns.node_counts.c[1] + j + dj) * blocks + block;
        const float share = (di ? offset.c[0] : 1.0f - offset.c[0]) * (dj ? offset.c[1] : 1.0f - offset.c[1]);
#if defined(__CUDA_ARCH__)
        const uint2 entry = reinterpret_cast<const uint2*>(shaded.columns.blocks.data)[at];
        const unsigned bits = entry.x >> place;
        const int row = (int)entry.y + __popc(entry.x & low);
        const uint2* shades = reinterpret_cast<const uint2*>(shaded.shades.data) + row;
        uint2 near = make_uint2(0u, 0u), far = make_uint2(0u, 0u);
        if (bits & 1u)
            near = shades[0];
        if (bits & 2u)
            far = shades[bits & 1u];
        const float a = share * (1.0f - offset.c[2]), c = share * offset.c[2];
        wp::half h;
        h.u = near.x & 0xffffu; r += a * wp::half_to_float(h);
        h.u = near.x >> 16; g += a * wp::half_to_float(h);
        h.u = near.y & 0xffffu; b += a * wp::half_to_float(h);
        h.u = near.y >> 16; d += a * wp::half_to_float(h);
        h.u = far.x & 0xffffu; r += c * wp::half_to_float(h);
        h.u = far.x >> 16; g += c * wp::half_to_float(h);
        h.u = far.y & 0xffffu; b += c * wp::half_to_float(h);
        h.u = far.y >> 16; d += c * wp::half_to_float(h);
#else
        const unsigned* entry = reinterpret_cast<const unsigned*>(shaded.columns.blocks.data) + 2 * (size_t)at;
        const unsigned bits = entry[0] >> place;
        const int row = (int)entry[1] + __builtin_popcount(entry[0] & low);
        const float* shade = reinterpret_cast<const float*>(shaded.shades.data) + 4 * (size_t)row;
        if (bits & 1u)
        {
            const float a = share * (1.0f - offset.c[2]);
            r += a * shade[0]; g += a * shade[1]; b += a * shade[2]; d += a * shade[3];
            shade += 4;
        }
        if (bits & 2u)
        {
            const float c = share * offset.c[2];
            r += c * shade[0]; g += c * shade[1]; b += c * shade[2]; d += c * shade[3];
        }
#endif
    }
    return wp::vec_t<4, wp::float32>(r, g, b, d);
""")
def shade_at(shaded: ShadedGrid, i: wp.int32, j: wp.int32, k: wp.int32, offset: wp.vec3) -> wp.vec4:
    """Trilinear shade at a place, 0 to 1, in the cell above node (i, j, k)."""
    ...
