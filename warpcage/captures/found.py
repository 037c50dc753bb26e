"""What COLMAP found, as plain arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..scene.pictures import COEFFICIENTS, distort


@dataclasses.dataclass(frozen=True)
class Lens:
    """A camera of a reconstruction."""

    size: tuple[int, int]  # width and height of its pictures, pixels
    intrinsics: tuple[float, float, float, float]  # (fx, fy, cx, cy), pixels; the centre of the first one is (0.5, 0.5)
    distortion: tuple[float, ...]  # in the order of COEFFICIENTS

    def enlarged(self, factor: float, size: tuple[int, int]) -> Lens:
        """The same lens for pictures `factor` times as large, of `size` pixels, which begin at the same corner."""
        fx, fy, cx, cy = self.intrinsics
        return Lens(size, (fx * factor, fy * factor, cx * factor, cy * factor), self.distortion)


@dataclasses.dataclass(frozen=True)
class Found:
    """Cameras and points of a reconstruction, of k pictures of n."""

    pictures: np.ndarray  # (k,) int64, which of the pictures have a camera, ascending
    poses: np.ndarray  # (k, 4, 4) float64, camera to world, OpenCV axes
    lenses: list[Lens]  # k; pictures of one camera share theirs
    points: np.ndarray  # (m, 3) float64, world units
    colours: np.ndarray  # (m, 3) uint8
    views: np.ndarray  # (m,) int64, pictures that each point was found in
    counts: np.ndarray  # (k,) int64, points that each picture shows
    # (k,) float64, mean distance between where a picture shows its points and where they project to, pixels
    errors: np.ndarray
    error: float  # the same over all pictures

    def moved(self, rotation: np.ndarray, centre: np.ndarray, scale: float) -> Found:
        """The same in other coordinates, x -> scale * rotation @ (x - centre): rotation (3, 3), centre (3,)."""
        poses = self.poses.copy()
        poses[:, :3, :3] = rotation @ self.poses[:, :3, :3]
        poses[:, :3, 3] = scale * (self.poses[:, :3, 3] - centre) @ rotation.T
        return dataclasses.replace(self, poses=poses, points=scale * (self.points - centre) @ rotation.T)


def found_of(model: Any, names: Sequence[str]) -> Found:
    """The cameras of a pycolmap Reconstruction in the order of `names`, those of all pictures, and its points."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    pictures = np.array([k for k, name in enumerate(names) if name in images], np.int64)
    chosen = [images[names[k]] for k in pictures]
    lenses = {number: _lens(camera) for number, camera in model.cameras.items()}
    poses = np.tile(np.eye(4), (len(chosen), 1, 1))
    for pose, image in zip(poses, chosen, strict=True):
        pose[:3] = image.cam_from_world().inverse().matrix()
    points = [model.points3D[number] for number in sorted(model.points3D)]
    place = np.array([point.xyz for point in points]).reshape(-1, 3)
    rows = {image.image_id: row for row, image in enumerate(chosen)}
    seen = np.array(
        [(k, rows[e.image_id], e.point2D_idx) for k, point in enumerate(points) for e in point.track.elements], np.int64
    ).reshape(-1, 3)
    counts, errors, total = np.zeros(len(chosen), np.int64), np.zeros(len(chosen)), 0.0
    for row, image in enumerate(chosen):
        mine = seen[seen[:, 1] == row]
        keypoints = image.points2D
        there = np.array([keypoints[index].xy for index in mine[:, 2]]).reshape(-1, 2)
        distance = np.linalg.norm(_project(lenses[image.camera_id], poses[row], place[mine[:, 0]]) - there, axis=1)
        counts[row], errors[row] = len(mine), distance.mean() if len(mine) else np.inf
        total += float(distance.sum())
    return Found(
        pictures,
        poses,
        [lenses[image.camera_id] for image in chosen],
        place,
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.bincount(seen[:, 0], minlength=len(points)),
        counts,
        errors,
        total / max(len(seen), 1),
    )


def _lens(camera: Any) -> Lens:
    """A camera of SIMPLE_RADIAL or RADIAL, the models that are asked for."""
    focal, cx, cy, *radial = (float(value) for value in camera.params)
    distortion = (*radial, *[0.0] * (len(COEFFICIENTS) - len(radial)))
    return Lens((int(camera.width), int(camera.height)), (focal, focal, cx, cy), distortion)


def _project(lens: Lens, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points (n, 3) in the picture of a lens."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    x, y = distort(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2], lens.distortion)
    fx, fy, cx, cy = lens.intrinsics
    return np.stack([fx * x + cx, fy * y + cy], axis=1)
