"""OpenSfM's reconstruction.json, also of OpenDroneMap."""
# Shots turn and move the world into cameras with OpenCV's axes. Focal lengths and principal points are in shares of the
# longer side of the picture, from its middle.

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...core.checks import checked_number, shown
from ...errors import InputError
from ..box import Bounds
from ..lenses import Lens, all_around
from ..parsing import PictureFinder, chosen_part, numbers, picture_size, read_json
from ..pictures import listed_scene
from ..scene import Scene
from ..sizes import View

MARK = "reconstruction.json, in it or in opensfm/, beside images/"
FILES = ("reconstruction.json", "opensfm/reconstruction.json")


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds a reconstruction of OpenSfM."""
    return any((folder / name).is_file() for name in FILES)


def read(folder: pathlib.Path, *, split: str, model: str | None = None, **options: Any) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`;
    of several reconstructions the one with most pictures is read, or the one of a number."""
    path = folder / next((name for name in FILES if (folder / name).is_file()), FILES[0])
    Bounds(folder).require(path, str(folder))
    found = _chosen(read_json(path, list), path, model)
    cameras, shots = found.get("cameras"), found.get("shots")
    if not isinstance(cameras, dict) or not isinstance(shots, dict) or not shots:
        raise InputError(f"{path}: a reconstruction needs cameras and shots")
    finder = PictureFinder(folder, ("images", ""))
    views = [_view(finder, cameras, name, shots[name], f"{path}: shot {shown(name)}") for name in sorted(shots)]
    places, colors = _points(found.get("points"), path)
    return listed_scene(folder, views, split, path, finder, **options, points=places, point_colors=colors)


def _chosen(content: list, path: pathlib.Path, model: str | None) -> dict:
    """The reconstruction of a number, or the one with most shots and a warning that names others."""
    if not content or not all(isinstance(each, dict) for each in content):
        raise InputError(f"{path} must hold a list of reconstructions")
    counts = {
        str(index): len(each["shots"]) if isinstance(each.get("shots"), dict) else 0
        for index, each in enumerate(content)
    }
    return content[int(chosen_part(counts, model, path, "reconstruction"))]


def _view(finder: PictureFinder, cameras: dict, name: str, shot: object, where: str) -> View:
    """One picture with its camera."""
    from scipy.spatial.transform import Rotation

    if not isinstance(shot, dict):
        raise InputError(f"{where} must be a JSON object, got {shown(shot)}")
    given = cameras.get(shot.get("camera")) if isinstance(shot.get("camera"), str) else None
    if not isinstance(given, dict):
        raise InputError(f"{where} has camera {shown(shot.get('camera'))}, which the file lacks")
    to_camera = np.eye(4)
    to_camera[:3, :3] = Rotation.from_rotvec(numbers(shot.get("rotation"), 3, f"{where}: rotation")).as_matrix()
    to_camera[:3, 3] = numbers(shot.get("translation"), 3, f"{where}: translation")
    width, height = (checked_number(given.get(side), f"{where}: {side} of its camera") for side in ("width", "height"))
    size = picture_size(width, height, f"{where}: its camera")
    longer = max(width, height)

    def value(*names: str, default: float | None = None) -> float:
        there = next((each for each in names if given.get(each) is not None), None)
        if there is None and default is not None:
            return default
        return checked_number(given.get(there or names[0]), f"{where}: {there or names[0]} of its camera")

    kind = given.get("projection_type", "perspective")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"{where}: projection_type {shown(kind)} is not read, only {', '.join(KINDS)}")
    file, pose = finder.find(name, where), np.linalg.inv(to_camera)
    if kind in ("spherical", "equirectangular"):
        return View(file, pose, where, all_around, size, lens=Lens("EQUIRECTANGULAR"))
    fx = value("focal_x", "focal")
    fy = value("focal_y", default=fx * value("aspect_ratio", default=1.0))
    intrinsics = (
        fx * longer,
        fy * longer,
        value("c_x", default=0.0) * longer + width / 2,
        value("c_y", default=0.0) * longer + height / 2,
    )
    values = tuple(value(each, default=0.0) for each in KINDS[kind])
    if kind.startswith("fisheye6") or kind == "dual":
        return View(file, pose, where, intrinsics, size, lens=Lens("OPENSFM", values))
    if kind.startswith("fisheye"):
        return View(file, pose, where, intrinsics, size, lens=Lens("FISHEYE", values))
    return View(file, pose, where, intrinsics, size, distortion=values)


#: Coefficients of the lens OPENSFM, in its order; what a camera lacks of them is 0.
ALL = ("transition", "p1", "p2", "s0", "s1", "s2", "s3", "k1", "k2", "k3", "k4", "k5", "k6")

#: Kinds of cameras, and the names of their coefficients, in the order of COEFFICIENTS, of powers of the angle, or ALL.
KINDS = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
    "fisheye62": ALL,
    "fisheye624": ALL,
    "dual": ALL,
    "spherical": (),
    "equirectangular": (),
}


def _points(points: object, path: pathlib.Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Points (n, 3) and their colours (n, 3) in [0, 1]; None where there are none."""
    if not isinstance(points, dict) or not points:
        return None, None
    places, colors = [], []
    for name, point in points.items():
        where = f"{path}: point {shown(name)}"
        if not isinstance(point, dict):
            raise InputError(f"{where} must be a JSON object, got {shown(point)}")
        places.append(numbers(point.get("coordinates"), 3, f"{where}: coordinates"))
        if point.get("color") is not None:
            colors.append(numbers(point.get("color"), 3, f"{where}: color"))
            if min(colors[-1]) < 0 or max(colors[-1]) > 255:
                raise InputError(f"{where}: color must lie in 0 to 255, got {shown(point['color'])}")
    rgb = (np.array(colors) / 255).astype(np.float32) if len(colors) == len(places) else None
    return np.array(places), rgb
