"""Lattice cells that lie on one side of a cage as a whole, where closed forms need not be evaluated."""

# What a "precise" march (see deform/views) looks up before it evaluates coordinates or winding numbers.

import warp as wp

from ..lattice.cage_map import CageMap, cell_sides
from .cells import jacobian_spread, largest_stretch, mat83, mean_jacobian
from .edits import CELL_CARRIES, CELL_FOLDED, CELL_INSIDE, CELL_OUTSIDE, CELL_STAYS, CELL_STEEP, LatticeEdit

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

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
    n = first + wp.tid()
    k = n % flags.shape[2]
    j = (n // flags.shape[2]) % flags.shape[1]
    i = n // (flags.shape[2] * flags.shape[1])
    flags[i, j, k] = wp.uint8(settled_case(rest, i, j, k, slack))


@wp.kernel
def settle_deformed_cells(first: int, edit: LatticeEdit, flags: wp.array3d(dtype=wp.uint8)):
    """The settled_case of each cell over the deformed cage, and what the lattice's map says of the inside ones:
    CELL_STAYS as the lattice has it, CELL_STEEP where it may be, CELL_FOLDED where the map may turn over somewhere."""
    n = first + wp.tid()
    k = n % flags.shape[2]
    j = (n // flags.shape[2]) % flags.shape[1]
    i = n // (flags.shape[2] * flags.shape[1])
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
