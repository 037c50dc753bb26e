"""Sides of the lattice cells at narrow gaps of a cage: which there are, as rows of a table.

A side is a set of inside corners of a cell joined by links that do not cross the cage, of the cell or one layer behind
a face of it. A cell may hold a tip of the cage without a corner inside it: besides its own it has the sides of the six
cells beside it that have no inside corner in common with it. Cells are marked, their sides counted column by column,
summed up and written; what the rows hold is in map_sides. Cells have the number of their first corner.
Siblings: harmonic_rows, lanes, map_extension, node_levels.
"""

import warp as wp

from .harmonic_rows import DOUBLE_CUT, CutRows
from .lanes import ballot, bit_count, bits_before, lane_count, sum_of_lanes
from .map_extension import is_open_link, node_step
from .node_levels import OUTSIDE, NodeLevels

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

#: Sides of a cell that there is room for in its entry of side_index.
MOST_SIDES = wp.constant(7)


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
