"""Values of a map for each side of a narrow gap of the cage.

Where two sheets of a cage pass within a cell or two, one outside node cannot continue the map of both sides. Cells
there get eight corner values for each side instead: a side is a set of inside corners joined by links that do not cross
the cage, of the cell or one layer behind a face of it; its other corners are continued from it alone, along a link
through the boundary value at the crossing (see map_extension), or have their ring's value where they serve no other,
then by parallelograms, u_1 + u_2 - u_12. All of it is linear in the values and exact for linear functions.

A fourth channel holds the distance to the side: the signed distance at its own corners, at the others the mean of what
continues it alike, which is right at folds of the cage, and their largest height over the faces that the side's links
cross, which is right at its edges. A point belongs to the side where that is lowest. A cell may hold a tip of the cage
without a corner inside it: besides its own it has the sides of the six cells beside it that have no inside corner in
common with it, continued once more; they come second where both could be meant.

Gaps are found at outside nodes next to the inside, where the inside nodes among the 26 neighbours are not joined by
links that do not cross the cage, and at links that leave the cage and enter it again: gaps narrower than a cell. They
count where the map differs by more than GAP_JUMP from one side to the other; grooves that a pose does not open do not
make sides necessary.
Siblings: map_extension, harmonic_rows, lanes, node_levels, crossings.
"""

import warp as wp

from .crossings import LineCrossings, exit_distance
from .harmonic_rows import DOUBLE_CUT, CutRows, crossing_value
from .lanes import ballot, bit_count, bits_before, lane_count, sum_of_lanes
from .map_extension import is_known, is_open_link, is_steady, node_step
from .node_levels import OUTSIDE, NodeLevels, node_place

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

#: Difference of the remainder of a map over a gap, as a share of the rest cage's size, from which on sides are kept.
GAP_JUMP = wp.constant(1.0e-2)

#: Sides of a cell that there is room for in its entry of side_index.
MOST_SIDES = wp.constant(7)

#: Below all heights of a corner of a cell over faces that cross it, in cells.
FARTHEST_INSIDE = wp.constant(-4.0)

#: Cells by which a point must be deeper in a side of a cell beside its own to belong to it.
HANDICAP = wp.constant(0.25)

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


@wp.func(inline=False)  # rare: only next to a link that crosses the cage twice
def loose_part(levels: NodeLevels, rows: CutRows, node: int, mask: int):
    """Those of the inside nodes among the 26 neighbours of a node, the bits of `mask`, that links that do not cross the
    cage do not join to the lowest."""
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
    return mask & ~reached


@wp.func
def far_side(levels: NodeLevels, rows: CutRows, node: int):
    """Inside nodes around an outside node on the far side of a gap, as a mask and the rest of them as another; none in
    the first where there is no gap."""
    shape = levels.shapes[0]
    mask = int(0)
    doubly_cut = int(0)
    for i in range(3):  # without branches, so that all are read at once
        for j in range(3):
            for k in range(3):
                code = levels.codes[node + ((i - 1) * shape[1] + j - 1) * shape[2] + k - 1]
                mask += wp.where(code > OUTSIDE, 1 << (9 * i + 3 * j + k), 0)
                if code >= 0 and code < rows.links.shape[0]:
                    doubly_cut = doubly_cut | (rows.links[code] & DOUBLE_CUT)
    if doubly_cut != 0:
        loose = loose_part(levels, rows, node, mask)
        return wp.vec2i(loose, mask & ~loose)
    reached = mask & (-mask)  # the lowest one
    for _step in range(7):
        reached = grown(reached) & mask
    if reached != mask:  # a path along the rim may take longer
        for _more in range(20):
            reached = grown(reached) & mask
    return wp.vec2i(mask & ~reached, reached)


@wp.func(inline=False)  # rare
def mean_around(levels: NodeLevels, values: wp.array(dtype=wp.vec3), node: int, mask: int):
    """Mean of the values at those of the 26 neighbours that are in `mask`."""
    shape = levels.shapes[0]
    total = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for d in range(27):
        if (mask >> d) & 1 == 1:
            total += values[node + ((d / 9 - 1) * shape[1] + (d / 3) % 3 - 1) * shape[2] + d % 3 - 1]
            count += 1.0
    return total / count


