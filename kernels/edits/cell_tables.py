"""Lattice cells that lie on one side of a cage as a whole, where closed forms need not be evaluated."""

import warp as wp

from ..core.lanes import grid_place
from ..field.grid import PART_REACH, VoxelGrid, empty_distance, grid_position
from ..lattice.cage_map import CageMap, cell_sides, map_distance
from .structs import (
    CELL_ALONE,
    CELL_CARRIES,
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    CUT_LENGTH,
    LATTICE_BORDER,
    LOOK_SKIP,
    LatticeEdit,
    lattice_lower,
    lattice_upper,
)
from .trace import in_rest_cage

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Distances between lattice cells are cut here: a lattice is some hundred cells wide, and they are spread at each pose.
REACH_LIMIT = wp.constant(12)

mat83 = wp.types.matrix(shape=(8, 3), dtype=wp.float32)


@wp.func
def corner_edge(corners: mat83, axis: int, side: int):
    """One of the four edges along an axis of a trilinear cell; corner c is at (c & 4, c & 2, c & 1)."""
    low = wp.where(axis == 0, side, wp.where(axis == 1, (side & 1) + 2 * (side & 2), 2 * side))
    return corners[low + (4 >> axis)] - corners[low]


@wp.func
def mean_jacobian(corners: mat83):
    """Jacobian at the middle of a trilinear cell, per cell: its columns are the means of four edges."""
    columns = wp.mat33()
    for axis in range(3):
        mean = wp.vec3()
        for side in range(4):
            mean += 0.25 * corner_edge(corners, axis, side)
        for row in range(3):
            columns[row, axis] = mean[row]
    return columns


@wp.func
def jacobian_spread(corners: mat83, mean: wp.mat33):
    """Bound of how far, in the Frobenius norm, the Jacobian anywhere in a trilinear cell is from its mean."""
    total = float(0.0)
    for axis in range(3):
        column = wp.vec3(mean[0, axis], mean[1, axis], mean[2, axis])
        farthest = float(0.0)
        for side in range(4):
            farthest = wp.max(farthest, wp.length_sq(corner_edge(corners, axis, side) - column))
        total += farthest
    return wp.sqrt(total)


@wp.func
def largest_stretch(jacobian: wp.mat33):
    """Bound of the largest singular value: the root of the largest absolute row sum of J^T J."""
    gram = wp.transpose(jacobian) * jacobian
    largest = float(0.0)
    for row in range(3):
        largest = wp.max(largest, wp.abs(gram[row, 0]) + wp.abs(gram[row, 1]) + wp.abs(gram[row, 2]))
    return wp.sqrt(largest)


@wp.kernel
def keep_edit(first: int, edit: LatticeEdit, index: int, edits: wp.array(dtype=LatticeEdit)):
    """Put an edit into an array: an argument takes the host less time than a copy. One item."""
    edits[first + wp.tid() + index] = edit


