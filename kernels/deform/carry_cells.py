"""The lattice of an edit's map with room around it, and its cells that crumbs go through."""

# The map on a lattice is that of "Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1.

import warp as wp

from ..lattice.cage_map import CageMap, cell_sides
from .cells import jacobian_spread, largest_stretch, mat83, mean_jacobian
from .edits import CELL_CARRIES, CELL_FOLDED, CELL_INSIDE, CELL_STEEP, CUT_LENGTH, LatticeEdit

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def pad_nodes(
    first: int,
    cage_map: CageMap,
    before: wp.vec3i,
    positions: wp.array3d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
    side_index: wp.array(dtype=int),
):
    """A map's nodes in a larger lattice, `before` of whose nodes lie below the map's along each axis, the others far
    outside the cage. side_index: (nodes,), or (0,) for a map without sides."""
    n = first + wp.tid()
    k = n % positions.shape[2]
    j = (n // positions.shape[2]) % positions.shape[1]
    i = n // (positions.shape[2] * positions.shape[1])
    a = i - before[0]
    b = j - before[1]
    c = k - before[2]
    shape = cage_map.distance.shape
    position = wp.vec3(0.0, 0.0, 0.0)
    nearest = 4.0 * cage_map.spacing
    entry = int(0)
    if a >= 0 and b >= 0 and c >= 0 and a < shape[0] and b < shape[1] and c < shape[2]:
        position = cage_map.positions[a, b, c]
        nearest = cage_map.distance[a, b, c]
        if side_index.shape[0] > 0:
            entry = cage_map.side_index[(a * shape[1] + b) * shape[2] + c]
    positions[i, j, k] = position
    distance[i, j, k] = nearest
    if side_index.shape[0] > 0:
        side_index[n] = entry


@wp.kernel
def mark_boxes(
    first: int,
    low: wp.array(dtype=wp.vec3i),
    high: wp.array(dtype=wp.vec3i),
    depth: int,
    marks: wp.array3d(dtype=wp.uint8),
):
    """1 at the cells of boxes (n,), from the first cell to the last; boxes may overlap, so that the CPU takes one
    thread. `depth` items per box, each for one layer of at most so many."""
    item = first + wp.tid()
    n = item / depth
    i = low[n][0] + item % depth
    if i > high[n][0]:
        return
    for j in range(low[n][1], high[n][1] + 1):
        for k in range(low[n][2], high[n][2] + 1):
            marks[i, j, k] = wp.uint8(1)


@wp.kernel
def mark_carrying_cells(
    first: int, edit: LatticeEdit, marks: wp.array3d(dtype=wp.uint8), cells: wp.array3d(dtype=wp.uint8)
):
    """CELL_CARRIES at marked cells, and what else holds there, but for those wholly in the cage or at a narrow gap of
    it. `cells` holds what deform/cells.mark_edit_cases says. One item per cell."""
    n = first + wp.tid()
    k = n % cells.shape[2]
    j = (n // cells.shape[2]) % cells.shape[1]
    i = n // (cells.shape[2] * cells.shape[1])
    if marks[i, j, k] == wp.uint8(0):
        return
    if (int(cells[i, j, k]) & CELL_INSIDE) != 0 or cell_sides(edit.deformed, i, j, k) != 0:
        return
    corners = mat83()
    for c in range(8):
        corners[c] = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
    flags = CELL_CARRIES
    jacobian = mean_jacobian(corners) * edit.deformed.inverse_spacing
    if wp.determinant(jacobian) <= 0.0:
        flags = flags | CELL_FOLDED
    spread = jacobian_spread(corners, edit.deformed.spacing * jacobian) * edit.deformed.inverse_spacing
    if largest_stretch(jacobian) + spread > CUT_LENGTH:
        flags = flags | CELL_STEEP
    cells[i, j, k] = wp.uint8(flags)
