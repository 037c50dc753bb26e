"""Cameras that hold a set of points just so in the picture."""

from __future__ import annotations

import numpy as np

from .arrays import as_host_points
from .camera import Camera, turntable


def framing_orbit(points, count: int, *, elevation_degrees: float = 20.0, start_degrees: float = 0.0,
                  up=(0.0, 0.0, 1.0), fov_degrees: float = 40.0, width: int = 400, height: int = 400,
                  fill: float = 0.92) -> list[Camera]:
    """`count` cameras on a circle around points (n, 3), as near as keeps every point in every picture.

    elevation_degrees: above the plane across `up`; start_degrees: of the first camera, from +x towards +y where up is
    z; fov_degrees: horizontal; fill: share of the picture's width or height that the points may take.
    Raises ValueError for no points, or angles and shares out of range.
    """
    points = as_host_points(points)
    if not len(points):
        raise ValueError("a view needs at least one point to look at")
    if not (0 < fov_degrees < 180 and 0 < fill <= 1):
        raise ValueError(f"a view needs fov_degrees in (0, 180) and fill in (0, 1], got {fov_degrees} and {fill}")
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    offsets = points - target
    tangent = np.tan(np.radians(fov_degrees) / 2) * fill
    options = {"up": up, "fov_degrees": fov_degrees, "width": width, "height": height, "start_degrees": start_degrees}
    distance = 0.0
    for camera in turntable(np.zeros(3), 1.0, elevation_degrees, count, **options):
        x, y, z = (offsets @ camera.rotation).T
        # a point is in the picture where |x| <= (distance + z) tan(fov / 2), and so for y
        needed = np.maximum(np.abs(x) / tangent, np.abs(y) / (tangent * height / width)) - z
        distance = max(distance, float(needed.max()))
    if distance <= 0.0:
        distance = 1.0  # one point alone: any distance shows it
    return turntable(target, distance, elevation_degrees, count, **options)
