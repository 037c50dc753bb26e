"""Lists of the nodes of a lattice over a cage, for every level of a multigrid hierarchy."""

# Level l keeps every 2^l-th node along each axis; its node (i, j, k) is first_node[l] + (i * ny + j) * nz + k. A node's
# code is its row in the table of cut nodes (see cut_rows.py) where that is >= 0, else a constant below. Sections of the
# list `nodes`, ascending within each, section s from starts[s] on:
#   2 l + c         inside nodes of level l with (i + j + k) % 2 = c ("red" 0, "black" 1); where `interpolates` is set,
#                   those evaluated (0) and those interpolated from them (1): with an odd coordinate, at least CLEARANCE
#                   cells from the cage (see closed_form.py)
#   2 L + l         inside nodes of level l whose cross of six grid edges meets the cage ("cut")
#   3 L + r         outside nodes of level 0: r = 0 face neighbours of an inside node, r = 1 other corners of cells with
#                   an inside node, r = 2 others within a cell's diagonal of the cage, which may be too thin or pointed
#                   there for inside nodes
# Columns are counted, summed up and written: no atomics, the same lists on every device.

import warp as wp

from ..core.lanes import ballot, bit_count, bits_before, lane_count, lane_place
from .crossings import LineCrossings, exit_distance
from .distance import is_clear

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
REGULAR = wp.constant(-1)  # inside, not cut
INTERPOLATED = wp.constant(-2)  # the same, but interpolated from others
OUTSIDE = wp.constant(-3)  # codes above are inside, codes below in a ring
RING = wp.constant(-4)  # ring r has code RING - r
RINGS = wp.constant(3)
CELL_DIAGONAL = wp.constant(1.7321)  # cells

#: Sections of a list on one level, as the closed forms have it, after that of the evaluated nodes.
INTERPOLATED_SECTION = wp.constant(1)
CUT_SECTION = wp.constant(2)
RING_SECTION = wp.constant(3)


@wp.struct
class NodeLevels:
    shapes: wp.array(dtype=wp.vec3i)  # (L,) nodes along each axis
    first_node: wp.array(dtype=int)  # (L + 1,)
    first_column: wp.array(dtype=int)  # (L + 1,) columns (i, j) are numbered like nodes
    codes: wp.array(dtype=int)  # (nodes of all levels,)
    nodes: wp.array(dtype=int)  # the list
    starts: wp.array(dtype=int)  # (3 L + RINGS + 1,)
    interpolates: int  # 1: of inside nodes clear of the cage only those of even coordinates are evaluated


@wp.func
def cut_section(levels: NodeLevels):
    """Section of the cut nodes of level 0; those of the other levels follow."""
    return 2 * levels.shapes.shape[0]


@wp.func
def ring_section(levels: NodeLevels):
    """Section of ring 0; rings 1 and 2 follow."""
    return 3 * levels.shapes.shape[0]


@wp.func
def level_of(offsets: wp.array(dtype=int), n: int):
    """Level whose share of `offsets` holds n."""
    level = int(0)
    for upper in range(1, offsets.shape[0] - 1):
        if n >= offsets[upper]:
            level = upper
    return level


@wp.func
def node_place(levels: NodeLevels, level: int, node: int):
    """(i, j, k) of a node of a level."""
    shape = levels.shapes[level]
    local = node - levels.first_node[level]
    row = local / shape[2]
    return wp.vec3i(row / shape[1], row % shape[1], local % shape[2])


@wp.func
def centered_place(levels: NodeLevels, node: int):
    """Place of a node of level 0 from the middle of the lattice, node units."""
    p = node_place(levels, 0, node)
    shape = levels.shapes[0]
    return wp.vec3(float(p[0] - (shape[0] - 1) / 2), float(p[1] - (shape[1] - 1) / 2), float(p[2] - (shape[2] - 1) / 2))


@wp.func
def is_inside_node(shape: wp.vec3i, distance: wp.array(dtype=float), i: int, j: int, k: int):
    """Whether node (i, j, k) of the lattice is inside; nodes off the lattice are outside."""
    if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
        return False
    return distance[(i * shape[1] + j) * shape[2] + k] < 0.0


