"""Density and colour of a sparse voxel grid at a place, with few reads: field/grid for marches that are to be fast.

On CUDA the harmonics of a row are packed into two reads of 16 bytes: the constant term of each channel as a half, the
others in 8 bits, in units that the row's largest one sets. The basis is rounded in the same way, so that four products
are one instruction. On a CPU the grid's own numbers are read, which lie together.
Needs: field/columns, field/grid, field/harmonics.
"""

import warp as wp

from .columns import Columns
from .grid import VoxelGrid
from .harmonics import vec9

wp.set_module_options({"enable_backward": False, "block_dim": 128})
eight_rows = wp.types.vector(length=8, dtype=wp.int32)


#: C++ of several functions below: where a cell lies among the blocks of its columns; the bits and the first row of one
#: of its four columns; the harmonics of a warp's rows in shared memory (CUDA, all lanes, at most 128 threads a block).
CELL_PLACE = """
    const int block = k / 31;
    const int place = k - 31 * block;
    const unsigned low = (1u << place) - 1u;
    const int width = columns.blocks.shape[1];
    const int begin = (i * columns.node_counts.c[1] + j) * width + block;
"""
COLUMN_ENTRY = """        const int at = begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * width;
#if defined(__CUDA_ARCH__)
        const uint2 entry = __ldg(reinterpret_cast<const uint2*>(columns.blocks.data) + at);
        const unsigned bits = entry.x >> place;
        const int row = (int)entry.y + __popc(entry.x & low);
#else
        const unsigned* entry = reinterpret_cast<const unsigned*>(columns.blocks.data) + 2 * (size_t)at;
        const unsigned bits = entry[0] >> place;
        const int row = (int)entry[1] + __builtin_popcount(entry[0] & low);
#endif
"""
STAGED_ROWS = """    // the rows of a warp are read as runs of memory, and turned over in shared memory
    __shared__ float staged[4][32 * 3 * N];
    const int lane = threadIdx.x & 31;
    float* rows = staged[(threadIdx.x >> 5) & 3];
    __syncwarp();
    #pragma unroll 9
    for (int part = 0; part < 3 * N; ++part)
    {
        const int entry = part * 32 + lane;
        const int owner = entry / (3 * N);
        const int source = __shfl_sync(0xffffffffu, row, owner);
        rows[entry] = reinterpret_cast<const float*>(sh.data)[(size_t)source * (3 * N) + entry - owner * 3 * N];
    }
    __syncwarp();
"""


@wp.struct
class RowTable:
    """A grid's rows as a march reads them."""

    columns: Columns
    packed: wp.array2d(dtype=wp.uint32)  # (rows, words) on CUDA, else none


@wp.func_native(
    CELL_PLACE
    + """    wp::vec_t<8, wp::int32> rows;
#if defined(__CUDA_ARCH__)
    #pragma unroll
#endif
    for (int column = 0; column < 4; ++column)
    {
"""
    + COLUMN_ENTRY
    + """        rows.c[2 * column] = (bits & 1u) ? row : -1;
        rows.c[2 * column + 1] = (bits & 2u) ? row + (int)(bits & 1u) : -1;
    }
    return rows;
"""
)
def cell_rows(columns: Columns, i: wp.int32, j: wp.int32, k: wp.int32) -> eight_rows:
    """Rows of the eight nodes of the cell above node (i, j, k), -1 for none; corner c is at (c & 4, c & 2, c & 1)."""
    ...


@wp.func_native(
    CELL_PLACE
    + """    const int* order = columns.order.data;
    float sums[4];
#if defined(__CUDA_ARCH__)
    #pragma unroll
#endif
    for (int column = 0; column < 4; ++column)
    {
"""
    + COLUMN_ENTRY
    + """        const int next = row + (int)(bits & 1u);
        float near = 0.0f, far = 0.0f;
        if (bits & 1u)
            near = density.data[order ? order[row] : row];
        if (bits & 2u)
            far = density.data[order ? order[next] : next];
        sums[column] = near + offset.c[2] * (far - near);
    }
    const float begin_sum = sums[0] + offset.c[1] * (sums[1] - sums[0]);
    const float end_sum = sums[2] + offset.c[1] * (sums[3] - sums[2]);
    return begin_sum + offset.c[0] * (end_sum - begin_sum);
"""
)
def row_density(
    density: wp.array(dtype=wp.float32), columns: Columns, i: wp.int32, j: wp.int32, k: wp.int32, offset: wp.vec3
) -> wp.float32:
    """Trilinear density before the ReLU, at a place, 0 to 1, in the cell above node (i, j, k)."""
    ...


