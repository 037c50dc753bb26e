"""Videos of rooms: ScanNet (Dai et al. 2017), and renders of Replica (Straub et al. 2019)."""
# Poses are camera to world with OpenCV's axes. Both count pixels from the middle of the first: half a pixel is added.

from __future__ import annotations

import math
import pathlib
import re
from typing import Any

import numpy as np

from ....core.checks import checked_number, warn_caller
from ....errors import InputError, MissingFileError
from ...box import Bounds
from ...lenses import Intrinsics, intrinsics_at
from ...parsing import evenly, floats, intrinsics_of, matrix_file, picture_size, pictures_in, read_json, read_text
from ...pictures import held_out_scene
from ...scene import Scene
from ...sizes import Size, View

SCANNET_MARK = "color/, pose/ and intrinsic/intrinsic_color.txt, in it or in frames/ (ScanNet's SensReader)"
INTRINSICS = ("intrinsic/intrinsic_color.txt", "intrinsic_color.txt", "intrinsics_color.txt")

#: Pixels by which ScanNet's pictures of 1296x968 miss the shape of 640x480, to which they are often shrunk.
SCANNET_ROUNDING = 4.0


def is_scannet(folder: pathlib.Path) -> bool:
    """Whether a folder holds frames of a scan as ScanNet's SensReader exports them."""
    return _scannet_home(folder) is not None


def _scannet_home(folder: pathlib.Path) -> pathlib.Path | None:
    """The folder of the frames, itself or frames/ in it."""
    homes = (folder, folder / "frames")
    return next((home for home in homes if (home / "color").is_dir() and (home / "pose").is_dir()), None)


def read_scannet(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`."""
    home, allowed = _scannet_home(folder), Bounds(folder)
    if home is None:
        raise MissingFileError(f"{str(folder)!r} holds no scan of ScanNet ({SCANNET_MARK})")
    path = next((home / name for name in INTRINSICS if (home / name).is_file()), home / INTRINSICS[0])
    fx, fy, cx, cy = intrinsics_of(matrix_file(allowed.require(path, str(folder)), (3, 4)), str(path))
    given = (fx, fy, cx + 0.5, cy + 0.5)
    size, found, lost = _color_size(folder, allowed), [], 0
    for file in _numbered(home / "color"):
        where = home / "pose" / f"{file.stem}.txt"
        text = read_text(allowed.require(where, str(file)), "pose") if where.is_file() else "none"
        if re.search(r"inf|nan|none", text, re.IGNORECASE):
            lost += 1  # the tracking was lost
        else:
            found.append((file, matrix_file(where, (4,), text), str(where)))
    if not found:
        raise InputError(f"{home / 'pose'} holds no pose: those of all {lost} pictures are not finite")
    if lost:
        warn_caller(f"{home}: {lost} of {lost + len(found)} pictures have no pose in pose/, or -inf, and are left out")

    def intrinsics(actual: Size) -> Intrinsics:
        return intrinsics_at(given, size or actual, actual, str(path), SCANNET_ROUNDING)

    taken = [found[index] for index in evenly(len(found))]
    views = [View(file, pose, where, intrinsics) for file, pose, where in taken]
    return held_out_scene(folder, views, split, **options)


def _numbered(folder: pathlib.Path) -> list[pathlib.Path]:
    """The pictures of a folder whose names end in numbers, in their order."""
    numbers = {file: re.search(r"(\d+)$", file.stem) for file in pictures_in(folder)}
    return sorted((file for file, found in numbers.items() if found), key=_number)


def _number(file: pathlib.Path) -> int:
    """The number that a name ends in, of at most 18 digits."""
    return int(re.findall(r"\d{1,18}", file.stem)[-1])


def _color_size(folder: pathlib.Path, allowed: Bounds) -> Size | None:
    """The size that intrinsics are for, of the scan's own NAME.txt; None where it is not there."""
    path = folder / f"{folder.absolute().name}.txt"
    if not path.is_file():
        return None
    text = read_text(allowed.require(path, str(folder)), "file")
    width, height = (
        re.search(rf"^color{side} *= *(\d{{1,6}})\s*$", text, re.MULTILINE) for side in ("Width", "Height")
    )
    return picture_size(float(width[1]), float(height[1]), str(path)) if width and height else None


REPLICA_MARK = "traj.txt beside results/, or traj_w_c.txt beside rgb/ (renders of Replica)"
CAMERA = "cam_params.json"

#: Of NICE-SLAM (Zhu et al. 2022) and Semantic-NeRF (Zhi et al. 2021): trajectory, folder and names of pictures.
RENDERS = (("traj.txt", "results", "frame"), ("traj_w_c.txt", "rgb", "rgb_"))


def is_replica(folder: pathlib.Path) -> bool:
    """Whether a folder holds one of the two renders of Replica with their trajectory."""
    return any((folder / file).is_file() and (folder / images).is_dir() for file, images, _ in RENDERS)


def read_replica(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`."""
    allowed = Bounds(folder)
    file, images, begin = next((each for each in RENDERS if (folder / each[0]).is_file()), RENDERS[0])
    path = allowed.require(folder / file, str(folder))
    values = floats(read_text(path, "trajectory"), str(path))
    if not values or len(values) % 16:
        raise InputError(f"{path} must hold 16 numbers a picture, a 4x4 pose in a line, got {len(values)}")
    poses, pictures = np.reshape(values, (-1, 4, 4)), _numbered(folder / images)
    pictures = [each for each in pictures if each.name.startswith(begin)]
    if not pictures or _number(pictures[-1]) >= len(poses):
        last = f"{pictures[-1].name!r} is beyond them" if pictures else f"no picture of {images}/ is called {begin}..."
        raise InputError(f"{path} has poses of pictures 0 to {len(poses) - 1}, {last}")
    size, intrinsics = _cam_params(folder) if images == "results" else (None, _right_angle)
    taken = [pictures[index] for index in evenly(len(pictures))]
    views = [View(each, poses[_number(each)], f"{path}: {each.name}", intrinsics, size) for each in taken]
    return held_out_scene(folder, views, split, **options)


def _right_angle(size: Size) -> Intrinsics:
    """Semantic-NeRF's pictures see 90 degrees across, and its folders hold no intrinsics."""
    focal = 0.5 * size[0] / math.tan(math.radians(45.0))
    return focal, focal, size[0] / 2, size[1] / 2


def _cam_params(folder: pathlib.Path) -> tuple[Size, Intrinsics]:
    """What cam_params.json says, which lies in the folder or, in NICE-SLAM's download, beside it."""
    around = folder.absolute().parent
    home = around if (around / CAMERA).is_file() and not (folder / CAMERA).is_file() else folder
    path = Bounds(home).require(home / CAMERA, str(home))
    given = read_json(path).get("camera")
    if not isinstance(given, dict):
        raise InputError(f"{path} must hold a camera with w, h, fx, fy, cx, cy")
    names = ("w", "h", "fx", "fy", "cx", "cy")
    width, height, fx, fy, cx, cy = (checked_number(given.get(name), f"{path}: {name}") for name in names)
    return picture_size(width, height, str(path)), (fx, fy, cx + 0.5, cy + 0.5)
