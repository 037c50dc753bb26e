"""What all renderers share: the options of a frame, a checked view, the arrays of its picture, and the last steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import array_view, empty_array
from ..core.checks import checked_flag, checked_positive, require_type
from ..core.devices import SpareMemory
from ..core.names import TRANSPARENT
from ..view.camera import Camera, tile_threads
from ..view.frame import (
    PART_NAMES,
    Frame,
    average_frame,
    checked_supersampling,
    finer_camera,
    part_type,
    view_background,
)
from .surroundings import LayeredBackground, OuterField

if TYPE_CHECKING:
    from .voxel_field import VoxelField

#: A march ends where less than this share of the light is left.
STOP_TRANSMITTANCE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class RenderOptions:
    """How a frame is rendered; None is the scene's own. Renderers ignore or refuse options of other kinds of scenes."""

    background: str | ArrayLike | None = None  # colour behind the scene, a name or (3,) in [0, 1]
    supersampling: int | None = None  # rays along each side of a pixel, 1 to 8
    antialias: bool | None = None  # splats: weaken those that the blur of the picture makes larger (Mip-Splatting)
    step: float | None = None  # voxels and sampled fields: march step, world units
    step_scale: float = 1.0  # voxels: factor on the field's own march step; more than 1 is faster and coarser
    fill: bool = False  # voxels: fill what an edit uncovers and no picture showed, see `fill_unseen`

    def __post_init__(self) -> None:
        if self.background is not None:
            view_background(self.background)
        if self.supersampling is not None:
            checked_supersampling(self.supersampling)
        if self.antialias is not None:
            checked_flag(self.antialias, "antialias")
        if self.step is not None:
            checked_positive(self.step, "the march step")
        checked_positive(self.step_scale, "step_scale")
        checked_flag(self.fill, "fill")

    @property
    def is_transparent(self) -> bool:
        """Whether pictures have opacity instead of a background."""
        return isinstance(self.background, str) and self.background == TRANSPARENT

    def color(self, default: np.ndarray) -> np.ndarray:
        """(3,) float32 colour behind the picture."""
        return default if self.background is None else view_background(self.background)

    def side(self, default: int) -> int:
        """Rays along each side of a pixel."""
        return default if self.supersampling is None else int(self.supersampling)


class RenderTarget(NamedTuple):
    """Where a frame is rendered to."""

    arrays: dict[str, wp.array] | None = None  # (h * w,) each, by the names of the frame's parts; None makes new ones
    is_again: bool = False  # whether a view of the same call came before: densities are as it found them


#: A frame of its own, in new arrays.
NEW_TARGET = RenderTarget()


class FieldView(NamedTuple):
    """A checked view of a field."""

    field: VoxelField
    camera: Camera
    rays: Camera  # the camera with a pixel for each ray
    center: wp.vec3  # of the camera, relative to the field's origin
    step: float  # of the march, world units
    work: float  # steps that a ray may take, as `core.devices.launch` has them
    color: np.ndarray  # behind the picture, black where there are layers
    layers: LayeredBackground | OuterField | None
    options: RenderOptions
    side: int  # rays along each side of a pixel
    masks: Sequence[str]
    target: RenderTarget

    @property
    def threads(self) -> int:
        """Rays, in whole tiles."""
        return tile_threads(self.rays)


def field_view(
    field: VoxelField,
    camera: Camera,
    options: RenderOptions,
    masks: Sequence[str] = (),
    target: RenderTarget = NEW_TARGET,
) -> FieldView:
    """The view of a field by a camera, with these masks."""
    require_type(camera, Camera, "render needs")
    scale = options.step_scale
    step, work = field.march_step(options.step if scale == 1.0 else scale * (options.step or field.step), camera)
    color, layers = field.chosen_background(options.background)
    side = options.side(field.supersampling)
    center = wp.vec3(*(camera.center - field.center).tolist())
    rays = finer_camera(camera, side)
    return FieldView(field, camera, rays, center, step, work, color, layers, options, side, masks, target)


def new_picture(view: FieldView) -> dict[str, wp.array]:
    """Arrays (rays,) for a march to fill, by the names of a Frame's parts and masks."""
    if view.target.arrays is not None and view.side == 1:
        return view.target.arrays
    field, count = view.field, view.rays.width * view.rays.height
    return picture_arrays(count, (*PART_NAMES, *view.masks), field.device, field.marching.spare)


def finish_frame(view: FieldView, arrays: dict[str, wp.array]) -> Frame:
    """The frame of a marched view: adds what is around the field, and averages rays to pixels."""
    if view.layers is not None:
        dimmed = [arrays[name] for name in view.masks]
        view.layers.add_around(view.rays, arrays["rgb"], arrays["alpha"], arrays["depth"], dimmed)
    frame = average_frame(Frame(view.rays.width, view.rays.height, **arrays), view.side, view.target.arrays)
    return frame.seen_by(view.camera, None if view.layers else view.color, view.options.background)


def picture_arrays(
    count: int, names: Sequence[str], device: wp.Device, spare: SpareMemory | None = None
) -> dict[str, wp.array]:
    """Arrays (count,) of a picture by names of a Frame's parts, of their `part_type`."""
    widths = [wp.types.type_size(part_type(name)) for name in names]
    block = empty_array((sum(widths), count), wp.float32, device)  # at once: on a GPU one takes as long as a launch
    if spare is not None:
        spare.keep(block.capacity)
    arrays, begin = {}, 0
    for name, width in zip(names, widths, strict=True):
        arrays[name] = array_view(block, part_type(name), count, offset=4 * begin)
        begin += count * width
    return arrays
