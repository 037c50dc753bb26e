"""Edits on lattices as fast marches read them: flat arrays, nodes of four numbers, and one table of cells."""

import warp as wp

from ..core.loads import trilinear_entry
from ..lattice.cage_map import CageMap
from ..mesh.triangle import Walls

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class FragmentCells:
    """The cells between voxels that fragments lie in. `marks` without entries: there are none."""

    lower: wp.vec3  # position of the voxel at the lower corner of cell (0, 0, 0)
    inverse_voxel_size: wp.vec3
    marks: wp.array3d(dtype=wp.uint8)  # 1 where any of a cell's eight corners is a voxel of a fragment


@wp.func
def in_fragments(fragments: FragmentCells, x: wp.vec3):
    """Whether a point of the scene at rest lies in a cell that holds any of a fragment."""
    if fragments.marks.shape[0] == 0:
        return False
    g = wp.cw_mul(x - fragments.lower, fragments.inverse_voxel_size)
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    found = bool(False)
    if i >= 0 and j >= 0 and k >= 0:
        if i < fragments.marks.shape[0] and j < fragments.marks.shape[1] and k < fragments.marks.shape[2]:
            found = fragments.marks[i, j, k] != wp.uint8(0)
    return found


UNCHANGED = wp.constant(0)

CLEARED = wp.constant(1)

MAPPED = wp.constant(2)

#: Flags of a lattice cell: all in the deformed cage, all out of it, all mapped into the rest cage, turned over, and
#: steps that may be longer in canonical space than CUT_LENGTH times their length.
CELL_INSIDE = wp.constant(1)

CELL_OUTSIDE = wp.constant(2)

CELL_STAYS = wp.constant(4)

CELL_FOLDED = wp.constant(8)

CELL_STEEP = wp.constant(16)

#: Of several edits: all of a cell is mapped to where no earlier edit has anything.
CELL_ALONE = wp.constant(32)

#: A lattice reaches so many cells beyond the cage that it lies over, on each side, and its map does nothing there.
LATTICE_BORDER = wp.constant(2.0)

#: Both at once: not all in the cage, and what is out of it may be a fragment that the edit carries along.
CELL_CARRIES = wp.constant(3)

#: A sample that is this many steps long in canonical space is cut into several.
CUT_LENGTH = wp.constant(1.5)


@wp.struct
class LatticeEdit:
    """An edit whose map and distances are looked up on lattices."""

    deformed: CageMap  # distance to the deformed cage, positions in the rest cage
    rest: CageMap  # distance to the rest cage; its positions are not used
    tolerance: float  # a point counts as inside the deformed cage up to this distance
    slack: float  # a mapped point counts as inside the rest cage up to this distance
    keeps_source: int  # 1: the rest cage is not cleared
    removes: int  # 1: nothing is drawn in the deformed cage
    fragments: FragmentCells  # they count as in the rest cage
    cells: wp.array3d(dtype=wp.uint8)  # lattice cell -> CELL_... flags of the cases that it settles as a whole
    skip: wp.array3d(dtype=wp.uint8)  # lattice cell -> Chebyshev distance to the nearest that may hold anything


@wp.struct
class CellTable:
    """CELL_... flags of the cells of a lattice over a cage, and how far beyond there is anything to see."""

    lower: wp.vec3  # position of node (0, 0, 0)
    spacing: float
    flags: wp.array3d(dtype=wp.uint8)  # CELL_INSIDE and CELL_OUTSIDE hold exactly; without either points are tested
    skip: wp.array3d(dtype=wp.uint8)  # as LatticeEdit.skip


