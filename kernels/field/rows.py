"""Colour of a sparse voxel grid at a place, with few reads: field/grid for marches that are to be fast.

On CUDA the harmonics of a row are packed into two reads of 16 bytes: its three constant terms as halves, the others in
8 bits, in units that the largest one sets. The basis is rounded in the same way, so that four products are one
instruction. Six words hold four numbers each: two words for each of red, green and blue; or four for luminance and one
for each difference of colour (field/harmonics). On a CPU the grid's own numbers are read, which lie together.
Needs: field/columns, field/grid, field/harmonics.
"""

import warp as wp

from .columns import CELL_PLACE, COLUMN_ENTRY, Columns
from .grid import VoxelGrid, eight_rows
from .harmonics import COLOUR_OF_ROW, vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})


#: C++ of several functions below: the harmonics of a row of 24 numbers in registers (CUDA; `whole`: whether they are);
#: those of a warp's rows in shared memory (CUDA, all lanes, at most 128 threads a block).
OWN_ROW = """    float own[24];
    const bool whole = width == 24 && (reinterpret_cast<size_t>(sh.data) & 15u) == 0;
    if (whole)
    {
        // six reads of 16 bytes, all under way at once; what a read leaves of a sector the next one finds in the cache
        const float4* parts = reinterpret_cast<const float4*>(sh.data) + (size_t)(unsigned)row * 6;
        float4 part[6];
        #pragma unroll
        for (int p = 0; p < 6; ++p)
            part[p] = __ldg(parts + p);
        #pragma unroll
        for (int p = 0; p < 6; ++p)
        {
            own[4 * p] = part[p].x;
            own[4 * p + 1] = part[p].y;
            own[4 * p + 2] = part[p].z;
            own[4 * p + 3] = part[p].w;
        }
    }
"""
STAGED_ROWS = """    // the rows of a warp are read as runs of memory, and turned over in shared memory
    __shared__ float staged[4][32 * 27];
    const int lane = threadIdx.x & 31;
    const int stride = width | 1;  // odd, so that lanes read from different banks
    float* rows = staged[(threadIdx.x >> 5) & 3];
    __syncwarp();
    #pragma unroll 9
    for (int part = 0; part < width; ++part)
    {
        const int entry = part * 32 + lane;
        const int owner = entry / width;
        const int number = entry - owner * width;
        const int source = __shfl_sync(0xffffffffu, row, owner);
        rows[owner * stride + number] = sh.data[(size_t)source * width + number];
    }
    __syncwarp();
"""


