"""The launches of a planned frame, and the modules of kernels that poses and frames launch."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import warp as wp

from ..core.arrays import array_view
from ..core.devices import RecordedLaunches
from ..core.modules import Kernel, load_modules
from ..core.names import coordinate_kind
from ..core.reports import Progress
from ..field import tables
from ..field.render import STOP_TRANSMITTANCE, FieldView
from ..kernels.core import texels
from ..kernels.edits import cell_tables, fine_cells, inverse, structs
from ..kernels.edits import nodes as map_cells
from ..kernels.field import columns, densities, outer_bricks, rows
from ..kernels.field import occupancy as grid_skip
from ..kernels.lattice import crossings, distance, gaps, nodes, rings, side_values
from ..kernels.render import march_cpu, shading
from ..kernels.render.march_cpu import render_edit_tiles
from ..kernels.render.rays import MarchOptions, Picture, ScenePart
from ..kernels.render.views import part_kernel, stack_kernel, view_kernel
from ..kernels.view import tile_order
from ..kernels.view.rays import TILE_SIZE
from ..lattice.buffers import BufferPool
from ..view.camera import camera_struct
from .plan import FramePlan, PlannedEdit
from .tile_order import BalancedTiles

#: Modules of the kernels that every pose launches.
POSE_MODULES = (crossings, distance, nodes, rings, gaps, side_values, cell_tables, structs, grid_skip)


def load_pose_modules(
    coordinates: str, others: Sequence[ModuleType | Kernel], device: wp.Device, progress: bool | Progress = False
) -> None:
    """Compile and load the kernels of a pose side by side, with what frames need beside them."""
    load_modules([*POSE_MODULES, *coordinate_kind(coordinates).kernel_modules(), *others], device, progress)


def render_modules(device: wp.Device, edit_count: int = 1, has_fragments: bool = False) -> list[ModuleType | Kernel]:
    """What renders views, kernel files and variants; has_fragments: fragments go with one of the edits."""
    if has_fragments:
        return [stack_kernel(False)]
    several = [stack_kernel(True), stack_kernel(False)] if edit_count > 1 else []
    if device.is_cpu and tables.TILES_ON_CPU:
        return [march_cpu, columns, *several]
    march_modules = [fine_cells, map_cells, *several]
    kernel_of = part_kernel if several else view_kernel
    by_rows = [kernel_of(False, has_sides) for has_sides in (False, True)]
    if device.is_cpu and not tables.SHADED_ON_CPU:
        return [*march_modules, *by_rows]
    shaded = [kernel_of(True, has_sides) for has_sides in (False, True)]
    # poses that turn matter over are marched by rows: loaded now, so that no drag waits for a compiler
    frame_modules = [columns, densities, outer_bricks, rows, texels, tile_order]
    return [*march_modules, inverse, shading, *shaded, *by_rows, *frame_modules]


#: Bytes of a ray in each of the three arrays that hold the state of rays.
STATE_BYTES = wp.types.type_size_in_bytes(wp.vec4)


class FrameTarget(NamedTuple):
    """The last arguments of every march of a frame, and the arrays that it fills."""

    pinhole: Any  # the PinholeCamera of the rays, relative to the field's origin
    background: wp.vec3
    options: Any  # the MarchOptions
    picture: Any  # the Picture
    arrays: dict[str, wp.array]  # those of the picture
    threads: int  # rays, in whole tiles
    work: float  # steps that a ray may take, as `core.devices.launch` has them


class FrameTables(NamedTuple):
    """What the march of a frame through edits on lattices reads."""

    field: list[Any]  # the VoxelGrid, its rows or colours, and its matter cells for lanes of tiles
    edits: Sequence[Any]  # EditData of those that are marched by themselves, front to back
    boxes: Sequence[list[list[float]]]  # of each, (2, 3) from the field's origin; none where one is marched whole
    stack: wp.array | None  # (edits,) EditData of a stack


def frame_target(view: FieldView, arc_opacity: int) -> FrameTarget:
    """The target of a view, in new arrays. arc_opacity: 1 keeps opacity along canonical arcs, 0 the paper's density."""
    pinhole, color = camera_struct(view.rays, view.field.center), wp.vec3(*map(float, view.color))
    options, picture, arrays = MarchOptions(), Picture(), view.new_arrays()
    options.step, options.inverse_step = view.step, 1.0 / view.step
    options.stop, options.arc_opacity = STOP_TRANSMITTANCE, arc_opacity
    for name, array in arrays.items():
        setattr(picture, name, array)
    return FrameTarget(pinhole, color, options, picture, arrays, view.threads, view.work)