@wp.kernel
def mark_edit_cases(first: int, edit: LatticeEdit, cells: wp.array3d(dtype=wp.uint8)):
    """The CELL_... flags of each lattice cell of an edit, so that most samples need neither distance."""
    # the trilinear distance in a cell lies between its corners', the trilinear map in the bounding box of its corners'
    i, j, k = grid_place(first + wp.tid(), cells.shape[1], cells.shape[2])
    nearest = float(1.0e30)
    farthest = float(-1.0e30)
    for c in range(8):
        distance = edit.deformed.distance[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        nearest = wp.min(nearest, distance)
        farthest = wp.max(farthest, distance)
    flags = int(0)
    if nearest > edit.tolerance:
        flags = CELL_OUTSIDE
    elif edit.removes == 0 and cell_sides(edit.deformed, i, j, k) != 0:
        flags = CELL_STEEP  # at a narrow gap of the cage: nothing is settled for the cell as a whole
    elif edit.removes == 0:
        corners = mat83()
        lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        upper = -lower
        for c in range(8):
            corners[c] = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
            lower = wp.min(lower, corners[c])
            upper = wp.max(upper, corners[c])
        if farthest <= edit.tolerance:
            flags = CELL_INSIDE
        # twice what the distance can change to the corners of the box, as the trilinear one is a little steeper
        if map_distance(edit.rest, 0.5 * (lower + upper)) < -wp.length(upper - lower):
            flags = flags | CELL_STAYS
        jacobian = mean_jacobian(corners) * edit.deformed.inverse_spacing
        if wp.determinant(jacobian) <= 0.0:
            flags = flags | CELL_FOLDED
        spread = jacobian_spread(corners, edit.deformed.spacing * jacobian) * edit.deformed.inverse_spacing
        if largest_stretch(jacobian) + spread > CUT_LENGTH:
            flags = flags | CELL_STEEP
    cells[i, j, k] = wp.uint8(flags)


@wp.func
def box_meets_cage(cage: CageMap, lower: wp.vec3, upper: wp.vec3):
    """Whether a box meets the one around a cage that a lattice lies over."""
    meets = bool(True)
    for axis in range(3):
        border = LATTICE_BORDER * cage.spacing
        end = cage.lower[axis] + cage.spacing * float(cage.distance.shape[axis] - 1)
        meets = meets and upper[axis] >= cage.lower[axis] + border and lower[axis] <= end - border
    return meets


@wp.func
def box_meets_edit(edit: LatticeEdit, lower: wp.vec3, upper: wp.vec3):
    """Whether anything of a box may be in an edit's posed cage or in its rest cage."""
    if edit.fragments.marks.shape[0] > 0:
        return True
    meets = box_meets_cage(edit.deformed, lower, upper)
    if edit.keeps_source == 0:
        meets = meets or box_meets_cage(edit.rest, lower, upper)
    return meets


@wp.kernel
def mark_alone_cells(
    first: int, edits: wp.array(dtype=LatticeEdit), edit_index: int, cells: wp.array3d(dtype=wp.uint8)
):
    """Add CELL_ALONE to the cells of an edit: what they map need not be traced through earlier edits."""
    i, j, k = grid_place(first + wp.tid(), cells.shape[1], cells.shape[2])
    edit = edits[edit_index]
    flags = int(cells[i, j, k])
    if (flags & CELL_CARRIES) != CELL_OUTSIDE and cell_sides(edit.deformed, i, j, k) == 0:
        lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        upper = -lower
        for c in range(8):
            position = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
            lower = wp.min(lower, position)
            upper = wp.max(upper, position)
        alone = bool(True)
        for e in range(edit_index):
            if box_meets_edit(edits[e], lower, upper):
                alone = False
        if alone:
            cells[i, j, k] = wp.uint8(flags | CELL_ALONE)


@wp.func
def grid_is_empty(grid: VoxelGrid, center: wp.vec3, half: wp.vec3):
    """Whether a box is certainly empty in the canonical grid."""
    g = grid_position(grid, center)
    reach = wp.cw_mul(half, grid.inverse_voxel_size)
    needed = float(0.0)
    nearest = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        top = float(grid.skip.shape[axis])
        if g[axis] + reach[axis] < 0.0 or g[axis] - reach[axis] > top:
            return True  # beside the grid
        nearest[axis] = wp.clamp(g[axis], 0.5, top - 0.5)
        needed = wp.max(needed, reach[axis] + wp.abs(g[axis] - nearest[axis]))
    return float(empty_distance(grid, nearest)) > needed + 1.0


@wp.func
def scene_is_empty(
    edits: wp.array(dtype=LatticeEdit), edit_count: int, grid: VoxelGrid, center: wp.vec3, half: wp.vec3
):
    """Whether a box is certainly empty in the scene that the first `edit_count` edits leave."""
    e = edit_count - 1
    while e >= 0:
        edit = edits[e]
        lower = lattice_lower(edit)
        upper = lattice_upper(edit)
        beside = bool(False)
        within = bool(True)
        for axis in range(3):
            if center[axis] + half[axis] < lower[axis] or center[axis] - half[axis] > upper[axis]:
                beside = True
            if center[axis] - half[axis] < lower[axis] or center[axis] + half[axis] > upper[axis]:
                within = False
        if not beside:
            # the part of the box in the edit's, whose `skip` counts the scene beneath there
            low = wp.max(center - half, lower)
            high = wp.min(center + half, upper)
            g = (0.5 * (low + high) - lower) * edit.deformed.inverse_spacing
            i = wp.clamp(int(wp.floor(g[0])), 0, edit.skip.shape[0] - 1)
            j = wp.clamp(int(wp.floor(g[1])), 0, edit.skip.shape[1] - 1)
            k = wp.clamp(int(wp.floor(g[2])), 0, edit.skip.shape[2] - 1)
            needed = 0.5 * wp.max(high - low) * edit.deformed.inverse_spacing + 1.0
            if within or float(edit.skip[i, j, k]) <= needed:
                return float(edit.skip[i, j, k]) > needed
            # beyond it there is no more than in the scene that the edit found
        e -= 1
    return grid_is_empty(grid, center, half)


@wp.kernel
def mark_edit_cells(
    first: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=LatticeEdit),
    edit_index: int,
    step: float,
    marks: wp.array3d(dtype=wp.uint8),
):
    """0 at the lattice cells of an edit in which a march must look, REACH_LIMIT at the others. Earlier edits' `skip`
    must be ready; step: of the march, world units."""
    # The scene beneath, canonical grid and earlier edits, decides whether the box of the corners' images is empty.
    # Sub-samples reach half a step out of the cell. Cells mapped out of the rest cage are looked at, to be counted.
    i, j, k = grid_place(first + wp.tid(), marks.shape[1], marks.shape[2])
    edit = edits[edit_index]
    nearest = float(1.0e30)
    farthest = float(-1.0e30)
    for c in range(8):
        distance = edit.deformed.distance[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        nearest = wp.min(nearest, distance)
        farthest = wp.max(farthest, distance)
    empty = edit.removes == 1 or (int(edit.cells[i, j, k]) & CELL_CARRIES) != CELL_CARRIES
    if edit.removes == 0 and nearest <= edit.tolerance:
        empty = empty and cell_sides(edit.deformed, i, j, k) == 0
        stays = (int(edit.cells[i, j, k]) & CELL_STAYS) != 0
        lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        upper = -lower
        for c in range(8):
            position = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
            lower = wp.min(lower, position)
            upper = wp.max(upper, position)
            if empty and not stays:
                empty = in_rest_cage(edit, position, edit.slack)
        reach = 0.5 + PART_REACH * step * edit.deformed.inverse_spacing
        empty = empty and scene_is_empty(edits, edit_index, grid, 0.5 * (lower + upper), reach * (upper - lower))
    if edit.removes == 1 or farthest > edit.tolerance:
        h = 0.5 * edit.deformed.spacing
        center = edit.deformed.lower + edit.deformed.spacing * wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5)
        empty = empty and scene_is_empty(edits, edit_index, grid, center, wp.vec3(h, h, h))
    marks[i, j, k] = wp.uint8(wp.where(empty, REACH_LIMIT, 0))


