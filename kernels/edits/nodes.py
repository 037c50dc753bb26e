"""The trilinear map of an edit, and its derivative along a ray, from nodes of four numbers that are read at once."""

import warp as wp

from ..core.gradients import forward, forward_only_in
from ..lattice.cage_map import corner_share, nearest_side
from .structs import LOOK_SKIP

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3))

#: vec4s of a cell's coefficients: eight of three numbers each, one after the other.
CELL_VEC4S = wp.constant(6)

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
    nodes, look: of edits/structs; polynomials: (CELL_VEC4S * nodes,)."""
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
    to = CELL_VEC4S * n
    polynomials[to] = wp.vec4(c[0], c[1], c[2], x[0])
    polynomials[to + 1] = wp.vec4(x[1], x[2], y[0], y[1])
    polynomials[to + 2] = wp.vec4(y[2], z[0], z[1], z[2])
    polynomials[to + 3] = wp.vec4(xy[0], xy[1], xy[2], xz[0])
    polynomials[to + 4] = wp.vec4(xz[1], xz[2], yz[0], yz[1])
    polynomials[to + 5] = wp.vec4(yz[2], xyz[0], xyz[1], xyz[2])


@forward.func_native(
    """
    float c[24];
#if defined(__CUDA_ARCH__)
    const float4* begin = reinterpret_cast<const float4*>(polynomials.data) + (size_t)6 * (unsigned)n;
    #pragma unroll
    for (int i = 0; i < 6; ++i) {
        const float4 four = __ldg(begin + i);
        c[4 * i] = four.x; c[4 * i + 1] = four.y; c[4 * i + 2] = four.z; c[4 * i + 3] = four.w;
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


#: C++ for CUDA that reads the eight nodes of a cell, a0 to d1.
EIGHT_NODES = """
    const float4* begin = reinterpret_cast<const float4*>(nodes.data) + (unsigned)n;
    const unsigned sx = (unsigned)x, sz = (unsigned)z;
    const float4 a0 = __ldg(begin), a1 = __ldg(begin + 1), b0 = __ldg(begin + sz), b1 = __ldg(begin + sz + 1);
    const float4 c0 = __ldg(begin + sx), c1 = __ldg(begin + sx + 1);
    const float4 d0 = __ldg(begin + sx + sz), d1 = __ldg(begin + sx + sz + 1);
"""

#: C++ for a CPU: values on the four edges of a cell along its last axis, p to t, and how they change, ea to ed.
FOUR_EDGES = """
    typedef float four __attribute__((ext_vector_type(4), aligned(4)));
    const four* begin = reinterpret_cast<const four*>(nodes.data) + n;
    const four ea = begin[1] - begin[0], eb = begin[z + 1] - begin[z];
    const four ec = begin[x + 1] - begin[x], ed = begin[x + z + 1] - begin[x + z];
    const four p = begin[0] + f.c[2] * ea, q = begin[z] + f.c[2] * eb;
    const four s = begin[x] + f.c[2] * ec, t = begin[x + z] + f.c[2] * ed;
"""

#: Four numbers of a node, and the derivative of three of them.
vec7 = wp.types.vector(length=7, dtype=wp.float32)


@forward.func_native(
    """
#if defined(__CUDA_ARCH__)
"""
    + EIGHT_NODES
    + """    float r[4];
    #define BLEND(m) { \\
        const float p = a0.m + f.c[2] * (a1.m - a0.m), q = b0.m + f.c[2] * (b1.m - b0.m); \\
        const float s = c0.m + f.c[2] * (c1.m - c0.m), t = d0.m + f.c[2] * (d1.m - d0.m); \\
        const float u = p + f.c[1] * (q - p), v = s + f.c[1] * (t - s); \\
        r[i++] = u + f.c[0] * (v - u); }
    int i = 0;
    BLEND(x) BLEND(y) BLEND(z) BLEND(w)
    #undef BLEND
    return wp::vec_t<4, wp::float32>(r[0], r[1], r[2], r[3]);
#else
    typedef float four __attribute__((ext_vector_type(4), aligned(4)));
    const four* begin = reinterpret_cast<const four*>(nodes.data) + n;
    const four a = begin[0] + f.c[2] * (begin[1] - begin[0]);
    const four b = begin[z] + f.c[2] * (begin[z + 1] - begin[z]);
    const four c = begin[x] + f.c[2] * (begin[x + 1] - begin[x]);
    const four d = begin[x + z] + f.c[2] * (begin[x + z + 1] - begin[x + z]);
    const four u = a + f.c[1] * (b - a), v = c + f.c[1] * (d - c);
    const four r = u + f.c[0] * (v - u);
    return wp::vec_t<4, wp::float32>(r.x, r.y, r.z, r.w);
#endif
"""
)
def node_blend(nodes: wp.array(dtype=wp.vec4), n: wp.int32, x: wp.int32, z: wp.int32, f: wp.vec3) -> wp.vec4:
    """Trilinear value at a place f, 0 to 1, in the cell above node n. x, z: from a node to the next of axes 0 and 1."""
    ...


@forward.func_native("""
#if defined(__CUDA_ARCH__)
    #define DISTANCE(i) __ldg(begin + 4 * (size_t)(i))
#else
    #define DISTANCE(i) begin[4 * (size_t)(i)]
#endif
    const float* begin = reinterpret_cast<const float*>(nodes.data) + 4 * (size_t)(unsigned)n + 3;
    const unsigned sx = (unsigned)x, sz = (unsigned)z;
    const float a0 = DISTANCE(0), a1 = DISTANCE(1), b0 = DISTANCE(sz), b1 = DISTANCE(sz + 1);
    const float c0 = DISTANCE(sx), c1 = DISTANCE(sx + 1), d0 = DISTANCE(sx + sz), d1 = DISTANCE(sx + sz + 1);
    #undef DISTANCE
    const float p = a0 + f.c[2] * (a1 - a0), q = b0 + f.c[2] * (b1 - b0);
    const float s = c0 + f.c[2] * (c1 - c0), t = d0 + f.c[2] * (d1 - d0);
    const float u = p + f.c[1] * (q - p), v = s + f.c[1] * (t - s);
    return u + f.c[0] * (v - u);
""")
def node_distance(nodes: wp.array(dtype=wp.vec4), n: wp.int32, x: wp.int32, z: wp.int32, f: wp.vec3) -> wp.float32:
    """node_blend's last number alone."""
    ...


@forward.func_native(
    """
#if defined(__CUDA_ARCH__)
"""
    + EIGHT_NODES
    + """    float r[3];
    #define SLOPE(m) { \\
        const float ea = a1.m - a0.m, eb = b1.m - b0.m, ec = c1.m - c0.m, ed = d1.m - d0.m; \\
        const float p = a0.m + f.c[2] * ea, q = b0.m + f.c[2] * eb, s = c0.m + f.c[2] * ec, t = d0.m + f.c[2] * ed; \\
        const float u = p + f.c[1] * (q - p), v = s + f.c[1] * (t - s); \\
        const float eu = ea + f.c[1] * (eb - ea), ev = ec + f.c[1] * (ed - ec); \\
        const float g = (q - p) + f.c[0] * ((t - s) - (q - p)); \\
        r[i++] = rate.c[0] * (v - u) + rate.c[1] * g + rate.c[2] * (eu + f.c[0] * (ev - eu)); }
    int i = 0;
    SLOPE(x) SLOPE(y) SLOPE(z)
    #undef SLOPE
    return wp::vec_t<3, wp::float32>(r[0], r[1], r[2]);
#else
"""
    + FOUR_EDGES
    + """    const four u = p + f.c[1] * (q - p), v = s + f.c[1] * (t - s);
    const four eu = ea + f.c[1] * (eb - ea), ev = ec + f.c[1] * (ed - ec);
    const four g = (q - p) + f.c[0] * ((t - s) - (q - p));
    const four r = rate.c[0] * (v - u) + rate.c[1] * g + rate.c[2] * (eu + f.c[0] * (ev - eu));
    return wp::vec_t<3, wp::float32>(r.x, r.y, r.z);
#endif
"""
)
def node_slope(
    nodes: wp.array(dtype=wp.vec4), n: wp.int32, x: wp.int32, z: wp.int32, f: wp.vec3, rate: wp.vec3
) -> wp.vec3:
    """Derivative of node_blend's first three numbers where f moves at `rate`."""
    ...


@forward.func_native(
    """
#if defined(__CUDA_ARCH__)
"""
    + EIGHT_NODES
    + """    wp::vec_t<7, wp::float32> result;
    #define VALUE(m) \\
        const float ea = a1.m - a0.m, eb = b1.m - b0.m, ec = c1.m - c0.m, ed = d1.m - d0.m; \\
        const float p = a0.m + f.c[2] * ea, q = b0.m + f.c[2] * eb, s = c0.m + f.c[2] * ec, t = d0.m + f.c[2] * ed; \\
        const float u = p + f.c[1] * (q - p), v = s + f.c[1] * (t - s); \\
        result.c[i] = u + f.c[0] * (v - u);
    #define BOTH(m) { \\
        VALUE(m) \\
        const float eu = ea + f.c[1] * (eb - ea), ev = ec + f.c[1] * (ed - ec); \\
        const float g = (q - p) + f.c[0] * ((t - s) - (q - p)); \\
        result.c[4 + i++] = rate.c[0] * (v - u) + rate.c[1] * g + rate.c[2] * (eu + f.c[0] * (ev - eu)); }
    int i = 0;
    BOTH(x) BOTH(y) BOTH(z)
    { VALUE(w) }
    #undef BOTH
    #undef VALUE
    return result;
#else
"""
    + FOUR_EDGES
    + """    const four u = p + f.c[1] * (q - p), v = s + f.c[1] * (t - s), r = u + f.c[0] * (v - u);
    const four eu = ea + f.c[1] * (eb - ea), ev = ec + f.c[1] * (ed - ec);
    const four g = (q - p) + f.c[0] * ((t - s) - (q - p));
    const four w = rate.c[0] * (v - u) + rate.c[1] * g + rate.c[2] * (eu + f.c[0] * (ev - eu));
    wp::vec_t<7, wp::float32> result;
    for (int i = 0; i < 4; ++i)
        result.c[i] = r[i];
    for (int i = 0; i < 3; ++i)
        result.c[4 + i] = w[i];
    return result;
#endif
"""
)
def node_blend_slope(
    nodes: wp.array(dtype=wp.vec4), n: wp.int32, x: wp.int32, z: wp.int32, f: wp.vec3, rate: wp.vec3
) -> vec7:
    """Both at once: node_blend's four numbers, and node_slope's three behind them."""
    ...


@wp.func
def share_slope(corner: int, offset: wp.vec3, rate: wp.vec3):
    """Derivative of lattice/cage_map.corner_share where the offset moves at `rate`."""
    total = float(0.0)
    for axis in range(3):
        high = (corner & (4 >> axis)) != 0
        moved = offset
        moved[axis] = wp.where(high, 1.0, 0.0)
        total += wp.where(high, rate[axis], -rate[axis]) * corner_share(corner, moved)
    return forward_only(total, offset)


@wp.func(inline=False)  # rare
def side_slope(sides: wp.array2d(dtype=wp.vec4), entry: int, offset: wp.vec3, rate: wp.vec3):
    """Derivative of lattice/cage_map.side_position where the offset moves at `rate`."""
    row = wp.max(nearest_side(sides, entry, offset), entry / 8)
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for corner in range(8):
        total += share_slope(corner, offset, rate) * sides[row, corner]
    return wp.vec3(total[0], total[1], total[2])
