"""What a camera sees of each voxel: its colour towards the camera and its optical depth, evaluated once per view."""

# A march then reads eight numbers of 8 bytes a sample instead of eight rows of harmonics. Trilinear weights blend the
# directions to the eight nodes to the direction to the sample, but for the square of a voxel's angle from the camera,
# so that sum_i w_i c_i . Y(d_i) differs from (sum_i w_i c_i) . Y(d) by the change of c over a voxel times that angle.

import warp as wp

from ..core.gradients import forward
from ..core.lanes import grid_place
from ..core.texels import FOUR_HALVES
from ..core.variants import native_source
from .columns import Columns, cell_rows, eight_rows
from .grid import VoxelGrid
from .harmonics import sh_basis, vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})


@wp.struct
class ShadedGrid:
    """The rows of a grid in memory order, as one camera sees them."""

    columns: Columns
    center: wp.vec3  # of the camera
    step: float
    colors: wp.array2d(dtype=wp.uint32)  # (rows, uint32s): red, green, blue less 0.5 and optical depth of a step


@forward.func_native(native_source(__file__, "cpp/shade_color.h"))
def shade_color(
    sh: wp.array2d(dtype=wp.float32), halves: wp.array2d(dtype=wp.float16), row: wp.int32, basis: vec16
) -> wp.vec3:
    """Harmonics of a row times a basis; `sh` and `halves` of VoxelGrid. All lanes, in blocks of at most 128 threads."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
"""
    + FOUR_HALVES
    + """
    reinterpret_cast<uint2*>(colors.data)[row] = make_uint2(r | (g << 16), b | (a << 16));
#else
    const float limit = 65504.0f;
    float* shade = reinterpret_cast<float*>(colors.data) + 4 * (size_t)row;
    for (int i = 0; i < 4; ++i)  // also of what is no number
        shade[i] = value.c[i] > limit ? limit : (value.c[i] >= -limit ? value.c[i] : -limit);
#endif
"""
)
def write_color(colors: wp.array2d(dtype=wp.uint32), row: wp.int32, value: wp.vec4):
    """Keep red, green, blue and optical depth of a row: halves on CUDA, floats on a CPU."""
    ...


@wp.func
def row_place(grid: VoxelGrid, node_counts: wp.vec3i, node: int):
    """Where the node of a row is."""
    i, j, k = grid_place(node, node_counts[1], node_counts[2])
    return grid.lower + wp.cw_mul(grid.voxel_size, wp.vec3(float(i), float(j), float(k)))


@wp.func
def own_row(shaded: ShadedGrid, n: int):
    """The grid's number of a row."""
    row = int(n)
    if shaded.columns.order.shape[0] > 0:
        row = shaded.columns.order[n]
    return row


@wp.kernel
def shade_rows(first: int, grid: VoxelGrid, nodes: wp.array(dtype=wp.int32), shaded: ShadedGrid):
    """One thread per row, their number rounded up to whole warps. nodes: (rows,) of field/columns."""
    item = first + wp.tid()
    n = wp.min(item, nodes.shape[0] - 1)
    row = own_row(shaded, n)
    place = row_place(grid, shaded.columns.node_counts, nodes[n])
    color = shade_color(grid.sh, grid.halves, row, sh_basis(wp.normalize(place - shaded.center)))
    if item < nodes.shape[0]:
        write_color(shaded.colors, n, wp.vec4(color[0], color[1], color[2], grid.density[row] * shaded.step))


@forward.func_native("""
    float r = 0.0f, g = 0.0f, b = 0.0f, d = 0.0f;
#if defined(__CUDA_ARCH__)
    const uint2* colors = reinterpret_cast<const uint2*>(data.data);
    #pragma unroll
    for (int c = 0; c < 8; ++c)
    {
        uint2 shade = make_uint2(0u, 0u);
        if (rows.c[c] >= 0)
            shade = __ldg(colors + rows.c[c]);
        const float weight = ((c & 4) ? offset.c[0] : 1.0f - offset.c[0]) * ((c & 2) ? offset.c[1] : 1.0f - offset.c[1])
            * ((c & 1) ? offset.c[2] : 1.0f - offset.c[2]);
        wp::half h;
        h.u = shade.x & 0xffffu; r += weight * wp::half_to_float(h);
        h.u = shade.x >> 16; g += weight * wp::half_to_float(h);
        h.u = shade.y & 0xffffu; b += weight * wp::half_to_float(h);
        h.u = shade.y >> 16; d += weight * wp::half_to_float(h);
    }
    return wp::vec_t<4, wp::float32>(r, g, b, d);
#else
    typedef float four __attribute__((ext_vector_type(4), aligned(4)));
    const four* colors = reinterpret_cast<const four*>(data.data);
    four sum = 0.0f;
    for (int c = 0; c < 8; ++c)
        if (rows.c[c] >= 0)
        {
            #pragma clang fp contract(fast)
            const float weight = ((c & 4) ? offset.c[0] : 1.0f - offset.c[0])
                * ((c & 2) ? offset.c[1] : 1.0f - offset.c[1]) * ((c & 1) ? offset.c[2] : 1.0f - offset.c[2]);
            sum += weight * colors[rows.c[c]];
        }
    return wp::vec_t<4, wp::float32>(sum.x, sum.y, sum.z, sum.w);
#endif
""")
def blended_colors(data: wp.array2d(dtype=wp.uint32), rows: eight_rows, offset: wp.vec3) -> wp.vec4:
    """Trilinear red, green, blue less 0.5 and optical depth at a place, 0 to 1, in the cell of eight rows."""
    ...


@wp.func
def color_at(shaded: ShadedGrid, i: int, j: int, k: int, offset: wp.vec3):
    """As `blended_colors`, in the cell above node (i, j, k)."""
    return blended_colors(shaded.colors, cell_rows(shaded.columns, i, j, k), offset)
