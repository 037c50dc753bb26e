"""CageEdit, and the buffers by which kernels resolve a list of edits: lattices, or closed forms at every sample."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..coordinates.deform import stretched_normals
from ..core.devices import launch, load_modules
from ..kernels.deform import cells as edit_cells
from ..kernels.deform import points_precise as precise_points
from ..kernels.deform import render_precise as precise_render
from ..kernels.deform import settled_cells
from ..kernels.deform.cells import mark_edit_cases, mark_edit_cells
from ..kernels.deform.edits import CellTable, ClosedFormEdit, LatticeEdit
from ..kernels.deform.points import map_points
from ..kernels.deform.render import render_edits
from ..kernels.deform.render_single import SingleEdit, join_cell_tables, render_edit
from ..kernels.field import skip as grid_skip
from ..kernels.field.skip import spread_distance
from ..kernels.lattice import closed_form as closed_form_map
from ..kernels.lattice import corrections as map_corrections
from ..kernels.lattice import crossings, gap_sides, harmonic, harmonic_coarse, narrow_gaps
from ..kernels.lattice import cut_rows as harmonic_rows
from ..kernels.lattice import distance as distance_band
from ..kernels.lattice import nodes as node_levels
from ..kernels.lattice import rings as map_extension
from ..kernels.lattice import side_values as map_sides
from ..kernels.lattice.cage_map import CageMap
from ..kernels.mesh import fans as face_fans
from ..lattice.lattice import CageLattice
from ..lattice.position_map import PositionMap
from ..mesh.containment import SURFACE_TOLERANCE
from ..mesh.fans import prepared_fans
from ..mesh.usable import require_usable

#: How far the map may lead out of the rest cage before a sample counts as outside, in cells of the rest cage's lattice:
#: the trilinear signed distance errs by up to half a cell at corners.
LATTICE_SLACK = 0.5

#: The same where distances are exact, as a share of the cage's size: float32 evaluates the maps to about 1e-5.
CLOSED_FORM_SLACK = 1e-4

#: Cells of the lattice that tells the closed forms what they can leave out, along the longest side of a cage, and how
#: much larger than a cell the box is that must show nothing, in cells.
GUIDE_RESOLUTION, GUIDE_MARGIN = 96, 0.5

#: Edits of one scene; a sample's way through them is kept in the bits of an int.
MAX_EDITS = 31


@dataclasses.dataclass(frozen=True)
class CageEdit:
    """One edit of a scene: what is in `cage` goes where the posed cage is.

    cage: the cage at rest. keep_source: leave a copy where it was (a duplicate). remove: draw nothing in its place (it
    is deleted; no pose is needed).
    Raises ValueError for both at once, or a cage that cannot be used.
    """

    cage: Cage
    keep_source: bool = False
    remove: bool = False

    def __post_init__(self):
        if not isinstance(self.cage, Cage):
            raise ValueError(f"an edit needs a Cage, got {type(self.cage).__name__}")
        if self.keep_source and self.remove:
            raise ValueError("an edit that removes its cage's content cannot keep the source: choose one")
        require_usable(self.cage, "the rest cage")


def checked_edits(rest) -> list[CageEdit]:
    """A Cage, a CageEdit or a list of either as a list of CageEdit. Raises ValueError for anything else."""
    edits = [rest] if isinstance(rest, Cage | CageEdit) else list(rest)
    edits = [edit if isinstance(edit, CageEdit) else CageEdit(edit) for edit in edits]
    if not 1 <= len(edits) <= MAX_EDITS:
        raise ValueError(f"a Deformer takes 1 to {MAX_EDITS} edits, got {len(edits)}")
    return edits


class LatticeEdits:
    """Edits whose maps and signed distances are looked up on lattices of `resolution` cells, and the cells to skip.

    origin: (3,) world point that device positions are relative to. render_modules: kernels (Python modules) that frames
    will need, if not those of this class's own.
    """

    map_kernel = map_points

    def __init__(
        self,
        edits: list[CageEdit],
        coordinates: str,
        resolution: int,
        origin,
        device,
        store: str = "map",
        *,
        render_modules: list | None = None,
    ):
        self.device = device
        self._edits = edits
        self.render_kernel = render_edit if len(edits) == 1 else render_edits
        if render_modules is None:
            render_modules = [sys.modules[self.render_kernel.module.name]]
        load_modules(_pose_modules(coordinates) + render_modules, device)
        self._rests = [CageLattice(edit.cage, resolution, origin=origin, device=device) for edit in edits]
        self._maps = [
            None
            if edit.remove
            else PositionMap(
                edit.cage, coordinates=coordinates, resolution=resolution, origin=origin, device=device, store=store
            )
            for edit in edits
        ]
        self._cells: list[wp.array] = []
        self._skips: list[wp.array] = []
        self._look: wp.array | None = None
        self.array: wp.array | None = None  #: (edit_count,) LatticeEdit
        self.scene = None  #: what the render kernel takes, once prepared: the one edit, or the array of all
        self._marked_step = 0.0

    def pose(self, cages: list[Cage | None]) -> None:
        """Compute the maps from the deformed cages (None where the edit removes)."""
        structs = []
        for edit, rest, position_map, cage in zip(self._edits, self._rests, self._maps, cages, strict=True):
            struct = LatticeEdit()
            struct.rest = _distance_map(rest)
            struct.deformed = struct.rest if position_map is None else position_map.pose(cage).data
            struct.tolerance = SURFACE_TOLERANCE * (edit.cage if cage is None else cage).size
            struct.slack = LATTICE_SLACK * rest.spacing
            struct.keeps_source, struct.removes = int(edit.keep_source), int(edit.remove)
            structs.append(struct)
        self._cells = [self._cell_buffer(self._cells, i, struct) for i, struct in enumerate(structs)]
        self._skips = [self._cell_buffer(self._skips, i, struct) for i, struct in enumerate(structs)]
        for struct, cells, skip in zip(structs, self._cells, self._skips, strict=True):
            struct.cells, struct.skip = cells, skip
            launch(mark_edit_cases, cells.size, [struct], [cells], device=self.device)
        self.scene = None
        self._structs = structs  # they own what the device array points to
        self.array = wp.array(structs, dtype=LatticeEdit, device=self.device)
        self._marked_step = 0.0

    def _cell_buffer(self, held: list[wp.array], index: int, struct: LatticeEdit) -> wp.array:
        """One byte for each lattice cell of an edit; the array of the last pose where that fits."""
        shape = tuple(side - 1 for side in struct.deformed.distance.shape)
        if index < len(held) and held[index].shape == shape:
            return held[index]
        return wp.empty(shape, dtype=wp.uint8, device=self.device)

    def rest_maps(self) -> list[CageMap]:
        """The signed distances to the rest cages, one an edit."""
        return [_distance_map(rest) for rest in self._rests]

    def posed(self) -> list[tuple[LatticeEdit, wp.array]]:
        """The posed edits, and the array in which `prepare` leaves what may be skipped."""
        return list(zip(self._structs, self._skips, strict=True))

    def prepare(self, grid, step: float) -> None:
        """Find the cells that a march of `step` (world units) through the deformed `grid` may skip; once a pose."""
        if step <= self._marked_step:
            return
        for index, skip in enumerate(self._skips):  # in order: each looks at the ones before it
            marks = wp.empty_like(skip)
            launch(mark_edit_cells, skip.size, [grid, self.array, index, step], [marks], device=self.device)
            source, target = marks, skip
            for axis in range(3):
                launch(spread_distance, skip.size, [axis, source], [target], device=self.device)
                source, target = target, source
        self._marked_step = step
        self.scene = self._single_edit() if len(self._edits) == 1 else self.array

    def _single_edit(self) -> SingleEdit:
        """The one edit of a scene as its own kernel takes it."""
        edit, single = self._structs[0], SingleEdit()
        shape = edit.deformed.distance.shape
        single.lower, single.inverse_spacing = edit.deformed.lower, edit.deformed.inverse_spacing
        single.node_counts = wp.vec3i(*shape)
        single.distance = edit.deformed.distance.flatten()
        if not edit.removes:
            single.positions = edit.deformed.positions.flatten()
        if self._look is None or self._look.size != single.distance.size:
            self._look = wp.zeros(single.distance.size, dtype=wp.uint8, device=self.device)
        single.look, single.rest = self._look, edit.rest
        side_index = edit.deformed.side_index
        single.has_sides = int(side_index is not None and side_index.size > 0)
        if single.has_sides:
            single.side_index, single.sides = side_index, edit.deformed.sides
        single.tolerance, single.slack = edit.tolerance, edit.slack
        single.keeps_source, single.removes = edit.keeps_source, edit.removes
        launch(
            join_cell_tables,
            edit.cells.size,
            [edit.cells, edit.skip, single.node_counts],
            [single.look],
            device=self.device,
        )
        return single


class ClosedFormEdits:
    """Edits whose mean value or Green coordinates are evaluated at every sample ("precise").

    A lattice map of the same coordinates finds the cells where that can be left out: those that are clear of a cage,
    and those that show nothing.
    """

    def __init__(self, edits: list[CageEdit], coordinates: str, origin, device):
        self.map_kernel, self.render_kernel = precise_points.map_points_precisely, precise_render.render_precisely
        self._settle_cells = settled_cells.settle_deformed_cells
        self.device = device
        self._edits, self._origin, self._is_green = edits, origin, coordinates == "green"
        self._guide = LatticeEdits(
            edits, coordinates, GUIDE_RESOLUTION, origin, device, render_modules=[precise_render, settled_cells]
        )
        self._rest_cells = []
        for edit, rest in zip(edits, self._guide.rest_maps(), strict=True):
            table = _cell_table(rest, device)
            slack = CLOSED_FORM_SLACK * edit.cage.size
            launch(settled_cells.settle_rest_cells, table.flags.size, [rest, slack], [table.flags], device=device)
            self._rest_cells.append(table)
        self.array: wp.array | None = None  #: (edit_count,) ClosedFormEdit

    def pose(self, cages: list[Cage | None]) -> None:
        """Upload the deformed cages (None where the edit removes)."""
        self._guide.pose(cages)
        self._structs = [
            self._struct(edit, edit.cage if cage is None else cage, rest_cells, guide, skip)
            for edit, cage, rest_cells, (guide, skip) in zip(
                self._edits, cages, self._rest_cells, self._guide.posed(), strict=True
            )
        ]
        self.array = wp.array(self._structs, dtype=ClosedFormEdit, device=self.device)

    def _struct(self, edit: CageEdit, deformed: Cage, rest_cells, guide: LatticeEdit, skip) -> ClosedFormEdit:
        rest = edit.cage
        struct = ClosedFormEdit()
        struct.deformed_vertices = self._local(deformed.vertices)
        struct.rest_vertices = self._local(rest.vertices)
        fans = rest.topology.fans
        struct.faces = wp.array(fans.faces, dtype=wp.vec3i, device=self.device)
        struct.fans = prepared_fans(struct.deformed_vertices, struct.faces, deformed.size)
        if self._is_green:
            normals = stretched_normals(deformed, rest)[fans.order].astype(np.float32)
            struct.rest_normals = wp.array(normals, dtype=wp.vec3, device=self.device)
        struct.size = deformed.size
        struct.tolerance = SURFACE_TOLERANCE * deformed.size
        struct.slack = CLOSED_FORM_SLACK * rest.size
        struct.deformed_cells = _cell_table(guide.deformed, self.device)
        struct.deformed_cells.skip = skip
        launch(self._settle_cells, skip.size, [guide], [struct.deformed_cells.flags], device=self.device)
        struct.rest_cells = rest_cells
        struct.is_green = int(self._is_green)
        struct.keeps_source, struct.removes = int(edit.keep_source), int(edit.remove)
        return struct

    @property
    def scene(self) -> wp.array:
        """What the render kernel takes: the array of all edits."""
        return self.array

    def _local(self, vertices: np.ndarray) -> wp.array:
        return wp.array((vertices - self._origin).astype(np.float32), dtype=wp.vec3, device=self.device)

    def prepare(self, grid, step: float) -> None:
        """Find the cells that a march of `step` (world units) may skip; once a pose. They are taken half a cell larger,
        as the lattice's map is only near the exact one."""
        self._guide.prepare(grid, step + GUIDE_MARGIN * max(guide.deformed.spacing for guide, _ in self._guide.posed()))


def _cell_table(cage_map: CageMap, device) -> CellTable:
    """An empty table over the cells of a map."""
    table = CellTable()
    table.lower, table.spacing = cage_map.lower, cage_map.spacing
    shape = tuple(side - 1 for side in cage_map.distance.shape)
    table.flags = wp.empty(shape, dtype=wp.uint8, device=device)
    return table


def _pose_modules(coordinates: str) -> list:
    """Modules of the kernels that posing edits launches."""
    solver = {
        "harmonic": [harmonic, harmonic_coarse, harmonic_rows],
        "mean_value": [closed_form_map, face_fans, harmonic_rows, map_corrections],
        "green": [closed_form_map, face_fans],
    }[coordinates]
    gaps = [narrow_gaps, gap_sides, map_sides]
    return [crossings, distance_band, node_levels, map_extension, edit_cells, grid_skip, *solver, *gaps]


def _distance_map(lattice: CageLattice) -> CageMap:
    """A CageMap that holds distances only."""
    data = CageMap()
    data.lower = lattice.local_lower
    data.spacing = lattice.spacing
    data.inverse_spacing = 1.0 / lattice.spacing
    data.distance = lattice.distance
    return data
