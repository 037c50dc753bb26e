"""Captures of phones with LiDAR: the raw data of Polycam, and Record3D as it exports it."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...core.checks import shown
from ...errors import InputError, MissingFileError
from ..pictures import View, files_of, make_scene, views_there
from ..scene import Scene
from .colmap import ModelImage
from .parsing import PICTURE_ENDINGS, TO_OPENCV, held_out, is_file, number, read_json

POLYCAM_MARK = "keyframes/ with cameras/ and images/"

#: From ARKit's world, y up, to z up.
TO_Z_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def is_polycam(folder: pathlib.Path) -> bool:
    """Whether a folder holds the raw data of Polycam."""
    return (folder / "keyframes" / "cameras").is_dir()


def read_polycam(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`."""
    keyframes = folder / "keyframes"
    views = _polycam_views(keyframes, "corrected_") or _polycam_views(keyframes, "")
    if not views:
        raise InputError(f"{keyframes / 'cameras'} holds no cameras (.json)")
    views = views_there(views, keyframes)
    chosen = [views[index] for index in held_out(len(views), split, folder)]
    return make_scene(folder, chosen, **options, beside=files_of(views), to_source=np.linalg.inv(TO_Z_UP))


def _polycam_views(keyframes: pathlib.Path, kind: str) -> list[View]:
    """The pictures of a kind with their cameras, by name."""
    cameras, images = keyframes / f"{kind}cameras", keyframes / f"{kind}images"
    return [_polycam_view(file, images) for file in sorted(cameras.glob("*.json"))] if images.is_dir() else []


def _polycam_view(file: pathlib.Path, images: pathlib.Path) -> View:
    given = read_json(file)

    def value(name: str) -> float:
        return number(given.get(name), f"{file}: {name}")

    pose = np.eye(4)
    pose[:3] = [[value(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    candidates = [images / (file.stem + ending) for ending in (".jpg", *PICTURE_ENDINGS)]
    picture = next((candidate for candidate in candidates if is_file(candidate)), candidates[0])
    return View(
        picture,
        TO_Z_UP @ pose @ TO_OPENCV,
        str(file),
        (value("fx"), value("fy"), value("cx"), value("cy")),
        (int(value("width")), int(value("height"))),
    )


RECORD3D_MARK = "metadata or metadata.json with poses, beside rgb/ or rgbd/"

#: Captures have 60 pictures a second: no more than this are taken, evenly, as nerfstudio does.
MOST_PICTURES = 300


def is_record3d(folder: pathlib.Path) -> bool:
    """Whether a folder holds a capture of Record3D."""
    return _metadata(folder) is not None and any((folder / name).is_dir() for name in ("rgb", "rgbd"))


def read_record3d(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`."""
    path = _metadata(folder)
    if path is None:
        raise MissingFileError(f"{str(folder)!r} holds no capture of Record3D ({RECORD3D_MARK})")
    given = read_json(path)
    poses = given.get("poses")
    if not isinstance(poses, list) or not poses:
        raise InputError(f"{path} holds no poses")
    images = folder / ("rgb" if (folder / "rgb").is_dir() else "rgbd")
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST_PICTURES)).round().astype(int))
    views = views_there([_record3d_view(path, images, given, poses, int(index)) for index in chosen], path)
    chosen = [views[index] for index in held_out(len(views), split, folder)]
    return make_scene(folder, chosen, **options, beside=files_of(views), to_source=np.linalg.inv(TO_Z_UP))


def _metadata(folder: pathlib.Path) -> pathlib.Path | None:
    return next((folder / name for name in ("metadata.json", "metadata") if is_file(folder / name)), None)


def _numbers(value: object, count: int, where: str) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{where} must hold {count} numbers, got {shown(value)}")
    return [number(each, where) for each in value]


def _record3d_view(path: pathlib.Path, images: pathlib.Path, given: dict, poses: list, index: int) -> View:
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
