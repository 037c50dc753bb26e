"""Where the cameras of the reference scenes stand: on the upper hemisphere, as in the NeRF-synthetic scenes."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..view.camera import Camera

#: Horizontal field of view (radians) and camera distance of the NeRF-synthetic scenes.
CAMERA_ANGLE_X = 0.6911112070083618
CAMERA_RADIUS = 4.0


def spread_eyes(count: int, seed: int) -> np.ndarray:
    """Eyes (count, 3) spread evenly over the upper hemisphere, CAMERA_RADIUS from the origin, on a Fibonacci spiral.
    seed: turns the spiral and moves each eye a little along it."""
    rng = np.random.default_rng(seed)
    height = 0.03 + 0.94 * (np.arange(count) + rng.random(count)) / count
    turn = 2 * np.pi * (rng.random() + np.arange(count) * (np.sqrt(5) - 1) / 2)
    flat = np.sqrt(1 - height**2)
    return CAMERA_RADIUS * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def orbit_eyes(count: int) -> np.ndarray:
    """Eyes (count, 3) once around the origin, between 15 and 50 degrees up, CAMERA_RADIUS away."""
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    rise = np.radians(32.5 + 17.5 * np.sin(2 * turn + 0.5))
    return CAMERA_RADIUS * np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1)


def reference_cameras(eyes: np.ndarray, target: np.ndarray, size: int) -> list[Camera]:
    """Cameras of size x size pixels at eyes (n, 3) that look at target (3,), world units."""
    view = {"fov_degrees": np.degrees(CAMERA_ANGLE_X), "width": size, "height": size}
    return [Camera.look_at(eye, target, **view) for eye in eyes]


def require_counts(train_views: int, test_views: int, size: int) -> None:
    """Raises ValueError for numbers of views, or of pixels along a side, below one."""
    if min(train_views, test_views, size) < 1:
        raise InputError(f"a scene needs views and pixels, got {train_views} + {test_views} views of {size} pixels")
