"""Load a scene of any known format."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_path, listed
from ..core.reports import Progress, hears
from ..errors import InputError, MissingFileError
from ..view.camera import CameraFile, rigid_motion
from ..view.frame import parse_background
from .formats.table import SceneFormat, candidates, format_named
from .scene import Scene, rotation_to


@hears
def load_scene(
    path: str | os.PathLike[str],
    *,
    split: str = "train",
    downscale: int = 1,
    format: str | None = None,
    background: str | ArrayLike = "white",
    masks: bool | str = True,
    orient: str | ArrayLike | None = None,
    cameras: str | os.PathLike[str] | None = None,
    model: str | None = None,
    progress: bool | Progress = False,
) -> Scene:
    """Read one split of a scene from disk.

    What the scene's files name must lie in its folder, by real paths: neither names nor links lead out of it. One kind
    of link may: that to a whole folder, directly in the scene's, as `images -> /captures/fox/images`. The format's own
    files (transforms.json, cameras.npz, sparse/0/cameras.bin) are opened by these names, whether links or not.

    Args:
        path: Folder of the scene.
        split: "train", "val" or "test" as the format has them. Where it has none, every eighth picture is "test", the
            others are "train", and "all" is both.
        downscale: Whole factor by which width and height shrink, by area averages of premultiplied colour.
        format: "blender" (NeRF-synthetic), "nsvf", "dtu" (IDR layout), "transforms" (nerfstudio, instant-ngp),
            "colmap", "polycam" (its raw data), "record3d", "arkitscenes", "stray" (Stray Scanner), "opensfm",
            "metashape", "bundler", "realityscan" (its .csv), "llff", or one that another package adds. None takes the
            first of these that fits.
        background: Colour put behind transparent pixels, a name or (3,) in [0, 1].
        masks: True makes mask files alphas, and what they hide the background. "split" keeps what they hide as the
            scene's surroundings, which `fit` puts into layers behind the object. "weights" makes them `Scene.weights`:
            pictures stay whole, and what is black in a mask is ignored. False leaves the pictures whole. But for
            False, what is not black in `dynamic_mask_NAME.png` beside picture NAME is ignored, as instant-ngp does.
        orient: "up" turns the world about its origin so that what is up for the training cameras (`Scene.up`) is +z;
            `Scene.straightening` is the turn. A rigid (4, 4) moves the world by it: that of a scene or a field that was
            straightened, to read another split of its scene without its training pictures. None leaves the coordinates
            as the files have them.
        cameras: Camera file (.json) whose cameras the pictures get, by their names, as `RefinedCameras.save` writes
            them after a fit. They are in the world that `orient` leads to. None takes those of the scene's files.
        model: Which of several COLMAP models, by its folder such as "1" or "sparse/1", of several reconstructions of
            OpenSfM, by its number, or of several chunks of Metashape, by its label. None takes the one with most
            pictures. Of ARKitScenes the folder of pictures; None takes that of the largest.
        progress: True shows a bar on stderr. A function is told (done, total, words), in pictures, and ends the work by
            returning False or by raising.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: For a missing folder, split, image or camera file.
        ValueError: For contents that cannot be used.
        Cancelled: Where `progress` returned False.
    """
    folder = checked_path(path, "the scene")
    if not folder.is_dir():
        what = "is a file" if folder.is_file() else "is not there"
        raise MissingFileError(f"scene folder {str(folder)!r} {what}")
    if int(downscale) != downscale or downscale < 1:
        raise InputError(f"downscale must be a whole number of at least 1, got {downscale}")
    found = holding_format(folder) if format is None else format_named(format)
    if masks not in (True, False, "split", "weights"):
        raise InputError(f"masks must be True, False, 'split' or 'weights', got {masks!r}")
    if isinstance(orient, str) and orient != "up":
        raise InputError(f"orient must be 'up', a rigid (4, 4), or None for the coordinates of files, got {orient!r}")
    motion = None if orient is None or isinstance(orient, str) else rigid_motion(orient, "orient")

    if model is not None and "model" not in found.options:
        raise InputError(f"model chooses among several that a scene holds: those of the format {found.name!r} hold one")
    chosen = {} if model is None else {"model": model}

    def read(name: str) -> Scene:
        color, factor = parse_background(background), int(downscale)
        return found.read(folder, split=name, downscale=factor, background=color, masks=masks, **chosen)

    scene = read(split)
    if isinstance(orient, str):
        motion = _straightening(scene if split == "train" else _other_split(read, scene))
    scene = scene if motion is None else scene.moved(motion, round_bounds=found.round_bounds)
    if cameras is None:
        return scene
    try:
        return scene.with_cameras(CameraFile.load(cameras))
    except ValueError as error:
        raise InputError(f"{cameras}: {str(error).removeprefix(f'{cameras}: ')}") from None


def _other_split(read: Callable[[str], Scene], scene: Scene) -> Scene:
    """The training split, by which all splits stay in one world; the scene itself where there is none."""
    try:
        return read("train")
    except FileNotFoundError:
        return scene


def _straightening(scene: Scene) -> np.ndarray | None:
    """The turn that makes a scene's up +z, None where it is."""
    return rotation_to(scene.up, np.array([0.0, 0.0, 1.0]))


def holding_format(path: str | os.PathLike[str]) -> SceneFormat:
    """The first format that fits a scene folder; ValueError, with what is known and what is there, where none does."""
    folder, tried = pathlib.Path(path), []
    for each in candidates():
        if each.is_scene(folder):
            return each
        tried.append(f"{each.name}: {each.mark}")
    there = listed(sorted(entry.name + "/" * entry.is_dir() for entry in folder.iterdir()), none="nothing")
    inner = next((entry for entry in sorted(folder.iterdir()) if entry.is_dir() and _is_scene(entry)), None)
    hint = "" if inner is None else f": give its folder {inner.name!r}, which is a scene"
    hint = scene_around(folder) or hint  # a folder of COLMAP's model, of pictures
    raise InputError(f"{str(folder)!r} is no scene of a known format ({'; '.join(tried)}); it holds {there}{hint}")


def scene_around(path: pathlib.Path) -> str:
    """What to say of a file or folder that is part of a scene; "" where it is of none."""
    above = [
        each for each in path.absolute().parents[:3] if "sparse" not in each.parts[-2:]
    ]  # COLMAP's has no pictures
    around = next(filter(_is_scene, above), None)
    return "" if around is None else f"; it is part of the scene {str(around)!r}: give that folder"


def _is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder is a scene; no for one whose files cannot be read."""
    try:
        return any(each.is_scene(folder) for each in candidates())
    except (ValueError, OSError):
        return False