@wp.struct
class ExactEdit:
    """An edit whose coordinates are evaluated at every point."""

    deformed_vertices: wp.array(dtype=wp.vec3)
    rest_vertices: wp.array(dtype=wp.vec3)
    rest_normals: wp.array(dtype=wp.vec3)  # (f,) stretched, for Green coordinates
    faces: wp.array(dtype=wp.vec3i)
    fans: wp.array(dtype=wp.vec4)  # of the deformed cage: see mesh/fans
    quads: wp.array(dtype=wp.vec4i)  # of cages of quads, for mean value coordinates: what stands in for faces
    planes: wp.array(dtype=wp.vec4)  # see coordinates/quad_mean_value
    deformed_cells: CellTable
    rest_cells: CellTable  # its `skip` is not used
    walls: Walls  # the map fades to the identity towards them
    fragments: FragmentCells  # they count as in the rest cage
    carried: CageMap  # the map on a lattice, where cells carry fragments
    size: float  # longest side of the deformed cage
    is_green: int  # 1: Green, 0: mean value
    is_of_quads: int  # 1: mean value of `quads`
    tolerance: float
    slack: float
    keeps_source: int
    removes: int


#: `look` holds the flags of a cell that must be looked at, or this and the distance to the nearest such cell.
LOOK_SKIP = wp.constant(64)


@wp.struct
class EditData:
    """A LatticeEdit with flat arrays: node (i, j, k), and the cell above it, is at (i * ny + j) * nz + k."""

    lower: wp.vec3  # position of node (0, 0, 0)
    inverse_spacing: float
    spacing: float  # world units
    node_counts: wp.vec3i
    nodes: wp.array(dtype=wp.vec4)  # canonical position and signed distance
    polynomials: wp.array(dtype=wp.vec4)  # the map again, by cells (edits/nodes); marches for one edit read it
    look: wp.array(dtype=wp.uint8)  # (nodes,) of the cell above each; the last of an axis have none
    fine_bits: int  # there are 2^fine_bits fine cells along each side of a cell
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
    carried_below: float  # samples below this rest distance read the colours of the carried layer
    fragments: FragmentCells  # only the march through several edits reads them


@wp.func
def entry_of_sides(edit: EditData, n: int):
    """Entry of the table of sides for the cell above node n, 0 for none; see lattice/cage_map."""
    entry = int(0)
    if edit.has_sides == 1:
        entry = edit.side_index[n]
    return entry


@wp.func
def rest_distance(edit: EditData, x: wp.vec3):
    """lattice/cage_map.map_distance of the rest cage."""
    rest = edit.rest
    return trilinear_entry(rest.distance, (x - rest.lower) * rest.inverse_spacing, 4.0 * rest.spacing)


@wp.func
def cell_exit(g: wp.vec3, inverse_rate: wp.vec3, reach: int):
    """field/grid.exit_distance with the divisions done once per ray."""
    leave = float(1.0e30)
    for axis in range(3):
        cell = wp.floor(g[axis])
        plane = wp.where(inverse_rate[axis] > 0.0, cell + float(reach), cell - float(reach) + 1.0)
        leave = wp.min(leave, (plane - g[axis]) * inverse_rate[axis])
    return leave


@wp.func
def table_upper(table: CellTable):
    """Upper corner of the box of a table of cells."""
    shape = wp.vec3(float(table.skip.shape[0]), float(table.skip.shape[1]), float(table.skip.shape[2]))
    return table.lower + table.spacing * shape


@wp.func
def lattice_lower(edit: LatticeEdit):
    """Lower corner of the box of an edit's lattice."""
    return edit.deformed.lower


@wp.func
def lattice_upper(edit: LatticeEdit):
    """Upper corner of the box of an edit's lattice."""
    shape = wp.vec3(float(edit.skip.shape[0]), float(edit.skip.shape[1]), float(edit.skip.shape[2]))
    return edit.deformed.lower + edit.deformed.spacing * shape


@wp.func
def lattice_lower(edit: ExactEdit):  # noqa: F811 (a Warp overload)
    return edit.deformed_cells.lower


@wp.func
def lattice_upper(edit: ExactEdit):  # noqa: F811
    return table_upper(edit.deformed_cells)
