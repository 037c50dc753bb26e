"""Frames of several rays a pixel."""

from __future__ import annotations

import numbers

import warp as wp

from .camera import Camera
from .devices import launch
from .kernels import downsample
from .render import Frame

#: Rays a side of a pixel, at most: the picture is rendered that many times wider and higher.
MAX_SUPERSAMPLING = 8


def checked_supersampling(side) -> int:
    """Rays a side of a pixel. Raises ValueError where that is no whole number from 1 to MAX_SUPERSAMPLING."""
    if not isinstance(side, numbers.Integral) or isinstance(side, bool) or not 1 <= side <= MAX_SUPERSAMPLING:
        raise ValueError(f"supersampling must be 1 to {MAX_SUPERSAMPLING} rays a side of a pixel, got {side!r}")
    return int(side)


def finer_camera(camera: Camera, side: int) -> Camera:
    """The same view with side x side pixels for each."""
    return Camera(side * camera.fx, side * camera.fy, side * camera.cx, side * camera.cy, side * camera.width,
                  side * camera.height, camera.camera_to_world)


def average_frame(frame: Frame, side: int) -> Frame:
    """Each side x side pixels of a frame of Warp arrays joined into one."""
    width, height = frame.width // side, frame.height // side
    joined = {}
    for name, parts in frame.arrays.items():
        kernel = downsample.average_values
        inputs = [side, width, parts]
        if name == "rgb":
            kernel = downsample.average_colours
        elif name == "depth":
            kernel = downsample.average_depths
            inputs.append(frame.arrays["alpha"])
        joined[name] = wp.empty(width * height, dtype=parts.dtype, device=parts.device)
        launch(kernel, width * height, inputs, [joined[name]], device=parts.device)
    return Frame(width, height, **joined)
