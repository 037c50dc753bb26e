"""Views of one object or place: Nerfies and HyperNeRF, BlendedMVS and others of MVSNet's layout, NeRF++."""
# Cameras have OpenCV's axes; the corner of the first pixel is (0, 0), as the authors' own loaders add half a pixel.

from __future__ import annotations

import pathlib
import re
from typing import Any

import numpy as np

from ....core.checks import checked_number, shown, warn_caller
from ....core.npz import NpyFile
from ....errors import InputError, MissingFileError
from ...box import Bounds
from ...lenses import Intrinsics, intrinsics_at
from ...parsing import (
    floats,
    inside,
    intrinsics_of,
    matrix,
    matrix_file,
    missing_split,
    picture_size,
    pictures_in,
    read_json,
    read_text,
)
from ...pictures import held_out_scene, make_scene, views_there
from ...scene import Scene
from ...sizes import Size, View, chosen_copy

# Nerfies (Park et al. 2021a) and HyperNeRF (Park et al. 2021b): the README of google/nerfies.

NERFIES_MARK = "dataset.json, camera/ and rgb/ (Nerfies, HyperNeRF)"


def is_nerfies(folder: pathlib.Path) -> bool:
    """Whether a folder holds a capture as Nerfies and HyperNeRF have it."""
    return (folder / "dataset.json").is_file() and (folder / "camera").is_dir() and (folder / "rgb").is_dir()


def read_nerfies(folder: pathlib.Path, *, split: str, downscale: int, **options: Any) -> Scene:
    """Read a split of dataset.json, `train`, `val` or `all`; rgb/4x is read for a downscale of 4. Options as usual."""
    path, allowed = folder / "dataset.json", Bounds(folder)
    listing = read_json(path)
    lists = {name: listing.get(key) for name, key in (("train", "train_ids"), ("val", "val_ids"), ("all", "ids"))}
    lists = {name: ids for name, ids in lists.items() if ids}
    if split not in lists:
        raise missing_split(split, folder, lists)
    if not isinstance(lists[split], list):
        raise InputError(f"{path}: its ids of {split!r} must be a list of names of pictures, got {shown(lists[split])}")
    sizes = {
        int(each.name[:-1]): each for each in (folder / "rgb").iterdir() if re.fullmatch(r"0*[1-9]\d?x", each.name)
    }
    if not sizes:
        raise MissingFileError(f"{str(folder / 'rgb')!r} holds no pictures in 1x/, 2x/, 4x/ or others")
    factor, rest = chosen_copy(sizes, downscale, folder / "rgb")
    images = sizes[factor]
    views = [_nerfies_view(folder, images, allowed, item, f"{path}: ids of {split!r}") for item in lists[split]]
    views = views_there(views, path)
    _warn_of_motion(folder, allowed)
    points = None
    if (folder / "points.npy").is_file():
        points = NpyFile(allowed.require(folder / "points.npy", str(folder))).read().astype(np.float64)
    return make_scene(folder, views, downscale=rest, **options, beside=pictures_in(images), points=points)


def _nerfies_view(folder: pathlib.Path, images: pathlib.Path, allowed: Bounds, item: object, where: str) -> View:
    """A picture by its name, which its camera has too."""
    path = inside(folder / "camera", f"{item}.json" if isinstance(item, str) else item, where)
    given = read_json(allowed.require(path, where))

    def values(name: str, count: int) -> list[float]:
        rows = given.get(name)
        if not isinstance(rows, list) or len(rows) < count:
            raise InputError(f"{path}: {name} must be {count} numbers, got {shown(rows)}")
        return [checked_number(each, f"{path}: {name}") for each in rows[:count]]

    if checked_number(given.get("skew", 0.0), f"{path}: skew") != 0.0:
        raise InputError(f"{path}: a camera with skew {given['skew']:g} is not read")
    pose = np.eye(4)
    pose[:3, :3] = matrix(given.get("orientation"), (3, 3), f"{path}: orientation").T
    pose[:3, 3] = values("position", 3)
    focal = checked_number(given.get("focal_length"), f"{path}: focal_length")
    down = focal * checked_number(given.get("pixel_aspect_ratio", 1.0), f"{path}: pixel_aspect_ratio")
    (cx, cy), (width, height) = values("principal_point", 2), values("image_size", 2)
    size = picture_size(width, height, f"{path}: image_size")
    k1, k2, k3 = values("radial_distortion", 3) if "radial_distortion" in given else (0.0, 0.0, 0.0)
    sideways = next((name for name in ("tangential", "tangential_distortion") if name in given), None)
    p1, p2 = (0.0, 0.0) if sideways is None else values(sideways, 2)

    def intrinsics(actual: Size) -> Intrinsics:
        return intrinsics_at((focal, down, cx, cy), size, actual, str(path))

    return View(images / f"{item}.png", pose, str(path), intrinsics, distortion=(k1, k2, p1, p2, k3))


