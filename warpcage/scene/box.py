"""Where the cameras of a scene look: the box around its object."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence

import numpy as np

from ..core.names import agreed
from ..errors import InputError
from ..view.camera import Camera

#: Where all cameras look the same way, the object is taken to be this many times their largest spread ahead.
PARALLEL_DISTANCE = 4.0

#: Optical axes whose equations are conditioned worse than this are taken to be parallel.
MAX_CONDITION = 1e6

#: Fewer points of a reconstruction say nothing about where the object is.
MIN_POINTS = 8

#: A point is no outlier where so many others are within this share of the diagonal of the bulk of them.
NEIGHBORS, NEIGHBOR_RADIUS = 5, 0.03

#: A box reaches upwards along axes with more of the direction up than this.
UPWARD = 0.5

#: Half side of the box over the radius of the object that a camera sees whole; most of it may be of its distance.
BOX_ROOM, MOST_OF_DISTANCE = 1.2, 0.95


def view_box(cameras: Sequence[Camera]) -> np.ndarray:
    """A cube around what cameras look at: (2, 3) float64 lower and upper corner, world units."""
    # Its centre is the point nearest to all optical axes (least squares; ahead of the cameras where those are
    # parallel), its half side the largest radius that most cameras see whole, at most their distance to the centre.
    centers = np.stack([camera.center for camera in cameras])
    center = axes_meeting(cameras)
    center = center_ahead(cameras) if center is None else center
    distance = np.linalg.norm(centers - center, axis=1)
    tangent = np.array([max(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in cameras])
    # an object that fills the image's longer side at that distance
    half = float(np.median(distance * tangent / np.sqrt(1 + tangent**2))) * BOX_ROOM
    half = min(half, MOST_OF_DISTANCE * float(distance.min())) if distance.min() > 0 else half
    return np.stack([center - half, center + half])


def _centers_and_axes(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Places and directions of view of cameras, (n, 3) each."""
    return np.stack([camera.center for camera in cameras]), np.stack([camera.rotation[:, 2] for camera in cameras])


def axes_meeting(cameras: Sequence[Camera]) -> np.ndarray | None:
    """The point (3,) nearest to all optical axes, by least squares; None for one camera and for parallel ones."""
    centers, axes = _centers_and_axes(cameras)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(axis=0)
    if not np.linalg.cond(system) < MAX_CONDITION:
        return None
    return np.linalg.solve(system, (across @ centers[:, :, None])[..., 0].sum(axis=0))


def center_ahead(cameras: Sequence[Camera]) -> np.ndarray:
    """A point (3,) ahead of cameras that look the same way, by how far apart they are: nothing says how far it is."""
    centers, axes = _centers_and_axes(cameras)
    spread = float(np.ptp(centers, axis=0).max())
    return (centers + axes * (PARALLEL_DISTANCE * spread if spread > 0 else 1.0)).mean(axis=0)


def scene_box(cameras: Sequence[Camera], bounds: np.ndarray | None = None) -> np.ndarray:
    """The box (2, 3) float64 of a scene's object, world units: the bounds of its files, or what the cameras look at.
    ValueError where they look at nothing in common."""
    if bounds is not None:
        return bounds
    box = view_box(cameras)
    away = sum((box.mean(axis=0) - camera.center) @ camera.rotation[:, 2] <= 0 for camera in cameras)
    if 2 * away > len(cameras):
        raise InputError(
            f"{away} of {len(cameras)} cameras {agreed(away, 'looks', 'look')} away from what the views "
            "have in common: check the "
            "cameras' axes, or give the bounds of what should be fitted"
        )
    if not (box[1] > box[0]).all():
        raise InputError(
            "the cameras do not tell the size of what they look at: check focal lengths and positions, or "
            "give the bounds of what should be fitted"
        )
    return box


def bulk_box(points: np.ndarray, seen_box: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """A box (2, 3) float64 around the bulk of reconstructed points (n, 3) in seen_box (2, 3), or of all; up: (3,) unit
    vector. None where there are too few points, or no extent."""
    low, high = seen_box
    seen = points[((points > low) & (points < high)).all(axis=1)]
    is_seen = len(seen) >= max(MIN_POINTS, len(points) // 4)
    bulk = seen if is_seen else points
    if len(bulk) < MIN_POINTS:
        return None
    low, high = np.percentile(bulk, [1.0, 99.0], axis=0)  # a few are always far off
    margin = 0.1 * float((high - low).max())
    if not (np.isfinite(margin) and margin > 0):
        return None
    radius = NEIGHBOR_RADIUS * float(np.linalg.norm(high - low))
    # Most points lie on the floor. Above the bulk the box also holds points with others near them: an arm or an ear has
    # few, beside each other, and mistakes of the reconstruction are alone.
    together = bulk[are_inliers(bulk, radius)] if is_seen else bulk[:0]
    top, bottom = together.max(axis=0, initial=-np.inf), together.min(axis=0, initial=np.inf)
    high = np.where(up > UPWARD, np.maximum(high, top), high)
    low = np.where(up < -UPWARD, np.minimum(low, bottom), low)
    return np.stack([low - margin, high + margin])


def are_inliers(points: np.ndarray, radius: float) -> np.ndarray:
    """Which points (n, 3) have NEIGHBOURS others within a radius, world units (radius outlier removal)."""
    from scipy.spatial import KDTree

    if len(points) <= NEIGHBORS:
        return np.zeros(len(points), bool)
    distances = np.asarray(KDTree(points).query(points, NEIGHBORS + 1)[0])  # the first is the point itself
    return distances[:, -1] <= radius


class Bounds:
    """Where the files of a scene may lie, by real paths: in its folder, or where a link to a folder in it leads.
    Such a link is `images -> /captures/fox/images`; links deeper inside, and to files, must not lead elsewhere."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder
        with os.scandir(folder) as entries:
            linked = [entry.path for entry in entries if entry.is_symlink() and entry.is_dir()]
        self.roots = [pathlib.Path(os.path.realpath(path)) for path in (folder, *linked)]

    def require(self, path: pathlib.Path, where: str) -> pathlib.Path:
        """The path of a file that a scene names; ValueError where it lies elsewhere."""
        real = pathlib.Path(os.path.realpath(path))
        if not any(real.is_relative_to(root) for root in self.roots):
            raise InputError(
                f"{where}: {path.name[:60]!r} is a link that leads out of the data folder {str(self.folder)!r}: put "
                "the file there, or a link to its whole folder"
            )
        return path
