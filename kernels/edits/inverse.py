"""Where a pose takes the matter of a rest cage: the map of a posed cage, inverted at the nodes of the rest cage's
lattice."""

import warp as wp

from ..core.gradients import forward_only_in
from ..core.lanes import grid_place
from ..field.grid import VoxelGrid, empty_distance, grid_position
from ..lattice.cage_map import corner_share
from .structs import CELL_OUTSIDE, EditData, entry_of_sides

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3), (wp.vec4, wp.vec3), (wp.mat33, wp.vec3))

#: Of Newton's method in a trilinear cell, at most, and a step, in cells, that is the last one: the next would be about
#: its square. From the middle two or three are enough where the cell is not folded.
NEWTON_STEPS = wp.constant(6)

LAST_STEP = wp.constant(1.0e-3)

#: A node counts as in a cell up to this far beyond its faces, and as met up to this far, in cells.
CELL_MARGIN = wp.constant(1.0e-3)

#: A cell whose image holds more nodes than this, which one thread would look through, is squeezed beyond all use.
MAX_NODES = wp.constant(4096)

#: No cell's number.
NO_CELL = wp.constant(2147483647)

mat83 = wp.types.matrix(shape=(8, 3), dtype=wp.float32)


@wp.func
def corner_node(edit: EditData, n: int, corner: int):
    """Node of the posed lattice at a corner of the cell above node n."""
    nz = edit.node_counts[2]
    return n + (corner >> 2) * edit.node_counts[1] * nz + ((corner >> 1) & 1) * nz + (corner & 1)


