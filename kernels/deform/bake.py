"""A deformed scene resampled at the nodes of a new voxel grid.

A node of the new grid takes density and spherical harmonics of its canonical point ("Deforming Radiance Fields with
Cages", ECCV 2022, Eq. 5). Harmonics f(d) become f(R d), R the rotation in the polar decomposition of the map's
Jacobian J: band 1 is a linear form in d and turns as a vector, band 2 a traceless quadratic form d^T S d and becomes
R^T S R. Where optical depth is taken in canonical arc length (|J d| of a step in direction d), the density takes the
root mean square of |J d| over all directions, sqrt(tr(J^T J) / 3), as a voxel has one density for all of them.
Needs: deform/edits, field/grid, field/harmonics.
"""

import warp as wp

from ..field.grid import VoxelGrid, cell_density, cell_sample, empty_distance, grid_position
from ..field.harmonics import vec9
from .edits import CLEARED, MAPPED, CanonicalPoint, LatticeEdit, canonical_point, canonical_step

wp.set_module_options({"enable_backward": False})

#: sh_basis: band 1 is -A y, A z, -A x; band 2 B xy, -B yz, C (2 z^2 - x^2 - y^2), -B xz, B / 2 (x^2 - y^2).
A = wp.constant(0.4886025119029199)
B = wp.constant(1.0925484305920792)
C = wp.constant(0.31539156525252005)


@wp.func
def node_point(n: int, shape: wp.vec3i, lower: wp.vec3, spacing: wp.vec3):
    """Position of the n-th node of a grid."""
    k = n % shape[2]
    j = (n // shape[2]) % shape[1]
    i = n // (shape[2] * shape[1])
    return lower + wp.cw_mul(spacing, wp.vec3(float(i), float(j), float(k)))


@wp.func
def holds_values(grid: VoxelGrid, point: CanonicalPoint):
    """Whether the field has values at a canonical point that are seen."""
    if point.vacant == 1 or point.region == CLEARED:
        return False
    return empty_distance(grid, grid_position(grid, point.position)) == 0


@wp.kernel
def mark_filled_nodes(
    first: int,
    edits: wp.array(dtype=LatticeEdit),
    grid: VoxelGrid,
    lower: wp.vec3,
    spacing: wp.vec3,
    mask: wp.array3d(dtype=wp.uint8),
):
    """1 at the nodes of a new grid (nx, ny, nz) at which the deformed scene has values, 0 at the others."""
    n = first + wp.tid()
    shape = wp.vec3i(mask.shape[0], mask.shape[1], mask.shape[2])
    filled = holds_values(grid, canonical_point(edits, node_point(n, shape, lower, spacing)))
    mask[n // (shape[2] * shape[1]), (n // shape[2]) % shape[1], n % shape[2]] = wp.uint8(wp.where(filled, 1, 0))


@wp.func
def map_jacobian(edits: wp.array(dtype=LatticeEdit), x: wp.vec3, here: CanonicalPoint, dt: float):
    """Jacobian of the map at a point by differences of dt, as the march takes them."""
    jacobian = wp.mat33()
    for axis in range(3):
        along = wp.vec3(0.0, 0.0, 0.0)
        along[axis] = 1.0
        column = canonical_step(edits, x, along, dt, here, canonical_point(edits, x + dt * along)) / dt
        for row in range(3):
            jacobian[row, axis] = column[row]
    return jacobian


@wp.func
def nearest_rotation(jacobian: wp.mat33):
    """The rotation R of the polar decomposition J = R S; of a map that turns over, the nearest rotation."""
    u = wp.mat33()
    v = wp.mat33()
    s = wp.vec3()
    wp.svd3(jacobian, u, s, v)
    sign = wp.where(wp.determinant(u) * wp.determinant(v) < 0.0, -1.0, 1.0)
    return u * wp.diag(wp.vec3(1.0, 1.0, sign)) * wp.transpose(v)


@wp.func
def rotated_harmonics(c: vec9, r: wp.mat33):
    """Coefficients of d -> f(R d) from those of f."""
    vector = wp.transpose(r) * (A * wp.vec3(-c[3], -c[1], c[2]))
    xx = -C * c[6] + 0.5 * B * c[8]
    yy = -C * c[6] - 0.5 * B * c[8]
    zz = 2.0 * C * c[6]
    xy = 0.5 * B * c[4]
    yz = -0.5 * B * c[5]
    xz = -0.5 * B * c[7]
    form = wp.transpose(r) * wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz) * r
    return vec9(
        c[0],
        -vector[1] / A,
        vector[2] / A,
        -vector[0] / A,
        2.0 * form[0, 1] / B,
        -2.0 * form[1, 2] / B,
        form[2, 2] / (2.0 * C),
        -2.0 * form[0, 2] / B,
        (form[0, 0] - form[1, 1]) / B,
    )


@wp.kernel
def bake_nodes(
    first: int,
    edits: wp.array(dtype=LatticeEdit),
    grid: VoxelGrid,
    lower: wp.vec3,
    spacing: wp.vec3,
    nodes: wp.array(dtype=wp.vec3i),
    dt: float,
    arc_opacity: int,
    density: wp.array(dtype=wp.float32),
    sh: wp.array2d(dtype=vec9),
):
    """Density (rows,) before the ReLU and harmonics (rows, rgb) of the deformed scene at nodes (rows,).

    dt: of the differences, world units. arc_opacity: 1 where optical depth is in canonical arc length.
    """
    n = first + wp.tid()
    node = nodes[n]
    x = lower + wp.cw_mul(spacing, wp.vec3(float(node[0]), float(node[1]), float(node[2])))
    here = canonical_point(edits, x)
    cell = cell_sample(grid, grid_position(grid, here.position))
    stretch = float(1.0)
    rotation = wp.identity(n=3, dtype=float)
    if here.region == MAPPED:
        jacobian = map_jacobian(edits, x, here, dt)
        rotation = nearest_rotation(jacobian)
        if arc_opacity == 1:
            stretch = wp.sqrt(wp.ddot(jacobian, jacobian) / 3.0)
    density[n] = stretch * cell_density(grid, cell)
    for channel in range(3):
        coefficients = vec9()
        for c in range(8):
            if cell.rows[c] >= 0:
                coefficients += cell.weights[c] * grid.sh[cell.rows[c], channel]
        sh[n, channel] = rotated_harmonics(coefficients, rotation)
