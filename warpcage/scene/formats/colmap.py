"""COLMAP models, text or binary: sparse/0/{cameras, images, points3D}.{bin, txt} beside images/."""
# Schoenberger and Frahm 2016. The centre of the first pixel is (0.5, 0.5); poses are world to camera, OpenCV axes.

from __future__ import annotations

import pathlib

import numpy as np

from ..scene import Scene
from .colmap_model import Model, ModelImage, read_model
from .distortion import COEFFICIENTS
from .parsing import PICTURE_ENDINGS, held_out, inside, is_file
from .views import View, make_scene, views_there

MARK = "sparse/0/ with cameras and images, .bin or .txt"

#: Where a model lies: COLMAP's own folders, nerfstudio's, and beside the pictures, as RealityScan exports it.
MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "dense/sparse", "")

#: Where its pictures lie.
PICTURE_FOLDERS = ("images", "dense/images", "")

#: Camera models and where their parameters go: fx, fy, cx, cy, then distortion by name.
PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", *COEFFICIENTS),
}


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds a COLMAP model."""
    return _model_folder(folder) is not None


def _model_folder(folder: pathlib.Path) -> pathlib.Path | None:
    """The folder of the model, or None."""
    for name in MODEL_FOLDERS:
        model = folder / name
        if any((model / f"cameras{e}").is_file() and (model / f"images{e}").is_file() for e in (".bin", ".txt")):
            return folder / name
    return None


def read(folder: pathlib.Path, *, split: str, downscale: int, background: np.ndarray, masks: bool | str) -> Scene:
    """Read a split: every eighth image, by name, is `test`, the others are `train`. Options as for `load_scene`."""
    # masks/<name>.png, as COLMAP itself takes it, or masks/<name> becomes the alpha; the bulk of the points the bounds.
    model_folder = _model_folder(folder)
    if model_folder is None:
        raise FileNotFoundError(f"{str(folder)!r} holds no COLMAP model ({MARK})")
    model = read_model(model_folder)
    if not model.images:
        raise ValueError(f"{model.images_path} holds no images")
    masks = masks and (folder / "masks").is_dir()
    pictures = _picture_folder(folder, model)
    views = [_view(folder, pictures, model, image, masks) for image in model.images]
    views = sorted(views_there(views, model.images_path), key=lambda view: str(view.file))
    views = [views[index] for index in held_out(len(views), split, folder)]
    return make_scene(folder, views, downscale=downscale, background=background, masks=masks, points=model.points)


def _picture_folder(folder: pathlib.Path, model: Model) -> pathlib.Path:
    """The folder of the pictures: the one where most of the model's are, the usual one where none is."""
    counts = [sum(is_file(folder / name / image.name) for image in model.images) for name in PICTURE_FOLDERS]
    return folder / PICTURE_FOLDERS[counts.index(max(counts))]


def _view(folder: pathlib.Path, pictures: pathlib.Path, model: Model, image: ModelImage, masks: bool | str) -> View:
    """One picture of a model with its camera."""
    where = f"{model.images_path}: image {image.name!r}"
    file = inside(pictures, image.name, where)
    camera = model.cameras.get(image.camera)
    if camera is None:
        raise ValueError(f"{where} has camera {image.camera}, which {model.cameras_path} lacks")
    names = PARAMETERS.get(camera.model)
    if names is None:
        raise ValueError(
            f"{model.cameras_path}: camera model {camera.model[:60]!r} is not read, only "
            f"{', '.join(PARAMETERS)}: run COLMAP's image_undistorter"
        )
    if len(camera.parameters) != len(names):
        raise ValueError(
            f"{model.cameras_path}: camera {image.camera} needs {len(names)} parameters "
            f"({' '.join(names)}), got {len(camera.parameters)}"
        )
    given = dict(zip(names, camera.parameters, strict=True))
    fx, fy = (given[name] if name in given else given["f"] for name in ("fx", "fy"))
    intrinsics = (fx, fy, given["cx"], given["cy"])
    distortion = tuple(given.get(name, 0.0) for name in COEFFICIENTS)
    mask = _mask_file(folder / "masks", image.name, where) if masks else None
    return View(file, image.camera_to_world(where), where, intrinsics, camera.size, distortion, mask)


def _mask_file(folder: pathlib.Path, name: str, where: str) -> pathlib.Path:
    """The mask of a picture; it may not be there."""
    path = inside(folder, name, where)
    candidates = [path.with_name(path.name + ".png"), *(path.with_suffix(ending) for ending in PICTURE_ENDINGS)]
    return next((candidate for candidate in candidates if is_file(candidate)), candidates[0])
