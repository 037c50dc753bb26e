"""NeRF-synthetic (Blender) folders: transforms_<split>.json beside RGBA images (Mildenhall et al. 2020)."""

from __future__ import annotations

import pathlib

import numpy as np

from ..scene import Scene
from .parsing import TO_OPENCV, find_picture, frames_of, matrix, number, read_json, split_file
from .views import View, make_scene

MARK = "transforms_train.json with camera_angle_x"


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds transforms_<split>.json as NeRF-synthetic scenes have it."""
    transforms = sorted(folder.glob("transforms_*.json"))
    if not transforms:
        return False
    content = read_json(transforms[0])
    return "camera_angle_x" in content and "fl_x" not in content


def read(folder: pathlib.Path, *, split: str, downscale: int, background: np.ndarray, masks: bool | str) -> Scene:
    """Read a split; camera axes are turned from Blender's (+y up, -z forward) to OpenCV's. Options as `load_scene`."""
    path = split_file(folder, split)
    transforms = read_json(path)
    angle = number(transforms.get("camera_angle_x"), f"{path}: camera_angle_x")
    if not 0 < angle < np.pi:
        raise ValueError(f"{path}: camera_angle_x must lie between 0 and pi, got {angle}")

    def intrinsics(size: tuple[int, int]) -> tuple[float, float, float, float]:
        focal = 0.5 * size[0] / np.tan(0.5 * angle)
        return focal, focal, size[0] / 2, size[1] / 2

    views = []
    for where, frame in frames_of(transforms, path):
        file = find_picture(folder, frame.get("file_path"), f"{where}: file_path")
        pose = matrix(frame.get("transform_matrix"), (4, 4), f"{where}: transform_matrix") @ TO_OPENCV
        views.append(View(file, pose, where, intrinsics))
    return make_scene(folder, views, downscale=downscale, background=background, masks=masks)