@wp.struct
class RowTable:
    """A grid's rows as a march reads them."""

    columns: Columns
    packed: wp.array2d(dtype=wp.uint32)  # (rows, words) on CUDA, else none
    laid: wp.array(dtype=wp.float16)  # (nodes,) density of each node in units, 0 without a row; on CUDA, else none
    unit: float  # of laid densities


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
    """
    const int width = sh.shape[1];
"""
    + CELL_PLACE
    + """#if defined(__CUDA_ARCH__)
    const bool luminous = width == 24;
    const int last = luminous ? 16 : 9;
    float largest = 1.0e-20f;
    #pragma unroll
    for (int b = 1; b < 16; ++b)
        if (b < last)
            largest = fmaxf(largest, fabsf(basis.c[b]));
    const float unit = largest * (1.0f / 127.0f);
    const float scale = __fdividef(127.0f, largest);
    int rounded[4];
    #pragma unroll
    for (int w = 0; w < 4; ++w)
    {
        unsigned word = 0u;
        #pragma unroll
        for (int b = 0; b < 4; ++b)
            if (4 * w + b + 1 < last)
                word |= ((unsigned)__float2int_rn(basis.c[4 * w + b + 1] * scale) & 0xffu) << (8 * b);
        rounded[w] = (int)word;
    }
    // what the third to sixth word of a row are multiplied by; the first two take the first two
    const int third = luminous ? rounded[2] : rounded[0];
    const int fourth = luminous ? rounded[3] : rounded[1];
    const int sixth = luminous ? rounded[0] : rounded[1];
    float first = 0.0f, second = 0.0f, extra = 0.0f, rest = 0.0f;
    const uint4* numbers = reinterpret_cast<const uint4*>(packed.data);
    uint2 entries[4];  // waited for together
    #pragma unroll
    for (int column = 0; column < 4; ++column)
        entries[column] = __ldg(reinterpret_cast<const uint2*>(columns.blocks.data)
            + begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * block_width);
    #pragma unroll
    for (int column = 0; column < 4; ++column)
    {
        const uint2 entry = entries[column];
        const unsigned bits = entry.x >> place;
        int row = (int)entry.y + __popc(entry.x & low);
        const float share = ((column & 2) ? offset.c[0] : 1.0f - offset.c[0])
            * ((column & 1) ? offset.c[1] : 1.0f - offset.c[1]);
        #pragma unroll
        for (int side = 0; side < 2; ++side)
        {
            if (bits & (1u << side))
            {
                const uint4 a = __ldg(numbers + (size_t)(unsigned)row * 2);
                const uint4 b = __ldg(numbers + (size_t)(unsigned)row * 2 + 1);
                ++row;
                const float weight = share * (side ? offset.c[2] : 1.0f - offset.c[2]);
                wp::half h;
                h.u = a.y >> 16;
                const float size = weight * unit * wp::half_to_float(h);
                const float constant = weight * basis.c[0];
                int sums[4] = {0, 0, 0, 0};
                asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[0]) : "r"(a.z), "r"(rounded[0]));
                asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[0]) : "r"(a.w), "r"(rounded[1]));
                asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[1]) : "r"(b.x), "r"(third));
                asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[1]) : "r"(b.y), "r"(fourth));
                asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[2]) : "r"(b.z), "r"(rounded[0]));
                asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[3]) : "r"(b.w), "r"(sixth));
                h.u = a.x & 0xffffu;
                first += constant * wp::half_to_float(h) + size * (float)sums[0];
                h.u = a.x >> 16;
                const float middle = constant * wp::half_to_float(h);
                h.u = a.y & 0xffffu;
                const float end = constant * wp::half_to_float(h);
                // luminance: both halves of it, orange, green; else red, green, both halves of blue
                second += size * (float)sums[1] + (luminous ? 0.0f : middle);
                extra += size * (float)sums[2] + (luminous ? middle : end);
                rest += size * (float)sums[3] + (luminous ? end : 0.0f);
            }
        }
    }
    if (luminous)
    {
        const float y = first + second + 0.5f - 0.5f * rest;
        return wp::vec_t<3, wp::float32>(y + extra, y + 1.5f * rest, y - extra);
    }
    return wp::vec_t<3, wp::float32>(first + 0.5f, second + 0.5f, extra + rest + 0.5f);
#else
    // eight numbers at a time; the last eight may overlap those before them
    typedef float lanes __attribute__((ext_vector_type(8), aligned(4)));
    const int* order = columns.order.data;
    lanes sum[4];
    for (int part = 0; part < 4; ++part)
        sum[part] = 0.0f;
    for (int column = 0; column < 4; ++column)
    {
        const int at = begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * block_width;
        const unsigned* entry = reinterpret_cast<const unsigned*>(columns.blocks.data) + 2 * (size_t)at;
        const unsigned bits = entry[0] >> place;
        int row = (int)entry[1] + __builtin_popcount(entry[0] & low);
        const float share = ((column & 2) ? offset.c[0] : 1.0f - offset.c[0])
            * ((column & 1) ? offset.c[1] : 1.0f - offset.c[1]);
        for (int side = 0; side < 2; ++side)
            if (bits & (1u << side))
            {
                #pragma clang fp contract(fast)
                const float weight = share * (side ? offset.c[2] : 1.0f - offset.c[2]);
                const float* numbers = sh.data + (size_t)(order ? order[row] : row) * width;
                ++row;
                sum[0] += weight * *reinterpret_cast<const lanes*>(numbers);
                sum[1] += weight * *reinterpret_cast<const lanes*>(numbers + 8);
                sum[2] += weight * *reinterpret_cast<const lanes*>(numbers + 16);
                if (width == 27)
                    sum[3] += weight * *reinterpret_cast<const lanes*>(numbers + 19);
            }
    }
    float c[27];
    *reinterpret_cast<lanes*>(c) = sum[0];
    *reinterpret_cast<lanes*>(c + 8) = sum[1];
    *reinterpret_cast<lanes*>(c + 16) = sum[2];
    if (width == 27)
        *reinterpret_cast<lanes*>(c + 19) = sum[3];
"""
    + COLOUR_OF_ROW
    + """
    return wp::vec_t<3, wp::float32>(red + 0.5f, green + 0.5f, blue + 0.5f);
#endif
"""
)
def row_colour(
    sh: wp.array2d(dtype=wp.float32),
    packed: wp.array2d(dtype=wp.uint32),
    columns: Columns,
    i: wp.int32,
    j: wp.int32,
    k: wp.int32,
    offset: wp.vec3,
    basis: vec16,
) -> wp.vec3:
    """SH colour before the clamp at zero, at a place, 0 to 1, in the cell above node (i, j, k)."""
    ...


