"""Values of a map for each side of a narrow gap of the cage.

Where two sheets of a cage pass within a cell or two, one outside node cannot continue the map of both sides. Cells
there get eight corner values for each side instead: a side is a set of inside corners joined by links that do not cross
the cage; its other corners are continued from it alone, along a link through the boundary value at the crossing (see
map_extension), then by parallelograms, u_1 + u_2 - u_12. All of it is linear in the values and exact for linear
functions. A fourth channel continues the signed distance alike, negative on the side itself: a point belongs to the
side where that is lowest.

Gaps are found at outside nodes next to the inside: there the inside nodes among the 26 neighbours are not joined by
links that do not cross the cage.
Siblings: map_extension, harmonic_rows, node_levels.
"""

import warp as wp

from .harmonic_rows import DOUBLE_CUT, CutRows, crossing_value
from .map_extension import is_steady, node_step
from .node_levels import REGULAR, NodeLevels, node_place

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

#: Least distance, in cells, between two crossings that a value beyond the second is continued from.
SHORTEST_CHORD = wp.constant(0.1)

#: Bits of a 3 x 3 x 3 neighbourhood, numbered like nodes, whose last coordinate is not the lowest; whose
#: middle one is not.
_ABOVE_K = wp.constant(0b110110110110110110110110110)
_ABOVE_J = wp.constant(0b111111000111111000111111000)
_ALL = wp.constant((1 << 27) - 1)


@wp.func
def grown(mask: int):
    """A set of places of a 3 x 3 x 3 neighbourhood and their neighbours along the axes."""
    below_k = mask & (_ABOVE_K >> 1)
    below_j = mask & (_ABOVE_J >> 3)
    result = mask | (below_k << 1) | ((mask & _ABOVE_K) >> 1)
    result = result | (below_j << 3) | ((mask & _ABOVE_J) >> 3)
    return (result | (mask << 9) | (mask >> 9)) & _ALL


@wp.func
def is_open_link(levels: NodeLevels, rows: CutRows, node: int, direction: int):
    """Whether the link from an inside node does not cross the cage."""
    code = levels.codes[node]
    return code < 0 or ((rows.links[code] >> direction) & 1) == 1


@wp.func(inline=False)  # rare: only next to a link that crosses the cage twice
def falls_apart(levels: NodeLevels, rows: CutRows, node: int, mask: int):
    """Whether inside nodes among the 26 neighbours of a node, the bits of `mask`, are not all joined by links that do
    not cross the cage."""
    shape = levels.shapes[0]
    reached = mask & (-mask)
    before = int(0)
    while reached != before:
        before = reached + 0
        for d in range(27):
            if (reached >> d) & 1 == 1:
                place = node + ((d / 9 - 1) * shape[1] + (d / 3) % 3 - 1) * shape[2] + d % 3 - 1
                for direction in range(6):
                    axis = direction / 2
                    weight = wp.where(axis == 0, 9, wp.where(axis == 1, 3, 1))
                    along = (d / weight) % 3 + wp.where(direction % 2 == 1, 1, -1)
                    other = d + wp.where(direction % 2 == 1, weight, -weight)
                    if along >= 0 and along < 3 and (mask >> other) & 1 == 1 and (reached >> other) & 1 == 0:
                        if is_open_link(levels, rows, place, direction):
                            reached = reached | (1 << other)
    return reached != mask


@wp.func
def is_gap_node(levels: NodeLevels, rows: CutRows, node: int):
    """Whether the inside nodes around an outside node belong to different sides of a gap."""
    shape = levels.shapes[0]
    mask = int(0)
    doubly_cut = int(0)
    for d in range(27):
        code = levels.codes[node + ((d / 9 - 1) * shape[1] + (d / 3) % 3 - 1) * shape[2] + d % 3 - 1]
        if code >= REGULAR:
            mask = mask | (1 << d)
            if code >= 0 and code < rows.links.shape[0]:
                if (rows.links[code] & DOUBLE_CUT) != 0:
                    doubly_cut = 1
    if doubly_cut == 1:
        return falls_apart(levels, rows, node, mask)
    reached = mask & (-mask)  # the lowest one
    for _step in range(7):
        reached = grown(reached) & mask
    if reached != mask:  # a path along the rim may take longer
        for _more in range(20):
            reached = grown(reached) & mask
    return reached != mask


@wp.kernel
def find_gap_nodes(
    first: int, levels: NodeLevels, rows: CutRows, flags: wp.array(dtype=int), count: wp.array(dtype=int)
):
    """flags (nodes of rings 0 and 1,): 1 at narrow gaps; count (1,) is above 0 where there are any.

    Items of a CPU launch that is cut over threads may miss each other's additions to count.
    """
    n = first + wp.tid()
    section = 3 * levels.shapes.shape[0]
    if n >= levels.starts[section + 2] - levels.starts[section]:
        if n < flags.shape[0]:
            flags[n] = 0
        return
    flag = int(0)
    if is_gap_node(levels, rows, levels.nodes[levels.starts[section] + n]):
        flag = 1
        wp.atomic_add(count, 0, 1)
    flags[n] = flag


@wp.func
def corner_node(levels: NodeLevels, cell: int, corner: int):
    """Node at a corner of a cell; bits of `corner`, highest first: forward along axis 0, 1, 2. Cells have the number of
    their first corner."""
    shape = levels.shapes[0]
    return cell + ((corner >> 2) * shape[1] + ((corner >> 1) & 1)) * shape[2] + (corner & 1)


