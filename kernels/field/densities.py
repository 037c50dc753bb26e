"""Trilinear density of a sparse voxel grid, with few reads that wait for each other."""

# On CUDA the densities of all nodes are halves, 0 without a row: eight reads that wait for nothing, where links or bits
# would be asked first. Their own units keep digits in scenes of any size. CPUs, whose caches hold bits, use those.

import warp as wp

from ..core.gradients import forward
from .columns import CELL_PLACE, COLUMN_ENTRY, Columns

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@forward.func_native(
    """
#if defined(__CUDA_ARCH__)
    const int nz = columns.node_counts.c[2], nyz = columns.node_counts.c[1] * nz;
    const unsigned short* low = reinterpret_cast<const unsigned short*>(laid.data)
        + ((size_t)(unsigned)i * (unsigned)nyz + (unsigned)(j * nz + k));
    const unsigned short* high = low + nyz;
    const unsigned short halves[8] = {__ldg(low), __ldg(low + 1), __ldg(low + nz), __ldg(low + nz + 1),
        __ldg(high), __ldg(high + 1), __ldg(high + nz), __ldg(high + nz + 1)};
    float v[8];
    #pragma unroll
    for (int c = 0; c < 8; ++c)
    {
        wp::half h;
        h.u = halves[c];
        v[c] = wp::half_to_float(h);
    }
    #pragma unroll
    for (int c = 0; c < 4; ++c)
        v[c] = v[2 * c] + offset.c[2] * (v[2 * c + 1] - v[2 * c]);
    const float begin_sum = v[0] + offset.c[1] * (v[1] - v[0]);
    const float end_sum = v[2] + offset.c[1] * (v[3] - v[2]);
    return unit * (begin_sum + offset.c[0] * (end_sum - begin_sum));
#else
"""
    + CELL_PLACE
    + """    const int* order = columns.order.data;
    float sums[4];
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
#endif
"""
)
def row_density(
    laid: wp.array(dtype=wp.float16),
    unit: wp.float32,
    density: wp.array(dtype=wp.float32),
    columns: Columns,
    i: wp.int32,
    j: wp.int32,
    k: wp.int32,
    offset: wp.vec3,
) -> wp.float32:
    """Trilinear density before the ReLU, at a place, 0 to 1, in the cell above node (i, j, k).
    laid: (nodes,) of lay_densities, in `unit`, read on CUDA; density: (rows,) of the grid, read on a CPU."""
    ...


@wp.kernel
def lay_densities(
    first: int,
    density: wp.array(dtype=wp.float32),
    order: wp.array(dtype=wp.int32),
    nodes: wp.array(dtype=wp.int32),
    inverse_unit: float,
    laid: wp.array(dtype=wp.float16),
):
    """Densities (rows,) to their nodes, as halves. order: of Columns; nodes: (rows,) flat index of each row's node."""
    n = first + wp.tid()
    row = int(n)
    if order.shape[0] > 0:
        row = order[n]
    laid[nodes[n]] = wp.float16(wp.clamp(inverse_unit * density[row], -65504.0, 65504.0))
