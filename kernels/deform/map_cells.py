"""The trilinear map of an edit, and its derivative along a ray, from a polynomial for each cell."""

# In a cell of its lattice the map of "Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1, is c + c_x x +
# c_y y + c_z z + c_xy x y + c_xz x z + c_yz y z + c_xyz x y z with x, y and z from 0 to 1. Its eight coefficients take
# half as many operations for a place and its derivative (Eq. 4) as the eight nodes do (deform/map_nodes), and lie side
# by side in memory. They are worked out once a pose, of cells that a march may look at.

import warp as wp

from .flat_edits import LOOK_SKIP

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Words of four numbers that a cell's coefficients take: eight of three numbers each, one after the other.
CELL_WORDS = wp.constant(6)

#: A position, and the derivative behind it.
vec6 = wp.types.vector(length=6, dtype=wp.float32)


@wp.kernel
def expand_map_cells(
    first: int,
    nodes: wp.array(dtype=wp.vec4),
    look: wp.array(dtype=wp.uint8),
    node_counts: wp.vec3i,
    polynomials: wp.array(dtype=wp.vec4),
):
    """The polynomial of the cell above each node, but for cells that are skipped as a whole; one item a node.
    nodes, look: of deform/flat_edits; polynomials: (CELL_WORDS * nodes,)."""
    n = first + wp.tid()
    if int(look[n]) >= LOOK_SKIP:
        return
    sz = node_counts[2]
    sx = node_counts[1] * sz
    c = nodes[n]
    z = nodes[n + 1] - c
    y = nodes[n + sz] - c
    x = nodes[n + sx] - c
    yz = (nodes[n + sz + 1] - c) - (y + z)
    xz = (nodes[n + sx + 1] - c) - (x + z)
    xy = (nodes[n + sx + sz] - c) - (x + y)
    xyz = (nodes[n + sx + sz + 1] - c) - (x + y + z) - (xy + xz + yz)
    to = CELL_WORDS * n
    polynomials[to] = wp.vec4(c[0], c[1], c[2], x[0])
    polynomials[to + 1] = wp.vec4(x[1], x[2], y[0], y[1])
    polynomials[to + 2] = wp.vec4(y[2], z[0], z[1], z[2])
    polynomials[to + 3] = wp.vec4(xy[0], xy[1], xy[2], xz[0])
    polynomials[to + 4] = wp.vec4(xz[1], xz[2], yz[0], yz[1])
    polynomials[to + 5] = wp.vec4(yz[2], xyz[0], xyz[1], xyz[2])


@wp.func_native(
    """
    float c[24];
#if defined(__CUDA_ARCH__)
    const float4* begin = reinterpret_cast<const float4*>(polynomials.data) + (size_t)6 * (unsigned)n;
    #pragma unroll
    for (int i = 0; i < 6; ++i) {
        const float4 word = __ldg(begin + i);
        c[4 * i] = word.x; c[4 * i + 1] = word.y; c[4 * i + 2] = word.z; c[4 * i + 3] = word.w;
    }
#else
    const float* begin = reinterpret_cast<const float*>(polynomials.data) + (size_t)24 * n;
    for (int i = 0; i < 24; ++i)
        c[i] = begin[i];
#endif
    const float x = f.c[0], y = f.c[1], z = f.c[2];
    wp::vec_t<6, wp::float32> result;
    #if defined(__CUDA_ARCH__)
    #pragma unroll
    #endif
    for (int i = 0; i < 3; ++i) {
        const float c0 = c[i], cx = c[3 + i], cy = c[6 + i], cz = c[9 + i];
        const float cxy = c[12 + i], cxz = c[15 + i], cyz = c[18 + i], cxyz = c[21 + i];
        const float xy = cxy + z * cxyz;
        const float dx = cx + z * cxz + y * xy, y_alone = cy + z * cyz;
        const float dz = cz + y * cyz + x * (cxz + y * cxyz);
        result.c[i] = c0 + z * cz + y * y_alone + x * dx;
        result.c[3 + i] = rate.c[0] * dx + rate.c[1] * (y_alone + x * xy) + rate.c[2] * dz;
    }
    return result;
"""
)
def cell_place_slope(polynomials: wp.array(dtype=wp.vec4), n: wp.int32, f: wp.vec3, rate: wp.vec3) -> vec6:
    """Where the map leads a place f, 0 to 1, in the cell above node n, and the derivative where f moves at `rate`."""
    ...
