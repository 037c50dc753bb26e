"""What all renderers of a field share: the arrays of a picture, its background, and several rays per pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import array_view, empty_array
from ..core.devices import SpareMemory
from ..view.camera import Camera, camera_struct, tile_threads
from ..view.frame import PART_NAMES, Frame, average_frame, finer_camera, part_type
from .surroundings import LayeredBackground, OuterField

#: A march ends where less than this share of the light is left.
STOP_TRANSMITTANCE = 1e-3

#: Makes the arrays of a picture, (h * w,) each, by the names of a Frame's parts and masks.
MakeArrays = Callable[[], dict[str, wp.array]]

#: Launches a kernel that marches the rays of a picture. It gets the number of threads, the PinholeCamera, the colour
#: behind the picture, and what makes the arrays to fill: to be called once, when the device is at work on what needs
#: none of them.
March = Callable[[int, Any, wp.vec3, MakeArrays], None]

#: Starts on what a march waits for, so that the device is at work while the host goes on.
BeginMarch = Callable[[], March]


def render_frame(
    march: March,
    camera: Camera,
    *,
    origin: ArrayLike,
    color: np.ndarray,
    layers: LayeredBackground | OuterField | None,
    supersampling: int,
    device: wp.Device,
    spare: SpareMemory,
    masks: Sequence[str] = (),
    into: dict[str, wp.array] | None = None,
) -> Frame:
    """The view of a camera, by any march, its arrays on the device; colour: behind it, black where there are layers.
    origin: (3,) world point that the kernel's positions are relative to; into: arrays to fill, None makes new ones."""
    fine = finer_camera(camera, supersampling)
    count = fine.width * fine.height
    arrays: dict[str, wp.array] = {}

    def made_arrays() -> dict[str, wp.array]:
        made = into if supersampling == 1 else None
        arrays.update(picture_arrays(count, (*PART_NAMES, *masks), device, spare) if made is None else made)
        return arrays

    march(tile_threads(fine), camera_struct(fine, origin), wp.vec3(*map(float, color)), made_arrays)
    if layers is not None:
        dimmed = [arrays[name] for name in masks]
        layers.add_around(fine, arrays["rgb"], arrays["alpha"], arrays["depth"], dimmed)
    return average_frame(Frame(fine.width, fine.height, **arrays), supersampling, into)


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
