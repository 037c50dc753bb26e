"""Two sets of cameras of the same pictures: similarities between them, and how others move along with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from .camera import Camera


@dataclasses.dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation x + shift, with rotation (3, 3) and shift (3,), float64, in units of the target."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    def moved(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Cameras that see the moved world as these see theirs."""
        poses = self.moved_poses(np.array([camera.camera_to_world for camera in cameras]).reshape(-1, 4, 4))
        return [dataclasses.replace(camera, camera_to_world=pose) for camera, pose in zip(cameras, poses, strict=True)]

    def moved_poses(self, poses: np.ndarray) -> np.ndarray:
        """(n, 4, 4) camera_to_world after the motion."""
        moved = poses.copy()
        moved[:, :3, :3] = self.rotation @ poses[:, :3, :3]
        moved[:, :3, 3] = self.scale * poses[:, :3, 3] @ self.rotation.T + self.shift
        return moved


def aligning_similarity(poses: np.ndarray, targets: np.ndarray, *, scaled: bool = True) -> Similarity:
    """The similarity that takes cameras (n, 4, 4) best to others of the same pictures, by places and by axes; n >= 1.
    The scale is 1 where lengths may not change (`scaled`), and where all places are one."""
    # It minimises sum |s R c + t - c'|^2 over the places, with R that of sum |s0 R c - c'|^2 + r^2 |R Q - Q'|^2: places
    # relative to their means, axes Q weighed by the spread r of the places, so that cameras on a line or in one place
    # are aligned by their axes (Umeyama 1991 for places; Horn 1987).
    centers, goals = poses[:, :3, 3], targets[:, :3, 3]
    spread, goal_spread = centers - centers.mean(axis=0), goals - goals.mean(axis=0)
    size, goal_size = (float(np.sqrt((part**2).sum() / len(part))) for part in (spread, goal_spread))
    weight = goal_size**2 if goal_size > 0 and size > 0 else 1.0
    factor = goal_size / size if goal_size > 0 and size > 0 else 1.0
    covariance = factor * goal_spread.T @ spread + weight * np.einsum(
        "nij,nkj->ik", targets[:, :3, :3], poses[:, :3, :3]
    )
    left, _, right = np.linalg.svd(covariance)
    rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    scale = 1.0
    if scaled and size > 0 and goal_size > 0:
        scale = float(np.einsum("ni,ij,nj->", goal_spread, rotation, spread) / (spread**2).sum())
        scale = scale if scale > 0 else 1.0
    return Similarity(scale, rotation, goals.mean(axis=0) - scale * rotation @ centers.mean(axis=0))


#: Steps of Gauss-Newton by which an alignment of pictures is found, and largest slope at which a point counts.
PICTURE_STEPS, WIDEST = 4, 4.0


def picture_similarity(poses: np.ndarray, targets: np.ndarray, points: np.ndarray) -> Similarity:
    """The similarity after which cameras (n, 4, 4) see points as others of the same pictures do.
    `points` (m, 3) are where the targets' world holds what is seen."""
    # A small turn of a camera and a shift across show an object the same way: poses found from pictures are inexact
    # along both together. So places in pictures count: Gauss-Newton on sum |u(S pose, x) - u(target, x)|^2 with
    # u = (x / z, y / z) in front of a camera, from `aligning_similarity` on.
    goal, _ = _seen(targets, points)
    valid = (np.abs(goal) < WIDEST).all(axis=2) & np.isfinite(goal).all(axis=2)
    found = aligning_similarity(poses, targets)
    middle = points.mean(axis=0)
    arms = points - middle
    size = max(float(np.sqrt((arms**2).sum(axis=1).mean())), 1e-12)
    # how points move, relative to the cameras, when the cameras are turned, shifted and spread about the middle
    moves = np.empty((len(points), 3, 7))
    for axis in range(3):
        moves[:, :, axis] = -np.cross(np.eye(3)[axis], arms)
        moves[:, :, 3 + axis] = -size * np.eye(3)[axis]
    moves[:, :, 6] = -arms
    for _ in range(PICTURE_STEPS):
        seen, slopes = _seen(found.moved_poses(poses), points)
        there = np.asarray(valid & np.isfinite(seen).all(axis=2))
        missed = np.where(there[..., None], seen - goal, 0.0).reshape(-1)
        jacobian = np.where(there[..., None, None], slopes @ moves, 0.0).reshape(-1, 7)
        normal = jacobian.T @ jacobian
        step = np.linalg.lstsq(normal, -jacobian.T @ missed, rcond=1e-9)[0]
        scale, rotation = float(np.exp(step[6])), _rotation(step[:3])
        shift = middle + size * step[3:6] - scale * rotation @ middle
        found = Similarity(scale * found.scale, rotation @ found.rotation, scale * rotation @ found.shift + shift)
    return found


