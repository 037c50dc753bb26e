"""What all renderers of a field share: a view as it is asked for, the arrays of its picture, and how a frame ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import array_view, empty_array
from ..core.devices import SpareMemory
from ..view.camera import Camera, tile_threads
from ..view.frame import PART_NAMES, Frame, average_frame, checked_supersampling, finer_camera, part_type
from .surroundings import LayeredBackground, OuterField

if TYPE_CHECKING:
    from .voxel_field import VoxelField

#: A march ends where less than this share of the light is left.
STOP_TRANSMITTANCE = 1e-3


class FieldView(NamedTuple):
    """A view of a field that was asked for, checked."""

    field: VoxelField
    camera: Camera
    rays: Camera  # the camera with a pixel for each ray
    center: wp.vec3  # of the camera, relative to the field's origin
    step: float  # of the march, world units
    work: float  # steps that a ray may take, as `core.devices.launch` has them
    color: np.ndarray  # behind the picture, black where there are layers
    layers: LayeredBackground | OuterField | None
    background: Any  # as the caller gave it
    supersampling: int
    masks: Sequence[str] = ()
    into: dict[str, wp.array] | None = None  # arrays (h * w,) to fill; None makes new ones
    is_again: bool = False  # whether a view of the same call came before: densities are as it found them

    @property
    def threads(self) -> int:
        """Rays, in whole tiles."""
        return tile_threads(self.rays)


def asked_view(
    field: VoxelField,
    camera: Camera,
    background: str | ArrayLike | None,
    step: float | None,
    supersampling: int | None,
    **more: Any,
) -> FieldView:
    """The view that the arguments of `render` ask for. more: the last fields of a FieldView."""
    step, work = field.march_step(step, camera)
    color, layers = field.chosen_background(background)
    side = checked_supersampling(field.supersampling if supersampling is None else supersampling)
    center = wp.vec3(*(camera.center - field.center).tolist())
    rays = finer_camera(camera, side)
    return FieldView(field, camera, rays, center, step, work, color, layers, background, side, **more)


def new_picture(view: FieldView) -> dict[str, wp.array]:
    """Arrays (rays,) for a march to fill, by the names of a Frame's parts and masks."""
    if view.into is not None and view.supersampling == 1:
        return view.into
    field, count = view.field, view.rays.width * view.rays.height
    return picture_arrays(count, (*PART_NAMES, *view.masks), field.device, field.marching.spare)


def finish_frame(view: FieldView, arrays: dict[str, wp.array]) -> Frame:
    """The frame of a view whose rays were marched: with what is around the field, its rays averaged to pixels."""
    if view.layers is not None:
        dimmed = [arrays[name] for name in view.masks]
        view.layers.add_around(view.rays, arrays["rgb"], arrays["alpha"], arrays["depth"], dimmed)
    frame = average_frame(Frame(view.rays.width, view.rays.height, **arrays), view.supersampling, view.into)
    return frame.seen_by(view.camera, None if view.layers else view.color, view.background)


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