@wp.kernel
def join_cell_tables(
    first: int,
    cells: wp.array3d(dtype=wp.uint8),
    skip: wp.array3d(dtype=wp.uint8),
    node_counts: wp.vec3i,
    look: wp.array(dtype=wp.uint8),
):
    """The two tables of a LatticeEdit's cells as one, so that a sample reads one byte. One item a node; above the last
    ones of an axis there is nothing to look at."""
    n = first + wp.tid()
    i, j, k = grid_place(n, node_counts[1], node_counts[2])
    value = LOOK_SKIP + 1
    if i < cells.shape[0] and j < cells.shape[1] and k < cells.shape[2]:
        value = int(cells[i, j, k])
        if skip[i, j, k] > wp.uint8(0):
            value = LOOK_SKIP + int(skip[i, j, k])
    look[n] = wp.uint8(value)


@wp.kernel
def join_nodes(
    first: int, positions: wp.array(dtype=wp.vec3), distance: wp.array(dtype=float), nodes: wp.array(dtype=wp.vec4)
):
    """Position and distance of each node as four numbers. An edit that removes has no positions."""
    n = first + wp.tid()
    position = wp.vec3(0.0, 0.0, 0.0)
    if positions.shape[0] > 0:
        position = positions[n]
    nodes[n] = wp.vec4(position[0], position[1], position[2], distance[n])


#: Half the diagonal of a cell: no point in it is farther from the nearest corner.
HALF_DIAGONAL = wp.constant(0.8661)


@wp.func
def settled_case(cage_map: CageMap, i: int, j: int, k: int, slack: float):
    """CELL_INSIDE or CELL_OUTSIDE where no point of a lattice cell can be on the other side of the cage, else 0.
    Outside means farther than `slack`."""
    # distances at nodes are exact up to their limit, and differ between two points by at most the way between them
    nearest = float(1.0e30)
    farthest = float(-1.0e30)
    for c in range(8):
        distance = cage_map.distance[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        nearest = wp.min(nearest, distance)
        farthest = wp.max(farthest, distance)
    reach = HALF_DIAGONAL * cage_map.spacing
    if nearest > reach + slack:
        return CELL_OUTSIDE
    if farthest < -reach:
        return CELL_INSIDE
    return int(0)


@wp.kernel
def settle_rest_cells(first: int, rest: CageMap, slack: float, flags: wp.array3d(dtype=wp.uint8)):
    """The settled_case of each cell of a lattice over the rest cage."""
    i, j, k = grid_place(first + wp.tid(), flags.shape[1], flags.shape[2])
    flags[i, j, k] = wp.uint8(settled_case(rest, i, j, k, slack))


@wp.kernel
def settle_deformed_cells(first: int, edit: LatticeEdit, flags: wp.array3d(dtype=wp.uint8)):
    """The settled_case of each cell over the deformed cage, and flags of the lattice's map in the inside ones:
    CELL_STAYS as the lattice has it, CELL_STEEP where it may be, CELL_FOLDED where the map may turn over somewhere."""
    i, j, k = grid_place(first + wp.tid(), flags.shape[1], flags.shape[2])
    case = settled_case(edit.deformed, i, j, k, edit.tolerance)
    if edit.removes == 0 and (int(edit.cells[i, j, k]) & CELL_CARRIES) == CELL_CARRIES:
        case = CELL_CARRIES | CELL_STEEP | CELL_FOLDED
    elif case == 0:
        case = CELL_STEEP | CELL_FOLDED
    elif case == CELL_INSIDE and edit.removes == 0:
        case = case | (int(edit.cells[i, j, k]) & (CELL_STAYS | CELL_STEEP))
        corners = mat83()
        for c in range(8):
            corners[c] = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        jacobian = mean_jacobian(corners)
        stretch = largest_stretch(jacobian)
        spread = jacobian_spread(corners, jacobian)
        if cell_sides(edit.deformed, i, j, k) != 0 or wp.determinant(jacobian) <= 6.0 * stretch * stretch * spread:
            case = case | CELL_FOLDED
    flags[i, j, k] = wp.uint8(case)
