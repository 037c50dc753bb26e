"""LLFF captures (Mildenhall et al. 2019): poses_bounds.npy beside images/ and smaller pictures in images_4/."""
# A row is a 3x5 matrix [rotation, place, (height, width, focal length)] and the nearest and farthest depth. The columns
# of the rotation point down, to the right and back.

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...core.npz import NpyFile
from ...errors import InputError, MissingFileError
from ..lenses import Intrinsics
from ..parsing import held_out, numbered_folders, pictures_in
from ..pictures import make_scene
from ..scene import Scene
from ..sizes import View, chosen_copy

MARK = "poses_bounds.npy beside images/, images_4/ or others"
FILE = "poses_bounds.npy"

#: Pixels by which pictures of another size may miss the shape of those that the poses are for: sides are rounded.
ROUNDING = 1.0


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds poses as LLFF has them."""
    return (folder / FILE).is_file()


def read(folder: pathlib.Path, *, split: str, downscale: int, **options: Any) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`;
    images_4 is read for a downscale of 4, where it is there."""
    path = folder / FILE
    file = NpyFile(path)
    if len(file.shape) != 2 or file.shape[1] != 17 or not file.shape[0]:
        raise InputError(f"{path} must be (n, 17), a row for each picture, got {file.shape}")
    rows = file.read().astype(np.float64)
    images, rest = _pictures_folder(folder, downscale)
    pictures = pictures_in(images)
    if len(pictures) != len(rows):
        raise InputError(
            f"{path} has {len(rows)} poses, {images} {len(pictures)} pictures: there must be one for each, in the "
            "order of their names"
        )
    views = []
    for index in held_out(len(pictures), split, folder):
        where = f"{path}: row {index}"
        views.append(_view(pictures[index], rows[index], where))
    return make_scene(folder, views, downscale=rest, **options, beside=pictures)


def _pictures_folder(folder: pathlib.Path, downscale: int) -> tuple[pathlib.Path, int]:
    """The folder of the pictures that are nearest to a downscale and not below it, and the downscale that is left."""
    sizes = numbered_folders(folder)
    if (folder / "images").is_dir():
        sizes[1] = folder / "images"
    if not sizes:
        raise MissingFileError(f"{str(folder)!r} holds no pictures in images/, images_4/ or others")
    factor, rest = chosen_copy(sizes, downscale, folder)
    return sizes[factor], rest


def _view(file: pathlib.Path, row: np.ndarray, where: str) -> View:
    """One picture with its camera."""
    if not np.isfinite(row[:15]).all():
        raise InputError(f"{where} holds numbers that are not finite")
    matrix = row[:15].reshape(3, 5)
    pose = np.eye(4)
    pose[:3] = matrix[:, [1, 0, 2, 3]] * [1, 1, -1, 1]
    height, width, focal = matrix[:, 4]
    if not (height > 0 and width > 0 and focal > 0):
        raise InputError(f"{where}: height, width and focal length must be positive, got {height}, {width}, {focal}")

    def intrinsics(size: tuple[int, int]) -> Intrinsics:
        across, down = size[0] / width, size[1] / height
        if abs(across - down) * max(width, height) > ROUNDING * max(1.0, across, down):
            raise InputError(
                f"{where}: the camera is for {width:g}x{height:g} pixels, image {file.name!r} has {size[0]}x{size[1]}, "
                "which is another shape"
            )
        return focal * across, focal * down, size[0] / 2, size[1] / 2

    return View(file, pose, where, intrinsics)
