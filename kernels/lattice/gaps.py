"""Narrow gaps of a cage: outside nodes next to the inside that lie between two of its sheets."""

import warp as wp

from ..core.gradients import forward_only_in
from ..core.lanes import ballot, bit_count, bits_before, lane_place, sum_of_lanes
from .crossings import LineCrossings, exit_distance
from .cut_rows import DOUBLE_CUT, CutRows
from .nodes import OUTSIDE, NodeLevels, cut_section, node_place, ring_section
from .rings import is_open_link, node_step

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "max_unroll": 2})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3))

#: Most sides that an entry of side_index has room for, and the mask of the bits that count them.
MAX_SIDES = wp.constant(7)


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
def cell_links(levels: NodeLevels, rows: CutRows, cell: int):
    """Bits of the inside corners of a cell, and of the edges of it that do not cross the cage: 8 b + corner for the one
    from a corner whose bit b is 0."""
    inside = int(0)
    links = int(0)
    for corner in range(8):
        code = levels.codes[corner_node(levels, cell, corner)]
        if code > OUTSIDE:
            inside = inside | (1 << corner)
            is_open = int(63)
            if code >= 0:
                is_open = rows.links[code]
            for b in range(3):
                if (corner >> b) & 1 == 0 and (is_open >> link_direction(corner, b)) & 1 == 1:
                    links = links | (1 << (8 * b + corner))
    return inside, links


@wp.func
def joined_along_edges(links: int, some: int):
    """Bits of the corners of a cell that its links, bits as cell_links has them, join to any of `some`."""
    joined = int(some)
    before = int(0)
    while joined != before:
        before = joined + 0
        for b in range(3):
            along = (links >> (8 * b)) & 255
            joined = joined | ((joined & along) << (1 << b)) | ((joined >> (1 << b)) & along)
    return joined


@wp.func
def joined_corners(levels: NodeLevels, rows: CutRows, cell: int, inside: int, links: int, some: int):
    """Bits of the corners of a cell, of `inside`, that are joined to any of `some`. links: of the cell."""
    joined = joined_along_edges(links, some)
    before = int(0)
    while joined != before and inside & ~joined != 0:
        before = joined + 0
        for corner in range(8):
            for b in range(3):
                # an edge of the cage between two corners across a face leaves them one side
                other = corner ^ (7 - (1 << b))
                if (joined >> corner) & 1 == 1 and ((inside & ~joined) >> other) & 1 == 1:
                    if is_joined_behind(levels, rows, cell, corner, other):
                        joined = joined_along_edges(links, joined | (1 << other))
    return joined


@wp.func
def lowest_side(levels: NodeLevels, rows: CutRows, cell: int, inside: int, links: int):
    """Bits of the corners joined to the lowest of `inside`, which are whole sides (not 0)."""
    return joined_corners(levels, rows, cell, inside, links, inside & (-inside))


@wp.kernel
def mark_gap_cells(first: int, levels: NodeLevels, flags: wp.array(dtype=int), side_index: wp.array(dtype=int)):
    """side_index (nodes,): -1 for the cells around flagged nodes."""
    n = first + wp.tid()
    if flags[n] == 1:
        node = levels.nodes[levels.starts[ring_section(levels)] + n]
        shape = levels.shapes[0]
        for corner in range(8):
            side_index[node - ((corner >> 2) * shape[1] + ((corner >> 1) & 1)) * shape[2] - (corner & 1)] = -1


@wp.func
def cut_row_count(levels: NodeLevels):
    """Rows of level 0."""
    section = cut_section(levels)
    return levels.starts[section + 1] - levels.starts[section]


@wp.kernel
def mark_narrow_cells(first: int, levels: NodeLevels, rows: CutRows, side_index: wp.array(dtype=int)):
    """side_index (nodes,): -1 for the cells around cut nodes with a link that crosses the cage twice. One item per row
    of level 0."""
    row = first + wp.tid()
    if row < cut_row_count(levels) and (rows.links[row] & DOUBLE_CUT) != 0:
        node = levels.nodes[levels.starts[cut_section(levels)] + row]
        shape = levels.shapes[0]
        for corner in range(8):
            side_index[node - ((corner >> 2) * shape[1] + ((corner >> 1) & 1)) * shape[2] - (corner & 1)] = -1


@wp.func
def is_near_mark(levels: NodeLevels, side_index: wp.array(dtype=int), node: int):
    """Whether an inside node is a corner of a marked cell, or of one beside it across a face."""
    shape = levels.shapes[0]
    # cells from 2 before the node to 1 behind it along each axis: its own are -1 and 0, a neighbour's -2 or 1 along one
    n = int(0)
    while n < 64:
        a = n / 16
        b = (n / 4) % 4
        c = n % 4
        beside = wp.where(a % 3 == 0, 1, 0) + wp.where(b % 3 == 0, 1, 0) + wp.where(c % 3 == 0, 1, 0)
        if beside < 2 and side_index[node + ((a - 2) * shape[1] + b - 2) * shape[2] + c - 2] < 0:
            n = int(64)
        n += 1
    return n > 64


@wp.func
def side_count(levels: NodeLevels, rows: CutRows, cell: int, inside: int, links: int):
    """Sides that some of the corners of a cell make, whole sides."""
    count = int(0)
    left = int(inside)
    while left != 0:
        left = left & ~lowest_side(levels, rows, cell, left, links)
        count += 1
    return count


