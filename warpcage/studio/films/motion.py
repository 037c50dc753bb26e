"""Poses and cameras of a film's frames: places among keyframes, and what lies between."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ...core.names import checked_choice
from ...errors import InputError
from ...mesh.mesh import ClosedMesh
from ...view.camera import Camera, CameraKey
from ...view.camera_path import camera_at, timed_keys
from ...view.motion import INTERPOLATIONS, axis_rotation, evenly, value_along

#: How a film goes through its keyframes: there and back, there, or at the last one throughout.
MOTIONS = ("swing", "once", "hold")

#: A cage of any class that has `vertices` and `with_vertices`.
Mesh = TypeVar("Mesh", bound=ClosedMesh)


def pose_weights(count: int, motion: str = "swing") -> np.ndarray:
    """Weights (count,) float64 in [0, 1] of one pose in the frames of a film, gentle at both ends."""
    return frame_places(count, 2, motion)


def frame_places(
    count: int,
    keyframe_count: int,
    motion: str = "swing",
    interpolation: str = "smooth",
    frames: ArrayLike | None = None,
) -> np.ndarray:
    """Places of a film's frames (count,) among keyframes, 0 for the first and keyframe_count - 1 for the last.
    frames: (n,) which of them, or between which, as numbers from 0 on; None is all."""
    if count < 1 or keyframe_count < 1:
        raise InputError(f"a film needs at least one frame and one keyframe, got {count} and {keyframe_count}")
    checked_choice(motion, "motion", MOTIONS)
    checked_choice(interpolation, "interpolation", INTERPOLATIONS)
    if motion == "hold":
        return np.full(count if frames is None else np.shape(frames), keyframe_count - 1.0)
    at = np.arange(count) if frames is None else np.asarray(frames, np.float64)
    # a film that swings loops without a repeated frame
    phase = at / count % 1.0 if motion == "swing" else 0.5 * np.clip(at, 0, count - 1) / max(1, count - 1)
    # phase 0 is the first keyframe, 1/2 the last
    weights = 0.5 - 0.5 * np.cos(2 * np.pi * phase) if interpolation == "smooth" else 1.0 - np.abs(1.0 - 2.0 * phase)
    return weights * (keyframe_count - 1)


def pose_along(keyframes: Sequence[Mesh], place: float, interpolation: str = "smooth") -> Mesh:
    """The cage at a place among keyframes of the same faces; see `value_along`."""
    return keyframes[0].with_vertices(value_along([cage.vertices for cage in keyframes], place, interpolation))


def cameras_along(
    cameras: Sequence[Camera], count: int, interpolation: str = "smooth", frames: ArrayLike | None = None
) -> list[Camera]:
    """`count` cameras on the way through a list of cameras of one picture size, the first and the last included.
    frames: (n,) which of them, or between which, as numbers from 0 on; None is all."""
    if not cameras:
        raise InputError("a camera path needs at least one camera")
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise InputError(f"cameras of a path must have one picture size, got {sorted(sizes)}")
    return [_camera_at(cameras, place, interpolation) for place in evenly(0, len(cameras) - 1, count, frames)]


def path_cameras(keys: Sequence[CameraKey], count: int, frames: ArrayLike | None = None) -> list[Camera]:
    """Cameras evenly over a path, the first and the last key included; keys may have times or not.
    frames: (n,) which of them, or between which, as numbers from 0 on; None is all."""
    if count < 1:
        raise InputError(f"a film needs at least one camera, got {count}")
    ordered = timed_keys(keys)
    times = evenly(ordered[0].time or 0.0, ordered[-1].time or 0.0, count, frames)
    return [camera_at(ordered, float(time)) for time in times]


def _camera_at(cameras: Sequence[Camera], place: float, interpolation: str) -> Camera:
    begin = min(int(place), max(0, len(cameras) - 2))
    end = min(begin + 1, len(cameras) - 1)
    pose = np.eye(4)
    pose[:3, 3] = value_along([camera.center[None] for camera in cameras], place, interpolation)
    pose[:3, :3] = _rotation_between(cameras[begin].rotation, cameras[end].rotation, place - begin)
    names = ("fx", "fy", "cx", "cy")
    lenses = [np.array([getattr(camera, name) for name in names]) for camera in cameras]
    lens = dict(zip(names, value_along(lenses, place, interpolation).tolist(), strict=True))
    return dataclasses.replace(cameras[begin], camera_to_world=pose, **lens)


def _rotation_between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """Rotation (3, 3) at a share of the shortest turn from `first` to `second`."""
    turn = first.T @ second
    cosine = np.clip(0.5 * (np.trace(turn) - 1), -1.0, 1.0)
    angle = np.arccos(cosine)
    if angle < 1e-9:
        return np.array(first)
    symmetric = 0.5 * (turn + turn.T)
    if angle > np.pi - 1e-4:  # half a turn: the axis is the eigenvector of the symmetric part
        axis = np.linalg.eigh(symmetric)[1][:, -1]
    else:
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        axis /= np.linalg.norm(axis)
    return first @ axis_rotation(axis, share * angle)