def edit_kernel(plan: FramePlan, edit: PlannedEdit) -> Any:
    """The kernel that marches an edit by itself."""
    if plan.lanes == "tile":
        return render_edit_tiles
    if plan.march == "edit":
        return view_kernel(plan.is_shaded, edit.has_sides)
    return part_kernel(plan.is_shaded, edit.has_sides)


class FrameLauncher:
    """Launches marches; of edits apart one for each, between which rays keep their state."""

    def __init__(self, device: wp.Device):
        self.rays = BufferPool(device).buffer(wp.vec4)  # kept: CUDA allocates memory slower than it fills it
        self._launches, self._tiles = RecordedLaunches(device), BalancedTiles(device)
        self._block: wp.array | None = None
        self._parts: list[tuple[list[list[float]], Any]] = []

    def launch_frame(self, plan: FramePlan, tables: FrameTables, target: FrameTarget) -> None:
        """March a view by its plan."""
        if plan.march == "stack":
            self.march(stack_kernel(plan.is_simple), [*tables.field, tables.stack], target)
            return
        item_rays = TILE_SIZE if plan.lanes == "tile" else 1
        orders = self._tiles.begin(len(plan.edits), target.threads // TILE_SIZE)
        parts = self._scene_parts(tables.boxes, target.pinhole.width * target.pinhole.height)
        for number, (planned, edit) in enumerate(zip(plan.edits, tables.edits, strict=True)):
            target.picture.order = orders[number]
            inputs = [*tables.field, edit, *parts[number : number + 1]]
            self.march(edit_kernel(plan, planned), inputs, target, number=number, item_rays=item_rays)
        self._tiles.end()

    def march(
        self, kernel: Any, inputs: list[Any], target: FrameTarget, *, number: int = 0, item_rays: int = 1, work: int = 1
    ) -> None:
        """Launch a kernel of items of `item_rays` rays. number: of the launch in its frame; work: most steps of one
        sample."""
        end, count, steps = target[:4], target.threads // item_rays, target.work * work * item_rays
        self._launches(kernel, count, [*inputs, *end], number=number, transient=len(end), work=steps)

    def _scene_parts(self, boxes: Sequence[list[list[float]]], rays: int) -> list[Any]:
        """The ScenePart of each box, with arrays for as many rays; those of the view before where it has the same."""
        # A box is of what its edit has to do with, half a step more. What is behind the last one goes with it.
        block = self.rays.take((3, rays)) if len(boxes) > 1 else None
        if block is not self._block or len(boxes) != len(self._parts):
            self._block, self._parts = block, [([], None) for _ in boxes]
        for number, box in enumerate(boxes):
            if self._parts[number][0] != box:
                self._parts[number] = box, scene_part(box, number == 0, number == len(boxes) - 1, block)
        return [part for _, part in self._parts]


def scene_part(box: list[list[float]], is_first: bool, is_last: bool, states: wp.array | None) -> Any:
    """The ScenePart of a box: its lower and upper corner, (3,) each, relative to the edits' origin.
    states: (3, rays) vec4 in which rays keep their state, not set yet; None for the first and only part."""
    part = ScenePart()
    part.lower, part.upper = (wp.vec3(*corner) for corner in box)
    part.is_first, part.is_last = int(is_first), int(is_last)
    if states is not None:
        rays = states.shape[1]
        for row, name in enumerate(("progress", "colors", "masks")):
            setattr(part, name, array_view(states, wp.vec4, rays, offset=row * rays * STATE_BYTES))
    return part