@wp.kernel
def find_gap_nodes(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    values: wp.array(dtype=wp.vec3),
    least: float,
    flags: wp.array(dtype=int),
    count: wp.array(dtype=int),
):
    """flags (nodes of rings 0 and 1,): 1 at narrow gaps over which `values` (nodes,) differ by more than `least`;
    count (1,) is above 0 where there are any.

    Items of a CPU launch that is cut over threads may miss each other's additions to count.
    """
    n = first + wp.tid()
    section = 3 * levels.shapes.shape[0]
    if n >= levels.starts[section + 2] - levels.starts[section]:
        if n < flags.shape[0]:
            flags[n] = 0
        return
    flag = int(0)
    node = levels.nodes[levels.starts[section] + n]
    parts = far_side(levels, rows, node)
    if parts[0] != 0:
        jump = mean_around(levels, values, node, parts[0]) - mean_around(levels, values, node, parts[1])
        if wp.length(jump) > least:
            flag = 1
            wp.atomic_add(count, 0, 1)
    flags[n] = flag


@wp.kernel
def confirm_narrow(
    first: int,
    crossings: LineCrossings,
    levels: NodeLevels,
    values: wp.array(dtype=wp.vec3),
    narrow: wp.array(dtype=int),
):
    """narrow (1,): from 1, where the lattice has links that leave the cage and enter it again, to 2 where the map jumps
    over one. One item a cut node of level 0."""
    if narrow[0] == 0:
        return
    row = first + wp.tid()
    section = 2 * levels.shapes.shape[0]
    if row >= levels.starts[section + 1] - levels.starts[section]:
        return
    node = levels.nodes[levels.starts[section] + row]
    p = node_place(levels, 0, node)
    for direction in range(6):
        other = node + node_step(levels, direction)
        if levels.codes[other] >= 0 and wp.length(values[other] - values[node]) > GAP_JUMP:
            if exit_distance(crossings, direction / 2, direction % 2 == 1, p[0], p[1], p[2]) < 1.0:
                narrow[0] = 2


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
        if levels.codes[corner_node(levels, cell, corner)] > OUTSIDE:
            mask = mask | (1 << corner)
    return mask


@wp.func
def link_direction(corner: int, bit: int):
    """Direction of the edge of a cell that leads from a corner to the one that differs in a bit."""
    return 2 * (2 - bit) + (((corner ^ (1 << bit)) >> bit) & 1)


@wp.func
def is_joined_behind(levels: NodeLevels, rows: CutRows, cell: int, corner: int, other: int):
    """Whether links that do not cross the cage join two inside corners across a face of a cell one layer behind it."""
    across = corner ^ other
    bit = wp.where(across == 3, 2, wp.where(across == 5, 1, 0))
    out = link_direction(corner, bit) ^ 1
    one = corner_node(levels, cell, corner)
    two = corner_node(levels, cell, other)
    if not (is_open_link(levels, rows, one, out) and is_open_link(levels, rows, two, out)):
        return False
    joined = bool(False)
    for b in range(3):
        if b != bit:
            there = link_direction(corner, b)
            middle = one + node_step(levels, out) + node_step(levels, there)
            if levels.codes[middle] > OUTSIDE:
                on = link_direction(corner, 3 - bit - b)
                if is_open_link(levels, rows, middle, there ^ 1) and is_open_link(levels, rows, middle, on):
                    joined = True
    return joined


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
                        if is_open_link(levels, rows, corner_node(levels, cell, corner), link_direction(corner, b)):
                            side = side | (1 << other)
                    # an edge of the cage between two corners across a face leaves them one side
                    other = corner ^ (7 - (1 << b))
                    if (inside >> other) & 1 == 1 and (side >> other) & 1 == 0:
                        if is_joined_behind(levels, rows, cell, corner, other):
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


@wp.func
def cut_row_count(levels: NodeLevels):
    """Rows of level 0."""
    section = 2 * levels.shapes.shape[0]
    return levels.starts[section + 1] - levels.starts[section]


@wp.kernel
def mark_narrow_cells(first: int, levels: NodeLevels, rows: CutRows, side_index: wp.array(dtype=int)):
    """side_index (nodes,): -1 for the cells around cut nodes with a link that crosses the cage twice. One item a row of
    level 0."""
    row = first + wp.tid()
    if row < cut_row_count(levels) and (rows.links[row] & DOUBLE_CUT) != 0:
        node = levels.nodes[levels.starts[2 * levels.shapes.shape[0]] + row]
        shape = levels.shapes[0]
        for corner in range(8):
            side_index[node - ((corner >> 2) * shape[1] + ((corner >> 1) & 1)) * shape[2] - (corner & 1)] = -1


@wp.func
def side_count(levels: NodeLevels, rows: CutRows, cell: int):
    """Sides that the inside corners of a cell make."""
    count = int(0)
    left = inside_corners(levels, cell)
    while left != 0:
        left = left & ~side_corners(levels, rows, cell, left)
        count += 1
    return count


