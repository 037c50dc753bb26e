"""Cameras at another size of picture."""

from __future__ import annotations

from collections.abc import Sequence

from .camera import Camera


def fitted(camera: Camera, size: Sequence[int], name: str = "size") -> Camera:
    """The same view at another size: a width, which keeps the shape, or width and height; none keeps the camera."""
    if not size:
        return camera
    width = int(size[0])
    usual = round(width * camera.height / camera.width)
    if len(size) == 1:
        return camera.resized(width, max(1, usual))
    height = int(size[1])
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise ValueError(
            f"{name} {width} {height} would squeeze a {camera.width}x{camera.height} picture: give {width} {usual}"
        )
    return camera.resized(width, height)
