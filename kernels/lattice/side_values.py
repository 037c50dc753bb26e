"""Values of a map for each side of a narrow gap of the cage."""

# Where two sheets of a cage pass within a cell or two, one outside node cannot continue the map of both sides: each
# side gets eight corner values of its own (see gaps.py). Inside corners have their nodes' values, others are continued
# from that side alone, through the boundary value at the crossing (see rings.py), or have their ring's value where they
# serve no other, then by parallelograms, u_1 + u_2 - u_12; sides of a neighbouring cell once more. All is linear in the
# values, exact for linear functions. The fourth channel is the distance to the side: signed at its own corners,
# elsewhere the mean of what continues it alike (right at folds) and the largest height over the faces that its links
# cross (right at edges). A point belongs to the side where it is lowest; a neighbouring cell's sides come second.

import warp as wp

from ..core.gradients import forward_only_in
from .cut_rows import DOUBLE_CUT, CutRows, crossing_value
from .gaps import corner_node, cut_row_count, far_side, inside_corners, link_direction, table_length
from .nodes import NodeLevels, cut_section, node_place
from .rings import is_known, is_steady, node_step

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "max_unroll": 2})

forward_only = forward_only_in(__name__, (wp.vec4, float))

#: Below all heights of a corner of a cell over faces that cross it, in cells.
FARTHEST_INSIDE = wp.constant(-4.0)

#: Cells by which a point must be deeper in a side of a neighbouring cell to belong to it.
HANDICAP = wp.constant(0.25)

#: Distance at a corner that a side does not define yet.
UNKNOWN = wp.constant(1.0e30)

#: Least distance, in cells, between two crossings that a value beyond the second is continued from.
SHORTEST_CHORD = wp.constant(0.1)


@wp.kernel
def set_boundary_values(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    vertex_values: wp.array(dtype=wp.vec3),
    boundary: wp.array2d(dtype=wp.vec3),
):
    """boundary (rows of level 0, 6): values where links cross the cage, of a map that is linear on its faces."""
    row = first + wp.tid()
    if row >= cut_row_count(levels):
        return
    for direction in range(6):
        if rows.faces[row, direction] >= 0:
            boundary[row, direction] = crossing_value(rows, faces, vertex_values, row, direction)


@wp.kernel
def measure_jumps(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    boundary: wp.array2d(dtype=wp.vec3),
    steepest: float,
    jump: wp.array(dtype=float),
):
    """jump (1,) is raised to the largest that `boundary` makes over a link that leaves the cage and enters it again,
    and that is more than `steepest` times the cells between: less is what the map stretches over a shallow groove."""
    row = first + wp.tid()
    if row < cut_row_count(levels) and (rows.links[row] & DOUBLE_CUT) != 0:
        node = levels.nodes[levels.starts[cut_section(levels)] + row]
        for direction in range(6):
            other = levels.codes[node + node_step(levels, direction)]
            if rows.faces[row, direction] >= 0 and other >= 0:
                change = wp.length(boundary[other, direction ^ 1] - boundary[row, direction])
                cells = 1.0 - rows.fractions[row, direction] - rows.fractions[other, direction ^ 1]
                if change > steepest * cells:
                    wp.atomic_max(jump, 0, change)


@wp.func
def affine_position(affine: wp.array(dtype=wp.vec3), x: wp.vec3):
    """x in node units through the affine part of the map."""
    return x[0] * affine[0] + x[1] * affine[1] + x[2] * affine[2] + affine[3]


