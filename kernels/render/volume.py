"""Shaded voxels of a deformed field for one camera, laid out by nodes, so that a march reads all around a place at
once."""

import warp as wp

from ..core.gradients import forward
from ..core.texels import BLENDED_TEXEL_MIDDLES, FOUR_HALVES, WRITE_HALVES
from ..core.variants import native_constants
from ..field.outer_bricks import ACROSS_BITS, BRICK_CELLS, BRICK_NODES

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Layers of colours: for samples that no map has moved, and for mapped ones.
PLAIN_LAYER = wp.constant(0)

CARRIED_LAYER = wp.constant(1)

COLOR_LAYERS = wp.constant(2)

#: A bit for each.
ALL_LAYERS = wp.constant(3)

#: Pages hold half texels from this many texels below zero on, as a number of 16 bits.
PAGE_BEGIN = 1 << 14

#: C++ of several functions: the sizes of bricks, and the float whose last bits stand for zero texels in a page.
BRICK_SIZES = native_constants(
    cells=int(BRICK_CELLS),
    nodes=int(BRICK_NODES),
    across_bits=int(ACROSS_BITS),
    page_origin=float((1 << 22) + PAGE_BEGIN),
)


@wp.struct
class ShadedVolume:
    """Colors at the nodes of a grid, in bricks as those of field/outer_bricks, 0 where a node has no row."""

    node_counts: wp.vec3i
    cells: wp.vec3  # node_counts less 1
    numbers: wp.array4d(dtype=wp.int32)  # (layers, bricks along each axis) of each brick in the texture; 0: it is empty
    pages: wp.array4d(dtype=wp.vec2i)  # where each is in it, on CUDA: texels less nodes along axis 2, axis 1; axis 0
    first_page: wp.uint32  # what the index of the first page comes to, of floats' bits
    texture: wp.uint64  # of four halves: axis 2 of the grid, axis 1, axis 0 of a brick
    surface: wp.uint64  # the same, to be written
    colors: wp.array(dtype=wp.vec4)  # (bricks * BRICK_NODES^3,) on a CPU


@forward.func_native(
    BRICK_SIZES
    + """
    const int* counts = laid.numbers.shape.dims;
    const int ny = laid.node_counts.c[1], nz = laid.node_counts.c[2];
    const int i = node / (ny * nz), j = (node / nz) % ny, k = node % nz;
    const int last_i = wp::min(i / cells, counts[1] - 1), last_j = wp::min(j / cells, counts[2] - 1);
    const int last_k = wp::min(k / cells, counts[3] - 1);
#if defined(__CUDA_ARCH__)
    const auto surface = laid.surface;
    const int last = (1 << across_bits) - 1;
"""
    + FOUR_HALVES
    + """#else
    const float limit = 65504.0f;
#endif
    for (int layer = 0; layer < counts[0]; ++layer)
        if ((layers >> layer) & 1)
            for (int u = (i - (i > 0)) / cells; u <= last_i; ++u)
                for (int v = (j - (j > 0)) / cells; v <= last_j; ++v)
                    for (int w = (k - (k > 0)) / cells; w <= last_k; ++w)
                    {
                        const int number
                            = laid.numbers.data[((layer * counts[1] + u) * counts[2] + v) * counts[3] + w];
                        if (number == 0)
                            continue;
#if defined(__CUDA_ARCH__)
                        const int x = nodes * (number & last) + k - cells * w;
                        const int y = nodes * ((number >> across_bits) & last) + j - cells * v;
                        const int z = nodes * (number >> (2 * across_bits)) + i - cells * u;
"""
    + WRITE_HALVES
    + """#else
                        const size_t line = ((size_t)number * nodes + i - cells * u) * nodes + j - cells * v;
                        float* shade = laid.colors.data[line * nodes + k - cells * w].c;
                        for (int n = 0; n < 4; ++n)  // also of what is no number
                            shade[n] = value.c[n] > limit ? limit : (value.c[n] >= -limit ? value.c[n] : -limit);
#endif
                    }
"""
)
def write_shaded_volume(laid: ShadedVolume, node: wp.int32, layers: wp.int32, value: wp.vec4):
    """Keep red, green, blue less 0.5 and optical depth of a node in its bricks of some layers. layers: their bits."""
    ...


@forward.func_native(
    BRICK_SIZES
    + """
    const int* counts = laid.numbers.shape.dims;
#if defined(__CUDA_ARCH__)
    // without conversions, on which a march would wait: the last bits of 2^23 + x are those of the whole number in x
    const unsigned i = __float_as_uint(__fmaf_rd(at.c[0], 1.0f / cells, 8388608.0f));
    const unsigned j = __float_as_uint(__fmaf_rd(at.c[1], 1.0f / cells, 8388608.0f));
    const unsigned k = __float_as_uint(__fmaf_rd(at.c[2], 1.0f / cells, 8388608.0f));
    const unsigned index = ((layer * counts[1] + i) * counts[2] + j) * counts[3] + k - laid.first_page;
    const uint2 page = __ldg(reinterpret_cast<const uint2*>(laid.pages.data) + index);
    // and those of 2^22 + x of half as much
    const auto texture = laid.texture;
    const float x = at.c[2] + (__uint_as_float(__byte_perm(page.x, 0x4a800000u, 0x7610)) - page_origin);
    const float y = at.c[1] + (__uint_as_float(__byte_perm(page.x, 0x4a800000u, 0x7632)) - page_origin);
    const float z = at.c[0] + (__uint_as_float(__byte_perm(page.y, 0x4a800000u, 0x7610)) - page_origin);
"""
    + BLENDED_TEXEL_MIDDLES
    + """
    return wp::vec_t<4, wp::float32>(r, g, b, a);
#else
    typedef float four __attribute__((ext_vector_type(4), aligned(4)));
    const int i = (int)at.c[0], j = (int)at.c[1], k = (int)at.c[2];
    const int number
        = laid.numbers.data[((layer * counts[1] + i / cells) * counts[2] + j / cells) * counts[3] + k / cells];
    const float x = at.c[0] - (float)i, y = at.c[1] - (float)j, z = at.c[2] - (float)k;
    const four* low = reinterpret_cast<const four*>(laid.colors.data)
        + (((size_t)number * nodes + i % cells) * nodes + j % cells) * nodes + k % cells;
    const four* high = low + nodes * nodes;
    const four a = low[0] + z * (low[1] - low[0]), b = low[nodes] + z * (low[nodes + 1] - low[nodes]);
    const four c = high[0] + z * (high[1] - high[0]), d = high[nodes] + z * (high[nodes + 1] - high[nodes]);
    const four u = a + y * (b - a), v = c + y * (d - c), s = u + x * (v - u);
    return wp::vec_t<4, wp::float32>(s.x, s.y, s.z, s.w);
#endif
"""
)
def shaded_value(laid: ShadedVolume, at: wp.vec3, layer: wp.int32) -> wp.vec4:
    """Trilinear value at node coordinates in a cell of the grid; the colour still lacks its 0.5."""
    ...
