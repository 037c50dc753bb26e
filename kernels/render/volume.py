"""Shaded voxels of a deformed field for one camera, laid out by nodes, so that a march reads all around a place at
once."""

import warp as wp

from ..core.gradients import forward
from ..core.texels import BLENDED_TEXEL, WRITE_HALF_TEXEL

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Layers of colours: for samples that no map has moved, and for mapped ones.
PLAIN_LAYER = wp.constant(0)

CARRIED_LAYER = wp.constant(1)

COLOR_LAYERS = wp.constant(2)


@wp.struct
class ShadedVolume:
    """Colors at the nodes of a grid, 0 where a node has no row."""

    node_counts: wp.vec3i
    cells: wp.vec3  # node_counts less 1
    texture: wp.uint64  # of four halves: axis 2 of the grid, axis 1, and axis 0 of one layer after the other
    surface: wp.uint64  # the same, to be written
    colors: wp.array(dtype=wp.vec4)  # (layers * nodes,) on a CPU


@forward.func_native(
    """
    const int ny = laid.node_counts.c[1], nz = laid.node_counts.c[2];
#if defined(__CUDA_ARCH__)
    const auto surface = laid.surface;
    const int x = node % nz, y = (node / nz) % ny, z = layer * laid.node_counts.c[0] + node / (ny * nz);
"""
    + WRITE_HALF_TEXEL
    + """#else
    const float limit = 65504.0f;
    float* shade = laid.colors.data[(size_t)layer * laid.node_counts.c[0] * ny * nz + node].c;
    for (int i = 0; i < 4; ++i)  // also of what is no number
        shade[i] = value.c[i] > limit ? limit : (value.c[i] >= -limit ? value.c[i] : -limit);
#endif
"""
)
def write_shaded_volume(laid: ShadedVolume, node: wp.int32, layer: wp.int32, value: wp.vec4):
    """Keep red, green, blue less 0.5 and optical depth of a node in a layer."""
    ...


@forward.func_native(
    """
#if defined(__CUDA_ARCH__)
    const auto texture = laid.texture;
    const float x = at.c[2], y = at.c[1], z = at.c[0] + (float)(layer * laid.node_counts.c[0]);
"""
    + BLENDED_TEXEL
    + """
    return wp::vec_t<4, wp::float32>(r, g, b, a);
#else
    typedef float four __attribute__((ext_vector_type(4), aligned(4)));
    const int ny = laid.node_counts.c[1], nz = laid.node_counts.c[2];
    const int i = (int)at.c[0], j = (int)at.c[1], k = (int)at.c[2];
    const float x = at.c[0] - (float)i, y = at.c[1] - (float)j, z = at.c[2] - (float)k;
    const four* low = reinterpret_cast<const four*>(laid.colors.data)
        + ((size_t)(layer * laid.node_counts.c[0] + i) * ny + j) * nz + k;
    const four* high = low + (size_t)ny * nz;
    const four a = low[0] + z * (low[1] - low[0]), b = low[nz] + z * (low[nz + 1] - low[nz]);
    const four c = high[0] + z * (high[1] - high[0]), d = high[nz] + z * (high[nz + 1] - high[nz]);
    const four u = a + y * (b - a), v = c + y * (d - c), s = u + x * (v - u);
    return wp::vec_t<4, wp::float32>(s.x, s.y, s.z, s.w);
#endif
"""
)
def shaded_value(laid: ShadedVolume, at: wp.vec3, layer: wp.int32) -> wp.vec4:
    """Trilinear value at node coordinates in a cell of the grid; the colour still lacks its 0.5."""
    ...