def picture_shifts(poses: np.ndarray, targets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far from where others see points (m, 3) cameras (n, 4, 4) see them, in focal lengths.
    Root mean squares (n,) over the points; 0 where a camera sees none."""
    return spread_of(picture_moves(poses, targets, points))


def picture_moves(
    poses: np.ndarray, targets: np.ndarray, points: np.ndarray, zooms: np.ndarray | None = None
) -> np.ndarray:
    """(n, m, 2) where others (n, 4, 4) see points (m, 3) from where cameras do, in focal lengths; NaN behind either.
    zooms: (n,) logarithms of the others' focal lengths over the cameras'; None is none."""
    others = _seen(targets, points)[0]
    others = others if zooms is None else np.exp(zooms)[:, None, None] * others
    return others - _seen(poses, points)[0]


def spread_of(moves: np.ndarray) -> np.ndarray:
    """(n,) root mean squares of moves (n, m, 2) over the points, those that are NaN left out; 0 where all are."""
    squares = (moves**2).sum(axis=2)
    there = np.isfinite(squares)
    return np.sqrt(np.where(there, squares, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1))


def _seen(poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, m, 2) slopes x / z and y / z of points, NaN behind a camera, and (n, m, 2, 3) how they change with them."""
    local = (points - poses[:, None, :3, 3]) @ poses[:, :3, :3]
    depth = np.where(local[..., 2] > 0, local[..., 2], np.nan)[..., None]
    seen = local[..., :2] / depth
    across, along = np.swapaxes(poses[:, None, :3, :2], 2, 3), poses[:, None, None, :3, 2]
    return seen, (across - seen[..., None] * along) / depth[..., None]


def _rotation(turn: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(turn).as_matrix()


def pose_errors(poses: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far cameras (n, 4, 4) are from others of the same pictures, after the best similarity.
    Returns angles (n,) in degrees, and distances (n,) in units of the targets."""
    moved = aligning_similarity(poses, targets).moved_poses(poses)
    turns = np.einsum("nij,nik->njk", targets[:, :3, :3], moved[:, :3, :3])
    skew = np.stack(
        [turns[:, 2, 1] - turns[:, 1, 2], turns[:, 0, 2] - turns[:, 2, 0], turns[:, 1, 0] - turns[:, 0, 1]], 1
    )
    angles = np.arctan2(np.linalg.norm(skew, axis=1), np.trace(turns, axis1=1, axis2=2) - 1.0)
    return np.degrees(angles), np.linalg.norm(moved[:, :3, 3] - targets[:, :3, 3], axis=1)


def pose_changes(poses: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(n, 6) turns about a camera's own axes, then shifts along those it has then, from poses (n, 4, 4) to others."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(np.swapaxes(poses[:, :3, :3], 1, 2) @ targets[:, :3, :3]).as_rotvec()
    shifts = np.einsum("nji,nj->ni", targets[:, :3, :3], targets[:, :3, 3] - poses[:, :3, 3])
    return np.concatenate([turns, shifts], axis=1)


#: Cameras near another one that its motion is taken from.
NEIGHBORS = 6

#: Two poses are one where their axes differ by no more, and their places by no more of the cameras' spread.
SAME_POSE = 1e-6


def moved_along(cameras: Sequence[Camera], given: Sequence[Camera], refined: Sequence[Camera]) -> list[Camera]:
    """Cameras that go along with those near them, given and refined ones of the same pictures: by medians of their
    turns and shifts, and their lens's zoom. A given one goes where that went, a refined one stays."""
    # No picture is looked at: what a held-out view then shows is predicted. Turns and shifts are about a camera's own
    # axes: an error of a lens moves every camera of an arc along its axis.
    starts, ends = (np.array([camera.camera_to_world for camera in each]) for each in (given, refined))
    changes, lenses = pose_changes(starts, ends), np.array([_lens(camera) for camera in given])
    zooms = np.log([one.fx / other.fx for one, other in zip(refined, given, strict=True)])
    places = starts[:, :3, 3]
    spread = max(float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1))), 1e-12)
    apart = np.array([_apart(pose, starts, spread) for pose in starts])
    share = 1.0
    if len(given) > 1:
        np.fill_diagonal(apart, np.inf)
        share = _predicted_share(changes, np.array([_near(changes, row) for row in apart]), spread)
    found = []
    for camera in cameras:
        pose = camera.camera_to_world.copy()
        if _apart(pose, ends, spread).min() < SAME_POSE:
            found.append(camera)
            continue
        distances = _apart(pose, starts, spread)
        known = distances.min() < SAME_POSE
        change = changes[distances.argmin()] if known else share * _near(changes, distances)
        alike = np.isclose(lenses, _lens(camera), rtol=1e-4).all(axis=1)
        factor = float(np.exp(np.median(zooms[alike]))) if alike.any() else 1.0
        pose[:3, :3] = pose[:3, :3] @ _rotation(change[:3])
        pose[:3, 3] += pose[:3, :3] @ change[3:]
        found.append(dataclasses.replace(camera, fx=factor * camera.fx, fy=factor * camera.fy, camera_to_world=pose))
    return found


