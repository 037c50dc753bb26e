"""Edits whose coordinates are evaluated at each sample, without a lattice: the precise mode of the paper."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..coordinates.coordinates import stretched_normals
from ..core.arrays import empty_array, local_points
from ..core.devices import launch
from ..core.names import coordinate_kind
from ..edits.edits import CageEdit
from ..edits.falloff import FalloffBand
from ..edits.fragments import CarriedFragments
from ..edits.maps import EditLattices, cell_shape
from ..field.render import FieldView
from ..kernels.edits import cell_tables, trace
from ..kernels.edits.structs import CellTable, ExactEdit
from ..kernels.render.views import exact_kernel
from ..mesh.mesh import prepared_fans, prepared_quads
from ..mesh.queries import SURFACE_TOLERANCE
from ..render.launch import FrameLauncher, frame_target, load_pose_modules
from ..render.view import PosedEdits
from ..view.frame import Frame

#: How far the map may lead out of the rest cage before a sample counts as outside, as a share of the cage's size:
#: float32 evaluates the maps to about 1e-5.
CLOSED_FORM_SLACK = 1e-4

#: Cells along the longest side of a cage of the lattice that finds where closed forms need not be evaluated, and how
#: much larger than a cell the box is that must be empty for that, in cells.
GUIDE_RESOLUTION, GUIDE_MARGIN = 96, 0.5


class ExactEdits(PosedEdits):
    """Edits whose mean value or Green coordinates are evaluated at every sample ("precise").
    bands, carried: one or None for each edit, () for none at all."""

    map_kernel = staticmethod(functools.partial(trace.map_kernel, True))

    # A lattice map of the same coordinates finds cells clear of a cage or that show nothing, and carries fragments.

    def __init__(
        self,
        edits: list[CageEdit],
        coordinates: str,
        origin: np.ndarray,
        device: wp.Device,
        bands: Sequence[FalloffBand | None] = (),
        carried: Sequence[CarriedFragments | None] = (),
    ):
        self.array, self.launcher = None, FrameLauncher(device)
        self._edits, self._origin, self._device = edits, origin, device
        self.sample_work = sum(len(edit.cage.faces) for edit in edits)  # each face is looked at
        self._is_green = coordinate_kind(coordinates).has_face_weights
        load_pose_modules(coordinates, [exact_kernel(), cell_tables], device)
        self._bands = list(bands) or [None] * len(edits)
        self.guide = EditLattices(edits, coordinates, GUIDE_RESOLUTION, origin, device, bands=bands, carried=carried)
        self._rest_cells = [
            settled_rest_cells(rest, CLOSED_FORM_SLACK * edit.cage.size, device)
            for edit, rest in zip(edits, self.guide.rest_maps(), strict=True)
        ]
        self._structs: list[Any] = []

    def pose(self, cages: Sequence[Cage | None]) -> None:
        self.guide.pose(cages)
        self._structs = [
            self._struct(edit, cage, band, rest_cells, settled_deformed_cells(guide, skip, self._device), guide)
            for edit, cage, band, rest_cells, (guide, skip) in zip(
                self._edits, cages, self._bands, self._rest_cells, self.guide.posed(), strict=True
            )
        ]
        self.array = wp.array(self._structs, dtype=ExactEdit, device=self._device)

    def prepare(self, grid: Any, step: float) -> None:
        # half a cell larger, as the lattice's map is only near the exact one
        margin = GUIDE_MARGIN * max(guide.deformed.spacing for guide, _ in self.guide.posed())
        self.guide.mark_empty(grid, step + margin)

    def render(self, view: FieldView, arc_opacity: int) -> Frame:
        marching = view.field.marching
        if not view.target.is_again:
            marching.begin()
        target = frame_target(view, arc_opacity)
        view.field.linked_grid()
        grid = marching.marched if view.target.is_again else marching.grid()
        self.prepare(grid, view.step)
        self.launcher.march(exact_kernel(), [grid, self.array], target, work=self.sample_work)
        return view.finished(target.arrays)

    def _struct(
        self,
        edit: CageEdit,
        cage: Cage | None,
        band: FalloffBand | None,
        rest_cells: Any,
        deformed_cells: Any,
        guide: Any,
    ) -> Any:
        """An edit for kernels, with the tables of its cells. guide: its LatticeEdit. cage: None for a removal."""
        rest, fans = edit.cage, edit.cage.topology.fans
        deformed = rest if cage is None else cage
        struct = ExactEdit()
        struct.deformed_vertices = local_points(deformed.vertices, self._origin, self._device)
        struct.rest_vertices = local_points(rest.vertices, self._origin, self._device)
        struct.faces = wp.array(fans.faces, dtype=wp.vec3i, device=self._device)
        struct.fans = prepared_fans(struct.deformed_vertices, struct.faces, deformed.size)
        if deformed.quads is not None and not self._is_green:
            struct.quads = wp.array(deformed.quads, dtype=wp.vec4i, device=self._device)
            struct.is_of_quads = 1
            struct.planes = prepared_quads(struct.deformed_vertices, struct.quads, deformed.size)
        if self._is_green:
            normals = stretched_normals(deformed, rest)[fans.order].astype(np.float32)
            struct.rest_normals = wp.array(normals, dtype=wp.vec3, device=self._device)
        if band is not None and cage is not None:
            struct.walls = band.on_device(cage, self._origin, self._device)
        struct.size = deformed.size
        struct.tolerance = SURFACE_TOLERANCE * deformed.size
        struct.slack = CLOSED_FORM_SLACK * rest.size
        struct.deformed_cells, struct.rest_cells = deformed_cells, rest_cells
        struct.fragments, struct.carried = guide.fragments, guide.deformed
        struct.is_green = int(self._is_green)
        struct.keeps_source, struct.removes = int(edit.keep_source), int(edit.remove)
        return struct


def settled_rest_cells(rest: Any, slack: float, device: wp.Device) -> Any:
    """The CellTable of where all of a cell of a CageMap lies on one side of its rest cage.
    Outside means farther than `slack` from the cage, world units."""
    table = cell_table(rest, device)
    launch(cell_tables.settle_rest_cells, table.flags.size, [rest, slack], [table.flags], device=device)
    return table


def settled_deformed_cells(guide: Any, skip: wp.array, device: wp.Device) -> Any:
    """The CellTable of what holds for whole cells over a deformed cage, whose posed LatticeEdit is `guide`.
    skip: (nx-1, ny-1, nz-1) uint8, how far each cell is from the nearest that may hold anything."""
    table = cell_table(guide.deformed, device)
    table.skip = skip
    launch(cell_tables.settle_deformed_cells, skip.size, [guide], [table.flags], device=device)
    return table


def cell_table(cage_map: Any, device: wp.Device) -> Any:
    """A CellTable over the cells of a CageMap, its flags not set yet."""
    table = CellTable()
    table.lower, table.spacing = cage_map.lower, cage_map.spacing
    table.flags = empty_array(cell_shape(cage_map), wp.uint8, device)
    return table