@wp.func
def correction_of(corrections: wp.array(dtype=wp.vec3), code: int):
    """Correction that is in the value of an inside node of this code (see corrections.py)."""
    if code >= 0 and corrections.shape[0] > 0:
        return corrections[code]
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def continued(
    levels: NodeLevels,
    rows: CutRows,
    boundary: wp.array2d(dtype=wp.vec3),
    scale: float,
    affine: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    corrections: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    node: int,
    direction: int,
):
    """Position and signed distance at the neighbour of cut node `node`, continued through the crossing between them."""
    row = levels.codes[node]
    back = direction ^ 1
    theta = rows.fractions[row, direction]
    p = node_place(levels, 0, node)
    place = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    axis = direction / 2
    sign = wp.where(direction % 2 == 1, 1.0, -1.0)
    place[axis] = place[axis] + sign * theta
    g = scale * boundary[row, direction] + affine_position(affine, place)
    position = values[node] - scale * correction_of(corrections, row)
    height = distance[node]
    ratio = (1.0 - theta) / wp.max(theta, 0.5)
    if theta < 0.5:
        if (rows.links[row] >> back) & 1 == 1:
            behind = node + node_step(levels, back)
            position = values[behind] - scale * correction_of(corrections, levels.codes[behind])
            height = distance[behind]
            ratio = (1.0 - theta) / (1.0 + theta)
        else:  # the cage is crossed again behind the node
            apart = theta + rows.fractions[row, back]
            place[axis] = place[axis] - sign * apart
            position = scale * boundary[row, back] + affine_position(affine, place)
            ratio = (1.0 - theta) / wp.max(apart, SHORTEST_CHORD)
    position = g + (g - position) * ratio
    return forward_only(wp.vec4(position[0], position[1], position[2], wp.max(-height * ratio, 0.0)), scale)


@wp.func
def distance_beyond(
    levels: NodeLevels,
    rows: CutRows,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    cell: int,
    own: int,
    corner: int,
):
    """Cells from a side, the corners `own` of a cell, to another corner: its largest height over the cage faces that
    links of the side cross within the cell; below FARTHEST_INSIDE where they cross none."""
    p = node_place(levels, 0, corner_node(levels, cell, corner))
    x = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    result = float(2.0 * FARTHEST_INSIDE)
    for a in range(8):
        if (own >> a) & 1 == 1:
            row = levels.codes[corner_node(levels, cell, a)]
            for b in range(3):
                direction = link_direction(a, b)
                if row >= 0:
                    f = rows.faces[row, direction]
                    if f >= 0:
                        face = faces[f]
                        origin = vertices[face[0]]
                        normal = wp.cross(vertices[face[1]] - origin, vertices[face[2]] - origin)
                        result = wp.max(result, wp.dot(wp.normalize(normal), x - origin))
    return result


@wp.func
def has_row(row: int, counts: wp.array(dtype=int), offsets: wp.array(dtype=int), side_cells: wp.array(dtype=int)):
    """Whether a table has a row; it has none where it is longer than side_cells."""
    length = table_length(offsets, counts)
    return row < length and length <= side_cells.shape[0]


@wp.kernel
def continue_sides(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    boundary: wp.array2d(dtype=wp.vec3),
    scale: float,
    affine: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    corrections: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    counts: wp.array(dtype=int),
    offsets: wp.array(dtype=int),
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
    sides: wp.array2d(dtype=wp.vec4),
):
    """sides (rows or more, 8): position and signed distance at the corners of a cell as one side sees them, UNKNOWN for
    a distance that no link of the side leads to. Eight items per row, one per corner."""
    # boundary (rows of level 0, 6): values, less the affine part, where links cross the cage. values, distance
    # (nodes,): with it, and signed. corrections: those of cut nodes, less the scale (of the rest cage), or (0,).
    item = first + wp.tid()
    row = item / 8
    corner = item % 8
    if not has_row(row, counts, offsets, side_cells):
        return
    cell = side_cells[row]
    own = side_masks[row] & 255
    node = corner_node(levels, cell, corner)
    if (own >> corner) & 1 == 1:
        v = values[node] - scale * correction_of(corrections, levels.codes[node])
        sides[row, corner] = wp.vec4(v[0], v[1], v[2], distance[node])
        return
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    count = float(0.0)
    for b in range(3):
        other = corner ^ (1 << b)
        if (own >> other) & 1 == 1:
            beside = corner_node(levels, cell, other)
            direction = link_direction(other, b)
            row_beside = levels.codes[beside]
            if row_beside >= 0:
                # values that amplify their errors count only where there are no others
                weight = wp.where(is_steady(rows, row_beside, direction), 1.0, 1.0e-6)
                total += weight * continued(
                    levels, rows, boundary, scale, affine, values, corrections, distance, beside, direction
                )
                count += weight
    if count > 0.0:
        sides[row, corner] = total / count
        return
    sides[row, corner] = wp.vec4(0.0, 0.0, 0.0, UNKNOWN)
    if is_known(levels.codes[node], 1) and own == inside_corners(levels, cell):
        if far_side(levels, rows, node)[0] == 0:  # a corner that serves this side alone
            v = values[node]
            sides[row, corner] = wp.vec4(v[0], v[1], v[2], distance[node])