#: C++ that packs the numbers `c` of a row, `luminous` where they are 24, and writes them.
PACKED_ROW = """
    const float limit = 65504.0f;
    // where the three parts of a row begin, each with its constant term
    const int starts[3] = {0, luminous ? 16 : 9, luminous ? 20 : 18};
    float largest = 0.0f;
    #pragma unroll
    for (int n = 1; n < (luminous ? 24 : 27); ++n)
        if (n != starts[1] && n != starts[2])
            largest = fmaxf(largest, fabsf(c[n]));
    // rounded up, so that no number needs more than 127 units
    const wp::half unit = wp::float_to_half(fminf(largest * (1.0005f / 127.0f) + 6.0e-8f, limit));
    const float scale = 1.0f / wp::half_to_float(unit);
    unsigned words[8];
    words[0] = (unsigned)wp::float_to_half(fminf(fmaxf(c[0], -limit), limit)).u
        | ((unsigned)wp::float_to_half(fminf(fmaxf(c[starts[1]], -limit), limit)).u << 16);
    words[1] = (unsigned)wp::float_to_half(fminf(fmaxf(c[starts[2]], -limit), limit)).u | ((unsigned)unit.u << 16);
    #pragma unroll
    for (int w = 0; w < 6; ++w)
    {
        // number of the word's first entry, and where the part that it belongs to ends
        const int from = luminous ? (w < 4 ? 1 + 4 * w : 4 * w + 1) : 9 * (w >> 1) + 1 + 4 * (w & 1);
        const int end = luminous ? (w < 4 ? 16 : 4 * w + 4) : 9 * (w >> 1) + 9;
        unsigned word = 0u;
        #pragma unroll
        for (int b = 0; b < 4; ++b)
            if (from + b < end)
                word |= ((unsigned)max(-127, min(127, __float2int_rn(c[from + b] * scale))) & 0xffu) << (8 * b);
        words[2 + w] = word;
    }
    uint4* to = reinterpret_cast<uint4*>(packed.data) + (size_t)target * 2;
    to[0] = make_uint4(words[0], words[1], words[2], words[3]);
    to[1] = make_uint4(words[4], words[5], words[6], words[7]);
"""


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    const int width = sh.shape[1];
"""
    + OWN_ROW
    + """    if (whole)
    {
        const float* c = own;
        const bool luminous = true;
        if (target < 0)
            return;
"""
    + PACKED_ROW
    + """        return;
    }
"""
    + STAGED_ROWS
    + """    if (target < 0)
        return;
    const float* c = rows + lane * stride;
    const bool luminous = width == 24;
"""
    + PACKED_ROW
    + """#endif
"""
)
def write_packed(
    sh: wp.array2d(dtype=wp.float32), row: wp.int32, packed: wp.array2d(dtype=wp.uint32), target: wp.int32
):
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
