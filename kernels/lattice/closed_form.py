"""Mean value, Green, maximum likelihood and biharmonic maps at the listed nodes of a lattice."""

# Cage vertices are in node units relative to the middle of the lattice, which keeps most float32 digits; `size` is the
# cage's. At CLEARANCE cells from the cage and more, where maps are smooth, every second node along each axis is
# evaluated, the others take the polynomial of degree five through three nodes either side, axis after axis: off by 1e-6
# of the size in poses that bend or twist, by 4e-5 in wild ones.

import warp as wp

from ..coordinates.biharmonic import biharmonic_position
from ..coordinates.green import green_position
from ..coordinates.maximum_likelihood import maximum_likelihood_point
from ..coordinates.mean_value import mean_value_position
from .cut_rows import CutRows
from .gaps import is_near_mark
from .nodes import CUT_SECTION, INTERPOLATED_SECTION, RING_SECTION, NodeLevels, centered_place, node_place

# so many registers per thread that larger blocks would fill a GPU less well
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})


@wp.kernel(launch_bounds=(128, 5))
def map_nodes_mean_value(
    first: int,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
):
    """values[node] = sum_j w_j targets_j at inside nodes that are not interpolated. fans: see prepare_fans. One item
    per node; one level."""
    n = first + wp.tid()
    if n >= levels.starts[INTERPOLATED_SECTION]:
        return
    node = levels.nodes[n]
    values[node] = mean_value_position(centered_place(levels, node), vertices, faces, fans, targets, size)


@wp.kernel
def map_nodes_green(
    first: int,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
):
    """values[node] = sum_i phi_i targets_i + sum_f psi_f target_normals_f at inside nodes that are not interpolated.
    One item per node; one level."""
    n = first + wp.tid()
    if n >= levels.starts[INTERPOLATED_SECTION]:
        return
    node = levels.nodes[n]
    values[node] = green_position(centered_place(levels, node), vertices, faces, fans, targets, target_normals, size)


@wp.kernel
def map_nodes_biharmonic(
    first: int,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    face_values: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
):
    """As `map_nodes_green`; face_values (3 f,): see kernels/coordinates/biharmonic.py."""
    n = first + wp.tid()
    if n >= levels.starts[INTERPOLATED_SECTION]:
        return
    node = levels.nodes[n]
    values[node] = biharmonic_position(centered_place(levels, node), vertices, faces, fans, targets, face_values, size)


@wp.kernel(launch_bounds=(128, 4))
def map_nodes_maximum_likelihood(
    first: int,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
    status: wp.array(dtype=float),
):
    """As `map_nodes_mean_value`. status[1] becomes what is left, above 0, at one of the nodes without a solution."""
    n = first + wp.tid()
    if n >= levels.starts[INTERPOLATED_SECTION]:
        return
    node = levels.nodes[n]
    point = maximum_likelihood_point(centered_place(levels, node), vertices, faces, fans, targets, size)
    values[node] = wp.vec3(point[0], point[1], point[2])
    if point[3] > 0.0:
        status[1] = point[3]


@wp.kernel
def interpolate_nodes(first: int, axis: int, levels: NodeLevels, values: wp.array(dtype=wp.vec3)):
    """Values at interpolated nodes that are odd along `axis` and even along the axes after it; the axes in order."""
    n = first + wp.tid()
    if n >= levels.starts[CUT_SECTION] - levels.starts[INTERPOLATED_SECTION]:
        return
    node = levels.nodes[levels.starts[INTERPOLATED_SECTION] + n]
    p = node_place(levels, 0, node)
    shape = levels.shapes[0]
    step = int(1)
    belongs = (p[2] & 1) == 1
    if axis == 1:
        step = shape[2]
        belongs = (p[1] & 1) == 1 and (p[2] & 1) == 0
    if axis == 0:
        step = shape[1] * shape[2]
        belongs = (p[0] & 1) == 1 and (p[1] & 1) == 0 and (p[2] & 1) == 0
    if belongs:
        values[node] = (
            150.0 * (values[node - step] + values[node + step])
            - 25.0 * (values[node - 3 * step] + values[node + 3 * step])
            + 3.0 * (values[node - 5 * step] + values[node + 5 * step])
        ) / 256.0


