"""Camera keys in time, the camera between them, and the cameras that a fit refined."""

from __future__ import annotations

import dataclasses
import itertools
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.checks import checked_number, require_type
from ..core.files import PathLike
from ..core.names import agreed
from ..errors import InputError
from .alignment import Similarity, moved_along
from .camera import Camera, CameraFile, CameraKey, camera_from_json, camera_json, common_up
from .motion import value_at

#: Least condition number, relative to the best, of directions in which the axes of cameras determine a target.
_MIN_CONDITION = 1e-4

#: A target nearer to a camera than this share of the median distance is not what the cameras look at.
_MIN_SHARE = 0.1


def timed_keys(keys: Sequence[CameraKey], length: float | None = None) -> list[CameraKey]:
    """Keys with times, in the order of their times.
    Where none has one, they are spread over `length` seconds; None makes them a second apart."""
    require_type(keys, Sequence, "keys of a camera path must be")
    for key in keys:
        require_type(key, CameraKey, "a key of a camera path must be")
    if not keys:
        raise InputError("a camera path needs at least one camera")
    untimed = [key for key in keys if key.time is None]
    if len(untimed) == len(keys):
        spread = np.linspace(0.0, len(keys) - 1.0 if length is None else length, len(keys)).tolist()
        keys = [dataclasses.replace(key, time=time) for key, time in zip(keys, spread, strict=True)]
    elif untimed:
        raise InputError(
            f"{len(untimed)} of {len(keys)} cameras {agreed(len(untimed), 'has', 'have')} no time: give "
            "all of them one, or none"
        )
    ordered = sorted(keys, key=lambda key: key.time or 0.0)
    for one, two in itertools.pairwise(ordered):
        if one.time == two.time:
            names = f" ({one.name!r} and {two.name!r})" if one.name and two.name else ""
            raise InputError(f"two cameras of a path{names} are at {one.time:g} s: give each a time of its own")
    return ordered


def camera_at(keys: Sequence[CameraKey], time: float, *, closed: bool = False) -> Camera:
    """The camera of a path at a time. Before the first and after the last key it stands still.

    Where the cameras look at a common point, or keys name targets, the camera orbits its target: the target, the
    distance, azimuth and elevation about the cameras' common up, and the roll are interpolated by
    `warpcage.view.motion.value_at`. So it keeps its distance where all keys have the same. Otherwise, as in a pan, the
    position and these angles are interpolated. At a key it is the camera of the key.

    Args:
        keys: The keys, all with times, all of one picture size; see `timed_keys`.
        time: Seconds.
        closed: Whether the last key is the first one again: a loop, which goes through it without stopping.

    Returns:
        The camera.

    Raises:
        ValueError: For no keys, keys without times, or pictures of several sizes.
    """
    time, ordered = checked_number(time, "the time of a camera path"), timed_keys(keys)
    sizes = sorted({(key.camera.width, key.camera.height) for key in ordered})
    if len(sizes) > 1:
        raise InputError(f"cameras of a path must have one picture size, got {sizes}")
    times, easings = [key.time or 0.0 for key in ordered], [key.easing for key in ordered]
    for key, at in zip(ordered, times, strict=True):
        if at == time or (time < at and key is ordered[0]) or (time > at and key is ordered[-1]):
            return key.camera
    distances = _target_distances(ordered)
    frame = up_frame(common_up([key.camera for key in ordered]))
    points, angles, lenses = _track(ordered, distances, frame)
    point, (azimuth, elevation, roll, reach), (fx, fy, cx, cy) = (
        value_at(times, values, time, easings, closed=closed) for values in (points, angles, lenses)
    )
    rotation = frame @ _held(azimuth, elevation, roll)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = point[0] if distances is None else point[0] - math.exp(reach) * rotation[:, 2]
    return dataclasses.replace(ordered[0].camera, fx=fx, fy=fy, cx=cx, cy=cy, camera_to_world=pose)


def _track(
    keys: Sequence[CameraKey], distances: np.ndarray | None, frame: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """What is interpolated of each key: points (1, 3), angles and the logarithm of the distance (4,), lenses (4,)."""
    cameras = [key.camera for key in keys]
    points = np.array([camera.center for camera in cameras])
    reach = np.zeros(len(keys))
    if distances is not None:
        points = points + distances[:, None] * np.array([camera.rotation[:, 2] for camera in cameras])
        reach = np.log(distances)
    angles = np.array([_angles(frame.T @ camera.rotation) for camera in cameras])
    angles[:, [0, 2]] = np.unwrap(angles[:, [0, 2]], axis=0)  # by the shorter way
    lenses = np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras])
    return list(points[:, None]), list(np.column_stack([angles, reach])), list(lenses)


def _angles(rotation: np.ndarray) -> tuple[float, float, float]:
    """Azimuth and elevation of where a camera looks from, about +z, and its roll; radians."""
    backward, up = -rotation[:, 2], -rotation[:, 1]
    elevation = math.asin(min(max(backward[2], -1.0), 1.0))
    # straight above or below the target, the azimuth is that of its upward axis
    across = backward if math.hypot(*backward[:2]) > 1e-3 else -math.copysign(1.0, elevation) * up
    azimuth = math.atan2(across[1], across[0])
    level = _held(azimuth, elevation, 0.0)
    return azimuth, elevation, math.atan2(up @ level[:, 0], -(up @ level[:, 1]))


