"""Optimiser step of a voxel field: RMSProp on the values that a gradient touched, and what total variation adds."""

# v <- beta v + (1 - beta) g^2 (v = g^2 at the first touch, as Plenoxels), x <- x - rate g / (sqrt(v) + eps): Tieleman
# and Hinton 2012. An item takes four numbers of a row, or its density.

from typing import Any

import warp as wp

from ..core.lanes import grid_place
from ..field.grid import VoxelGrid
from ..field.harmonics import DIFFERENCE_BASIS, LUMINANCE_BASIS

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Numbers of a voxel's SH (field/harmonics): sixteen of luminance, four of orange, four of green.
COEFFICIENTS = wp.constant(24)

#: Numbers of a row's gradient: the coefficients and the density. The coefficients of all rows come first, then all
#: densities.
GRADIENT_ROW = wp.constant(25)

#: Items of a row: six times four coefficients, and the density.
ROW_PARTS = wp.constant(7)
four_bfloats = wp.types.vector(length=4, dtype=wp.bfloat16)


@wp.func
def harmonic_degree(number: int):
    """Degree of the harmonic that a coefficient belongs to: 0 to 3."""
    basis = number
    if number >= LUMINANCE_BASIS:
        basis = (number - LUMINANCE_BASIS) % DIFFERENCE_BASIS
    return wp.where(basis == 0, 0, wp.where(basis < 4, 1, wp.where(basis < 9, 2, 3)))


@wp.func
def gradient_place(row: int, number: int, rows: int):
    """Where the gradient of a row's coefficient, or of its density after those, is among those of all rows."""
    if number < COEFFICIENTS:
        return row * COEFFICIENTS + number
    return rows * COEFFICIENTS + row


@wp.func
def rmsprop_update(value: float, moment: float, gradient: float, rate: float, beta: float, epsilon: float):
    """(value, moment) after a step by a gradient. A moment of 0 has met no gradient before."""
    v = gradient * gradient
    if moment != 0.0:
        v = beta * moment + (1.0 - beta) * gradient * gradient
    return value - rate * gradient / (wp.sqrt(v) + epsilon), v


@wp.kernel
def apply_rmsprop(
    first: int,
    rate_density: float,
    rates_sh: wp.vec4,
    beta: float,
    epsilon_density: float,
    epsilon_sh: float,
    touched: wp.array(dtype=wp.uint8),
    grad_density: wp.array(dtype=wp.float32),
    grad_sh: wp.array2d(dtype=wp.vec4),
    moments_density: wp.array(dtype=wp.bfloat16),
    moments_sh: wp.array2d(dtype=four_bfloats),
    density: wp.array(dtype=wp.float32),
    sh: wp.array2d(dtype=wp.vec4),
):
    """Step where the gradient is not zero, and clear the gradient for the next batch. ROW_PARTS items per row.
    touched: (rows,) 1 where any gradient may be. Densities: (rows,), per world unit; sh: (rows, 6) of four numbers."""
    # Moments have 8 bits of mantissa: they scale steps, and a share of 1 - beta moves them by more than a last bit.
    n = first + wp.tid()
    row = n // ROW_PARTS
    part = n % ROW_PARTS
    if touched[row] == wp.uint8(0):
        return
    if part == ROW_PARTS - 1:
        slope = grad_density[row]
        if slope != 0.0:
            sigma = density[row]
            spread = float(moments_density[row])
            sigma, spread = rmsprop_update(sigma, spread, slope, rate_density, beta, epsilon_density)
            density[row] = sigma
            moments_density[row] = wp.bfloat16(spread)
            grad_density[row] = 0.0
        return
    gradients = grad_sh[row, part]
    if gradients[0] == 0.0 and gradients[1] == 0.0 and gradients[2] == 0.0 and gradients[3] == 0.0:
        return
    values = sh[row, part]
    moments = moments_sh[row, part]
    for i in range(4):
        gradient = gradients[i]
        if gradient != 0.0:
            rate = rates_sh[harmonic_degree(4 * part + i)]
            value, moment = rmsprop_update(values[i], float(moments[i]), gradient, rate, beta, epsilon_sh)
            values[i] = value
            moments[i] = wp.bfloat16(moment)
    sh[row, part] = values
    moments_sh[row, part] = moments
    grad_sh[row, part] = wp.vec4()