def _warn_of_motion(folder: pathlib.Path, allowed: Bounds) -> None:
    """Warn of a scene that moves, by the times in metadata.json."""
    path = folder / "metadata.json"
    if not path.is_file():
        return
    rows = [row for row in read_json(allowed.require(path, str(folder))).values() if isinstance(row, dict)]
    times = {shown(row.get("warp_id", row.get("time_id"))) for row in rows}
    if len(times) > 1:
        warn_caller(f"{path}: pictures show {len(times)} moments of what moves; they are read as if it stood still")


# MVSNet's layout (Yao et al. 2018), which BlendedMVS (Yao et al. 2020) has: README of YoYo000/MVSNet.

BLENDEDMVS_MARK = "cams/ with 00000000_cam.txt beside blended_images/ or images/ (BlendedMVS, MVSNet)"
CAMERA_ENDING = "_cam.txt"


def is_blendedmvs(folder: pathlib.Path) -> bool:
    """Whether a folder holds cameras and pictures in MVSNet's layout."""
    return any((folder / "cams").glob(f"*{CAMERA_ENDING}")) and _mvs_images(folder).is_dir()


def _mvs_images(folder: pathlib.Path) -> pathlib.Path:
    return folder / ("blended_images" if (folder / "blended_images").is_dir() else "images")


def read_blendedmvs(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`."""
    allowed, images = Bounds(folder), _mvs_images(folder)
    pictures = {file.stem: file for file in pictures_in(images)}
    files = {
        file.name.removesuffix(CAMERA_ENDING): file for file in sorted((folder / "cams").glob(f"*{CAMERA_ENDING}"))
    }
    if not files:
        raise MissingFileError(f"{folder / 'cams'} holds no cameras (00000000{CAMERA_ENDING})")
    views = [
        _mvs_view(pictures.get(name, images / f"{name}.jpg"), allowed.require(file, str(folder)))
        for name, file in files.items()
    ]
    views = views_there(views, folder / "cams")
    return held_out_scene(folder, views, split, **options)


def _mvs_view(picture: pathlib.Path, path: pathlib.Path) -> View:
    """A picture with its camera: "extrinsic" and a 4x4 matrix from the world, "intrinsic" and a 3x3 one, depths."""
    tokens = read_text(path, "camera file").split()
    if tokens[:1] != ["extrinsic"] or tokens[17:18] != ["intrinsic"] or len(tokens) < 27:
        raise InputError(f"{path} must hold 'extrinsic' and 16 numbers, then 'intrinsic' and 9 numbers")
    to_camera = np.reshape(floats(" ".join(tokens[1:17]), str(path)), (4, 4))
    if not np.linalg.cond(to_camera) < 1e12:
        raise InputError(f"{path}: its extrinsic matrix is singular")
    k = np.reshape(floats(" ".join(tokens[18:27]), str(path)), (3, 3))
    given = intrinsics_of(k, str(path))

    def intrinsics(actual: Size) -> Intrinsics:
        return intrinsics_at(given, actual, actual, str(path))

    return View(picture, np.linalg.inv(to_camera), str(path), intrinsics)


# NeRF++ (Zhang et al. 2020), Tanks and Temples among it: its README, and half a pixel as its rays have it.

NERFPP_MARK = "train/ with rgb/, pose/ and intrinsics/ (NeRF++)"
SPLITS = {"train": "train", "val": "validation", "test": "test"}


def is_nerfpp(folder: pathlib.Path) -> bool:
    """Whether a folder holds splits as NeRF++ has them."""
    return bool(_nerfpp_splits(folder))


def _nerfpp_splits(folder: pathlib.Path) -> dict[str, pathlib.Path]:
    """The folders of splits that have pictures, poses and intrinsics."""
    homes = {name: folder / each for name, each in SPLITS.items()}
    return {
        name: home
        for name, home in homes.items()
        if all((home / part).is_dir() for part in ("rgb", "pose", "intrinsics"))
    }


def read_nerfpp(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: the folder train/, validation/ (`val`) or test/. Options as for `load_scene`."""
    homes, allowed = _nerfpp_splits(folder), Bounds(folder)
    if split not in homes:
        raise missing_split(split, folder, homes)
    if options.get("masks", True) and (homes[split] / "mask").is_dir():
        warn_caller(f"{homes[split] / 'mask'} is not read: its pictures are taken whole")
    views = []
    for file in pictures_in(homes[split] / "rgb"):
        lens, pose = (homes[split] / part / f"{file.stem}.txt" for part in ("intrinsics", "pose"))
        given = intrinsics_of(matrix_file(allowed.require(lens, str(file)), (4,)), str(lens))
        views.append(View(file, matrix_file(allowed.require(pose, str(file)), (4,)), str(pose), given))
    pictures = [file for home in homes.values() for file in pictures_in(home / "rgb")]
    return make_scene(folder, views, **options, beside=pictures)
