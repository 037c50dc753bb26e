"""Where a pose takes the matter of a rest cage: the map of a posed cage, inverted at the nodes of the rest cage's
lattice."""

import warp as wp

from ..core.gradients import forward_only_in
from ..core.lanes import grid_place, lowest_bit, without_lowest_bit
from ..field.grid import VoxelGrid, empty_distance, grid_position
from ..lattice.cage_map import corner_share
from .structs import CELL_OUTSIDE, EditData, entry_of_sides

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})

mat83 = wp.types.matrix(shape=(8, 3), dtype=wp.float32)

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3), (wp.vec4, wp.vec3), (mat83, mat83))

#: Of Newton's method in a trilinear cell, at most, and a step, in cells, that is the last one: the next would be about
#: its square. From the middle two or three are enough where the cell is not folded.
NEWTON_STEPS = wp.constant(6)

LAST_STEP = wp.constant(1.0e-3)

#: A node counts as in a cell up to this far beyond its faces, and as met up to this far, in cells.
CELL_MARGIN = wp.constant(1.0e-3)

#: A cell whose image holds more nodes than this, which one thread would look through, is squeezed beyond all use.
MAX_NODES = wp.constant(4096)

#: Nodes that a thread looks through at a time.
NODE_BITS = wp.constant(32)

#: No cell's number.
NO_CELL = wp.constant(2147483647)


@wp.func
def corner_node(edit: EditData, n: int, corner: int):
    """Node of the posed lattice at a corner of the cell above node n."""
    nz = edit.node_counts[2]
    return n + (corner >> 2) * edit.node_counts[1] * nz + ((corner >> 1) & 1) * nz + (corner & 1)


@wp.func
def cell_terms(corners: mat83):
    """A trilinear cell about its middle, of values at its corners: row c is the term of the product of the axes that
    bits 4, 2 and 1 of c stand for; row 0 is the value at the middle."""
    terms = corners
    for axis in range(3):
        bit = 4 >> axis
        for c in range(8):
            if (c & bit) == 0:
                low = terms[c]
                high = terms[c + bit]
                terms[c] = 0.5 * (low + high)
                terms[c + bit] = high - low
    return forward_only(terms, corners)


