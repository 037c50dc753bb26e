"""What a march may skip of an edit's lattice, by fine cells, 4 x 4 x 4 in a cell."""

import warp as wp

from ..core.lanes import (
    ballot,
    index_from_lane,
    lane_count,
    lowest_bit,
    mask_from_lane,
    octet_count,
    without_lowest_bit,
)
from ..core.loads import byte_entry, cell_byte, row_has_zero, vec4_entry
from ..field.grid import PART_REACH, VoxelGrid, grid_position
from ..lattice.cage_map import map_distance
from .nodes import node_blend
from .structs import CELL_FOLDED, CELL_INSIDE, CELL_OUTSIDE, CELL_STAYS, CELL_STEEP, LOOK_SKIP, EditData, entry_of_sides

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})

#: Fine cells of a cell along each axis, in all, and uint32s that hold four of their bytes each.
FINE_SIDE = wp.constant(4)

FINE_COUNT = wp.constant(64)

FINE_UINTS = wp.constant(16)

#: Width of a fine cell, in cells.
FINE_SIZE = wp.constant(0.25)

#: Distance of a fine cell that is farther than the bits of the neighbouring cells reach.
FINE_FAR = wp.constant(5)

#: A fine cell whose image meets more rows of the grid's cells is looked at: it is stretched out of all proportion.
MAX_ROWS = wp.constant(64)

#: The eight corners of the first fine cell of a cell, in the bits of StayingCorners.
CORNERS = wp.constant(wp.uint64(0xC6000063))

#: Bytes of 1, and what takes four bits to the lowest of four bytes each.
BYTES_OF_ONE = wp.constant(wp.uint32(0x01010101))

BITS_TO_BYTES = wp.constant(wp.uint32(0x00204081))


@wp.func
def cells_are_empty(grid: VoxelGrid, lower: wp.vec3, upper: wp.vec3):
    """Whether nothing is in the cells of the grid that a box meets; no for very many. edits/cell_tables.grid_is_empty
    says so by one read, for fewer boxes."""
    begin = grid_position(grid, lower)
    end = grid_position(grid, upper)
    low = wp.vec3i()
    size = wp.vec3i()  # less 1
    nearest = int(1 << 20)
    for axis in range(3):
        low[axis] = wp.max(int(wp.floor(begin[axis])), 0)
        size[axis] = wp.min(int(wp.floor(end[axis])), grid.skip.shape[axis] - 1) - low[axis]
        nearest = wp.min(nearest, size[axis] / 2)
    if wp.min(size) < 0:
        return True
    farthest = wp.max(size) - wp.max(size) / 2
    empty = cell_byte(grid.skip, low[0] + size[0] / 2, low[1] + size[1] / 2, low[2] + size[2] / 2)
    if empty > farthest or empty <= nearest:  # all of the box is nearer than what is nearest, or that lies in it
        return empty > farthest
    if farthest > 1:
        if (size[0] + 1) * (size[1] + 1) > MAX_ROWS:
            return False
        return cells_of_box_are_empty(grid, low, low + size)
    # three cells along each axis at most: their rows are read at once, as each read is waited for
    found = int(0)
    for i in range(3):
        for j in range(3):
            ci = low[0] + wp.min(i, size[0])
            cj = low[1] + wp.min(j, size[1])
            found += row_has_zero(grid.skip, ci, cj, low[2], size[2])
    return found == 0


@wp.func
def cells_of_box_are_empty(grid: VoxelGrid, low: wp.vec3i, high: wp.vec3i):
    """Whether nothing is in the grid's cells from `low` to `high`."""
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            k = low[2]
            while k <= high[2]:
                empty = cell_byte(grid.skip, i, j, k)
                if empty == 0:
                    return False
                k += empty
    return True


@wp.struct
class FineEdges:
    """The map and the signed distance on the four edges along axis 0 of a row of fine cells: at their beginning in the
    cell, and by how much they change to its end."""

    begin_0: wp.vec4
    begin_1: wp.vec4
    begin_2: wp.vec4
    begin_3: wp.vec4
    change_0: wp.vec4
    change_1: wp.vec4
    change_2: wp.vec4
    change_3: wp.vec4


