"""How far behind the surface of an object the depth of its frames lies."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..field.voxel_field import VoxelField
from ..view.camera import turntable

#: Cameras around a field, pixels along their sides, and their distance in diagonals of its bounds.
CAMERAS, PIXELS, DISTANCE = 4, 24, 1.5

#: Pixels that are at least so opaque show a surface; march steps to either side of its depth that are looked at.
OPAQUE, STEPS = 0.9, 32


def depth_behind(field: Any) -> float:
    """World units by which frames' depth lies behind the surface, in the median of pixels; 0 for other than voxels."""
    # Matter that absorbs sigma a unit stops light at distances that are exponentially distributed from the surface on:
    # their mean, which is the depth of a frame, lies one standard deviation, 1 / sigma, behind it. Densities of fits
    # are low enough for that to be about a voxel.
    if not isinstance(field, VoxelField):
        return 0.0
    low, high = field.bounds
    size = float(np.linalg.norm(high - low))
    found = []
    for camera in turntable((low + high) / 2, DISTANCE * size, 25, CAMERAS, width=PIXELS, height=PIXELS):
        frame = field.render(camera, background="white", supersampling=1)
        seen = frame.alpha > OPAQUE
        origins, directions = (part[seen] for part in camera.rays())
        distances = frame.depth[seen, None] + field.step * np.arange(-STEPS, STEPS + 1)
        places = origins[:, None] + distances[..., None] * directions[:, None]
        along = np.broadcast_to(directions[:, None], places.shape)
        density = np.asarray(field.sample(places.reshape(-1, 3), along.reshape(-1, 3))[1]).reshape(distances.shape)
        light = np.exp(-field.step * np.cumsum(np.maximum(density, 0), axis=1))
        weights = np.concatenate([1 - light[:, :1], light[:, :-1] - light[:, 1:]], axis=1)
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-6)
        middle = (weights * distances).sum(axis=1, keepdims=True)
        found.append(np.sqrt((weights * (distances - middle) ** 2).sum(axis=1)))
    spreads = np.concatenate(found)
    return float(np.median(spreads)) if len(spreads) else 0.0