@wp.kernel
def complete_sides(
    first: int,
    counts: wp.array(dtype=int),
    offsets: wp.array(dtype=int),
    side_cells: wp.array(dtype=int),
    sides: wp.array2d(dtype=wp.vec4),
):
    """Fill in the corners that are UNKNOWN by parallelograms of those that are not. One item per row."""
    row = first + wp.tid()
    if not has_row(row, counts, offsets, side_cells):
        return
    found = int(0)
    for corner in range(8):
        if sides[row, corner][3] != UNKNOWN:
            found = found | (1 << corner)
    for _step in range(2):
        known = found
        for corner in range(8):
            total = wp.vec4(0.0, 0.0, 0.0, 0.0)
            count = float(0.0)
            for b in range(3):
                one = corner ^ (1 << b)
                two = corner ^ (1 << ((b + 1) % 3))
                both = one ^ (1 << ((b + 1) % 3))
                needed = (1 << one) | (1 << two) | (1 << both)
                if (known >> corner) & 1 == 0 and (known & needed) == needed:
                    total += sides[row, one] + sides[row, two] - sides[row, both]
                    count += 1.0
            if count > 0.0:
                sides[row, corner] = total / count
                found = found | (1 << corner)


@wp.kernel
def place_sides(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    scales: wp.array(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    counts: wp.array(dtype=int),
    offsets: wp.array(dtype=int),
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
    sides: wp.array2d(dtype=wp.vec4),
):
    """Add the height over the cage to distances to sides at corners that are not their own. Four items per row, for
    two corners each along the axis that it is continued along. scales[0]: units per cell; vertices in node units."""
    # Sides of a neighbouring cell are continued to this one HANDICAP farther away: its own come first.
    item = first + wp.tid()
    row = item / 4
    if not has_row(row, counts, offsets, side_cells):
        return
    own = side_masks[row] & 255
    origin = side_masks[row] >> 8
    bit = int(0)
    if origin > 0:
        bit = 2 - (origin - 1) / 2
    below = (1 << bit) - 1
    pair = item % 4
    low = 2 * (pair & ~below) + (pair & below)  # the corner whose bit is 0
    for end in range(2):
        corner = low | (end << bit)
        if (own >> corner) & 1 == 0:
            away = distance_beyond(levels, rows, vertices, faces, side_cells[row], own, corner)
            if away > FARTHEST_INSIDE:
                side = sides[row, corner]
                sides[row, corner] = wp.vec4(side[0], side[1], side[2], 0.5 * (side[3] + away * scales[0]))
    if origin > 0:
        high = low | (1 << bit)
        one = sides[row, low]
        two = sides[row, high]
        aside = wp.vec4(0.0, 0.0, 0.0, HANDICAP * scales[0])
        if (origin - 1) % 2 == 1:
            sides[row, low] = 2.0 * one - two + aside
            sides[row, high] = one + aside
        else:
            sides[row, low] = two + aside
            sides[row, high] = 2.0 * two - one + aside


@wp.kernel
def gather_side_status(
    first: int,
    counts: wp.array(dtype=int),
    offsets: wp.array(dtype=int),
    jump: wp.array(dtype=float),
    status: wp.array(dtype=float),
):
    """status (2,): rows of the table, and the largest jump over a gap narrower than a cell. One item."""
    status[0] = float(table_length(offsets, counts))
    status[1] = jump[0]
