"""Captures of Record3D as it exports them (.r3d unpacked, or "EXR + RGB"): metadata beside rgb/ or rgbd/."""
# metadata (or metadata.json) holds K, the intrinsic matrix column by column, w, h, and poses: for each picture a
# quaternion (x, y, z, w) and a place, camera to world: ARKit's axes, the world's y up, the camera's +y up and -z
# forward; perFrameIntrinsicCoeffs (fx, fy, cx, cy) where focus moved. Pictures are 0.jpg, 1.jpg, ... Here z is up.

from __future__ import annotations

import pathlib

import numpy as np

from ...core.checks import shown
from ..scene import Scene
from .colmap_model import ModelImage
from .parsing import PICTURE_ENDINGS, TO_OPENCV, held_out, is_file, number, read_json
from .polycam import TO_Z_UP
from .views import View, make_scene, views_there

MARK = "metadata or metadata.json with poses, beside rgb/ or rgbd/"

#: Captures have 60 pictures a second: no more than this are taken, evenly, as nerfstudio does.
MOST_PICTURES = 300


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds a capture of Record3D."""
    return _metadata(folder) is not None and any((folder / name).is_dir() for name in ("rgb", "rgbd"))


def read(folder: pathlib.Path, *, split: str, downscale: int, background: np.ndarray, masks: bool | str) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`."""
    path = _metadata(folder)
    if path is None:
        raise FileNotFoundError(f"{str(folder)!r} holds no capture of Record3D ({MARK})")
    given = read_json(path)
    poses = given.get("poses")
    if not isinstance(poses, list) or not poses:
        raise ValueError(f"{path} holds no poses")
    images = folder / ("rgb" if (folder / "rgb").is_dir() else "rgbd")
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST_PICTURES)).round().astype(int))
    views = views_there([_view(path, images, given, poses, int(index)) for index in chosen], path)
    views = [views[index] for index in held_out(len(views), split, folder)]
    return make_scene(
        folder, views, downscale=downscale, background=background, masks=masks, to_source=np.linalg.inv(TO_Z_UP)
    )


def _metadata(folder: pathlib.Path) -> pathlib.Path | None:
    return next((folder / name for name in ("metadata.json", "metadata") if is_file(folder / name)), None)


def _numbers(value: object, count: int, where: str) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"{where} must hold {count} numbers, got {shown(value)}")
    return [number(each, where) for each in value]


def _view(path: pathlib.Path, images: pathlib.Path, given: dict, poses: list, index: int) -> View:
    """One picture with its camera."""
    where = f"{path}: picture {index}"
    x, y, z, w, *place = _numbers(poses[index], 7, f"{path}: poses[{index}]")
    # ModelImage holds the inverse motion: that of the conjugate, without a shift
    pose = ModelImage("", (w, -x, -y, -z), (0.0, 0.0, 0.0), 0).camera_to_world(where)
    pose[:3, 3] = place
    each = given.get("perFrameIntrinsicCoeffs")
    if isinstance(each, list) and len(each) == len(poses):
        fx, fy, cx, cy = _numbers(each[index], 4, f"{path}: perFrameIntrinsicCoeffs[{index}]")
    else:
        matrix = _numbers(given.get("K"), 9, f"{path}: K")
        fx, fy, cx, cy = matrix[0], matrix[4], matrix[6], matrix[7]
    candidates = [images / f"{index}{ending}" for ending in (".jpg", *PICTURE_ENDINGS)]
    picture = next((candidate for candidate in candidates if is_file(candidate)), candidates[0])
    size = (int(number(given.get("w"), f"{path}: w")), int(number(given.get("h"), f"{path}: h")))
    return View(picture, TO_Z_UP @ pose @ TO_OPENCV, where, (fx, fy, cx, cy), size)
