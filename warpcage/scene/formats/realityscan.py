"""RealityScan's and RealityCapture's camera parameters as .csv (Export, Internal/External camera parameters)."""
# A row is a name, a place, heading, pitch and roll in degrees, and the focal length of a frame of 36 mm; the principal
# point is in shares of the longer side, from the middle. Cameras look along -z with +y up, turned by
# Rz(-heading) Rx(pitch) Ry(roll): Epic's page on camera math, and nerfstudio's reader.

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...errors import InputError, MissingFileError
from ..box import Bounds
from ..lenses import Intrinsics, Lens
from ..parsing import TO_OPENCV, PictureFinder, first_with, floats, table_rows
from ..pictures import listed_scene
from ..scene import Scene
from ..sizes import Size, View

MARK = "a .csv file that begins with #name,x,y,alt,heading, beside images/"

#: Columns that must be there, and those that are 0 where they are not.
NEEDED = ("x", "y", "alt", "heading", "pitch", "roll", "f")
OTHERS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")

#: Width of the frame that focal lengths are for, mm.
FRAME = 36.0


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds camera parameters of RealityScan."""
    return _table(folder) is not None


def _table(folder: pathlib.Path) -> pathlib.Path | None:
    return first_with(sorted(folder.glob("*.csv")), 200, b"#name,x,y,alt,heading")


def read(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`."""
    path = _table(folder)
    if path is None:
        raise MissingFileError(f"{str(folder)!r} holds no camera parameters of RealityScan ({MARK})")
    Bounds(folder).require(path, str(folder))
    finder = PictureFinder(folder, ("images", ""))
    views = [_view(finder, row, where) for where, row in table_rows(path, "table of cameras", ("#name", *NEEDED))]
    if not views:
        raise InputError(f"{path} has no camera")
    return listed_scene(folder, views, split, path, finder, **options)


def _view(finder: PictureFinder, row: dict[str, str], where: str) -> View:
    """One picture with its camera."""
    from scipy.spatial.transform import Rotation

    named = [*NEEDED, *(name for name in OTHERS if name in row)]
    numbers = [floats(row[name], f"{where}: {name}") for name in named]
    if any(len(number) != 1 for number in numbers):
        raise InputError(f"{where}: each column must hold one number")
    values = dict.fromkeys(OTHERS, 0.0) | {name: number[0] for name, number in zip(named, numbers, strict=True)}
    if not values["f"] > 0:
        raise InputError(f"{where}: f must be positive, got {values['f']:g}")
    pose = np.eye(4)
    turns = -values["heading"], values["pitch"], values["roll"]
    pose[:3, :3] = Rotation.from_euler("ZXY", turns, degrees=True).as_matrix()
    pose[:3, 3] = values["x"], values["y"], values["alt"]

    def intrinsics(size: Size) -> Intrinsics:
        longer, focal = max(size), values["f"] * max(size) / FRAME
        return focal, focal, values["px"] * longer + size[0] / 2, values["py"] * longer + size[1] / 2

    k1, k2, k3, k4, t1, t2 = (values[name] for name in OTHERS[2:])
    file = finder.find(row["#name"], where)
    if k4:  # Metashape's tangential ones stand the other way round
        lens = Lens("METASHAPE", (0.0, 0.0, k1, k2, k3, k4, t2, t1, 0.0, 0.0))
        return View(file, pose @ TO_OPENCV, where, intrinsics, lens=lens)
    return View(file, pose @ TO_OPENCV, where, intrinsics, distortion=(k1, k2, t1, t2, k3))