@wp.func
def fine_edges(edit: EditData, n: int, y: float, z: float):
    """Of the row of fine cells that begins at places y and z, 0 to 1, of axes 1 and 2 of the cell above node n."""
    nz = edit.node_counts[2]
    nyz = edit.node_counts[1] * nz
    a = vec4_entry(edit.nodes, n)
    b = vec4_entry(edit.nodes, n + nz)
    c = vec4_entry(edit.nodes, n + nyz)
    d = vec4_entry(edit.nodes, n + nyz + nz)
    da = vec4_entry(edit.nodes, n + 1) - a
    db = vec4_entry(edit.nodes, n + nz + 1) - b
    dc = vec4_entry(edit.nodes, n + nyz + 1) - c
    dd = vec4_entry(edit.nodes, n + nyz + nz + 1) - d
    low = a + z * da
    low_y = b + z * db - low
    high = c + z * dc
    high_y = d + z * dd - high
    up = low + FINE_SIZE * da
    up_y = low_y + FINE_SIZE * (db - da)
    far = high + FINE_SIZE * dc
    far_y = high_y + FINE_SIZE * (dd - dc)
    edges = FineEdges()
    edges.begin_0 = low + y * low_y
    edges.begin_1 = edges.begin_0 + FINE_SIZE * low_y
    edges.begin_2 = up + y * up_y
    edges.begin_3 = edges.begin_2 + FINE_SIZE * up_y
    edges.change_0 = high + y * high_y
    edges.change_1 = edges.change_0 + FINE_SIZE * high_y - edges.begin_1
    edges.change_0 = edges.change_0 - edges.begin_0
    edges.change_2 = far + y * far_y
    edges.change_3 = edges.change_2 + FINE_SIZE * far_y - edges.begin_3
    edges.change_2 = edges.change_2 - edges.begin_2
    return edges


@wp.struct
class FineBounds:
    """The boxes around an edit's map, and around its signed distance, in a fine cell."""

    lower: wp.vec4
    upper: wp.vec4


@wp.func
def fine_bounds(edges: FineEdges, x: float):
    """Of the fine cell that begins at place x, 0 to 1, of its row."""
    a = edges.begin_0 + x * edges.change_0
    b = edges.begin_1 + x * edges.change_1
    c = edges.begin_2 + x * edges.change_2
    d = edges.begin_3 + x * edges.change_3
    e = a + FINE_SIZE * edges.change_0
    f = b + FINE_SIZE * edges.change_1
    g = c + FINE_SIZE * edges.change_2
    h = d + FINE_SIZE * edges.change_3
    bounds = FineBounds()
    bounds.lower = wp.min(wp.min(wp.min(a, b), wp.min(c, d)), wp.min(wp.min(e, f), wp.min(g, h)))
    bounds.upper = wp.max(wp.max(wp.max(a, b), wp.max(c, d)), wp.max(wp.max(e, f), wp.max(g, h)))
    return bounds


# A GPU waits for instructions where a kernel is long: what is called twice is called in a `while`, which is not
# unrolled.


@wp.struct
class StayingCorners:
    """Bits of the 5 x 5 x 5 corners of a cell's fine cells that the map leads into the rest cage."""

    low: wp.uint64
    high: wp.uint64


@wp.func
def staying_corners(edit: EditData, n: int, lane: int):
    """Of the cell above node n, as far as the rest cage reaches (EditData.slack). All lanes."""
    nz = edit.node_counts[2]
    result = StayingCorners()
    half = int(64)
    begin = int(0)
    while begin < 2 * half:
        corner = begin + lane
        place = FINE_SIZE * wp.vec3(float(corner / 25), float(corner / 5 % 5), float(corner % 5))
        node = node_blend(edit.nodes, n, edit.node_counts[1] * nz, nz, place)
        stays = map_distance(edit.rest, wp.vec3(node[0], node[1], node[2])) <= edit.slack
        marked = wp.uint64(wp.uint32(ballot(wp.where(stays, 1, 0)))) << wp.uint64(begin % half)
        if begin < half:
            result.low = result.low | marked
        else:
            result.high = result.high | marked
        begin += lane_count()
    return result


