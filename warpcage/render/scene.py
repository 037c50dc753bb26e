"""Edits on lattices that are posed and rendered: plans of views, tables kept from pose to pose, launches."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.arrays import struct_array
from ..core.devices import RecordedLaunches
from ..core.memory import free_bytes
from ..edits.apart import NOWHERE, EditBoxes, edit_boxes, front_to_back, wider
from ..edits.edits import CageEdit
from ..edits.falloff import FalloffBand
from ..edits.fragments import CarriedFragments
from ..edits.maps import EditLattices
from ..field import tables
from ..field.voxel_field import VoxelField
from ..kernels.edits import trace
from ..kernels.edits.structs import EditData
from ..kernels.render import march_cpu
from ..kernels.render.views import part_kernel, stack_kernel, view_kernel
from ..kernels.view.rays import TILE_SIZE
from ..lattice.buffers import BufferPool, SideStream
from .modules import load_pose_modules, render_modules
from .parts import PartsInTurn
from .shading import CarriedShades, shade_texture_bytes
from .tables import (
    FineCells,
    MapPolynomials,
    TileStarts,
    edit_data,
    join_tables,
    lattice_box,
    needs_general_map,
    tell_sides,
)
from .tile_order import BalancedTiles
from .view import PosedEdits, SeenView, ViewRequest

#: Rays from which on a view is one of many pixels.
LARGE_PICTURE = 1 << 20

#: Whether a pose on a CPU launches what views are likely to ask for, too: there nothing waits for the host.
LOOKS_AHEAD_ON_CPU = False

#: Sizes of a field at which it is seen from afar.
FAR = 4.0

#: Bytes a node that tables for views take, and the share of free memory that they may take before there is a view.
TABLE_BYTES, WARM_MEMORY = 192, 1 / 16

#: Lattices of fewer nodes have numbers left that say on which side of the posed cage a place is.
MOST_LATTICE_NODES = 1 << 30

#: Share of a GPU's memory that shades of a grid's nodes may take.
MOST_SHADES = 0.25


class Plan(NamedTuple):
    """How a view is marched."""

    parts: list[tuple[Any, np.ndarray]] | None  # EditData and box (2, 3) of edits, front to back; None: one kernel
    is_shaded: bool  # whether voxels are shaded for the view


class LatticeEdits(PosedEdits):
    """Edits on lattices, for the kernel of one edit or that of several; arguments as EditLattices has them."""

    def __init__(
        self,
        edits: list[CageEdit],
        coordinates: str,
        resolution: int,
        origin: ArrayLike,
        device: wp.Device,
        store: str = "map",
        bands: Sequence[FalloffBand | None] = (),
        carried: Sequence[CarriedFragments | None] = (),
    ):
        # the marches for one edit alone know no fragments
        self._edits, self._device, self._origin = edits, device, np.asarray(origin)
        self._is_single, self._has_fragments = len(edits) == 1 and not any(carried), any(carried)
        self._by_tiles = device.is_cpu and tables.TILES_ON_CPU
        self._looks_ahead = device.is_cuda or LOOKS_AHEAD_ON_CPU
        super().__init__(trace.map_points, None)  # poses choose the other one
        load_pose_modules(coordinates, render_modules(device, len(edits), self._has_fragments), device)
        self.lattices = EditLattices(edits, coordinates, resolution, origin, device, store, bands, carried)
        self.flat: list[Any] = []  # the EditData of each edit in their order, once a pose is prepared
        self._laid: list[tuple[Any, Any]] = []  # each LatticeEdit and its EditData, once for a pose
        self._seen: SeenView | None = None  # the last view, where it was of the last pose
        self.plan, self._lattice_boxes = Plan(None, False), []  # of the last view
        self.carried_shades = CarriedShades(len(edits), device)
        self._side, self._join = SideStream(device, priority=-1), RecordedLaunches(device)
        self._fine, self._is_fine = FineCells(len(edits), self._side), False
        self._polynomials = MapPolynomials(len(edits), device)
        self.most_shades = math.inf if device.is_cpu else MOST_SHADES * device.total_memory  # bytes
        self._boxes: EditBoxes | None = None
        self._apart: tuple[float, np.ndarray | None] | None = None
        pool = BufferPool(device)
        self._look_buffers = [pool.buffer(wp.uint8) for _ in edits]
        self._node_buffers = [pool.buffer(wp.vec4) for _ in edits]
        self.parts_in_turn = PartsInTurn(device)
        self._tiles, self._begins = BalancedTiles(device), TileStarts(self._side)

    def begin_view(self, field: VoxelField, center: wp.vec3, step: float) -> None:
        self._side.mark()
        if self.flat:
            self.plan = self._planned(field, center, step)
            if self.plan.is_shaded and self.carried_shades.is_posed and not self.carried_shades.is_known_folded:
                self.carried_shades.aim(center)

    def row_tables(self, field: VoxelField, center: wp.vec3, step: float) -> list[Any]:
        if not self.flat:
            return []  # where a new pose leads to is not known yet
        if not self.plan.is_shaded:
            return [field.marching.rows()]
        if not self.carried_shades.is_posed:
            return []
        if self.carried_shades.is_known_folded:
            return self._unshaded_tables(field)
        return [self.carried_shades.shades(field.grid, field.marching.columns, center, step)]

    def _unshaded_tables(self, field: VoxelField) -> list[Any]:
        """Rows, as the pose turns matter over."""
        self.plan = Plan(self.plan.parts, False)
        return [field.marching.rows()]

    def _planned(self, field: VoxelField, center: wp.vec3, step: float) -> Plan:
        """How a view is marched."""
        parts = self.scene_parts(center, step)
        # where each voxel is seen from one direction only, which hardly changes over it, and where there is memory
        is_shaded = (
            not self._by_tiles
            and not self._has_fragments
            and (self._is_single or parts is not None)
            and all(flat.nodes.shape[0] < MOST_LATTICE_NODES for flat in self.flat)
            and field.marching.is_shaded(center, self._lattice_boxes)
            and shade_texture_bytes(field.marching.columns) <= self.most_shades
        )
        return Plan(parts, is_shaded)

    def pose(self, cages: Sequence[Cage | None]) -> None:
        seen, self._seen = self._seen, None
        self.flat, self._laid, self.array, self.scene = [], [], None, None
        self._boxes = self._apart = None
        if self.lattices.begin(cages) and seen is not None:  # the device is at work
            self._lay_out()
        self.lattices.finish()
        self.array = self.lattices.array
        if len(self._edits) > 1 and not self._has_fragments:
            structs = [struct for struct, _ in self.lattices.posed()]
            tolerances, slacks = ([float(getattr(each, name)) for each in structs] for name in ("tolerance", "slack"))
            self._boxes = edit_boxes(self._edits, cages, self._origin, tolerances, slacks)
        if seen is not None:
            self._look_ahead(seen)

    def warm(self, field: VoxelField) -> None:
        """Launch once what poses and views of a field do, at rest and seen from afar: the first ones take no longer
        then. Nothing is done where poses do not look ahead, or where memory is short."""
        lattices = [found.lattice for found in self.lattices.maps if found is not None]
        if not self._looks_ahead or any(lattice is None for lattice in lattices):  # where no graphs are
            return
        node_count = sum(lattice.node_count for lattice in lattices if lattice is not None)
        if TABLE_BYTES * node_count > WARM_MEMORY * free_bytes(self._device):
            return
        self.pose([None if edit.remove else edit.cage for edit in self._edits])
        low, high = field.bounds
        center = wp.vec3(*(FAR * (high - low)).tolist())
        seen = SeenView(field, field.marching.grid(), center, field.step)
        self._look_ahead(seen)
        if self.plan.is_shaded:
            self.carried_shades.aim(center)
            self.carried_shades.walls(seen.grid, field.marching.columns)
        self._seen = seen  # by which the first pose goes

    def _look_ahead(self, seen: SeenView) -> None:
        """Launch what the next view is likely to ask for: who saw the last pose will see this one, and the device would
        wait for the host between. A view of something else finds its own."""
        self.prepare(seen.grid, seen.step)
        self.plan = self._planned(seen.field, seen.center, seen.step)
        has_begun = self._begin_tables(seen.grid)
        if self.plan.is_shaded:
            self._find_places(seen.grid)
        if has_begun:
            self._end_tables()

    def prepare(self, grid: Any, step: float) -> None:
        scene, self.scene = self.scene, None  # an interrupt leaves none
        if self.lattices.mark_empty(grid, step) or scene is None:
            scene = self.flat_scene()
        self.scene = scene

    def flat_scene(self) -> Any:
        """The posed edits with what `mark_empty` found, as their render kernel takes them: one EditData, or an array of
        several."""
        posed = self.lattices.posed()
        if [id(edit) for edit, _ in posed] != [id(edit) for edit, _ in self._laid]:
            self._lay_out()
        laid, self._laid = self._laid, []
        for number, ((edit, skip), (_, flat)) in enumerate(zip(posed, laid, strict=True)):
            tell_sides(flat, edit)
            join_tables(flat, edit, skip, functools.partial(self._join, number=number))
        self.flat = [flat for _, flat in laid]
        self._lattice_boxes, self.carried_shades.is_posed = [lattice_box(flat) for flat in self.flat], False
        self._is_fine = False
        if not self._is_single:
            is_simple = not any(self.lattices.carried) and not any(flat.has_sides for flat in self.flat)
            self.render_kernel = stack_kernel(is_simple)
            return self.flat_array()
        (flat,) = self.flat
        if not self._by_tiles:
            self.render_kernel = view_kernel(False, needs_general_map(flat))
        return flat

    def _lay_out(self) -> None:
        """Make the FlatEdits of the pose, their tables still to be filled."""
        edits = [edit for edit, _ in self.lattices.posed()]
        buffers = zip(edits, self._look_buffers, self._node_buffers, strict=True)
        self._laid = [(edit, edit_data(edit, look, nodes)) for edit, look, nodes in buffers]

    def _begin_tables(self, grid: Any) -> bool:
        """Launch the tables of fine cells and the polynomials of cells, where the march knows them: for one edit or
        edits apart. Returns whether they are new: they are there behind `_end_tables`."""
        is_known = not self._by_tiles and (self._is_single or self.plan.parts is not None)
        if self._is_fine or not is_known:
            return False
        self._fine.begin(self.flat, grid, self.lattices.marked_step)
        self._polynomials.expand(self.flat)  # on the program's stream, which has less to do meanwhile
        return True

    def _end_tables(self) -> None:
        """Let what follows wait for the tables."""
        self._side.join()
        self._is_fine = True
        if self._is_single:
            self.render_kernel = view_kernel(False, needs_general_map(self.flat[0]))

    def _find_places(self, grid: Any) -> None:
        """Launch what finds where the pose takes matter."""
        self.carried_shades.pose(self.flat, [struct.cells for struct, _ in self.lattices.posed()], grid)

    def render(self, view: ViewRequest) -> None:
        field, center, step = view.field, view.pinhole.center, view.options.step
        is_new = not view.rows or (self.plan.is_shaded and not self.carried_shades.is_posed)
        rows = view.rows
        if is_new:
            self.begin_view(field, center, step)
            rows = self.row_tables(field, center, step)
        has_begun = self._begin_tables(view.grid)
        begins = self._tile_starts(view)
        if is_new and self.plan.is_shaded:
            self._find_places(view.grid)
            rows = self.row_tables(field, center, step)
        if has_begun:
            self._end_tables()
        else:
            self._side.join()
        # asked behind all that is launched for others
        if self.plan.is_shaded and self.carried_shades.has_inverted_cells():
            rows = self._unshaded_tables(field)
        if self._looks_ahead:
            self._seen = SeenView(field, view.grid, center, step)
        view = dataclasses.replace(view, rows=rows)
        (parts, is_shaded), tiles = self.plan, view.threads // TILE_SIZE
        if parts is not None:
            orders = self._tiles.begin(len(parts), tiles)
            if self._by_tiles:
                kernels = [march_cpu.render_edit_tiles, march_cpu.render_edit_tiles]
            else:
                kernels = [part_kernel(is_shaded, has_sides) for has_sides in (False, True)]
            self.parts_in_turn.render(self, view, parts, kernels, orders, begins)
            self._tiles.end()
        elif self._is_single:
            (order,) = self._tiles.begin(1, tiles)
            kernel = self._shaded_kernel(view) if is_shaded else self.render_kernel
            self.march(view, kernel, [self.flat[0] if is_shaded else self.scene], order=order, begins=begins[0])
            self._tiles.end()
        else:
            super().render(view)
        self.carried_shades.release()

    def _tile_starts(self, view: ViewRequest) -> list[wp.array | None]:
        """How far the rays of each tile go before they may meet anything, for each edit that is marched by itself; None
        where its kernel does not ask."""
        parts = self.plan.parts
        marched = self.flat if self._is_single else [edit for edit, _ in parts or []]
        if self._by_tiles or not marched:
            return [None for _ in marched]
        return [*self._begins.find(marched, view.grid, view.pinhole, view.threads // TILE_SIZE)]

    def _shaded_kernel(self, view: ViewRequest) -> Any:
        """The kernel that marches a view of shaded voxels through one edit."""
        has_sides = needs_general_map(self.flat[0])
        return view_kernel(True, has_sides, large=view.threads >= LARGE_PICTURE and not has_sides)

    def scene_parts(self, center: wp.vec3, step: float) -> list[tuple[Any, np.ndarray]] | None:
        """The EditData of each edit and its box (2, 3), front to back from `centre`, relative to the edits' origin, as
        a view takes them one by one. None where one kernel takes the whole scene."""
        # One kernel takes: one edit on CUDA, fragments, edits that may meet, boxes that hide each other in a circle.
        if self._is_single:
            return [(self.flat[0], NOWHERE)] if self._by_tiles else None
        if self._boxes is None:
            return None
        reach = 0.5 * step  # that of the first and the last part of a sample
        if self._apart is None or self._apart[0] != reach:
            self._apart = reach, wider(self._boxes.changed, reach) if self._boxes.are_apart(reach) else None
        boxes = self._apart[1]
        if boxes is None:
            return None
        order = front_to_back(boxes, tuple(center))
        return None if order is None else [(self.flat[index], boxes[index]) for index in order]

    def flat_array(self) -> wp.array:
        """(edits,) EditData, as the kernel for several edits takes them."""
        return struct_array(self.flat, EditData, self._device)
