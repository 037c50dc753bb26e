"""NeRF-synthetic (Blender) folders: transforms_<split>.json beside RGBA images (Mildenhall et al. 2020)."""

from __future__ import annotations

import pathlib

import numpy as np

from ..scene import Scene
from .parsing import find_picture, matrix, missing_split, number, read_json
from .views import View, make_scene

MARK = "transforms_train.json with camera_angle_x"

#: From Blender's camera axes (+y up, -z forward) to OpenCV's, to multiply poses with from the right.
TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def is_scene(folder: pathlib.Path) -> bool:
    transforms = sorted(folder.glob("transforms_*.json"))
    if not transforms:
        return False
    content = read_json(transforms[0])
    return "camera_angle_x" in content and "fl_x" not in content


def read(folder: pathlib.Path, *, split: str, downscale: int, background: np.ndarray, masks: bool | str) -> Scene:
    """Read a split; camera axes are turned from Blender's (+y up, -z forward) to OpenCV's."""
    path = split_file(folder, split)
    transforms = read_json(path)
    angle = number(transforms.get("camera_angle_x"), f"{path}: camera_angle_x")
    if not 0 < angle < np.pi:
        raise ValueError(f"{path}: camera_angle_x must lie between 0 and pi, got {angle}")

    def intrinsics(size):
        focal = 0.5 * size[0] / np.tan(0.5 * angle)
        return focal, focal, size[0] / 2, size[1] / 2

    views = []
    for where, frame in frames_of(transforms, path):
        file = find_picture(folder, frame.get("file_path"), f"{where}: file_path")
        pose = matrix(frame.get("transform_matrix"), (4, 4), f"{where}: transform_matrix") @ TO_OPENCV
        views.append(View(file, pose, where, intrinsics))
    return make_scene(views, downscale=downscale, background=background, masks=masks)


def split_file(folder: pathlib.Path, split: str) -> pathlib.Path:
    """transforms_<split>.json; FileNotFoundError that names the splits there are."""
    files = {file.stem.removeprefix("transforms_"): file for file in sorted(folder.glob("transforms_*.json"))}
    if split not in files:
        raise missing_split(split, folder, files)
    return files[split]


def frames_of(transforms: dict, path: pathlib.Path) -> list[tuple[str, dict]]:
    """The frames of a transforms file, each with its name for messages."""
    frames = transforms.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{path} holds no frames")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise ValueError(f"{path}: frame {index} must be a JSON object")
    return [(f"{path}: frame {index}", frame) for index, frame in enumerate(frames)]