@wp.func
def corners_stay(corners: StayingCorners, fine: int):
    """Whether all corners of a fine cell do."""
    first = wp.uint64((fine >> 4) * 25 + ((fine >> 2) & 3) * 5 + (fine & 3))
    half = wp.uint64(64)
    bits = wp.uint64(0)
    if first < half:
        bits = (corners.low >> first) | (corners.high << (half - wp.uint64(1) - first) << wp.uint64(1))
    else:
        bits = corners.high >> (first - half)
    return (bits & CORNERS) == CORNERS


@wp.func
def fine_place(fine: int):
    """Where a fine cell begins in its cell, 0 to 1."""
    return FINE_SIZE * wp.vec3(float(fine >> 4), float((fine >> 2) & 3), float(fine & 3))


@wp.func
def fine_flags(
    grid: VoxelGrid,
    edit: EditData,
    step: float,
    n: int,
    fine: int,
    bounds: FineBounds,
    cell_flags: int,
    corners: StayingCorners,
):
    """The CELL_... flags of a fine cell of the cell above node n, LOOK_SKIP where it holds nothing. Out of the posed
    cage CELL_STAYS says that all of it is in the rest cage, and cleared."""
    low = fine_place(fine)
    lower = wp.vec3(bounds.lower[0], bounds.lower[1], bounds.lower[2])
    upper = wp.vec3(bounds.upper[0], bounds.upper[1], bounds.upper[2])
    is_mapped = edit.removes == 0 and bounds.lower[3] <= edit.tolerance
    is_empty = bool(True)
    beyond = float(0.0)
    flags = int(CELL_OUTSIDE)
    if is_mapped:
        flags = cell_flags & (CELL_FOLDED | CELL_STEEP | CELL_STAYS)
        flags = flags | wp.where(bounds.upper[3] <= edit.tolerance, CELL_INSIDE, 0)
        if (flags & CELL_STEEP) != 0:
            beyond = PART_REACH * step  # a sample that is cut reaches so far out of the fine cell
            reach = (beyond * edit.inverse_spacing * float(FINE_SIDE)) * (upper - lower)
            lower -= reach
            upper += reach
        if (flags & CELL_STAYS) == 0:
            # twice what the distance can change to the corners of the box, as the trilinear one is a little steeper
            if map_distance(edit.rest, 0.5 * (lower + upper)) < -wp.length(upper - lower):
                flags = flags | CELL_STAYS
            else:
                is_empty = corners_stay(corners, fine)  # samples that leave the rest cage are looked at, to be counted
    # its image, and where it is: both of those that the posed cage cuts, or with samples that are cut
    place = int(wp.where(is_mapped, 0, 1))
    last = int(wp.where(edit.removes == 1 or bounds.upper[3] + 2.0 * beyond > edit.tolerance, 1, 0))
    while is_empty and place <= last:
        if place == 1:
            nz = edit.node_counts[2]
            cell = wp.vec3(float(n / nz / edit.node_counts[1]), float(n / nz % edit.node_counts[1]), float(n % nz))
            one = wp.vec3(1.0, 1.0, 1.0)
            lower = edit.lower + edit.spacing * (cell + low) - beyond * one
            upper = lower + (FINE_SIZE * edit.spacing + 2.0 * beyond) * one
        is_empty = cells_are_empty(grid, lower, upper)
        if not is_empty and not is_mapped and edit.keeps_source == 0:
            if map_distance(edit.rest, 0.5 * (lower + upper)) < -wp.length(upper - lower):
                flags = flags | CELL_STAYS
        place += 1
    return wp.where(is_empty, int(LOOK_SKIP), flags)


