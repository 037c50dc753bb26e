"""Slopes by the corners of faces: from crossings of lattice links with the cage, and summed up to vertices."""

# A link along the axis e crosses the face v_1, v_2, v_3 (normal n) at p + s theta e = sum b_k v_k, s = 1 or -1. As
# corners move by dv_k, the crossing moves along the link by t = n . sum b_k dv_k / (n . e), so d theta = s t, and
# against the face by sum db_k v_k = t e - sum b_k dv_k. The map there, g = sum b_k r_k, moves by sum b_k dr_k + J (t e
# - sum b_k dv_k), J the slope on the face of what is r_k at v_k. With G = dL/dg, T = dL/dtheta, q = J^T G:
#   dL/dr_k = b_k G,    dL/dv_k = b_k (((q . e + s T) / (n . e)) n - q).

import warp as wp

from ..core.lanes import lane_place, sum_of_lanes
from ..lattice.cut_rows import MIN_FRACTION, CutRows, crossing_value
from ..lattice.nodes import NodeLevels, cut_section
from .ring_adjoint import CrossingSlopes

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Links that lie in a face up to this, the sine of their angle, cross it as if at that angle.
MIN_SINE = wp.constant(1.0e-2)


@wp.func
def add_crossing(
    rows: CutRows,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    row: int,
    direction: int,
    by_value: wp.vec3,
    by_fraction: float,
    part: int,
    by_vertices: wp.array3d(dtype=wp.vec3),
    by_targets: wp.array3d(dtype=wp.vec3),
):
    """Add what a crossing passes on to the corners of its face."""
    f = rows.faces[row, direction]
    face = faces[f]
    share = rows.corners[row, direction]
    a = vertices[face[0]]
    u = vertices[face[1]] - a
    v = vertices[face[2]] - a
    normal = wp.cross(u, v)
    squared = wp.max(wp.dot(normal, normal), 1.0e-12)
    # of a linear function on the face: its slope is the sum of its steps along u, v times (v x n, n x u) / |n|^2
    along_u = wp.dot(by_value, targets[face[1]] - targets[face[0]])
    along_v = wp.dot(by_value, targets[face[2]] - targets[face[0]])
    q = (along_u * wp.cross(v, normal) + along_v * wp.cross(normal, u)) / squared
    axis = direction / 2
    across = normal[axis]
    least = MIN_SINE * wp.sqrt(squared)
    if wp.abs(across) < least:
        across = wp.where(across < 0.0, -least, least)
    turn = q[axis] + wp.where(direction % 2 == 1, by_fraction, -by_fraction)
    by_place = (turn / across) * normal - q
    for k in range(3):
        wp.atomic_add(by_vertices, part, f, k, share[k] * by_place)
        wp.atomic_add(by_targets, part, f, k, share[k] * by_value)


@wp.kernel
def sum_crossings(
    first: int,
    span: int,
    count: int,
    levels: NodeLevels,
    rows: CutRows,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    loads: wp.array(dtype=wp.vec3),
    by_crossings: CrossingSlopes,
    by_vertices: wp.array3d(dtype=wp.vec3),
    by_targets: wp.array3d(dtype=wp.vec3),
):
    """Add to by_vertices, by_targets (parts, f, 3) what crossings of links pass on, `count` rows, `span` an item: as
    many items as parts on a CPU, where parts must not be shared. vertices: node units."""
    # loads (nodes,) or (0,): the solution lambda of K lambda = dL / du for the symmetric matrix K of the rows of
    # cut_rows.py, with which dL = sum lambda (sum dg / theta - (g - u_0) dtheta / theta^2); positions: u.
    item = first + wp.tid()
    part = (item / wp.where(span > 1, 1, 32)) % by_vertices.shape[0]
    row = item * span
    end = wp.min(row + span, count)
    while row < end:
        node = levels.nodes[levels.starts[cut_section(levels)] + row]
        for direction in range(6):
            if rows.faces[row, direction] >= 0:
                by_value = by_crossings.values[row, direction]
                by_fraction = by_crossings.fractions[row, direction]
                theta = rows.fractions[row, direction]
                if loads.shape[0] > 0:
                    g = crossing_value(rows, faces, targets, row, direction)
                    by_value += loads[node] / theta
                    by_fraction -= wp.dot(loads[node], g - positions[node]) / (theta * theta)
                if theta <= MIN_FRACTION:
                    by_fraction = 0.0
                if wp.length_sq(by_value) > 0.0 or by_fraction != 0.0:
                    add_crossing(
                        rows,
                        vertices,
                        faces,
                        targets,
                        row,
                        direction,
                        by_value,
                        by_fraction,
                        part,
                        by_vertices,
                        by_targets,
                    )
        row += 1


@wp.kernel
def gather_corners(
    first: int,
    by_corners: wp.array2d(dtype=wp.vec3),
    starts: wp.array(dtype=int),
    corners: wp.array(dtype=int),
    shares: wp.array(dtype=float),
    scale: float,
    by_vertices: wp.array(dtype=wp.vec3),
):
    """by_vertices (v,) = scale times the sum of by_corners (parts, 3 f), in all parts, at the corners of faces that a
    vertex has a share in: vertex j in corners[starts[j]] to corners[starts[j + 1] - 1]. A group of lanes a vertex."""
    j, lane, lanes = lane_place(first + wp.tid())
    total = wp.vec3(0.0, 0.0, 0.0)
    n = starts[j]
    while n < starts[j + 1]:
        part = lane
        while part < by_corners.shape[0]:
            total += shares[n] * by_corners[part, corners[n]]
            part += lanes
        n += 1
    for axis in range(3):
        total[axis] = scale * sum_of_lanes(total[axis])
    if lane == 0:
        by_vertices[j] = total


@wp.kernel
def gather_nodes(first: int, levels: NodeLevels, by_nodes: wp.array(dtype=wp.vec3), slopes: wp.array(dtype=wp.vec3)):
    """slopes (m,): those of the nodes that are listed first."""
    n = first + wp.tid()
    slopes[n] = by_nodes[levels.nodes[n]]