@wp.func
def is_detached(side: int, direction: int):
    """Whether a side of the cell that lies in a direction has no inside corner on the face towards the cell it is seen
    from, so that it is none of that cell's own."""
    bit = 2 - direction / 2
    facing = int(0)
    for corner in range(8):
        if (corner >> bit) & 1 != direction % 2:
            facing = facing | (1 << corner)
    return side & facing == 0


@wp.func
def detached_count(levels: NodeLevels, rows: CutRows, cell: int, direction: int):
    """Sides of the cell beside one in a direction that are none of its own."""
    beside = cell + node_step(levels, direction)
    count = int(0)
    left = inside_corners(levels, beside)
    while left != 0:
        side = side_corners(levels, rows, beside, left)
        left = left & ~side
        if is_detached(side, direction):
            count += 1
    return count


@wp.func
def entry_length(levels: NodeLevels, rows: CutRows, cell: int):
    """Sides that a marked cell gets: its own, and those of the six cells beside it that are none of them."""
    count = side_count(levels, rows, cell)
    for direction in range(6):
        count += detached_count(levels, rows, cell, direction)
    return wp.min(count, MOST_SIDES)


@wp.func
def is_marked(side_index: wp.array(dtype=int), column: int, k: int, depth: int):
    """Whether cell k of a column of `depth` cells is marked; none is beyond its end."""
    return k < depth and side_index[column * depth + wp.min(k, depth - 1)] == -1


@wp.kernel
def count_column_sides(
    first: int, levels: NodeLevels, rows: CutRows, side_index: wp.array(dtype=int), counts: wp.array(dtype=int)
):
    """counts (columns of level 0 or more,): sides of the cells marked -1 in each column, 0 beyond the last. A group of
    lanes a column, a lane a cell."""
    item = first + wp.tid()
    lanes = lane_count()
    lane = item % lanes
    column = item / lanes
    if column >= counts.shape[0]:
        return
    shape = levels.shapes[0]
    count = int(0)
    if column < shape[0] * shape[1]:
        for k in range(lane, shape[2], lanes):
            if is_marked(side_index, column, k, shape[2]):
                count += entry_length(levels, rows, column * shape[2] + k)
    total = sum_of_lanes(float(count))
    if lane == 0:
        counts[column] = int(total)


@wp.func
def table_length(offsets: wp.array(dtype=int), counts: wp.array(dtype=int)):
    """Rows of the table, from the counts of its columns and their scan."""
    last = counts.shape[0] - 1
    return offsets[last] + counts[last]


@wp.func
def list_sides(
    levels: NodeLevels,
    rows: CutRows,
    cell: int,
    origin: int,
    row: int,
    end: int,
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
):
    """Write the sides of a cell to rows from `row`, before `end`; the row after them. origin: 0, or 1 plus the
    direction in which the cell lies from the one that gets its detached sides."""
    at = int(row)
    left = inside_corners(levels, cell)
    while left != 0 and at < end:
        side = side_corners(levels, rows, cell, left)
        left = left & ~side
        if origin == 0 or is_detached(side, wp.max(origin - 1, 0)):
            side_cells[at] = cell
            side_masks[at] = side | (origin << 8)
            at += 1
    return at


@wp.kernel
def list_column_sides(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    counts: wp.array(dtype=int),
    offsets: wp.array(dtype=int),
    side_index: wp.array(dtype=int),
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
):
    """side_index: 8 * first row + number of sides of each cell that has any, else 0; cell and corners of each row.
    Nothing where the table is longer than side_cells. A group of lanes a column, a lane a cell.

    Rows hold the cell whose corners make the side; above the corners' bits stands 1 plus the direction in which that
    cell lies, where it is not the one that gets the side.
    """
    item = first + wp.tid()
    lanes = lane_count()
    lane = item % lanes
    column = item / lanes
    shape = levels.shapes[0]
    if column >= shape[0] * shape[1] or table_length(offsets, counts) > side_cells.shape[0]:
        return
    row = offsets[column]
    for k in range(0, shape[2], lanes):
        marked = is_marked(side_index, column, k + lane, shape[2])
        if ballot(wp.where(marked, 1, 0)) != 0:
            cell = column * shape[2] + k + lane
            length = int(0)
            if marked:
                length = entry_length(levels, rows, cell)
            begin = row + 0
            for bit in range(3):  # MOST_SIDES is below 8
                lengths = ballot((length >> bit) & 1)
                begin += bit_count(bits_before(lengths, lane)) << bit
                row += bit_count(lengths) << bit
            if marked:
                end = list_sides(levels, rows, cell, 0, begin, begin + length, side_cells, side_masks)
                for direction in range(6):
                    beside = cell + node_step(levels, direction)
                    end = list_sides(
                        levels, rows, beside, direction + 1, end, begin + length, side_cells, side_masks
                    )
                side_index[cell] = wp.where(length > 0, 8 * begin + length, 0)


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
    first: int, levels: NodeLevels, rows: CutRows, boundary: wp.array2d(dtype=wp.vec3), jump: wp.array(dtype=float)
):
    """jump (1,) is raised to the largest that `boundary` makes over a link that leaves the cage and enters it again."""
    row = first + wp.tid()
    if row < cut_row_count(levels) and (rows.links[row] & DOUBLE_CUT) != 0:
        node = levels.nodes[levels.starts[2 * levels.shapes.shape[0]] + row]
        for direction in range(6):
            other = levels.codes[node + node_step(levels, direction)]
            if rows.faces[row, direction] >= 0 and other >= 0:
                wp.atomic_max(jump, 0, wp.length(boundary[other, direction ^ 1] - boundary[row, direction]))