@wp.func
def fine_bits(
    grid: VoxelGrid,
    edit: EditData,
    step: float,
    n: int,
    cell_flags: int,
    lane: int,
    fine_look: wp.array(dtype=wp.uint8),
):
    """The fine cells of the cell above node n that a march must look at; `fine_look` keeps their flags. All
    lanes."""
    has_sides = entry_of_sides(edit, n) != 0
    corners = StayingCorners()
    if edit.removes == 0 and (cell_flags & CELL_STAYS) == 0:
        corners = staying_corners(edit, n, lane)
    half = FINE_COUNT / 2
    bits = wp.uint64(0)
    begin = int(0)
    while begin < half:
        low = fine_place(begin + lane)  # two on the same row, whose edges they share
        edges = fine_edges(edit, n, low[1], low[2])
        bounds = fine_bounds(edges, low[0])
        other_bounds = fine_bounds(edges, low[0] + 0.5)
        turn = int(begin)
        while turn < FINE_COUNT:
            flags = int(cell_flags)
            if not has_sides:  # at a narrow gap of the cage nothing is known of less than a cell
                flags = fine_flags(grid, edit, step, n, turn + lane, bounds, cell_flags, corners)
            if flags < LOOK_SKIP:
                fine_look[n * FINE_COUNT + turn + lane] = wp.uint8(flags)
            marked = wp.uint32(ballot(wp.where(flags < LOOK_SKIP, 1, 0)))
            bits = bits | (wp.uint64(marked) << wp.uint64(turn))
            bounds = other_bounds
            turn += half
        begin += lane_count()
    return bits


@wp.kernel(cuda_max_registers=64)
def mark_fine_cells(
    first: int,
    grid: VoxelGrid,
    edit: EditData,
    step: float,
    looks: wp.array(dtype=wp.uint64),
    fine_look: wp.array(dtype=wp.uint8),
):
    """Which fine cells of each cell a march must look at; a group of lanes takes octet_count() cells. step: world
    units; looks: (nodes,) bits; fine_look: (FINE_COUNT * nodes,) becomes the flags of those, and nothing of others."""
    item = first + wp.tid()
    lane = item % lane_count()
    begin = item / lane_count() * octet_count()  # not all that lanes could hold: groups are to end together
    look = int(LOOK_SKIP)
    if lane < octet_count() and begin + lane < looks.shape[0]:
        look = byte_entry(edit.look, begin + lane)
    left = ballot(wp.where(look < LOOK_SKIP, 1, 0))
    own = wp.uint64(0)
    while left != 0:
        other = lowest_bit(left)
        left = without_lowest_bit(left)
        bits = fine_bits(grid, edit, step, begin + other, index_from_lane(look, other), lane, fine_look)
        if other == lane:
            own = bits
    if lane < octet_count() and begin + lane < looks.shape[0]:
        looks[begin + lane] = own


@wp.func
def looks_at(looks: wp.array(dtype=wp.uint64), n: int):
    """The bits of a cell; none beyond the lattice, whose last cells of each axis have none either."""
    if n < 0 or n >= looks.shape[0]:
        return wp.uint64(0)
    return looks[n]


@wp.struct
class Axis:
    """How the fine cells of a cell follow each other along an axis, in bits."""

    fine: wp.uint64  # from one to the next
    cell: wp.uint64  # from the first to that of the next cell
    firsts: wp.uint64  # one for each run of four


@wp.func
def fine_axis(axis: int):
    """Axis 0, 1 or 2."""
    result = Axis()
    result.fine = wp.uint64(16)
    result.cell = wp.uint64(64)
    result.firsts = wp.uint64(0x0000000000000001)
    if axis == 1:
        result.fine = wp.uint64(4)
        result.cell = wp.uint64(16)
        result.firsts = wp.uint64(0x0001000100010001)
    elif axis == 2:
        result.fine = wp.uint64(1)
        result.cell = wp.uint64(4)
        result.firsts = wp.uint64(0x1111111111111111)
    return result


@wp.func
def moved(axis: Axis, before: wp.uint64, bits: wp.uint64, after: wp.uint64, count: int):
    """The bits of a cell, of the one before and of the one after it, moved both ways along an axis by 1 to 4 fine
    cells."""
    if count == FINE_SIDE:
        return before | after
    one = wp.uint64(1)
    way = axis.fine * wp.uint64(count)
    rest = axis.cell - way
    low = axis.firsts * ((one << way) - one)
    high = axis.firsts * ((one << rest) - one)
    up = ((bits << way) & ~low) | ((before >> rest) & low)
    down = ((bits >> way) & high) | ((after << rest) & ~high)
    return up | down


@wp.struct
class NearFine:
    """Bits of the fine cells of a cell that have others within a distance of one, two, three and four."""

    one: wp.uint64
    two: wp.uint64
    three: wp.uint64
    four: wp.uint64


