"""Edits on lattices that are posed and rendered: how a frame is planned, finds its tables and is launched."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from ..cage.cage import Cage
from ..core.memory import free_bytes
from ..edits.apart import NOWHERE, EditBoxes, edit_boxes
from ..edits.maps import EditLattices
from ..field.render import FieldView
from ..field.voxel_field import VoxelField
from ..kernels.edits import trace
from ..view.frame import Frame
from .launch import FrameLauncher, FrameTables, frame_target
from .plan import FrameFacts, FramePlan, plan_frame
from .shading import CarriedColors
from .tables import EditTables
from .view import PosedEdits, SeenView

#: Whether a pose on a CPU launches what views are likely to need, too: there nothing waits for the host.
LOOKS_AHEAD_ON_CPU = False

#: Sizes of a field at which it is seen from afar.
FAR = 4.0

#: Bytes a node that tables for views take, and the share of free memory that they may take before there is a view.
TABLE_BYTES, WARM_MEMORY = 192, 1 / 16

#: Lattices of fewer nodes have numbers left that say on which side of the posed cage a place is.
MAX_LATTICE_NODES = 1 << 30

#: Share of a GPU's memory that colours of a grid's nodes may take.
MAX_COLOR_SHARE = 0.25


class PosedScene(PosedEdits):
    """Edits on lattices in a pose, and what frames of it need."""

    map_kernel = staticmethod(functools.partial(trace.map_kernel, False))

    def __init__(self, lattices: EditLattices):
        self.lattices, self.edits, self.device = lattices, lattices.edits, lattices.device
        edits, device = self.edits, self.device
        self.tables, self.carried_colors = EditTables(len(edits), device), CarriedColors(len(edits), device)
        self.launcher = FrameLauncher(device)
        self.boxes: EditBoxes | None = None  # of several edits without fragments, in the pose
        self.plan = FramePlan("stack")  # of the last view
        self.seen: SeenView | None = None  # the last view, where it was of the last pose
        self.max_color_bytes = math.inf if device.is_cpu else MAX_COLOR_SHARE * device.total_memory  # bytes

    @property
    def array(self) -> wp.array | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(edits,) LatticeEdit, once posed."""
        return self.lattices.array

    @property
    def looks_ahead(self) -> bool:
        """Whether a pose launches what views are likely to need."""
        return self.device.is_cuda or LOOKS_AHEAD_ON_CPU

    def pose(self, cages: Sequence[Cage | None]) -> None:
        seen, self.seen = self.seen, None
        self.tables.clear()
        self.boxes = None
        if self.lattices.begin(cages) and seen is not None:  # the device is at work
            self.tables.lay_out(self.lattices.posed())
        self.lattices.finish()
        if len(self.edits) > 1 and not any(self.lattices.carried):
            structs = [struct for struct, _ in self.lattices.posed()]
            tolerances, slacks = ([float(getattr(each, name)) for each in structs] for name in ("tolerance", "slack"))
            self.boxes = edit_boxes(self.edits, cages, self.lattices.origin, tolerances, slacks)
        if seen is not None:
            self._look_ahead(seen)

    def warm(self, field: VoxelField) -> None:
        """Launch once what poses and views of a field do, at rest and seen from afar: the first ones take no longer
        then. Nothing is done where poses do not look ahead, or where memory is short."""
        lattices = [found.lattice for found in self.lattices.maps if found is not None]
        if not self.looks_ahead or any(lattice is None for lattice in lattices):  # where no graphs are
            return
        node_count = sum(lattice.node_count for lattice in lattices if lattice is not None)
        if TABLE_BYTES * node_count > WARM_MEMORY * free_bytes(self.device):
            return
        self.pose([None if edit.remove else edit.cage for edit in self.edits])
        low, high = field.bounds
        center = wp.vec3(*(FAR * (high - low)).tolist())
        seen = SeenView(field, field.marching.grid(), center, field.step)
        self._look_ahead(seen)
        if self.plan.is_shaded:
            self.carried_colors.aim(center)
            self.carried_colors.find_bricks(seen.grid, field.marching.columns)
        self.seen = seen  # by which the first pose goes

    def _look_ahead(self, seen: SeenView) -> None:
        """Launch what the next view is likely to need: most views repeat the last one in a new pose, and the device
        would wait for the host between. Other views launch their own."""
        self.prepare(seen.grid, seen.step)
        self.plan = plan_frame(self.facts(seen))
        has_begun = self.tables.begin_cells(self.plan, seen.grid, self.lattices.marked_step)
        if self.plan.is_shaded:
            self._find_places(seen.grid)
        if has_begun:
            self.tables.join()

    def prepare(self, grid: Any, step: float) -> None:
        if self.lattices.mark_empty(grid, step) or not self.tables.edits:
            self.tables.fill(self.lattices.posed())
            if len(self.edits) > 1 or any(self.lattices.carried):
                self.tables.stack()
            self.carried_colors.is_posed = False

    def facts(self, view: FieldView | SeenView) -> FrameFacts:
        """What is known of a view before its tables are there."""
        marching, colors, tables = view.field.marching, self.carried_colors, self.tables
        order = None if self.boxes is None else self.boxes.front_to_back(tuple(view.center), 0.5 * view.step)
        has_fragments = any(self.lattices.carried)
        by_tiles, is_alone = marching.by_tiles, not has_fragments and (len(self.edits) == 1 or order is not None)
        is_far = is_alone and not by_tiles and marching.is_shaded(view.center, tables.lattice_boxes)
        return FrameFacts(
            general_maps=tables.general_maps,
            has_gaps=tables.has_gaps,
            has_fragments=has_fragments,
            by_tiles=by_tiles,
            order=order,
            is_far=is_far,
            colors_fit=is_far
            and tables.most_nodes < MAX_LATTICE_NODES
            and marching.columns.color_bricks.most_bytes <= self.max_color_bytes,
            is_folded=colors.is_known_folded if colors.is_posed else None,
        )

    def _begin(self, view: FieldView) -> FrameFacts:
        """Plan a view and find its directions: what needs no table of the pose."""
        facts = self.facts(view)
        self.plan = plan_frame(facts)
        if self.plan.is_shaded and self.carried_colors.is_posed:
            self.carried_colors.aim(view.center)
        return facts

    def _field_tables(self, view: FieldView) -> list[Any] | None:
        """Launch what a view reads of the field: its rows, or their colours. None where it takes places to be found."""
        marching = view.field.marching
        if not self.plan.is_shaded:
            return [marching.rows()]
        if not self.carried_colors.is_posed:
            return None
        return [self.carried_colors.shaded(view.field.stored, marching.columns, view.center, view.step)]

    def _find_places(self, grid: Any) -> None:
        """Launch what finds where the pose takes matter."""
        self.carried_colors.pose(self.tables.edits, [struct.cells for struct, _ in self.lattices.posed()], grid)

    def render(self, view: FieldView, arc_opacity: int) -> Frame:
        # The device gets work before the host waits or allocates; what is read back comes behind what is launched.
        marching, lattices, tables = view.field.marching, self.lattices, self.tables
        facts = self._begin(view) if tables.edits else None  # None: where a new pose leads to is not known yet
        if not view.target.is_again:
            marching.begin()
        rows = None if facts is None else self._field_tables(view)
        target = frame_target(view, arc_opacity)
        grid = marching.marched if view.target.is_again else marching.grid()
        self.prepare(grid, view.step)
        if facts is None or rows is None or (self.plan.is_shaded and not self.carried_colors.is_posed):
            facts = self._begin(view)
            rows = self._field_tables(view)
        has_begun = tables.begin_cells(self.plan, grid, lattices.marked_step)
        if rows is None:
            self._find_places(grid)
            rows = self._field_tables(view)
        if has_begun:
            tables.join()
        # read behind all that is launched
        is_folded = self.carried_colors.has_inverted_cells() if self.plan.is_shaded else facts.is_folded
        was_shaded = self.plan.is_shaded
        self.plan = plan_frame(facts._replace(general_maps=tables.general_maps, is_folded=is_folded))
        if was_shaded and not self.plan.is_shaded:
            rows = self._field_tables(view)
        if self.looks_ahead:
            self.seen = SeenView(view.field, grid, view.center, view.step)
        self.launcher.launch_frame(self.plan, self._frame_tables(view, grid, rows), target)
        self.carried_colors.release()
        return view.finished(target.arrays)

    def _frame_tables(self, view: FieldView, grid: Any, rows: Any) -> FrameTables:
        """What the planned march of a view reads."""
        plan, cells = self.plan, [view.field.marching.cells(grid)] if self.plan.lanes == "tile" else []
        edits = [self.tables.edits[edit.number] for edit in plan.edits]
        boxes: list[list[list[float]]] = []
        if plan.march == "parts":
            around = [NOWHERE] if self.boxes is None else self.boxes.reaching(0.5 * view.step)
            boxes = [around[edit.number].tolist() for edit in plan.edits]
        stack = self.tables.stack() if plan.march == "stack" else None
        return FrameTables([grid, *rows, *cells], edits, boxes, stack)
