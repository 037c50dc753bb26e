"""Which nodes of a field views speak for: by masks, or by how far from the cameras what they show is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_number
from ..view.camera import Camera

if TYPE_CHECKING:
    from .voxel_field import VoxelField

#: Pixels along the longer side of the views that depths are taken from.
DEPTH_PIXELS = 200

#: A view shows a node that lies within so many voxels of the depth that it has there, where it is half opaque.
DEPTH_VOXELS = 2.0


def in_masks(points: np.ndarray, cameras: list[Camera], masks: list[ArrayLike]) -> np.ndarray:
    """Which points (n, 3), world units, are inside the mask of every picture that they fall into, and fall into one.
    masks: one (h, w) per camera, the object where it is above half its largest value."""
    if len(cameras) != len(masks) or not cameras:
        raise ValueError(f"one mask per camera is needed, got {len(masks)} masks and {len(cameras)} cameras")
    inside, seen = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    for number, (camera, given) in enumerate(zip(cameras, masks, strict=True)):
        picture = np.asarray(given)
        if picture.shape != (camera.height, camera.width):
            raise ValueError(
                f"mask {number} must be ({camera.height}, {camera.width}) as its camera, got {picture.shape}"
            )
        ahead, row, column = _fallen(points, camera)
        seen[ahead] = True
        top = picture.max()
        inside[ahead] &= picture[row, column] > 0.5 * top if top > 0 else False
    return inside & seen


def in_depths(points: np.ndarray, field: VoxelField, cameras: list[Camera], depth: ArrayLike) -> np.ndarray:
    """Which points (n, 3) of a field's matter the views show at distances in a range, and what is hidden behind those.
    depth: (2,) least and largest distance from the camera along the ray, world units."""
    values = np.asarray(depth, np.float64) if np.shape(depth) == (2,) else np.full(2, np.nan)
    near, far = (checked_number(each, "depth") if np.isfinite(each) else np.nan for each in values)
    if not 0.0 <= near < far:
        raise ValueError(f"depth must be two distances from the cameras, the nearer one first, got {depth!r}")
    if not cameras:
        raise ValueError("depth needs the cameras of the views")
    within, without, hidden, through = (np.zeros(len(points), int) for _ in range(4))
    room = DEPTH_VOXELS * float(np.max(field.voxel_size))
    for camera in cameras:
        shrink = min(1.0, DEPTH_PIXELS / max(camera.width, camera.height))
        small = camera.resized(*(max(1, round(shrink * side)) for side in (camera.width, camera.height)))
        frame = field.render(small, background="black", supersampling=1)
        ahead, row, column = _fallen(points, small)
        distance = np.linalg.norm(points[ahead] - small.centre, axis=1)
        opaque = frame.alpha[row, column] >= 0.5
        behind = distance - np.where(opaque, frame.depth[row, column], np.inf)
        # in front of what it shows a view looks through haze, behind it there is what it cannot see
        shown, fits = np.abs(behind) <= room, (distance >= near) & (distance <= far)
        within[ahead[shown & fits]] += 1
        without[ahead[shown & ~fits]] += 1
        hidden[ahead[behind > room]] += 1
        through[ahead[behind < -room]] += 1
    kept, seen = within > without, within + without > 0
    # what no view shows, and more have behind something than look through, goes with the nearest shown point
    rest = np.flatnonzero(~seen & (hidden > through))
    if len(rest) and kept.any():
        from scipy.spatial import KDTree

        shown = np.flatnonzero(seen)
        kept[rest] = kept[shown[KDTree(points[shown]).query(points[rest])[1]]]
    return kept


def _fallen(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the points that fall into a picture, and their rows and columns in it."""
    pixels, depth = camera.project(points)
    ahead = np.flatnonzero(depth > 0.0)
    column, row = np.floor(pixels[ahead]).astype(np.int64).T
    falls = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return ahead[falls], row[falls], column[falls]
