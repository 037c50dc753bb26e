"""Motion: how cages and cameras go from keyframe to keyframe."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..mesh.mesh import ClosedMesh
from .camera import Camera
from .keys import value_at

#: How a film goes through its keyframes: there and back, there, or at the last one throughout.
MOTIONS = ("swing", "once", "hold")

#: How it goes from one keyframe to the next.
INTERPOLATIONS = ("smooth", "linear")

#: A cage of any class that has `vertices` and `with_vertices`.
Mesh = TypeVar("Mesh", bound=ClosedMesh)


def pose_weights(count: int, motion: str = "swing") -> np.ndarray:
    """Weights (count,) float64 in [0, 1] of one pose in the frames of a film, gentle at both ends."""
    return frame_places(count, 2, motion)


def frame_places(count: int, keyframe_count: int, motion: str = "swing", interpolation: str = "smooth") -> np.ndarray:
    """Places (count,) of a film's frames among keyframes, 0 for the first and keyframe_count - 1 for the last."""
    if count < 1 or keyframe_count < 1:
        raise ValueError(f"a film needs at least one frame and one keyframe, got {count} and {keyframe_count}")
    if motion not in MOTIONS:
        raise ValueError(f"motion {motion!r} is not known: {', '.join(MOTIONS)}")
    _check_interpolation(interpolation)
    if motion == "hold":
        return np.full(count, keyframe_count - 1.0)
    # a film that swings loops without a repeated frame
    phase = np.arange(count) / count if motion == "swing" else 0.5 * np.arange(count) / max(1, count - 1)
    # phase 0 is the first keyframe, 1/2 the last
    weights = 0.5 - 0.5 * np.cos(2 * np.pi * phase) if interpolation == "smooth" else 1.0 - np.abs(1.0 - 2.0 * phase)
    return weights * (keyframe_count - 1)


def value_along(values: Sequence[np.ndarray], place: float, interpolation: str = "smooth") -> np.ndarray:
    """The value at a place among keyframes, from 0 for the first to len(values) - 1 for the last.
    `values` are arrays of one shape: (d,) d numbers of their own, or (..., d) vectors."""
    # "linear" joins keyframes by straight lines, "smooth" by cubics whose speed does not jump at keyframes and that
    # never go beyond them (see `value_at`; straight at both ends).
    _check_interpolation(interpolation)
    if not 0 <= place <= len(values) - 1:
        raise ValueError(f"a place among {len(values)} keyframes must be 0 to {len(values) - 1}, got {place}")
    return value_at(range(len(values)), values, place, [interpolation] * len(values), still_ends=False)


def pose_between(rest: Mesh, posed: Mesh, weight: float) -> Mesh:
    """`rest` with its vertices moved by a share, `weight`, of the straight way to `posed`, of the same faces."""
    return rest.with_vertices((1.0 - weight) * rest.vertices + weight * posed.vertices)


def pose_along(keyframes: Sequence[Mesh], place: float, interpolation: str = "smooth") -> Mesh:
    """The cage at a place among keyframes of the same faces; see `value_along`."""
    return keyframes[0].with_vertices(value_along([cage.vertices for cage in keyframes], place, interpolation))


def cameras_along(cameras: Sequence[Camera], count: int, interpolation: str = "smooth") -> list[Camera]:
    """`count` cameras on the way through a list of cameras of one picture size, the first and the last included."""
    if not cameras:
        raise ValueError("a camera path needs at least one camera")
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise ValueError(f"cameras of a path must have one picture size, got {sorted(sizes)}")
    # centres go as keyframes do, rotations by the shortest turn from one to the next
    return [_camera_at(cameras, place, interpolation) for place in np.linspace(0, len(cameras) - 1, count)]


def axis_rotation(axis: ArrayLike, angle: float) -> np.ndarray:
    """The rotation (3, 3) about a unit vector (3,) by an angle, radians, counterclockwise seen from its tip."""
    x, y, z = np.asarray(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # Rodrigues' formula
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _camera_at(cameras: Sequence[Camera], place: float, interpolation: str) -> Camera:
    begin = min(int(place), max(0, len(cameras) - 2))
    end = min(begin + 1, len(cameras) - 1)
    pose = np.eye(4)
    pose[:3, 3] = value_along([camera.centre[None] for camera in cameras], place, interpolation)
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


def _check_interpolation(interpolation: str) -> None:
    if interpolation not in INTERPOLATIONS:
        raise ValueError(f"interpolation {interpolation!r} is not known: {', '.join(INTERPOLATIONS)}")