@wp.func
def cell_corners(edit: EditData, n: int, entry: int, side: int):
    """Images of the corners of the cell above node n of the posed lattice, in cells of the rest lattice."""
    corners = mat83()
    for c in range(8):
        node = edit.nodes[corner_node(edit, n, c)]
        if entry != 0:
            node = edit.sides[entry // 8 + side, c]
        corners[c] = (wp.vec3(node[0], node[1], node[2]) - edit.rest.lower) * edit.rest.inverse_spacing
    return corners


@wp.func
def corner_mean(corners: mat83, f: wp.vec3):
    """Trilinear value at a place f, 0 to 1, of a cell."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for c in range(8):
        total += corner_share(c, f) * corners[c]
    return total


@wp.func
def corner_slope(corners: mat83, f: wp.vec3):
    """Derivative of corner_mean; its columns belong to the axes of f."""
    slope = wp.mat33()
    for axis in range(3):
        bit = 4 >> axis
        ahead = f
        behind = f
        ahead[axis] = 1.0
        behind[axis] = 0.0
        column = wp.vec3(0.0, 0.0, 0.0)
        for c in range(8):
            if (c & bit) != 0:
                column += corner_share(c, ahead) * (corners[c] - corners[c - bit])
        for row in range(3):
            slope[row, axis] = column[row]
    return forward_only(slope, f)


@wp.func
def place_in_cell(corners: mat83, target: wp.vec3):
    """The place f of a cell with corner_mean = target, 0 to 1; 1e6 where there is none near."""
    f = wp.vec3(0.5, 0.5, 0.5)
    step = int(0)
    while step < NEWTON_STEPS:  # not unrolled: a GPU waits for instructions where a kernel is long
        step += 1
        slope = corner_slope(corners, f)
        if wp.abs(wp.determinant(slope)) < 1.0e-9:
            return forward_only(wp.vec3(1.0e6, 1.0e6, 1.0e6), target)
        change = wp.inverse(slope) * (target - corner_mean(corners, f))
        if wp.length_sq(change) < LAST_STEP * LAST_STEP:
            step = int(NEWTON_STEPS)
        f += change
        f = wp.max(wp.min(f, wp.vec3(2.0, 2.0, 2.0)), wp.vec3(-1.0, -1.0, -1.0))
    if wp.length(corner_mean(corners, f) - target) > CELL_MARGIN:
        return forward_only(wp.vec3(1.0e6, 1.0e6, 1.0e6), target)
    return forward_only(f, target)


@wp.func
def side_distance(edit: EditData, n: int, entry: int, side: int, f: wp.vec3):
    """Signed distance to the posed cage, as one side of the cell above node n has it, at a place f of the cell."""
    total = float(0.0)
    for c in range(8):
        node = edit.nodes[corner_node(edit, n, c)]
        if entry != 0:
            node = edit.sides[entry // 8 + side, c]
        total += corner_share(c, f) * node[3]
    return total


@wp.func
def met_place(edit: EditData, n: int, entry: int, side: int, corners: mat83, target: wp.vec3):
    """The place of the cell above node n that the map takes to `target`, in cells of the rest lattice, and its signed
    distance to the posed cage; 1e6 where there is none. The nearest side of a cell decides where its map leads."""
    f = place_in_cell(corners, target)
    distance = float(1.0e6)
    if wp.min(f) >= -CELL_MARGIN and wp.max(f) <= 1.0 + CELL_MARGIN:
        distance = side_distance(edit, n, entry, side, f)
        for other in range(entry % 8):
            if side_distance(edit, n, entry, other, f) < distance:
                return forward_only(wp.vec4(1.0e6, 1.0e6, 1.0e6, 1.0e6), target)
    return forward_only(wp.vec4(f[0], f[1], f[2], distance), target)


@wp.func
def has_matter_near(grid: VoxelGrid, edit: EditData, node: wp.vec3):
    """Whether there is matter within a cell of the rest lattice around one of its nodes."""
    size = grid.voxel_size
    empty = empty_distance(grid, grid_position(grid, edit.rest.lower + edit.rest.spacing * node))
    return float(empty - 1) * wp.min(size) <= edit.rest.spacing


@wp.kernel(cuda_max_registers=128)
def scatter_cells(
    first: int,
    edit: EditData,
    cells: wp.array3d(dtype=wp.uint8),
    grid: VoxelGrid,
    owners: wp.array3d(dtype=int),
    folds: wp.array(dtype=int),
):
    """Each cell of the posed lattice puts its number down at the nodes of the rest lattice in its image; the lowest
    stays. An item a cell, all on one thread of a CPU. cells: CELL_... flags; grid: its `skip` marks where matter is."""
    # owners: (nx, ny, nz) of the rest lattice, NO_CELL before: n, or n plus the number of posed nodes out of the posed
    # cage. folds: (1,) becomes 1 where the map turns matter over, into several places, or squeezes it too much to look.
    i, j, k = grid_place(first + wp.tid(), cells.shape[1], cells.shape[2])
    if (int(cells[i, j, k]) & CELL_OUTSIDE) != 0:
        return
    n = (i * edit.node_counts[1] + j) * edit.node_counts[2] + k
    entry = entry_of_sides(edit, n)
    for side in range(wp.max(entry % 8, 1)):
        corners = cell_corners(edit, n, entry, side)
        lower = corners[0]
        upper = corners[0]
        for c in range(1, 8):
            lower = wp.min(lower, corners[c])
            upper = wp.max(upper, corners[c])
        begin = wp.vec3i()
        end = wp.vec3i()
        for axis in range(3):
            begin[axis] = int(wp.ceil(wp.max(lower[axis] - CELL_MARGIN, 0.0)))
            end[axis] = int(wp.floor(wp.min(upper[axis] + CELL_MARGIN, float(owners.shape[axis] - 1)))) + 1
        size = wp.vec3(float(end[0] - begin[0]), float(end[1] - begin[1]), float(end[2] - begin[2]))
        if wp.min(size) > 0.0 and size[0] * size[1] * size[2] > float(MAX_NODES):
            folds[0] = 1
            return
        for a in range(begin[0], end[0]):
            for b in range(begin[1], end[1]):
                for c in range(begin[2], end[2]):
                    target = wp.vec3(float(a), float(b), float(c))
                    met = met_place(edit, n, entry, side, corners, target)
                    if met[3] < 1.0e6:
                        claim = int(n)
                        if met[3] > edit.tolerance:
                            claim += edit.nodes.shape[0]
                        elif wp.determinant(corner_slope(corners, wp.vec3(met[0], met[1], met[2]))) <= 0.0:
                            if has_matter_near(grid, edit, target):
                                folds[0] = 1
                        wp.atomic_min(owners, a, b, c, claim)


@wp.kernel(cuda_max_registers=128)
def gather_inverse(first: int, edit: EditData, owners: wp.array3d(dtype=int), places: wp.array3d(dtype=wp.vec4)):
    """Where each node of the rest lattice is in the posed scene, in cells of the posed lattice, with 1; 0 where no cell
    of the posed lattice leads to it. places: as owners, which become NO_CELL again."""
    i, j, k = grid_place(first + wp.tid(), owners.shape[1], owners.shape[2])
    place = wp.vec4(0.0, 0.0, 0.0, 0.0)
    n = owners[i, j, k]
    if n != NO_CELL:
        owners[i, j, k] = NO_CELL
        n = n % edit.nodes.shape[0]
        entry = entry_of_sides(edit, n)
        f = wp.vec3(0.5, 0.5, 0.5)
        for side in range(wp.max(entry % 8, 1)):
            corners = cell_corners(edit, n, entry, side)
            met = met_place(edit, n, entry, side, corners, wp.vec3(float(i), float(j), float(k)))
            if met[3] < 1.0e6:
                f = wp.vec3(met[0], met[1], met[2])
        f = wp.max(wp.min(f, wp.vec3(1.0, 1.0, 1.0)), wp.vec3(0.0, 0.0, 0.0))
        nz = edit.node_counts[2]
        cell = wp.vec3(float(n // (edit.node_counts[1] * nz)), float((n // nz) % edit.node_counts[1]), float(n % nz))
        place = wp.vec4(cell[0] + f[0], cell[1] + f[1], cell[2] + f[2], 1.0)
    places[i, j, k] = place