@wp.kernel
def stretch_normals(
    first: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    rest_normals: wp.array(dtype=wp.vec3),
    rest_products: wp.array(dtype=wp.vec3),
    affine: wp.array(dtype=wp.vec3),
    rest_size: float,
    values: wp.array(dtype=wp.vec3),
):
    """values (f,): what psi in node units multiplies for the residual of a map after its affine part A x + b, as a
    share of the rest cage's size: stretched normals of the rest cage less A n, as x = sum phi v + sum psi n."""
    # rest_products: |s|^2, s.t, |t|^2 of two edges of each face, over the rest size squared. Stretch (Lipman et al.
    # 2008) from area A, edges u, v: sqrt(|s|^2 |v|^2 - 2 (s.t)(u.v) + |t|^2 |u|^2) / (sqrt(8) A).
    f = first + wp.tid()
    face = faces[f]
    u = vertices[face[1]] - vertices[face[0]]
    v = vertices[face[2]] - vertices[face[0]]
    normal = wp.cross(u, v)
    double_area = wp.length(normal)
    normal = normal / (double_area * rest_size)
    rest = rest_products[f]
    energy = rest[0] * wp.dot(v, v) - 2.0 * rest[1] * wp.dot(u, v) + rest[2] * wp.dot(u, u)
    stretch = wp.sqrt(wp.max(0.5 * energy, 0.0)) / double_area
    values[f] = stretch * rest_normals[f] - (normal[0] * affine[0] + normal[1] * affine[1] + normal[2] * affine[2])


@wp.func
def marked_crossing(levels: NodeLevels, rows: CutRows, marks: wp.array(dtype=int), row: int, direction: int):
    """Where a link of a cut node crosses the cage, and above 0 if it does, and the node is at a cell that is marked, as
    lattice/gaps has them, or beside one: sides are continued from no others."""
    place = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if row < levels.starts[RING_SECTION] - levels.starts[CUT_SECTION]:
        node = levels.nodes[levels.starts[CUT_SECTION] + row]
        if rows.faces[row, direction] >= 0 and is_near_mark(levels, marks, node):
            x = centered_place(levels, node)
            axis = direction / 2
            away = wp.where(direction % 2 == 1, rows.fractions[row, direction], -rows.fractions[row, direction])
            place = wp.vec4(
                x[0] + wp.where(axis == 0, away, 0.0),
                x[1] + wp.where(axis == 1, away, 0.0),
                x[2] + wp.where(axis == 2, away, 0.0),
                1.0,
            )
    return place


@wp.kernel
def map_crossings_green(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    marks: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
    boundary: wp.array2d(dtype=wp.vec3),
):
    """boundary (rows, 6): the map's limit from inside where links of cut nodes cross the cage: see marked_crossing. One
    level."""
    item = first + wp.tid()
    row = item / 6
    direction = item % 6
    place = marked_crossing(levels, rows, marks, row, direction)
    if place[3] > 0.0:
        x = wp.vec3(place[0], place[1], place[2])
        boundary[row, direction] = green_position(x, vertices, faces, fans, targets, target_normals, size)


@wp.kernel
def map_crossings_biharmonic(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    marks: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    face_values: wp.array(dtype=wp.vec3),
    size: float,
    boundary: wp.array2d(dtype=wp.vec3),
):
    """As `map_crossings_green`."""
    item = first + wp.tid()
    row = item / 6
    direction = item % 6
    place = marked_crossing(levels, rows, marks, row, direction)
    if place[3] > 0.0:
        x = wp.vec3(place[0], place[1], place[2])
        boundary[row, direction] = biharmonic_position(x, vertices, faces, fans, targets, face_values, size)