def _held(azimuth: float, elevation: float, roll: float) -> np.ndarray:
    """The rotation (3, 3) of a camera that has these angles: right, down and forward as columns."""
    aside, above = (np.array([math.cos(angle), math.sin(angle)]) for angle in (azimuth, elevation))
    forward = -np.array([above[0] * aside[0], above[0] * aside[1], above[1]])
    level = np.array([-aside[1], aside[0], 0.0])
    up = np.cross(level, forward)
    right = math.cos(roll) * level - math.sin(roll) * up
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _target_distances(keys: Sequence[CameraKey]) -> np.ndarray | None:
    """(n,) distance of each camera's target ahead of it, None where the cameras look at nothing in common."""
    centers = np.stack([key.camera.center for key in keys])
    axes = np.stack([key.camera.rotation[:, 2] for key in keys])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(axis=0)
    middle = centers.mean(axis=0)  # where the axes say nothing of a direction, the point is as far along as this
    pull = (across @ (centers - middle)[:, :, None])[..., 0].sum(axis=0)
    # the target is on the axis, nearest to the key's point, or to the one that is nearest to all axes (least squares)
    common = middle + np.linalg.pinv(system, rcond=_MIN_CONDITION, hermitian=True) @ pull
    offsets = np.array([common if key.target is None else key.target for key in keys]) - centers
    distances = (offsets * axes).sum(axis=1)
    least = _MIN_SHARE * float(np.median(np.linalg.norm(offsets, axis=1)))
    return distances if distances.min() > max(least, 0.0) else None


def up_frame(up: np.ndarray) -> np.ndarray:
    """(3, 3) columns: two directions across `up`, and `up`."""
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    across = np.cross(up, side)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up], axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class RefinedCameras:
    """Cameras and exposures of pictures as a fit refined them."""

    names: list[str]
    cameras: list[Camera]  # in the field's world
    gains: np.ndarray  # (n, 3) float64, factors of the field's red, green and blue in each picture
    offsets: np.ndarray  # (n, 3) float64, added after that
    given: list[Camera] = dataclasses.field(default_factory=list)  # as they were before; left out, the same

    def __post_init__(self) -> None:
        if not self.given:
            object.__setattr__(self, "given", list(self.cameras))

    def __len__(self) -> int:
        return len(self.cameras)

    def save(self, path: PathLike) -> pathlib.Path:
        """Write them as a camera file, whole or not at all, which `load_scene(path, cameras=...)` takes for its
        pictures."""
        keys = [CameraKey(camera, name=name) for name, camera in zip(self.names, self.cameras, strict=True)]
        # an `exposure` with gain and offset for each, which readers of cameras pass over
        CameraFile(keys).save(path, extras=[{"exposure": exposure} for exposure in self._exposures()])
        return pathlib.Path(path)

    def moved_along(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Other cameras of the same capture, moved by the medians of the six nearest cameras' turns and shifts; focal
        lengths change as those of their lens."""
        return moved_along(cameras, self.given, self.cameras)

    def shrunk(self, divisor: float) -> RefinedCameras:
        """The cameras in a smaller world; divisor: old lengths over new ones."""
        moved = Similarity(1.0 / divisor, np.eye(3), np.zeros(3)).moved
        return dataclasses.replace(self, cameras=moved(self.cameras), given=moved(self.given))

    def entries(self) -> list[dict[str, Any]]:
        """An entry for each picture, for JSON, as files of fields hold it."""
        rows = zip(self.names, self.cameras, self.given, self._exposures(), strict=True)
        return [
            camera_json(CameraKey(camera, name=name)) | {"given": camera_json(CameraKey(given)), "exposure": exposure}
            for name, camera, given, exposure in rows
        ]

    @classmethod
    def from_entries(cls, entries: Sequence[dict[str, Any]]) -> RefinedCameras:
        """The cameras of `entries`; ValueError, KeyError or TypeError for others."""
        keys, given = (
            [camera_from_json(entry, index) for index, entry in enumerate(rows)]
            for rows in (entries, [entry["given"] for entry in entries])
        )
        gains, offsets = (
            np.array([entry["exposure"][name] for entry in entries], np.float64) for name in ("gain", "offset")
        )
        for values in (gains, offsets):
            if values.shape != (len(keys), 3) or not np.isfinite(values).all():
                raise InputError("refined cameras have exposures that are not three finite numbers each")
        return cls(
            [key.name for key in keys], [key.camera for key in keys], gains, offsets, [key.camera for key in given]
        )

    def _exposures(self) -> list[dict[str, list[float]]]:
        pairs = zip(self.gains.tolist(), self.offsets.tolist(), strict=True)
        return [{"gain": gain, "offset": offset} for gain, offset in pairs]