@wp.func_native(
    """
    constexpr int N = sizeof(basis) / sizeof(wp::float32);
"""
    + CELL_PLACE
    + """#if defined(__CUDA_ARCH__)
    constexpr int WORDS = (N + 2) / 4;  // of a channel
    constexpr int READS = (2 + 3 * WORDS + 3) / 4;
    float largest = 1.0e-20f;
    #pragma unroll
    for (int b = 1; b < N; ++b)
        largest = fmaxf(largest, fabsf(basis.c[b]));
    const float unit = largest * (1.0f / 127.0f);
    const float scale = __fdividef(127.0f, largest);
    int rounded[WORDS];
    #pragma unroll
    for (int w = 0; w < WORDS; ++w)
    {
        unsigned word = 0u;
        #pragma unroll
        for (int b = 0; b < 4; ++b)
            if (4 * w + b + 1 < N)
                word |= ((unsigned)__float2int_rn(basis.c[4 * w + b + 1] * scale) & 0xffu) << (8 * b);
        rounded[w] = (int)word;
    }
    float red = 0.5f, green = 0.5f, blue = 0.5f;
    const uint4* numbers = reinterpret_cast<const uint4*>(packed.data);
    #pragma unroll 1  // registers are few
    for (int column = 0; column < 4; ++column)
    {
        const int at = begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * width;
        const uint2 entry = __ldg(reinterpret_cast<const uint2*>(columns.blocks.data) + at);
        const unsigned bits = entry.x >> place;
        int row = (int)entry.y + __popc(entry.x & low);
        const float share = ((column & 2) ? offset.c[0] : 1.0f - offset.c[0])
            * ((column & 1) ? offset.c[1] : 1.0f - offset.c[1]);
        #pragma unroll
        for (int side = 0; side < 2; ++side)
        {
            if (bits & (1u << side))
            {
                unsigned words[4 * READS];
                #pragma unroll
                for (int r = 0; r < READS; ++r)
                {
                    const uint4 part = __ldg(numbers + (size_t)(unsigned)row * READS + r);
                    words[4 * r] = part.x;
                    words[4 * r + 1] = part.y;
                    words[4 * r + 2] = part.z;
                    words[4 * r + 3] = part.w;
                }
                ++row;
                const float weight = share * (side ? offset.c[2] : 1.0f - offset.c[2]);
                wp::half h;
                h.u = words[1] >> 16;
                const float size = weight * unit * wp::half_to_float(h);
                const float first = weight * basis.c[0];
                int sums[3] = {0, 0, 0};
                #pragma unroll
                for (int w = 0; w < WORDS; ++w)
                {
                    for (int channel = 0; channel < 3; ++channel)
                        asm("dp4a.s32.s32 %0, %1, %2, %0;"
                            : "+r"(sums[channel]) : "r"(words[2 + WORDS * channel + w]), "r"(rounded[w]));
                }
                h.u = words[0] & 0xffffu;
                red += first * wp::half_to_float(h) + size * (float)sums[0];
                h.u = words[0] >> 16;
                green += first * wp::half_to_float(h) + size * (float)sums[1];
                h.u = words[1] & 0xffffu;
                blue += first * wp::half_to_float(h) + size * (float)sums[2];
            }
        }
    }
    return wp::vec_t<3, wp::float32>(red, green, blue);
#else
    // eight numbers at a time; the last eight may overlap those before them
    typedef float lanes __attribute__((ext_vector_type(8), aligned(4)));
    constexpr int PARTS = (3 * N + 7) / 8;
    const int* order = columns.order.data;
    lanes sum[PARTS];
    for (int part = 0; part < PARTS; ++part)
        sum[part] = 0.0f;
    for (int column = 0; column < 4; ++column)
    {
        const int at = begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * width;
        const unsigned* entry = reinterpret_cast<const unsigned*>(columns.blocks.data) + 2 * (size_t)at;
        const unsigned bits = entry[0] >> place;
        int row = (int)entry[1] + __builtin_popcount(entry[0] & low);
        const float share = ((column & 2) ? offset.c[0] : 1.0f - offset.c[0])
            * ((column & 1) ? offset.c[1] : 1.0f - offset.c[1]);
        for (int side = 0; side < 2; ++side)
            if (bits & (1u << side))
            {
                const float weight = share * (side ? offset.c[2] : 1.0f - offset.c[2]);
                const float* numbers = reinterpret_cast<const float*>(sh.data)
                    + (size_t)(order ? order[row] : row) * (3 * N);
                ++row;
                for (int part = 0; part < PARTS; ++part)
                {
                    #pragma clang fp contract(fast)
                    const int first = part < PARTS - 1 ? 8 * part : 3 * N - 8;
                    sum[part] += weight * *reinterpret_cast<const lanes*>(numbers + first);
                }
            }
    }
    float total[3 * N];
    for (int part = 0; part < PARTS; ++part)
        *reinterpret_cast<lanes*>(total + (part < PARTS - 1 ? 8 * part : 3 * N - 8)) = sum[part];
    float sums[3];
    for (int channel = 0; channel < 3; ++channel)
    {
        sums[channel] = 0.5f;
        for (int b = 0; b < N; ++b)
            sums[channel] += basis.c[b] * total[N * channel + b];
    }
    return wp::vec_t<3, wp::float32>(sums[0], sums[1], sums[2]);
#endif
"""
)
def row_colour(
    sh: wp.array2d(dtype=vec9),
    packed: wp.array2d(dtype=wp.uint32),
    columns: Columns,
    i: wp.int32,
    j: wp.int32,
    k: wp.int32,
    offset: wp.vec3,
    basis: vec9,
) -> wp.vec3:
    """SH colour before the clamp at zero, at a place, 0 to 1, in the cell above node (i, j, k)."""
    ...