@wp.func
def near_on_line(axis: Axis, before: wp.uint64, bits: wp.uint64, after: wp.uint64):
    """Of the bits of three cells on an axis."""
    near = NearFine()
    near.one = bits | moved(axis, before, bits, after, 1)
    near.two = near.one | moved(axis, before, bits, after, 2)
    near.three = near.two | moved(axis, before, bits, after, 3)
    near.four = near.three | before | after
    return near


@wp.func
def near_along(axis: Axis, before: NearFine, near: NearFine, after: NearFine):
    """Of the bits of three cells on an axis that are near others along other axes."""
    result = NearFine()
    result.one = near.one | moved(axis, before.one, near.one, after.one, 1)
    result.two = near.two
    result.three = near.three
    result.four = near.four | before.four | after.four
    for count in range(1, 3):
        result.two = result.two | moved(axis, before.two, near.two, after.two, count)
    for count in range(1, 4):
        result.three = result.three | moved(axis, before.three, near.three, after.three, count)
        result.four = result.four | moved(axis, before.four, near.four, after.four, count)
    return result


@wp.func
def near_in_layer(looks: wp.array(dtype=wp.uint64), n: int, nz: int, nyz: int):
    """Of the cells beside cell n along axes 0 and 1."""
    before = NearFine()
    near = NearFine()
    after = NearFine()
    line = n - nz
    while line <= n + nz:
        before = near
        near = after
        low = looks_at(looks, line - nyz)
        high = looks_at(looks, line + nyz)
        after = near_on_line(fine_axis(0), low, looks_at(looks, line), high)
        line += nz
    return near_along(fine_axis(1), before, near, after)


@wp.func
def bytes_of(bits: wp.uint64, part: int):
    """The uint32 of four fine cells with 1 in each byte whose cell's bit is set."""
    four = wp.uint32(bits >> wp.uint64(FINE_SIDE * part)) & wp.uint32(15)
    return (four * BITS_TO_BYTES) & BYTES_OF_ONE


@wp.kernel
def spread_fine_cells(
    first: int, edit: EditData, looks: wp.array(dtype=wp.uint64), fine_look: wp.array(dtype=wp.uint32)
):
    """How far each fine cell is from the nearest that a march must look at; an item a cell, in whole groups of lanes.
    looks: (nodes,) bits; fine_look: (FINE_UINTS * nodes,) of four bytes, LOOK_SKIP + distance where there is no bit."""
    item = first + wp.tid()
    nodes = looks.shape[0]
    n = wp.min(item, nodes - 1)
    apart = byte_entry(edit.look, n) - LOOK_SKIP  # cells to the nearest that is looked at
    near = NearFine()
    if apart < 2:
        nz = edit.node_counts[2]
        nyz = edit.node_counts[1] * nz
        before = NearFine()
        after = NearFine()
        layer = n - 1
        while layer <= n + 1:
            before = near
            near = after
            after = near_in_layer(looks, layer, nz, nyz)
            layer += 1
        near = near_along(fine_axis(2), before, near, after)
    # the lanes write the cells of their group one after the other, side by side
    lane = item % lane_count()
    place = int(lane)
    while place < FINE_UINTS * lane_count():
        owner = place / FINE_UINTS
        part = place % FINE_UINTS
        cells_apart = index_from_lane(apart, owner)
        within = bytes_of(mask_from_lane(near.one, owner), part) + bytes_of(mask_from_lane(near.two, owner), part)
        within += bytes_of(mask_from_lane(near.three, owner), part) + bytes_of(mask_from_lane(near.four, owner), part)
        distances = wp.uint32(LOOK_SKIP + wp.max(FINE_FAR, FINE_SIDE * (cells_apart - 1) + 1)) * BYTES_OF_ONE - within
        at = (item - lane) * FINE_UINTS + place
        if at < FINE_UINTS * nodes:
            if cells_apart <= 0:
                kept = bytes_of(looks[at / FINE_UINTS], part) * wp.uint32(255)
                distances = (distances & ~kept) | (fine_look[at] & kept)
            fine_look[at] = distances
        place += lane_count()
