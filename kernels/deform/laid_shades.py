"""What a camera sees of each voxel of a deformed field, laid out by nodes, so that a march reads what lies around a
place at once.

A row inside a rest cage is seen where the pose takes it, any other as it is (deform/carried_shades). Where the cage
cuts matter, samples on both sides of it read the same rows: those near the cage have a second shade, as the other side
sees them. On CUDA a shade is four halves, on a CPU four floats. The last bits of blue and of optical depth tell whose
it is.
Needs: field/columns, field/shades.
"""

import warp as wp

from ..field.columns import CELL_PLACE, COLUMN_ENTRY, Columns
from ..field.shades import ADD_HALVES, SHADE_FLOATS, SHADE_HALVES

wp.set_module_options({"enable_backward": False})


@wp.struct
class LaidShades:
    """Shades at the nodes of a grid, 0 where a node has no row."""

    columns: Columns
    shades: wp.array2d(dtype=wp.uint32)  # (nodes, words)
    others: wp.array2d(dtype=wp.uint32)  # (rows, words) of rows near a rest cage, or none


@wp.func_native(
    """
    const unsigned is_carried = carried ? 1u : 0u;
"""
    + SHADE_HALVES
    + """    const unsigned last = (b & 0xfffeu) | is_carried | ((d & 0xfffeu) << 16) | ((1u - is_carried) << 16);
    reinterpret_cast<uint2*>(shades.data)[row] = make_uint2(r | (g << 16), last);
"""
    + SHADE_FLOATS
    + """    unsigned* bits = reinterpret_cast<unsigned*>(shade);
    bits[2] = (bits[2] & ~1u) | is_carried;
    bits[3] = (bits[3] & ~1u) | (1u - is_carried);
#endif
"""
)
def write_sided_shade(shades: wp.array2d(dtype=wp.uint32), row: wp.int32, value: wp.vec4, carried: wp.int32):
    """Keep red, green, blue and optical depth of a row, and whether a pose has taken it somewhere."""
    ...


#: C++ that takes the colours of a cell's rows that are seen from the other side from there; `other` tells them by the
#: last word of a shade.
OTHER_COLOURS = (
    CELL_PLACE
    + """
#if defined(__CUDA_ARCH__)
        #pragma unroll
#endif
        for (int column = 0; column < 4; ++column)
        {
"""
    + COLUMN_ENTRY
    + """
#if defined(__CUDA_ARCH__)
            #pragma unroll
#endif
            for (int up = 0; up < 2; ++up)
            {
                const int corner = 2 * column + up;
                if (is_other(corner))
                    take_other(corner, up ? row + (int)(bits & 1u) : row);
            }
        }
"""
)


@wp.func_native(
    """
    const auto& columns = table.columns;
    const int ny = columns.node_counts.c[1], nz = columns.node_counts.c[2];
    const size_t first = (size_t)(unsigned)i * ((unsigned)ny * (unsigned)nz) + (unsigned)(j * nz + k);
    const bool has_others = table.others.shape[0] > 0;
#if defined(__CUDA_ARCH__)
    const uint2* low = reinterpret_cast<const uint2*>(table.shades.data) + first;
    const uint2* high = low + ny * nz;
    uint2 s[8] = {__ldg(low), __ldg(low + 1), __ldg(low + nz), __ldg(low + nz + 1),
        __ldg(high), __ldg(high + 1), __ldg(high + nz), __ldg(high + nz + 1)};
    const unsigned other = side == 1 ? 0x10000u : 1u;
    unsigned joined = 0u;
    #pragma unroll
    for (int c = 0; c < 8; ++c)
        joined |= s[c].y;
    if (has_others && (joined & other) && (side != 0 || (joined & 0x10000u)))  // rare
    {
        const uint2* others = reinterpret_cast<const uint2*>(table.others.data);
        auto is_other = [&](int c) { return (s[c].y & other) != 0u; };
        auto take_other = [&](int c, int row) {
            const uint2 shade = others[row];
            s[c] = make_uint2(shade.x, (shade.y & 0xffffu) | (s[c].y & 0xffff0000u));
        };
"""
    + OTHER_COLOURS
    + """
    }
    float r = 0.0f, g = 0.0f, b = 0.0f, d = 0.0f;
    #pragma unroll
    for (int c = 0; c < 8; ++c)
    {
        const uint2 shade = s[c];
"""
    + ADD_HALVES
    + """    }
    return wp::vec_t<4, wp::float32>(r, g, b, d);
#else
    typedef float four __attribute__((ext_vector_type(4), aligned(4)));
    const four* low = reinterpret_cast<const four*>(table.shades.data) + first;
    const four* high = low + (size_t)ny * nz;
    four s[8] = {low[0], low[1], low[nz], low[nz + 1], high[0], high[1], high[nz], high[nz + 1]};
    auto is_other = [&](int c) {
        unsigned bits[4];
        __builtin_memcpy(bits, &s[c], sizeof(bits));
        return (bits[side == 1 ? 3 : 2] & 1u) != 0u;
    };
    bool any = false, all = true;
    for (int c = 0; c < 8; ++c)
    {
        any = any || is_other(c);
        all = all && is_other(c);
    }
    if (has_others && any && (side != 0 || !all))
    {
        const four* others = reinterpret_cast<const four*>(table.others.data);
        auto take_other = [&](int c, int row) { s[c].xyz = others[row].xyz; };
"""
    + OTHER_COLOURS
    + """
    }
    four sum = 0.0f;
    for (int c = 0; c < 8; ++c)
        sum += ((c & 4) ? offset.c[0] : 1.0f - offset.c[0]) * ((c & 2) ? offset.c[1] : 1.0f - offset.c[1])
            * ((c & 1) ? offset.c[2] : 1.0f - offset.c[2]) * s[c];
    return wp::vec_t<4, wp::float32>(sum.x, sum.y, sum.z, sum.w);
#endif
"""
)
def laid_shade(table: LaidShades, i: wp.int32, j: wp.int32, k: wp.int32, offset: wp.vec3, side: wp.int32) -> wp.vec4:
    """Trilinear shade at a place, 0 to 1, in the cell above node (i, j, k); the colour still lacks its 0.5.

    side: 1 where a map has led there; 2 where none has and rest cages keep what they hold; 0 where none has and they
    are cleared, so that nobody asks for the colour of a cell that lies in one as a whole.
    """
    ...
