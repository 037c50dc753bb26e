"""NSVF folders: rgb/, pose/, intrinsics.txt, bbox.txt, the split in the first letter of each name (Liu et al. 2020)."""
# Poses are camera to world in OpenCV axes, the centre of the first pixel is (0.5, 0.5).

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...errors import InputError
from ..box import Bounds
from ..parsing import floats, intrinsics_of, missing_split, pictures_in, read_text
from ..pictures import make_scene
from ..scene import Scene
from ..sizes import View

MARK = "rgb/, pose/ and intrinsics.txt"
PREFIXES = {"train": "0_", "val": "1_", "test": "2_"}


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds pictures, poses and intrinsics as NSVF has them."""
    return (folder / "rgb").is_dir() and (folder / "pose").is_dir() and (folder / "intrinsics.txt").is_file()


def read(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split; bbox.txt, where there is one, becomes the scene's bounds. Options as for `load_scene`."""
    intrinsics = _read_intrinsics(folder / "intrinsics.txt")
    pictures = pictures_in(folder / "rgb")
    splits = {name: [file for file in pictures if file.name.startswith(prefix)] for name, prefix in PREFIXES.items()}
    splits = {name: files for name, files in splits.items() if files}
    if split not in splits:
        raise missing_split(split, folder, splits)
    views, allowed = [], Bounds(folder)
    for file in splits[split]:
        path = allowed.require(folder / "pose" / f"{file.stem}.txt", str(file))
        views.append(View(file, _read_pose(path), str(path), intrinsics))
    return make_scene(folder, views, **options, beside=pictures, bounds=_read_bounds(folder))


def _read_intrinsics(path: pathlib.Path) -> tuple[float, float, float, float]:
    """A 4x4 or 3x3 matrix; or "f cx cy 0" in the first of several lines, as NSVF's synthetic scenes had it once."""
    text = read_text(path, "file")
    values = floats(text, str(path))
    if len(values) in (9, 16):
        return intrinsics_of(np.reshape(values, (3, 3) if len(values) == 9 else (4, 4)), str(path))
    first = floats(text.strip().splitlines()[0], str(path)) if values else []
    if len(first) not in (3, 4):
        raise InputError(f"{path}: a 4x4 or 3x3 matrix or a line 'f cx cy 0' expected, got {len(values)} numbers")
    return first[0], first[0], first[1], first[2]


def _read_pose(path: pathlib.Path) -> np.ndarray:
    """(4, 4) camera to world; the last row may be left out."""
    values = floats(read_text(path, "pose"), str(path))
    if len(values) == 12:
        values += [0.0, 0.0, 0.0, 1.0]
    if len(values) != 16:
        raise InputError(f"{path}: a 4x4 pose expected, got {len(values)} numbers")
    return np.reshape(values, (4, 4))


def _read_bounds(folder: pathlib.Path) -> np.ndarray | None:
    """The box of bbox.txt: x0 y0 z0 x1 y1 z1, and a voxel size that is not used."""
    path = folder / "bbox.txt"
    if not path.is_file():
        return None
    values = floats(read_text(path, "file"), str(path))
    if len(values) not in (6, 7) or not np.less(values[:3], values[3:6]).all():
        raise InputError(f"{path}: x0 y0 z0 x1 y1 z1 with lower below upper expected, got {len(values)} numbers")
    return np.reshape(values[:6], (2, 3))