@wp.func
def is_cut_link(
    crossings: LineCrossings, distance: wp.array(dtype=float), p: wp.vec3i, axis: int, forward: bool, reach: int
):
    """Whether the cage comes between inside node p (lattice numbering) and its neighbour `reach` nodes on."""
    q = p
    q[axis] = p[axis] + wp.where(forward, reach, -reach)
    if not is_inside_node(crossings.shapes[0], distance, q[0], q[1], q[2]):
        return True
    return exit_distance(crossings, axis, forward, p[0], p[1], p[2]) < float(reach)


@wp.func
def node_cut(crossings: LineCrossings, distance: wp.array(dtype=float), p: wp.vec3i, reach: int):
    """1 where the cage comes between inside node p (lattice numbering) and any of the six `reach` nodes on; 2 where all
    six are inside, so that it does so twice on a link."""
    shape = crossings.shapes[0]
    outside = int(0)
    for d in range(6):  # without branches, so that all six are read together
        q = p
        q[d / 2] = p[d / 2] + wp.where(d % 2 == 1, reach, -reach)
        i = wp.clamp(q[0], 0, shape[0] - 1)
        j = wp.clamp(q[1], 0, shape[1] - 1)
        k = wp.clamp(q[2], 0, shape[2] - 1)
        beside = i != q[0] or j != q[1] or k != q[2]
        if distance[(i * shape[1] + j) * shape[2] + k] >= 0.0 or beside:
            outside += 1
    if outside > 0:
        return int(1)
    for axis in range(3):
        if exit_distance(crossings, axis, False, p[0], p[1], p[2]) < float(reach):
            return int(2)
        if exit_distance(crossings, axis, True, p[0], p[1], p[2]) < float(reach):
            return int(2)
    return int(0)


