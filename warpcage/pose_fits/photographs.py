"""What photographs hold besides the object: surroundings that stay, and exposures that differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.devices import launch
from ..kernels.gradients.differences import Pixels
from ..kernels.gradients.photographs import (
    Around,
    compose_surroundings,
    pull_surroundings,
    solve_exposures,
    sum_exposure_lines,
)
from ..view.camera import Camera
from ..view.frame import part_type

#: Steps of reweighted least squares for exposures, in each evaluation.
STEPS = 3


class Surroundings:
    """What lies around a field in pictures of some cameras, of one size: it does not move with a pose."""

    # A frame before black, of colours c and opacities a, becomes front + light c + (1 - a) (clear - front): what is
    # before the field's box hides it, what is behind shows where it lets light through.

    def __init__(self, model: Any, bounds: np.ndarray, cameras: Sequence[Camera], device: wp.Device):
        layers = zip(*(_layers(model, bounds, camera, device) for camera in cameras), strict=True)
        clear, front, light = (np.concatenate(part) for part in layers)
        self._around, self._device = Around(), device
        self._around.front = wp.array(front, dtype=wp.vec3, device=device)
        self._around.light = wp.array(light, dtype=wp.float32, device=device)
        self._around.behind = wp.array(clear - front, dtype=wp.vec3, device=device)

    def composed(self, frames: Any) -> wp.array:
        """Colours of frames with what is around them, from those before black and opacities."""
        count = frames.rgb.size
        colors = empty_array(count, wp.vec3, self._device)
        launch(compose_surroundings, count, [frames, self._around], [colors], device=self._device)
        return colors

    def pull(self, slopes: Any) -> None:
        """Turn slopes by composed colours into those by colours before black and opacities, in place."""
        launch(pull_surroundings, slopes.rgb.size, [self._around], [slopes], device=self._device)


def _layers(model: Any, bounds: np.ndarray, camera: Camera, device: Any) -> list[np.ndarray]:
    """Colours (h * w, 3) around a box that is empty, those before it, and the share (h * w,) of light that passes."""
    origins, directions = camera.rays()
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort((bounds[:, None, None] - origins) / directions, axis=0)
    near, far = np.maximum(np.nan_to_num(ends[0]).max(axis=-1), 0), ends[1].min(axis=-1)
    middle = np.linalg.norm(bounds.mean(axis=0) - camera.center)
    entry = np.where(near < far, near, middle)  # a pose may leave the box
    found, count = [], camera.width * camera.height
    for opacity, distance in ((0.0, np.full_like(entry, np.inf)), (1.0, entry)):
        alpha = wp.array(np.full(count, opacity), dtype=wp.float32, device=device)
        depth = wp.array(distance.ravel(), dtype=wp.float32, device=device)
        rgb = wp.zeros(count, dtype=part_type("rgb"), device=device)
        model.add_around(camera, rgb, alpha, depth)
        found += [rgb.numpy(), alpha.numpy()]
    return [found[0], found[2], found[3]]


def fit_exposures(
    frames: wp.array, pictures: wp.array, width: int, height: int, weights: wp.array, exposures: wp.array
) -> None:
    """Fit exposures (n,), in place: factors of red, green and blue by which pictures (n * h * w,) are brighter than
    frames of the same, robust against pixels that show something else."""
    device, lines = frames.device, exposures.size * height
    sums = [empty_array(lines, wp.vec3, device) for _ in range(3)]
    for _ in range(STEPS):
        inputs = [frames, pictures, weights, exposures, width, height]
        launch(sum_exposure_lines, lines, inputs, sums, device=device, work=8 * width)
        launch(solve_exposures, exposures.size, [*sums, height], [exposures], device=device, work=height)


def pixels_of(parts: dict[str, wp.array]) -> Any:
    """The Pixels of arrays by names of a frame's parts."""
    pixels = Pixels()
    for name, array in parts.items():
        setattr(pixels, name, array)
    return pixels


def hull_pixels(cameras: Sequence[Camera], vertices: np.ndarray) -> float:
    """Pixels that the convex hull of a cage's vertices (v, 3) covers in all pictures."""
    from scipy.spatial import ConvexHull

    total = 0.0
    for camera in cameras:
        places, depths = camera.project(vertices)
        within = np.clip(places, 0, [camera.width, camera.height])
        if (depths <= 0).all():
            continue
        if (depths <= 0).any():
            total += camera.width * camera.height
        elif (np.ptp(within, axis=0) > 0).all():
            total += ConvexHull(within, qhull_options="QJ").volume
    return total