@wp.func
def affine_position(affine: wp.array(dtype=wp.vec3), x: wp.vec3):
    """x in node units through the affine part of the map."""
    return x[0] * affine[0] + x[1] * affine[1] + x[2] * affine[2] + affine[3]


@wp.func
def correction_of(corrections: wp.array(dtype=wp.vec3), code: int):
    """Correction that is in the value of an inside node of this code (see map_corrections)."""
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
    return wp.vec4(position[0], position[1], position[2], wp.max(-height * ratio, 0.0))


@wp.func
def move_side(sides: wp.array2d(dtype=wp.vec4), row: int, direction: int, handicap: float):
    """Corner values of a cell continued to the cell that it lies beside, seen from there in a direction. handicap: is
    added to the distances, so that sides of the cell itself come first where both could be meant."""
    bit = 4 >> (direction / 2)
    for corner in range(8):
        if corner & bit == 0:
            low = sides[row, corner]
            high = sides[row, corner | bit]
            if direction % 2 == 1:
                sides[row, corner] = 2.0 * low - high
                sides[row, corner | bit] = low
            else:
                sides[row, corner] = high
                sides[row, corner | bit] = 2.0 * high - low
    for corner in range(8):
        side = sides[row, corner]
        sides[row, corner] = wp.vec4(side[0], side[1], side[2], side[3] + handicap)


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


@wp.kernel
def fill_sides(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    boundary: wp.array2d(dtype=wp.vec3),
    scale: float,
    affine: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    corrections: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    scales: wp.array(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    counts: wp.array(dtype=int),
    offsets: wp.array(dtype=int),
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
    sides: wp.array2d(dtype=wp.vec4),
):
    """sides (rows or more, 8): position and signed distance at the corners of a cell as one side sees them.

    boundary (rows of level 0, 6): values of the map, less the affine part, where links cross the cage.
    values, distance (nodes,): positions (the affine part added) and signed distances at nodes, scales[0] units a cell.
    corrections: those that are in the values of cut nodes, row by row, less the scale (see map_corrections), or (0,).
    vertices in node units. side_cells, side_masks (rows,): see list_column_sides.
    """
    row = first + wp.tid()
    if row >= table_length(offsets, counts) or table_length(offsets, counts) > side_cells.shape[0]:
        return
    cell = side_cells[row]
    known = side_masks[row] & 255
    for corner in range(8):
        if (known >> corner) & 1 == 1:
            node = corner_node(levels, cell, corner)
            v = values[node] - scale * correction_of(corrections, levels.codes[node])
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
                        levels, rows, boundary, scale, affine, values, corrections, distance, node, direction
                    )
                    count += weight
        if count > 0.0:
            sides[row, corner] = total / count
            found = found | (1 << corner)
    if known == inside_corners(levels, cell):
        for corner in range(8):
            node = corner_node(levels, cell, corner)
            if (found >> corner) & 1 == 0 and is_known(levels.codes[node], 1):
                if far_side(levels, rows, node)[0] == 0:  # a corner that serves this side alone
                    v = values[node]
                    sides[row, corner] = wp.vec4(v[0], v[1], v[2], distance[node])
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
    own = side_masks[row] & 255
    for corner in range(8):
        if (own >> corner) & 1 == 0:
            away = distance_beyond(levels, rows, vertices, faces, cell, own, corner)
            if away > FARTHEST_INSIDE:
                side = sides[row, corner]
                sides[row, corner] = wp.vec4(side[0], side[1], side[2], 0.5 * (side[3] + away * scales[0]))
    if side_masks[row] > 255:
        move_side(sides, row, (side_masks[row] >> 8) - 1, HANDICAP * scales[0])


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