@wp.func_native(
    """
    constexpr int N = sizeof(*sh.data) / sizeof(wp::float32);
#if defined(__CUDA_ARCH__)
    constexpr int WORDS = (N + 2) / 4;
    constexpr int READS = (2 + 3 * WORDS + 3) / 4;
"""
    + STAGED_ROWS
    + """    if (target < 0)
        return;
    const float* c = rows + lane * 3 * N;
    const float limit = 65504.0f;
    float largest = 0.0f;
    for (int channel = 0; channel < 3; ++channel)
        for (int b = 1; b < N; ++b)
            largest = fmaxf(largest, fabsf(c[channel * N + b]));
    // rounded up, so that no number needs more than 127 units
    const wp::half unit = wp::float_to_half(fminf(largest * (1.0005f / 127.0f) + 6.0e-8f, limit));
    const float scale = 1.0f / wp::half_to_float(unit);
    unsigned words[4 * READS];
    #pragma unroll
    for (int w = 0; w < 4 * READS; ++w)
        words[w] = 0u;
    words[0] = (unsigned)wp::float_to_half(fminf(fmaxf(c[0], -limit), limit)).u
        | ((unsigned)wp::float_to_half(fminf(fmaxf(c[N], -limit), limit)).u << 16);
    words[1] = (unsigned)wp::float_to_half(fminf(fmaxf(c[2 * N], -limit), limit)).u | ((unsigned)unit.u << 16);
    #pragma unroll
    for (int channel = 0; channel < 3; ++channel)
        #pragma unroll
        for (int b = 1; b < N; ++b)
        {
            const int q = max(-127, min(127, __float2int_rn(c[channel * N + b] * scale)));
            words[2 + WORDS * channel + (b - 1) / 4] |= ((unsigned)q & 0xffu) << (8 * ((b - 1) % 4));
        }
    uint4* to = reinterpret_cast<uint4*>(packed.data) + (size_t)target * READS;
    #pragma unroll
    for (int r = 0; r < READS; ++r)
        to[r] = make_uint4(words[4 * r], words[4 * r + 1], words[4 * r + 2], words[4 * r + 3]);
#endif
"""
)
def write_packed(sh: wp.array2d(dtype=vec9), row: wp.int32, packed: wp.array2d(dtype=wp.uint32), target: wp.int32):
    """Pack a row; -1 is no target. All lanes, in blocks of at most 128 threads."""
    ...


@wp.kernel
def pack_rows(first: int, grid: VoxelGrid, columns: Columns, packed: wp.array2d(dtype=wp.uint32)):
    """One thread per row, their number rounded up to whole warps, on CUDA."""
    item = first + wp.tid()
    row = wp.min(item, packed.shape[0] - 1)
    target = wp.where(item < packed.shape[0], item, -1)
    if columns.order.shape[0] > 0:
        row = columns.order[row]
    write_packed(grid.sh, row, packed, target)
