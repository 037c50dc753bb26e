"""Gradient of the total variation of a voxel field's density and SH coefficients.
Per node and number sqrt(dx^2 + dy^2 + dz^2 + eps), differences to nodes without a row 0 (Plenoxels 2022, Eq. 3)."""

import warp as wp

from ..field.grid import VoxelGrid
from .rmsprop import COEFFICIENTS, GRADIENT_ROW, gradient_place, harmonic_degree

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def neighbor_row(grid: VoxelGrid, node: wp.vec3i, axis: int):
    """Row of the next node along an axis, or -1."""
    i = node[0] + wp.where(axis == 0, 1, 0)
    j = node[1] + wp.where(axis == 1, 1, 0)
    k = node[2] + wp.where(axis == 2, 1, 0)
    if i < grid.links.shape[0] and j < grid.links.shape[1] and k < grid.links.shape[2]:
        return grid.links[i, j, k]
    return int(-1)


@wp.kernel
def accumulate_variation_gradient(
    first: int,
    grid: VoxelGrid,
    nodes: wp.array(dtype=wp.vec3i),
    first_row: int,
    density_unit: float,
    scale_density: float,
    scale_sh: float,
    scale_high_degree: float,
    gradients: wp.array(dtype=wp.float32),
    touched: wp.array(dtype=wp.uint8),
):
    """Adds the gradient of a sum of total variations over a run of rows. GRADIENT_ROW items per row, one per number.
    nodes: (rows,) grid indices. Rows are shared with neighbours: on the CPU each thread needs gradients of its own."""
    # scale_density * TV(density / density_unit), scale_sh * TV(sh) of degrees 0 and 1, scale_high_degree * TV(sh) of 2
    # and 3. Rows from first_row on, then from 0. gradients: (25 rows,) of fitting/rmsprop. touched: (rows,) set to 1.
    n = first + wp.tid()
    number = n % GRADIENT_ROW
    row = (first_row + n // GRADIENT_ROW) % nodes.shape[0]
    unit = float(1.0)
    scale = float(scale_sh)
    value = float(0.0)
    if number < COEFFICIENTS:
        if harmonic_degree(number) > 1:
            scale = scale_high_degree
        value = grid.sh[row, number]
    else:
        unit = density_unit
        scale = scale_density
        value = grid.density[row]
    rows = wp.vec3i()
    difference = wp.vec3()
    for axis in range(3):
        rows[axis] = neighbor_row(grid, nodes[row], axis)
        if rows[axis] >= 0:
            if number < COEFFICIENTS:
                difference[axis] = grid.sh[rows[axis], number] - value
            else:
                difference[axis] = (grid.density[rows[axis]] - value) / unit
    slope = scale / unit / wp.sqrt(wp.dot(difference, difference) + 1.0e-9)
    if number == 0:
        touched[row] = wp.uint8(1)
    total = difference[0] + difference[1] + difference[2]
    wp.atomic_add(gradients, gradient_place(row, number, nodes.shape[0]), -slope * total)
    for axis in range(3):
        if rows[axis] >= 0:
            if number == 0:
                touched[rows[axis]] = wp.uint8(1)
            wp.atomic_add(gradients, gradient_place(rows[axis], number, nodes.shape[0]), slope * difference[axis])