@wp.func
def ring_code(shape: wp.vec3i, distance: wp.array(dtype=float), p: wp.vec3i):
    """Code of outside node p of level 0, within a cell's diagonal of the cage: the ring that it belongs to. The margin
    of the lattice is wider than that, so that all neighbours are there."""
    node = (p[0] * shape[1] + p[1]) * shape[2] + p[2]
    beside = float(1.0)
    around = float(1.0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                found = distance[node + (i * shape[1] + j) * shape[2] + k]
                around = wp.min(around, found)
                if i * i + j * j + k * k == 1:
                    beside = wp.min(beside, found)
    return wp.where(beside < 0.0, RING, wp.where(around < 0.0, RING - 1, RING - 2))


@wp.func
def node_code(
    crossings: LineCrossings,
    distance: wp.array(dtype=float),
    scale: float,
    clear_octants: wp.array(dtype=int),
    levels: NodeLevels,
    level: int,
    p: wp.vec3i,
    narrow: wp.array(dtype=int),
):
    """Code of the node at place p (lattice numbering) of a level; the arguments are those of classify_columns."""
    reach = 1 << level
    shape = levels.shapes[0]
    code = OUTSIDE
    cells = float(0.0)
    if p[0] < shape[0] and p[1] < shape[1] and p[2] < shape[2]:
        cells = distance[(p[0] * shape[1] + p[1]) * shape[2] + p[2]] / scale
    if cells < 0.0:
        code = REGULAR
        # no link is cut where the cage is farther than its length; beyond 4 cells `distance` is clamped
        if level > 2 or -cells < 0.9999 * float(reach):
            cut = node_cut(crossings, distance, p, reach)
            if cut > 0:
                code = 0
            if cut == 2 and level == 0:
                narrow[0] = 1
        elif levels.interpolates == 1 and ((p[0] | p[1] | p[2]) & 1) == 1:
            if is_clear(shape, clear_octants, p[0], p[1], p[2]):
                code = INTERPOLATED
    elif level == 0 and cells < CELL_DIAGONAL:
        code = ring_code(shape, distance, p)
    return code


@wp.func
def inside_section(levels: NodeLevels, code: int, parity: int):
    """Which of a level's two sections an inside node belongs to; parity: that of i + j + k."""
    if levels.interpolates == 1:
        return wp.where(code == INTERPOLATED, 1, 0)
    return parity % 2


@wp.struct
class SectionFlags:
    """Which of the sections that its level fills a node belongs to, 1 or 0 each."""

    one: int
    other: int
    cut: int
    ring_0: int
    ring_1: int
    ring_2: int


@wp.func
def section_flags(levels: NodeLevels, code: int, parity: int):
    result = SectionFlags()
    section = inside_section(levels, code, parity)
    result.one = wp.where(code > OUTSIDE and section == 0, 1, 0)
    result.other = wp.where(code > OUTSIDE and section == 1, 1, 0)
    result.cut = wp.where(code >= 0, 1, 0)
    result.ring_0 = wp.where(code == RING, 1, 0)
    result.ring_1 = wp.where(code == RING - 1, 1, 0)
    result.ring_2 = wp.where(code == RING - 2, 1, 0)
    return result


@wp.func
def column_code(levels: NodeLevels, begin: int, count: int, k: int):
    """Code of node k of a column of `count` nodes that begins at `begin`; OUTSIDE beyond its end."""
    code = levels.codes[begin + wp.min(k, count - 1)]
    return wp.where(k < count, code, OUTSIDE)


@wp.kernel
def classify_columns(
    first: int,
    crossings: LineCrossings,
    distance: wp.array(dtype=float),
    scales: wp.array(dtype=float),
    clear_octants: wp.array(dtype=int),
    levels: NodeLevels,
    narrow: wp.array(dtype=int),
    counts: wp.array(dtype=int),
):
    """Codes of all nodes, and how many of each section each column has. One group of lanes per column, one lane per
    node. Cut nodes get 0 until list_columns numbers them."""
    # distance (nodes of level 0,): scales[0] units per cell. narrow (1,) becomes 1 where links leave the cage and enter
    # it again: a gap below a cell. counts: section after section, an entry per column of its level.
    column, lane, lanes = lane_place(first + wp.tid())
    level_count = levels.shapes.shape[0]
    if column >= levels.first_column[level_count]:
        return
    level = level_of(levels.first_column, column)
    shape = levels.shapes[level]
    local = column - levels.first_column[level]
    begin = levels.first_node[level] + local * shape[2]
    place = wp.vec3i(local / shape[1], local % shape[1], 0)
    parity = place[0] + place[1]
    one = int(0)
    other = int(0)
    cut = int(0)
    ring_0 = int(0)
    ring_1 = int(0)
    ring_2 = int(0)
    for k in range(0, shape[2], lanes):
        code = OUTSIDE
        if k + lane < shape[2]:
            place[2] = k + lane
            p = place * (1 << level)
            code = node_code(crossings, distance, scales[0], clear_octants, levels, level, p, narrow)
            levels.codes[begin + k + lane] = code
        if ballot(wp.where(code != OUTSIDE, 1, 0)) != 0:
            flags = section_flags(levels, code, parity + k + lane)
            one += bit_count(ballot(flags.one))
            other += bit_count(ballot(flags.other))
            cut += bit_count(ballot(flags.cut))
            ring_0 += bit_count(ballot(flags.ring_0))
            ring_1 += bit_count(ballot(flags.ring_1))
            ring_2 += bit_count(ballot(flags.ring_2))
    if lane == 0:
        columns = levels.first_column[level_count]
        width = levels.first_column[level + 1] - levels.first_column[level]
        counts[2 * levels.first_column[level] + local] = one
        counts[2 * levels.first_column[level] + width + local] = other
        counts[2 * columns + column] = cut
        if level == 0:
            counts[3 * columns + local] = ring_0
            counts[3 * columns + width + local] = ring_1
            counts[3 * columns + 2 * width + local] = ring_2
            if column == 0:
                counts[3 * columns + RINGS * width] = 0


@wp.func
def scan_entry(levels: NodeLevels, section: int):
    """Entry of the scanned counts at which a section begins."""
    level_count = levels.shapes.shape[0]
    columns = levels.first_column[level_count]
    if section < 2 * level_count:
        level = section / 2
        width = levels.first_column[level + 1] - levels.first_column[level]
        return 2 * levels.first_column[level] + (section % 2) * width
    if section < 3 * level_count:
        return 2 * columns + levels.first_column[section - 2 * level_count]
    return 3 * columns + (section - 3 * level_count) * levels.first_column[1]


@wp.func
def lists_have_room(levels: NodeLevels, offsets: wp.array(dtype=int), limits: wp.array(dtype=int), lane: int):
    """Whether no section is longer than its limit. All lanes."""
    exceeded = int(0)
    for s in range(lane, limits.shape[0], lane_count()):
        if offsets[scan_entry(levels, s + 1)] - offsets[scan_entry(levels, s)] > limits[s]:
            exceeded = 1
    return ballot(exceeded) == 0


@wp.func
def list_node(levels: NodeLevels, flag: int, slot: int, node: int, lane: int):
    """Write the nodes of the lanes with a flag to the list, from `slot` on; the slot after them. All lanes."""
    flags = ballot(flag)
    if flag == 1:
        levels.nodes[slot + bit_count(bits_before(flags, lane))] = node
    return slot + bit_count(flags)


@wp.kernel
def list_columns(
    first: int,
    levels: NodeLevels,
    offsets: wp.array(dtype=int),
    limits: wp.array(dtype=int),
    overflow: wp.array(dtype=int),
):
    """Write the nodes of each column to their sections, the rows of cut nodes to their codes, and starts.
    One group of lanes per column, one lane per node. Beyond limits (sections,) overflow (1,) is 1, sections empty."""
    column, lane, lanes = lane_place(first + wp.tid())
    level_count = levels.shapes.shape[0]
    if column >= levels.first_column[level_count]:
        return
    has_room = lists_have_room(levels, offsets, limits, lane)
    if column == 0:
        for s in range(lane, limits.shape[0] + 1, lanes):
            levels.starts[s] = wp.where(has_room, offsets[scan_entry(levels, s)], 0)
        if lane == 0 and not has_room:
            overflow[0] = 1
    if not has_room:
        return
    level = level_of(levels.first_column, column)
    shape = levels.shapes[level]
    local = column - levels.first_column[level]
    begin = levels.first_node[level] + local * shape[2]
    parity = local / shape[1] + local % shape[1]
    columns = levels.first_column[level_count]
    width = levels.first_column[level + 1] - levels.first_column[level]
    one = offsets[2 * levels.first_column[level] + local]
    other = offsets[2 * levels.first_column[level] + width + local]
    cut = offsets[2 * columns + column]
    first_cut = offsets[2 * columns]
    ring_0 = int(0)
    ring_1 = int(0)
    ring_2 = int(0)
    if level == 0:
        ring_0 = offsets[3 * columns + local]
        ring_1 = offsets[3 * columns + width + local]
        ring_2 = offsets[3 * columns + 2 * width + local]
    for k in range(0, shape[2], lanes):
        code = column_code(levels, begin, shape[2], k + lane)
        if ballot(wp.where(code != OUTSIDE, 1, 0)) != 0:
            node = begin + k + lane
            flags = section_flags(levels, code, parity + k + lane)
            one = list_node(levels, flags.one, one, node, lane)
            other = list_node(levels, flags.other, other, node, lane)
            cuts = ballot(flags.cut)
            if flags.cut == 1:
                row = cut + bit_count(bits_before(cuts, lane))
                levels.nodes[row] = node
                levels.codes[node] = row - first_cut
            cut += bit_count(cuts)
            ring_0 = list_node(levels, flags.ring_0, ring_0, node, lane)
            ring_1 = list_node(levels, flags.ring_1, ring_1, node, lane)
            ring_2 = list_node(levels, flags.ring_2, ring_2, node, lane)
