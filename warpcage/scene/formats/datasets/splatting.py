"""Output folders of 3D Gaussian Splatting (Kerbl et al. 2023): its splats, its cameras, and where its pictures are."""
# point_cloud/iteration_30000/point_cloud.ply, cameras.json, and cfg_args, its options as Python shows
# them. They are in the world of the pictures' own scene, of which the split is taken too.

from __future__ import annotations

import ast
import contextlib
import pathlib
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from ....core.checks import shown, warn_caller
from ....errors import InputError, MissingFileError
from ....view.camera import Camera, CameraFile
from ...box import Bounds
from ...parsing import PICTURE_ENDINGS, read_text
from ...scene import Scene, turn_between

MARK = "cameras.json beside point_cloud/iteration_30000/point_cloud.ply (output of 3D Gaussian Splatting)"
NAME, CAMERAS, OPTIONS, CLOUD = "3dgs", "cameras.json", "cfg_args", "point_cloud.ply"

#: Bytes that cfg_args may have: they are some hundreds, and deep ones would exhaust the stack of the parser.
MAX_OPTIONS = 1 << 14

#: Degrees, and shares of the cameras' extent, by which cameras.json may miss the cameras of the pictures' own scene.
SAME_TURN, SAME_PLACE = 0.1, 1e-3


def iterations(folder: pathlib.Path) -> dict[int, pathlib.Path]:
    """The files of splats of an output folder by their iterations, ascending; {} for other folders."""
    found = {}
    for home in folder.glob("point_cloud/iteration_*"):
        number = re.fullmatch(r"iteration_(\d{1,12})", home.name)
        if number and (home / CLOUD).is_file():
            found[int(number[1])] = home / CLOUD
    return dict(sorted(found.items()))


def output_of(path: pathlib.Path) -> pathlib.Path | None:
    """The output folder of 3D Gaussian Splatting that a file of splats lies in; None for other files."""
    around = path.absolute().parents[2:3]
    fits = path.name == CLOUD and re.fullmatch(r"iteration_\d{1,12}", path.parent.name)
    return around[0] if fits and around and (around[0] / OPTIONS).is_file() else None


def is_output(folder: pathlib.Path) -> bool:
    """Whether a folder is an output folder with cameras."""
    return (folder / CAMERAS).is_file() and bool(iterations(folder))


def trained_options(folder: pathlib.Path) -> dict[str, Any]:
    """The options in cfg_args that are literals, {} without the file; nothing of it is run."""
    path = folder / OPTIONS
    if not path.is_file():
        return {}
    if path.stat().st_size > MAX_OPTIONS:
        raise InputError(f"{path} must be of some hundred bytes, got {path.stat().st_size}")
    text = read_text(Bounds(folder).require(path, str(folder)), "file").strip()
    try:
        parsed = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        parsed = None
    if not (isinstance(parsed, ast.Call) and isinstance(parsed.func, ast.Name) and parsed.func.id == "Namespace"):
        raise InputError(f"{path} must hold Namespace(...), as 3D Gaussian Splatting writes it")
    given = {option.arg: option.value for option in parsed.keywords}
    return {name: value.value for name, value in given.items() if name and isinstance(value, ast.Constant)}


def trained_background(folder: pathlib.Path) -> str | None:
    """The background that the splats were fitted with, "white" or "black"; None where it is not recorded."""
    white = trained_options(folder).get("white_background")
    return None if white is None else "white" if white else "black"


def source_of(folder: pathlib.Path) -> pathlib.Path:
    """The scene of the pictures, where cfg_args says, or by its name in the output folder or beside it."""
    named = trained_options(folder).get("source_path")
    if not isinstance(named, str) or not named or "\0" in named:
        lacks = "names no source_path" if (folder / OPTIONS).is_file() else "is not there"
        raise MissingFileError(f"{folder / OPTIONS} {lacks}: give the folder of the scene itself")
    name = pathlib.PurePath(named.replace("\\", "/")).name
    places = [pathlib.Path(named), *(home / name for home in (folder, folder.absolute().parent) if name)]
    for place in places:
        with contextlib.suppress(OSError):  # a name that no folder can have
            if place.is_dir():
                return place
    raise MissingFileError(
        f"{folder}: the pictures are not there: {OPTIONS} names source_path {shown(named)}, which is not a folder "
        f"here, nor is {shown(name)} beside it; put it there, or give the folder of the scene itself"
    )


def read(folder: pathlib.Path, *, formats: Iterable[Any], split: str, downscale: int, **options: Any) -> Scene:
    """Read a split of the pictures' own scene with the cameras of cameras.json. Options as for `load_scene`; pictures
    are as large as they were in the fit, where cfg_args names images_4/. formats: of scenes, all that there are."""
    source, given = source_of(folder), trained_options(folder)
    found = next((each for each in formats if each.name != NAME and each.is_scene(source)), None)
    if found is None:
        raise InputError(f"{folder}: {str(source)!r}, where its pictures come from, is not a scene of a known format")
    smaller = re.fullmatch(r"images_([1-9]\d?)", str(given.get("images")))
    factor = int(smaller[1]) if smaller else 1
    if "progress" not in found.options:
        options.pop("progress", None)
    scene = found.read(source, split=split, downscale=downscale * factor, **options)
    if split not in ("train", "all") and given.get("eval") is False:
        warn_caller(f"{folder}: eval=False in {OPTIONS}: the splats were fitted to the pictures of {split!r} too")
    return scene.with_cameras(_cameras_of(scene, folder / CAMERAS, str(source)))


def _cameras_of(scene: Scene, path: pathlib.Path, source: str) -> list[Camera]:
    """The camera of each picture of a scene in cameras.json, by name and place."""
    by_name: dict[str, list[Camera]] = {}
    for key in CameraFile.load(path):
        by_name.setdefault(_stem(key.name), []).append(key.camera)
    centers = np.stack([camera.center for camera in scene.cameras])
    extent = max(float(np.linalg.norm(np.ptp(centers, axis=0))), 1e-9)
    chosen = []
    for name, own in zip(scene.names, scene.cameras, strict=True):
        named = by_name.get(_stem(name), [])
        if not named:
            raise InputError(f"{path} has no camera for picture {name!r} of {source}: were other pictures fitted to?")
        nearest = min(named, key=lambda camera: _apart(camera, own, extent))
        if _apart(nearest, own, extent) > 1.0:
            raise InputError(
                f"{path}: the camera of picture {name!r} is another than that of {source}, which may have been "
                "captured anew since: they do not belong together"
            )
        chosen.append(nearest.resized(own.width, own.height))
    return chosen


def _stem(name: str) -> str:
    """A picture's name without folder and ending."""
    last = pathlib.PurePosixPath(name.replace("\\", "/")).name
    return last[: -len(pathlib.PurePath(last).suffix)] if last.lower().endswith(PICTURE_ENDINGS) else last


def _apart(one: Camera, other: Camera, extent: float) -> float:
    """How far two cameras are apart; up to 1 they count as the same."""
    place = float(np.linalg.norm(one.center - other.center)) / extent
    return max(turn_between(one, other) / SAME_TURN, place / SAME_PLACE)