@wp.func
def inside_corners(levels: NodeLevels, cell: int):
    """Bits of the corners of a cell that are inside."""
    mask = int(0)
    for corner in range(8):
        if levels.codes[corner_node(levels, cell, corner)] >= REGULAR:
            mask = mask | (1 << corner)
    return mask


@wp.func
def side_corners(levels: NodeLevels, rows: CutRows, cell: int, inside: int):
    """Bits of the corners joined to the lowest of `inside` (not 0)."""
    side = inside & (-inside)
    for _step in range(7):
        for corner in range(8):
            if (side >> corner) & 1 == 1:
                for b in range(3):
                    other = corner ^ (1 << b)
                    if (inside >> other) & 1 == 1 and (side >> other) & 1 == 0:
                        direction = 2 * (2 - b) + ((other >> b) & 1)
                        if is_open_link(levels, rows, corner_node(levels, cell, corner), direction):
                            side = side | (1 << other)
    return side


@wp.kernel
def mark_gap_cells(first: int, levels: NodeLevels, flags: wp.array(dtype=int), side_index: wp.array(dtype=int)):
    """side_index (nodes,): -1 for the cells around flagged nodes."""
    n = first + wp.tid()
    if flags[n] == 1:
        node = levels.nodes[levels.starts[3 * levels.shapes.shape[0]] + n]
        shape = levels.shapes[0]
        for corner in range(8):
            side_index[node - ((corner >> 2) * shape[1] + ((corner >> 1) & 1)) * shape[2] - (corner & 1)] = -1


@wp.kernel
def count_cell_sides(
    first: int, levels: NodeLevels, rows: CutRows, side_index: wp.array(dtype=int), counts: wp.array(dtype=int)
):
    """counts (nodes,): sides of the cells marked -1, zero for others. One item a node."""
    cell = first + wp.tid()
    count = int(0)
    if side_index[cell] == -1:
        left = inside_corners(levels, cell)
        while left != 0:
            left = left & ~side_corners(levels, rows, cell, left)
            count += 1
    counts[cell] = count


@wp.kernel
def list_cell_sides(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    offsets: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    side_index: wp.array(dtype=int),
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
):
    """side_index: 8 * first row + number of sides of each cell that has any, else 0; cell and corners of each row."""
    cell = first + wp.tid()
    count = counts[cell]
    row = offsets[cell]
    side_index[cell] = wp.where(count > 0, 8 * row + count, 0)
    if count > 0:
        left = inside_corners(levels, cell)
        while left != 0:
            side = side_corners(levels, rows, cell, left)
            side_cells[row] = cell
            side_masks[row] = side
            left = left & ~side
            row += 1


@wp.func
def affine_position(affine: wp.array(dtype=wp.vec3), x: wp.vec3):
    """x in node units through the affine part of the map."""
    return x[0] * affine[0] + x[1] * affine[1] + x[2] * affine[2] + affine[3]


@wp.func
def continued(
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    vertex_values: wp.array(dtype=wp.vec3),
    scale: float,
    affine: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
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
    g = scale * crossing_value(rows, faces, vertex_values, row, direction) + affine_position(affine, place)
    position = values[node]
    height = distance[node]
    ratio = (1.0 - theta) / wp.max(theta, 0.5)
    if theta < 0.5:
        if (rows.links[row] >> back) & 1 == 1:
            behind = node + node_step(levels, back)
            position = values[behind]
            height = distance[behind]
            ratio = (1.0 - theta) / (1.0 + theta)
        else:  # the cage is crossed again behind the node
            apart = theta + rows.fractions[row, back]
            place[axis] = place[axis] - sign * apart
            position = scale * crossing_value(rows, faces, vertex_values, row, back) + affine_position(affine, place)
            ratio = (1.0 - theta) / wp.max(apart, SHORTEST_CHORD)
    position = g + (g - position) * ratio
    return wp.vec4(position[0], position[1], position[2], wp.max(-height * ratio, 0.0))


@wp.kernel
def fill_sides(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    vertex_values: wp.array(dtype=wp.vec3),
    scale: float,
    affine: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
    sides: wp.array2d(dtype=wp.vec4),
):
    """sides (rows, 8): position and signed distance at the corners of a cell as one side sees them.

    values, distance (nodes,): positions (the affine part added) and signed distances at nodes.
    """
    row = first + wp.tid()
    cell = side_cells[row]
    known = side_masks[row]
    for corner in range(8):
        if (known >> corner) & 1 == 1:
            node = corner_node(levels, cell, corner)
            v = values[node]
            sides[row, corner] = wp.vec4(v[0], v[1], v[2], distance[node])
    found = known
    for corner in range(8):
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        count = float(0.0)
        for b in range(3):
            other = corner ^ (1 << b)
            if (known >> corner) & 1 == 0 and (known >> other) & 1 == 1:
                node = corner_node(levels, cell, other)
                direction = 2 * (2 - b) + ((corner >> b) & 1)
                row_of_node = levels.codes[node]
                if row_of_node >= 0:
                    # values that amplify what they come from count only where there are no others
                    weight = wp.where(is_steady(rows, row_of_node, direction), 1.0, 1.0e-6)
                    total += weight * continued(
                        levels, rows, faces, vertex_values, scale, affine, values, distance, node, direction
                    )
                    count += weight
        if count > 0.0:
            sides[row, corner] = total / count
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