@wp.func
def image_terms(edit: EditData, n: int, entry: int, side: int):
    """The cell_terms of the image of the cell above node n of the posed lattice, in cells of the rest lattice."""
    corners = mat83()
    for c in range(8):
        node = edit.nodes[corner_node(edit, n, c)]
        if entry != 0:
            node = edit.sides[entry // 8 + side, c]
        corners[c] = (wp.vec3(node[0], node[1], node[2]) - edit.rest.lower) * edit.rest.inverse_spacing
    return cell_terms(corners)


@wp.func
def cell_value(terms: mat83, f: wp.vec3):
    """Trilinear value at a place f, 0 to 1, of a cell."""
    x = f[0] - 0.5
    y = f[1] - 0.5
    z = f[2] - 0.5
    edge = terms[4] + y * terms[6] + z * terms[5] + (y * z) * terms[7]
    return terms[0] + y * terms[2] + z * terms[1] + (y * z) * terms[3] + x * edge


@wp.func
def cell_slope(terms: mat83, f: wp.vec3):
    """Derivative of cell_value; its columns belong to the axes of f."""
    x = f[0] - 0.5
    y = f[1] - 0.5
    z = f[2] - 0.5
    return wp.matrix_from_cols(
        terms[4] + y * terms[6] + z * terms[5] + (y * z) * terms[7],
        terms[2] + x * terms[6] + z * terms[3] + (x * z) * terms[7],
        terms[1] + x * terms[5] + y * terms[3] + (x * y) * terms[7],
    )


@wp.func
def place_in_cell(terms: mat83, target: wp.vec3):
    """The place f of a cell with cell_value = target, 0 to 1; 1e6 where there is none near."""
    f = wp.vec3(0.5, 0.5, 0.5)
    step = int(0)
    while step < NEWTON_STEPS:  # not unrolled: a GPU waits for instructions where a kernel is long
        step += 1
        slope = cell_slope(terms, f)
        if wp.abs(wp.determinant(slope)) < 1.0e-9:
            return forward_only(wp.vec3(1.0e6, 1.0e6, 1.0e6), target)
        change = wp.inverse(slope) * (target - cell_value(terms, f))
        if wp.length_sq(change) < LAST_STEP * LAST_STEP:
            step = int(NEWTON_STEPS)
        f += change
        f = wp.max(wp.min(f, wp.vec3(2.0, 2.0, 2.0)), wp.vec3(-1.0, -1.0, -1.0))
    if wp.length(cell_value(terms, f) - target) > CELL_MARGIN:
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
def met_place(edit: EditData, n: int, entry: int, side: int, terms: mat83, target: wp.vec3):
    """The place of the cell above node n that the map takes to `target`, in cells of the rest lattice, and its signed
    distance to the posed cage; 1e6 where there is none. The nearest side of a cell decides where its map leads."""
    f = place_in_cell(terms, target)
    distance = float(1.0e6)
    if wp.min(f) >= -CELL_MARGIN and wp.max(f) <= 1.0 + CELL_MARGIN:
        distance = side_distance(edit, n, entry, side, f)
        for other in range(entry % 8):
            if side_distance(edit, n, entry, other, f) < distance:
                return forward_only(wp.vec4(1.0e6, 1.0e6, 1.0e6, 1.0e6), target)
    return forward_only(wp.vec4(f[0], f[1], f[2], distance), target)


@wp.struct
class AffineCell:
    """A cell's map as it is at its middle, by which most targets out of the cell are known to be."""

    inverse: wp.mat33  # of its derivative
    reach: float  # from the middle, along each axis: beyond it by `inverse`, a target is out of the cell


@wp.func
def affine_cell(terms: mat83):
    """Of a trilinear cell; no reach where it has no inverse."""
    slope = cell_slope(terms, wp.vec3(0.5, 0.5, 0.5))
    cell = AffineCell()
    if wp.abs(wp.determinant(slope)) >= 1.0e-9:
        cell.inverse = wp.inverse(slope)
        pairs = wp.length(terms[3]) + wp.length(terms[5]) + wp.length(terms[6])
        bend = 0.26 * pairs + 0.13 * wp.length(terms[7]) + CELL_MARGIN  # a quarter, an eighth: products of halves
        cell.reach = 0.5 + CELL_MARGIN + wp.sqrt(wp.ddot(cell.inverse, cell.inverse)) * bend
    return cell


@wp.func
def box_node(begin: wp.vec3i, size: wp.vec3i, n: int):
    """The n-th node of a box of nodes."""
    i, j, k = grid_place(n, size[1], size[2])
    return wp.vec3(float(begin[0] + i), float(begin[1] + j), float(begin[2] + k))


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
        terms = image_terms(edit, n, entry, side)
        half = wp.vec3(0.0, 0.0, 0.0)
        for c in range(1, 8):
            half += wp.abs(terms[c]) * wp.where(c == 7, 0.125, wp.where(c == 1 or c == 2 or c == 4, 0.5, 0.25))
        begin = wp.vec3i()
        size = wp.vec3i()
        for axis in range(3):
            begin[axis] = int(wp.ceil(wp.max(terms[0][axis] - half[axis] - CELL_MARGIN, 0.0)))
            top = wp.min(terms[0][axis] + half[axis] + CELL_MARGIN, float(owners.shape[axis] - 1))
            size[axis] = wp.max(int(wp.floor(top)) + 1 - begin[axis], 0)
        if float(size[0]) * float(size[1]) * float(size[2]) > float(MAX_NODES):
            folds[0] = 1
            return
        # boxes hold one node to eight: threads look through those that are left together
        affine = affine_cell(terms)
        count = size[0] * size[1] * size[2]
        first_node = int(0)
        while first_node < count:
            near = int(0)
            bit = int(0)
            while bit < wp.min(count - first_node, NODE_BITS):
                way = affine.inverse * (box_node(begin, size, first_node + bit) - terms[0])
                if wp.max(wp.abs(way)) <= affine.reach:
                    near = near | (1 << bit)
                bit += 1
            while near != 0:
                target = box_node(begin, size, first_node + lowest_bit(near))
                near = without_lowest_bit(near)
                met = met_place(edit, n, entry, side, terms, target)
                if met[3] < 1.0e6:
                    claim = int(n)
                    if met[3] > edit.tolerance:
                        claim += edit.nodes.shape[0]
                    elif wp.determinant(cell_slope(terms, wp.vec3(met[0], met[1], met[2]))) <= 0.0:
                        if has_matter_near(grid, edit, target):
                            folds[0] = 1
                    wp.atomic_min(owners, int(target[0]), int(target[1]), int(target[2]), claim)
            first_node += NODE_BITS


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
            terms = image_terms(edit, n, entry, side)
            met = met_place(edit, n, entry, side, terms, wp.vec3(float(i), float(j), float(k)))
            if met[3] < 1.0e6:
                f = wp.vec3(met[0], met[1], met[2])
        f = wp.max(wp.min(f, wp.vec3(1.0, 1.0, 1.0)), wp.vec3(0.0, 0.0, 0.0))
        nz = edit.node_counts[2]
        cell = wp.vec3(float(n // (edit.node_counts[1] * nz)), float((n // nz) % edit.node_counts[1]), float(n % nz))
        place = wp.vec4(cell[0] + f[0], cell[1] + f[1], cell[2] + f[2], 1.0)
    places[i, j, k] = place