@wp.func
def detached_corners(levels: NodeLevels, rows: CutRows, cell: int, direction: int, inside: int, links: int):
    """Bits of the inside corners of a cell whose sides have none on the face towards the cell that sees it in a
    direction, so that they are none of that one's own."""
    bit = 2 - direction / 2
    facing = int(0)
    for corner in range(8):
        if (corner >> bit) & 1 != direction % 2:
            facing = facing | (1 << corner)
    return inside & ~joined_corners(levels, rows, cell, inside, links, inside & facing)


@wp.func
def entry_length(levels: NodeLevels, rows: CutRows, cell: int):
    """Sides that a marked cell gets, its own and those of the six cells beside it that are none of them, and above
    their count's 3 bits one for each direction in which there are such."""
    inside, links = cell_links(levels, rows, cell)
    count = side_count(levels, rows, cell, inside, links)
    directions = int(0)
    for direction in range(6):
        beside = cell + node_step(levels, direction)
        inside_there, links_there = cell_links(levels, rows, beside)
        loose = detached_corners(levels, rows, beside, direction, inside_there, links_there)
        if loose != 0:
            count += side_count(levels, rows, beside, loose, links_there)
            directions = directions | (8 << direction)
    return wp.min(count, MAX_SIDES) | directions


@wp.func
def is_marked(side_index: wp.array(dtype=int), column: int, k: int, depth: int):
    """Whether cell k of a column of `depth` cells is marked; none is beyond its end."""
    return k < depth and side_index[column * depth + wp.min(k, depth - 1)] < 0


@wp.kernel
def count_column_sides(
    first: int, levels: NodeLevels, rows: CutRows, counts: wp.array(dtype=int), side_index: wp.array(dtype=int)
):
    """counts (columns of level 0 or more,): sides of the marked cells in each column, 0 beyond the last. side_index:
    from -1, a mark, to -1 less entry_length. One group of lanes per column, one lane per cell."""
    column, lane, lanes = lane_place(first + wp.tid())
    if column >= counts.shape[0]:
        return
    shape = levels.shapes[0]
    count = int(0)
    if column < shape[0] * shape[1]:
        for k in range(lane, shape[2], lanes):
            if is_marked(side_index, column, k, shape[2]):
                entry = entry_length(levels, rows, column * shape[2] + k)
                side_index[column * shape[2] + k] = -1 - entry
                count += entry & MAX_SIDES
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
    inside: int,
    links: int,
    origin: int,
    row: int,
    end: int,
    side_cells: wp.array(dtype=int),
    side_masks: wp.array(dtype=int),
):
    """Write the sides that some corners of a cell make, whole sides, to rows from `row`, before `end`; the row after
    them. origin: 0, or 1 plus the direction in which the cell lies from the one that gets its detached sides."""
    at = int(row)
    left = int(inside)
    while left != 0 and at < end:
        side = lowest_side(levels, rows, cell, left, links)
        left = left & ~side
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
    """side_index: from what count_column_sides leaves to 8 * first row + number of sides of each cell, 0 where it has
    none; side_cells, side_masks: cell and corners of each row. One group of lanes per column, one lane per cell."""
    # Nothing is written where the table is longer than they are. Rows hold the cell whose corners make the side; above
    # the corners' bits stands 1 plus the direction in which that cell lies, where it is not the one that gets the side.
    column, lane, lanes = lane_place(first + wp.tid())
    shape = levels.shapes[0]
    if column >= shape[0] * shape[1] or table_length(offsets, counts) > side_cells.shape[0]:
        return
    row = offsets[column]
    for k in range(0, shape[2], lanes):
        marked = is_marked(side_index, column, k + lane, shape[2])
        if ballot(wp.where(marked, 1, 0)) != 0:
            cell = column * shape[2] + k + lane
            entry = int(0)
            if marked:
                entry = -1 - side_index[cell]
            length = entry & MAX_SIDES
            begin = row + 0
            for bit in range(3):  # MAX_SIDES is below 8
                lengths = ballot((length >> bit) & 1)
                begin += bit_count(bits_before(lengths, lane)) << bit
                row += bit_count(lengths) << bit
            if marked:
                end = begin + length
                inside, links = cell_links(levels, rows, cell)
                at = list_sides(levels, rows, cell, inside, links, 0, begin, end, side_cells, side_masks)
                for direction in range(6):
                    if (entry >> (3 + direction)) & 1 == 1:
                        beside = cell + node_step(levels, direction)
                        inside, links = cell_links(levels, rows, beside)
                        inside = detached_corners(levels, rows, beside, direction, inside, links)
                        origin = direction + 1
                        at = list_sides(levels, rows, beside, inside, links, origin, at, end, side_cells, side_masks)
                side_index[cell] = wp.where(length > 0, 8 * begin + length, 0)


#: Difference of the residual of a map over a gap, as a share of the rest cage's size, above which sides are kept.
GAP_JUMP = wp.constant(1.0e-2)

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
    """Inside nodes among the 26 neighbours of a node, the bits of `mask`, that are not joined to the lowest of them by
    links that stay inside the cage."""
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
    return forward_only(total / count, total)


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
    count (1,) is above 0 where there are any, no more: threads of a CPU may miss each other's additions."""
    n = first + wp.tid()
    section = ring_section(levels)
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
    over one. One item per cut node of level 0."""
    if narrow[0] == 0:
        return
    row = first + wp.tid()
    section = cut_section(levels)
    if row >= levels.starts[section + 1] - levels.starts[section]:
        return
    node = levels.nodes[levels.starts[section] + row]
    p = node_place(levels, 0, node)
    for direction in range(6):
        other = node + node_step(levels, direction)
        if levels.codes[other] >= 0 and wp.length(values[other] - values[node]) > GAP_JUMP:
            if exit_distance(crossings, direction / 2, direction % 2 == 1, p[0], p[1], p[2]) < 1.0:
                narrow[0] = 2
