"""Bundler's output (Snavely et al. 2006), version 0.3, as Bundler, VisualSFM, Metashape and others write it."""
# Cameras look along -z with +y up, so do pixels, from the middle of the picture. A lens is f, k1 and k2, as OpenCV's.

from __future__ import annotations

import pathlib
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...core.checks import shown, warn_caller
from ...errors import InputError, MissingFileError
from ..box import Bounds
from ..parsing import TO_OPENCV, PictureFinder, first_with, floats, pictures_in, read_text
from ..pictures import listed_scene
from ..scene import Scene
from ..sizes import View

MARK = "a .out file of Bundler, in it or in bundle/, with list.txt"
HEADER = "# Bundle file v0.3"

#: Numbers of a camera: focal length, k1, k2, rotation, translation.
CAMERA = 15

#: What may stand behind a name in list.txt: 0, and a focal length in pixels.
_FOCAL = re.compile(r"(\s+0\s+[-+.\deE]+|\s+0)\s*$")


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds an output of Bundler."""
    return _output(folder) is not None


def _output(folder: pathlib.Path) -> pathlib.Path | None:
    """The first file that begins as outputs of Bundler do."""
    return first_with([*sorted(folder.glob("*.out")), *sorted(folder.glob("bundle/*.out"))], 40, b"Bundlefile")


def read(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`."""
    path = _output(folder)
    if path is None:
        raise MissingFileError(f"{str(folder)!r} holds no output of Bundler ({MARK})")
    Bounds(folder).require(path, str(folder))
    head, _, text = read_text(path, "Bundler file").partition("\n")
    if head.strip() != HEADER:
        raise InputError(f"{path} must begin with {HEADER!r}, got {shown(head)}")
    tokens = text.split()
    counts = [int(value) for value in floats(" ".join(tokens[:2]), str(path))]
    count, point_count = counts if len(counts) == 2 else (0, 0)
    if count < 1 or point_count < 0 or 2 + CAMERA * count + 7 * point_count > len(tokens):
        raise InputError(f"{path} announces {count} cameras and {point_count} points, and holds {len(tokens)} numbers")
    finder = PictureFinder(folder, ("", "images"))
    views, left_out = [], 0
    for index, file in enumerate(_pictures(folder, path, finder, count)):
        where = f"{path}: camera {index}"
        values = floats(" ".join(tokens[2 + CAMERA * index :][:CAMERA]), where)
        if values[0] == 0.0:  # a picture that found no place
            left_out += 1
        else:
            views.append(_view(file, values, where))
    if not views:
        raise InputError(f"{path} has no camera with a focal length")
    if left_out:
        warn_caller(f"{path}: {left_out} of {count} pictures have no camera and are left out")
    places, colors = _points(tokens, 2 + CAMERA * count, point_count, path)
    return listed_scene(folder, views, split, path, finder, **options, points=places, point_colors=colors)


def _pictures(folder: pathlib.Path, path: pathlib.Path, finder: PictureFinder, count: int) -> list[pathlib.Path]:
    """The pictures of all cameras: those of the list, or without one all that are there, by name."""
    candidates = [path.parent / "list.txt", folder / "list.txt", path.with_name(f"{path.stem}.list.txt")]
    listing = next((each for each in candidates if each.is_file()), None)
    if listing is None:
        files = pictures_in(folder / "images" if (folder / "images").is_dir() else folder)
    else:
        Bounds(folder).require(listing, str(path))
        files = list(_listed(listing, finder))
    if len(files) != count:
        there = f"{listing or files[0].parent} {len(files)} pictures"
        raise InputError(f"{path} has {count} cameras, {there}: there must be one for each")
    return files


def _listed(listing: pathlib.Path, finder: PictureFinder) -> Iterator[pathlib.Path]:
    for line, text in enumerate(read_text(listing, "list of pictures").splitlines(), 1):
        name = _FOCAL.sub("", text).strip()
        if name:
            yield finder.find(name, f"{listing}:{line}")


def _view(file: pathlib.Path, values: list[float], where: str) -> View:
    """One picture with its camera."""
    focal, k1, k2 = values[:3]
    to_camera = np.eye(4)
    to_camera[:3, :3], to_camera[:3, 3] = np.reshape(values[3:12], (3, 3)), values[12:]
    if not np.linalg.cond(to_camera[:3, :3]) < 1e6:
        raise InputError(f"{where} has no rotation")
    pose = np.linalg.inv(to_camera) @ TO_OPENCV
    return View(file, pose, where, lambda size: (focal, focal, size[0] / 2, size[1] / 2), distortion=(k1, k2, 0.0, 0.0))


def _points(tokens: list[str], place: int, count: int, path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and their colours (n, 3) in [0, 1]; behind each stands a list of its pictures."""
    places, colors = np.empty((count, 3)), np.empty((count, 3), np.float32)
    for index in range(count):
        where = f"{path}: point {index}"
        values = floats(" ".join(tokens[place : place + 7]), where)
        if len(values) < 7 or not 0 <= values[6] <= len(tokens):
            raise InputError(f"{where}: a place, a colour and a list of pictures expected, the file ends before")
        places[index], colors[index] = values[:3], values[3:6]
        place += 7 + 4 * int(values[6])
    if not (colors >= 0).all() or not (colors <= 255).all():
        raise InputError(f"{path}: colours of points must lie in 0 to 255")
    return places, colors / np.float32(255)
