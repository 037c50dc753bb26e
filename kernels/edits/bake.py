"""A deformed scene resampled at the nodes of a new voxel grid."""

import warp as wp

from ..core.lanes import grid_place
from ..field.grid import VoxelGrid, cell_density, cell_sample, empty_distance, grid_position, stored_number
from ..field.harmonics import LUMINANCE_NUMBERS, sh_basis, vec16
from .structs import CLEARED, MAPPED, LatticeEdit
from .trace import CanonicalPoint, canonical_point, canonical_step

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

vec5 = wp.types.vector(length=5, dtype=wp.float32)

vec7 = wp.types.vector(length=7, dtype=wp.float32)

vec27 = wp.types.vector(length=27, dtype=wp.float32)

mat73 = wp.types.matrix(shape=(7, 3), dtype=wp.float32)

mat77 = wp.types.matrix(shape=(7, 7), dtype=wp.float32)

#: sh_basis: band 1 is -A y, A z, -A x; band 2 B xy, -B yz, C (2 z^2 - x^2 - y^2), -B xz, B / 2 (x^2 - y^2).
B = wp.constant(1.0925484305920792)

C = wp.constant(0.31539156525252005)

#: Seven directions at which band 3 is well conditioned (2.4), and the inverse of its functions there.
# fmt: off
PROBES = wp.constant(mat73(
    0.7071067811865476, 0.7071067811865476, 0.0,
    1.0, 0.0, 0.0,
    0.7071067811865476, 0.0, -0.7071067811865476,
    0.5773502691896258, -0.5773502691896258, 0.5773502691896258,
    0.0, 0.7071067811865476, 0.7071067811865476,
    0.0, 1.0, 0.0,
    0.0, 0.0, 1.0,
))

TAKEN_APART = wp.constant(mat77(
    -0.599198765, -0.211848755, -0.599198765, 0.0, 0.599198765, 1.059243776, 0.211848755,
    0.0, -0.691895137, 0.0, -1.797596296, 0.0, 0.691895137, -0.691895137,
    0.77356228, 0.273495567, 0.77356228, 0.0, -0.77356228, 0.820486701, -0.273495567,
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.339849171,
    0.77356228, 0.820486701, -0.77356228, 0.0, 0.77356228, 0.273495567, 0.273495567,
    -0.978487486, -0.345947568, -0.978487486, 0.0, -0.978487486, -0.345947568, 0.0,
    0.599198765, -1.059243776, -0.599198765, 0.0, 0.599198765, 0.211848755, 0.211848755,
))

# fmt: on


@wp.func
def node_point(n: int, shape: wp.vec3i, lower: wp.vec3, spacing: wp.vec3):
    """Position of the n-th node of a grid."""
    i, j, k = grid_place(n, shape[1], shape[2])
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
def rotated_vector(c: wp.vec3, r: wp.mat33):
    """Coefficients of band 1 of d -> f(R d) from those of f."""
    v = wp.transpose(r) * wp.vec3(-c[2], -c[0], c[1])
    return wp.vec3(-v[1], v[2], -v[0])


@wp.func
def rotated_form(c: vec5, r: wp.mat33):
    """The same of band 2."""
    xx = -C * c[2] + 0.5 * B * c[4]
    yy = -C * c[2] - 0.5 * B * c[4]
    zz = 2.0 * C * c[2]
    xy = 0.5 * B * c[0]
    yz = -0.5 * B * c[1]
    xz = -0.5 * B * c[3]
    form = wp.transpose(r) * wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz) * r
    return vec5(
        2.0 * form[0, 1] / B,
        -2.0 * form[1, 2] / B,
        form[2, 2] / (2.0 * C),
        -2.0 * form[0, 2] / B,
        (form[0, 0] - form[1, 1]) / B,
    )


@wp.func
def rotated_cubic(c: vec7, r: wp.mat33):
    """The same of band 3: what f is in seven turned directions, taken apart again."""
    values = vec7()
    for i in range(7):
        basis = sh_basis(r * wp.vec3(PROBES[i, 0], PROBES[i, 1], PROBES[i, 2]))
        for m in range(7):
            values[i] += c[m] * basis[9 + m]
    return TAKEN_APART * values


@wp.func
def rotated_harmonics(c: vec27, first: int, bands: int, r: wp.mat33):
    """Numbers of d -> f(R d) from those of f, a function of bands 0 to `bands` whose coefficients begin at `first`."""
    result = vec16()
    result[0] = c[first]
    vector = rotated_vector(wp.vec3(c[first + 1], c[first + 2], c[first + 3]), r)
    for m in range(3):
        result[1 + m] = vector[m]
    if bands > 1:
        form = vec5()
        for m in range(5):
            form[m] = c[first + 4 + m]
        form = rotated_form(form, r)
        for m in range(5):
            result[4 + m] = form[m]
    if bands > 2:
        cubic = vec7()
        for m in range(7):
            cubic[m] = c[first + 9 + m]
        cubic = rotated_cubic(cubic, r)
        for m in range(7):
            result[9 + m] = cubic[m]
    return result


@wp.kernel
def bake_nodes(
    first: int,
    edits: wp.array(dtype=LatticeEdit),
    grid: VoxelGrid,
    lower: wp.vec3,
    spacing: wp.vec3,
    shape: wp.vec3i,
    nodes: wp.array(dtype=wp.int32),
    dt: float,
    arc_opacity: int,
    density: wp.array(dtype=wp.float32),
    sh: wp.array2d(dtype=wp.float32),
):
    """Density (rows,) before the ReLU and harmonics (rows, 24 or 27) of the deformed scene at nodes (rows,), flat.
    dt: of the differences, world units; arc_opacity: 1 where optical depth is in canonical arc length."""
    n = first + wp.tid()
    i, j, k = grid_place(nodes[n], shape[1], shape[2])
    x = lower + wp.cw_mul(spacing, wp.vec3(float(i), float(j), float(k)))
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
    numbers = vec27()
    for number in range(sh.shape[1]):
        for c in range(8):
            if cell.rows[c] >= 0:
                numbers[number] += cell.weights[c] * stored_number(grid, cell.rows[c], number)
    luminous = sh.shape[1] == LUMINANCE_NUMBERS
    begin = int(0)
    for part in range(3):  # luminance, orange, green; or red, green, blue
        bands = wp.where(luminous, wp.where(part == 0, 3, 1), 2)
        turned = rotated_harmonics(numbers, begin, bands, rotation)
        count = (bands + 1) * (bands + 1)
        for m in range(count):
            sh[n, begin + m] = turned[m]
        begin += count
