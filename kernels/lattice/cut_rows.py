"""Rows of the Laplace equation at nodes whose grid edges cross the cage, with boundary values at the true crossings."""

# At a node with values u_k at its six neighbours, or boundary values g_k at crossings a fraction theta_k of a cell away
# (1 for links that do not cross the cage),
#   sum_k (u_k - u_0) / theta_k = 0
# (Gibou, Fedkiw, Cheng and Kang, "A Second-Order-Accurate Symmetric Discretization of the Poisson Equation on Irregular
# Domains", J. Comput. Phys. 2002): symmetric, exact for linear functions, second order. The nearest crossing counts,
# even where the neighbour is inside again beyond a thin gap. Boundary values are linear on each triangle (Joshi et al.
# 2007). Coarse levels use the lines of the finest lattice. Directions: 2 * axis + forward.

import warp as wp

from ..mesh.containment import closest_point_on_triangle, triangle_distance_squared
from .crossings import LineCrossings, exit_crossing, exit_distance, line_index
from .nodes import NodeLevels, is_cut_link, is_inside_node, level_of, node_place

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Smallest fraction of a cell between a node and the cage. Nodes nearer than that move by less than the lattice's
#: rounding.
MIN_FRACTION = wp.constant(1.0e-4)

#: Bit of `links` at nodes of level 0 with a neighbour that is inside as well, but beyond a gap of the cage.
DOUBLE_CUT = wp.constant(64)


@wp.struct
class CutRows:
    links: wp.array(dtype=int)  # (rows,) bit d is set where the link in direction d does not cross the cage
    diagonals: wp.array(dtype=float)  # (rows,) sum of 1 / theta
    fractions: wp.array2d(dtype=float)  # (rows, 6) theta
    faces: wp.array2d(dtype=int)  # (rows of level 0, 6) cage face of the crossing, -1 for none
    corners: wp.array2d(dtype=wp.vec3)  # (rows of level 0, 6) barycentric coordinates of the crossing


@wp.func
def barycentric(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentric coordinates of the point of triangle abc nearest to x; not negative, of sum 1."""
    p = closest_point_on_triangle(x, a, b, c)
    normal = wp.cross(b - a, c - a)
    wa = wp.max(wp.dot(normal, wp.cross(c - b, p - b)), 0.0)
    wb = wp.max(wp.dot(normal, wp.cross(a - c, p - c)), 0.0)
    wc = wp.max(wp.dot(normal, wp.cross(b - a, p - a)), 0.0)
    return wp.vec3(wa, wb, wc) / wp.max(wa + wb + wc, 1.0e-30)


@wp.func
def nearest_face(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i)):
    """The cage face nearest to x."""
    nearest = float(1.0e30)
    found = int(0)
    for f in range(faces.shape[0]):
        face = faces[f]
        d = triangle_distance_squared(x, vertices[face[0]], vertices[face[1]], vertices[face[2]])
        if d < nearest:
            nearest = d
            found = f
    return found


@wp.kernel
def describe_rows(
    first: int,
    crossings: LineCrossings,
    distance: wp.array(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    levels: NodeLevels,
    rows: CutRows,
):
    """Fill the table of cut nodes of all levels. vertices (v,) in node units of the lattice. One item per row."""
    row = first + wp.tid()
    level_count = levels.shapes.shape[0]
    if row >= levels.starts[3 * level_count] - levels.starts[2 * level_count]:
        return
    node = levels.nodes[levels.starts[2 * level_count] + row]
    level = level_of(levels.first_node, node)
    reach = 1 << level
    p = node_place(levels, level, node) * reach
    links = int(0)
    diagonal = float(0.0)
    for axis in range(3):
        for side in range(2):
            forward = side == 1
            direction = 2 * axis + side
            fraction = float(1.0)
            face = int(-1)
            corners = wp.vec3(0.0, 0.0, 0.0)
            if is_cut_link(crossings, distance, p, axis, forward, reach):
                away = exit_distance(crossings, axis, forward, p[0], p[1], p[2])
                fraction = wp.clamp(away / float(reach), MIN_FRACTION, 1.0)
                if level == 0:
                    q = p
                    q[axis] = p[axis] + wp.where(forward, 1, -1)
                    if is_inside_node(crossings.shapes[0], distance, q[0], q[1], q[2]):
                        links = links | DOUBLE_CUT
                    x = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
                    step = wp.min(away, 1.0)
                    x[axis] = x[axis] + wp.where(forward, step, -step)
                    if away < 1.0 + 1.0e-3:
                        slot = exit_crossing(crossings, axis, forward, p[0], p[1], p[2])
                        face = crossings.faces[line_index(crossings.shapes[0], axis, p[0], p[1], p[2]), slot]
                    else:  # lines of two axes disagree by rounding
                        face = nearest_face(x, vertices, faces)
                    triangle = faces[face]
                    corners = barycentric(x, vertices[triangle[0]], vertices[triangle[1]], vertices[triangle[2]])
            else:
                links += 1 << direction
            diagonal += 1.0 / fraction
            rows.fractions[row, direction] = fraction
            if level == 0:
                rows.faces[row, direction] = face
                rows.corners[row, direction] = corners
    rows.links[row] = links
    rows.diagonals[row] = diagonal


@wp.func
def crossing_value(
    rows: CutRows, faces: wp.array(dtype=wp.vec3i), values: wp.array(dtype=wp.vec3), row: int, direction: int
):
    """Boundary value where the link of a cut node crosses the cage: linear between the values at cage vertices."""
    face = faces[rows.faces[row, direction]]
    weight = rows.corners[row, direction]
    return weight[0] * values[face[0]] + weight[1] * values[face[1]] + weight[2] * values[face[2]]


@wp.kernel
def set_sources(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    values: wp.array(dtype=wp.vec3),
    sources: wp.array(dtype=wp.vec3),
):
    """sources (rows of level 0,): sum of g / theta over the links that cross the cage. values (v,) at cage vertices."""
    row = first + wp.tid()
    level_count = levels.shapes.shape[0]
    if row >= levels.starts[2 * level_count + 1] - levels.starts[2 * level_count]:
        return
    source = wp.vec3(0.0, 0.0, 0.0)
    for direction in range(6):
        if rows.faces[row, direction] >= 0:
            source += crossing_value(rows, faces, values, row, direction) / rows.fractions[row, direction]
    sources[row] = source