@wp.kernel
def add_gradients(first: int, other: wp.array(dtype=wp.float32), total: wp.array(dtype=wp.float32)):
    """Move one thread's gradients into the total and clear them. One item per number."""
    n = first + wp.tid()
    gradient = other[n]
    if gradient != 0.0:
        total[n] = total[n] + gradient
        other[n] = 0.0


@wp.kernel
def join_maximum(first: int, other: wp.array(dtype=wp.float32), values: wp.array(dtype=wp.float32)):
    """The larger of two numbers, in `values`. One item per number."""
    n = first + wp.tid()
    values[n] = wp.max(values[n], other[n])


@wp.kernel
def count_marks(first: int, shown: wp.array2d(dtype=wp.uint32), counts: wp.array(dtype=wp.uint8)):
    """Adds the pictures that show a row, up to 255, and clears their marks (shards, rows). One item per row."""
    n = first + wp.tid()
    marks = wp.uint32(0)
    for shard in range(shown.shape[0]):
        marks = marks | shown[shard, n]
        shown[shard, n] = wp.uint32(0)
    counts[n] = wp.uint8(wp.min(int(counts[n]) + int(wp.bit_count(marks)), 255))


@wp.kernel
def gather_numbers(
    first: int,
    rows: wp.array(dtype=wp.int32),
    density: wp.array(dtype=Any),
    sh: wp.array2d(dtype=Any),
    kept_density: wp.array(dtype=Any),
    kept_sh: wp.array2d(dtype=Any),
):
    """Numbers of the rows (rows,) that stay, values or moments: of densities (rows,), of sh (rows, 6). ROW_PARTS items
    per row. rows: which each was before."""
    n = first + wp.tid()
    row = n // ROW_PARTS
    part = n % ROW_PARTS
    if part == ROW_PARTS - 1:
        kept_density[row] = density[rows[row]]
    else:
        kept_sh[row, part] = sh[rows[row], part]


for one, four in ((wp.float32, wp.vec4), (wp.bfloat16, four_bfloats)):
    arrays = {"density": wp.array(dtype=one), "sh": wp.array2d(dtype=four)}
    wp.overload(gather_numbers, {**arrays, **{f"kept_{name}": each for name, each in arrays.items()}})


@wp.kernel
def shrink_view_dependence(first: int, factor: float, coefficients: wp.array2d(dtype=wp.float32)):
    """Multiplies the coefficients (rows, 24) that depend on direction by a factor. One item per number."""
    n = first + wp.tid()
    row = n // COEFFICIENTS
    number = n % COEFFICIENTS
    if harmonic_degree(number) > 0:
        coefficients[row, number] = factor * coefficients[row, number]


# Per node and number sqrt(dx^2 + dy^2 + dz^2 + eps), differences to nodes without a row 0 (Plenoxels 2022, Eq. 3).


@wp.func
def neighbor_row(grid: VoxelGrid, node: int, axis: int):
    """Row of the next node along an axis, or -1. node: flat index."""
    i, j, k = grid_place(node, grid.links.shape[1], grid.links.shape[2])
    i += wp.where(axis == 0, 1, 0)
    j += wp.where(axis == 1, 1, 0)
    k += wp.where(axis == 2, 1, 0)
    if i < grid.links.shape[0] and j < grid.links.shape[1] and k < grid.links.shape[2]:
        return grid.links[i, j, k]
    return int(-1)


@wp.kernel
def accumulate_variation_gradient(
    first: int,
    grid: VoxelGrid,
    nodes: wp.array(dtype=wp.int32),
    first_row: int,
    density_unit: float,
    scale_density: float,
    scale_sh: float,
    scale_high_degree: float,
    views: wp.array(dtype=wp.uint8),
    by_views: wp.array(dtype=wp.vec2),
    gradients: wp.array(dtype=wp.float32),
    touched: wp.array(dtype=wp.uint8),
):
    """Adds the gradient of a sum of total variations over a run of rows. GRADIENT_ROW items per row, one per number.
    nodes: (rows,) flat indices. Rows are shared with neighbours: on the CPU each thread needs gradients of its own."""
    # scale_density * TV(density / density_unit), scale_sh * TV(sh) of degrees 0 and 1, scale_high_degree * TV(sh) of 2
    # and 3. Rows from first_row on, then from 0. gradients: (25 rows,) as above. touched: (rows,) set to 1. by_views:
    # (256,) factors on the terms of density and of sh by the number of views (rows,) of a row; empty: 1.
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
    if views.shape[0] > 0:
        scale *= by_views[int(views[row])][wp.where(number < COEFFICIENTS, 1, 0)]
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
