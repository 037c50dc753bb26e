"""Edits on lattices as fast marches read them: flat arrays, nodes of four numbers, and one table of cells."""

# The map of "Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1.

import warp as wp

from ..core.entries import trilinear_entry
from ..lattice.cage_map import CageMap
from .crumbs import CrumbCells

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: `look` holds the flags of a cell that must be looked at, or this and the distance to the nearest such cell.
LOOK_SKIP = wp.constant(64)


@wp.struct
class FlatEdit:
    """A LatticeEdit with flat arrays: node (i, j, k), and the cell above it, is at (i * ny + j) * nz + k."""

    lower: wp.vec3  # position of node (0, 0, 0)
    inverse_spacing: float
    spacing: float  # world units
    node_counts: wp.vec3i
    nodes: wp.array(dtype=wp.vec4)  # canonical position and signed distance
    polynomials: wp.array(dtype=wp.vec4)  # the map again, by cells (deform/map_cells); marches for one edit read it
    look: wp.array(dtype=wp.uint8)  # (nodes,) of the cell above each; the last of an axis have none
    fine_bits: int  # 2^fine_bits fine cells along each side of a cell are told apart
    last_fine: wp.vec3i  # number of the last one along each axis
    fine_width: float  # of one, in cells
    fine_size: float  # world units
    inverse_fine_size: float
    fine_look: wp.array(dtype=wp.uint8)  # (8^fine_bits * nodes,) as `look`, distances in fine cells
    by_nodes: int  # 1: its cells have no polynomials
    has_sides: int  # 1: there are cells at narrow gaps of the cage with corner values for each side (see CageMap)
    side_index: wp.array(dtype=int)
    sides: wp.array2d(dtype=wp.vec4)
    rest: CageMap
    tolerance: float
    slack: float
    keeps_source: int
    removes: int
    all_outside: int  # CELL_OUTSIDE if no place is mapped, as the edit removes; else 0
    carried_below: float  # rest distance of what shades have in the layer of matter that goes with the pose
    crumbs: CrumbCells  # only the march through several edits knows them


@wp.func
def entry_of_sides(edit: FlatEdit, n: int):
    """Entry of the table of sides for the cell above node n, 0 for none; see lattice/cage_map."""
    entry = int(0)
    if edit.has_sides == 1:
        entry = edit.side_index[n]
    return entry


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
    k = n % node_counts[2]
    j = (n // node_counts[2]) % node_counts[1]
    i = n // (node_counts[2] * node_counts[1])
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


@wp.func
def rest_distance(edit: FlatEdit, x: wp.vec3):
    """lattice/cage_map.map_distance of the rest cage."""
    rest = edit.rest
    return trilinear_entry(rest.distance, (x - rest.lower) * rest.inverse_spacing, 4.0 * rest.spacing)


@wp.func
def cell_exit(g: wp.vec3, inverse_rate: wp.vec3, reach: int):
    """field/samples.exit_distance with the divisions done once per ray."""
    leave = float(1.0e30)
    for axis in range(3):
        cell = wp.floor(g[axis])
        plane = wp.where(inverse_rate[axis] > 0.0, cell + float(reach), cell - float(reach) + 1.0)
        leave = wp.min(leave, (plane - g[axis]) * inverse_rate[axis])
    return leave