def _near(changes: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """(6,) the median of the changes (n, 6) of the cameras that are nearest, none of them infinitely far."""
    nearest = np.argsort(distances, kind="stable")[: min(NEIGHBORS, int(np.isfinite(distances).sum()))]
    return np.median(changes[nearest], axis=0)


def _predicted_share(changes: np.ndarray, predicted: np.ndarray, spread: float) -> float:
    """How much of what cameras' neighbors predict (n, 6) their own changes (n, 6) bear out: 1 all, 0 where each camera
    was off by itself, as its neighbors' changes are noise then."""
    # Least squares for changes = share * predicted, of where the middle of a picture goes, of rolls and of ways ahead.
    moves = []
    for each in (changes, predicted):
        turns, shifts = each[:, :3], each[:, 3:] / spread
        moves.append(
            np.column_stack([turns[:, 0] - shifts[:, 1], turns[:, 1] + shifts[:, 0], turns[:, 2], shifts[:, 2]])
        )
    own, near = moves
    weights = 1.0 / np.maximum(np.linalg.norm(own, axis=1) + np.linalg.norm(near, axis=1), 1e-12)[:, None]
    return float(np.clip((weights * own * near).sum() / max((weights * near * near).sum(), 1e-30), 0.0, 1.0))


def _apart(pose: np.ndarray, poses: np.ndarray, spread: float) -> np.ndarray:
    """(n,) how far poses (n, 4, 4) are from one: distances over the cameras' spread and, about, angles."""
    turns = np.sqrt(0.5 * ((poses[:, :3, :3] - pose[:3, :3]) ** 2).sum(axis=(1, 2)))
    return np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) / spread + turns


def _lens(camera: Camera) -> list[float]:
    """Focal lengths and principal point over the picture's sides, which are those of any size of it."""
    sides = [camera.width, camera.height] * 2
    return [number / side for number, side in zip((camera.fx, camera.fy, camera.cx, camera.cy), sides, strict=True)]
