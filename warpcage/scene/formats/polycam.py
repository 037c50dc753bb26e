"""The raw data of Polycam (LiDAR and room mode): keyframes/ with a JSON file a picture."""
# Each of keyframes/cameras/*.json holds fx, fy, cx, cy, width, height, and the pose t_00 ... t_23, camera to world,
# rows first: ARKit's axes, the world's y up, the camera's +y up and -z forward. corrected_cameras/ and
# corrected_images/, where Polycam optimised them, are taken instead if all are of one size. Here z is up, as nerfstudio
# has it.

from __future__ import annotations

import pathlib

import numpy as np

from ..scene import Scene
from .parsing import PICTURE_ENDINGS, TO_OPENCV, held_out, is_file, number, read_json
from .views import View, make_scene, views_there

MARK = "keyframes/ with cameras/ and images/"

#: From ARKit's world, y up, to z up.
TO_Z_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds the raw data of Polycam."""
    return (folder / "keyframes" / "cameras").is_dir()


def read(folder: pathlib.Path, *, split: str, downscale: int, background: np.ndarray, masks: bool | str) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`."""
    keyframes = folder / "keyframes"
    views = _views(keyframes, "corrected_")
    if not views or len({view.size for view in views}) > 1:
        views = _views(keyframes, "")
    if not views:
        raise ValueError(f"{keyframes / 'cameras'} holds no cameras (.json)")
    views = views_there(views, keyframes)
    views = [views[index] for index in held_out(len(views), split, folder)]
    return make_scene(
        folder, views, downscale=downscale, background=background, masks=masks, to_source=np.linalg.inv(TO_Z_UP)
    )


def _views(keyframes: pathlib.Path, kind: str) -> list[View]:
    """The pictures of a kind with their cameras, by name."""
    cameras, images = keyframes / f"{kind}cameras", keyframes / f"{kind}images"
    return [_view(file, images) for file in sorted(cameras.glob("*.json"))] if images.is_dir() else []


def _view(file: pathlib.Path, images: pathlib.Path) -> View:
    given = read_json(file)

    def value(name: str) -> float:
        return number(given.get(name), f"{file}: {name}")

    pose = np.eye(4)
    pose[:3] = [[value(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    candidates = [images / (file.stem + ending) for ending in (".jpg", *PICTURE_ENDINGS)]
    picture = next((candidate for candidate in candidates if is_file(candidate)), candidates[0])
    return View(
        picture,
        TO_Z_UP @ pose @ TO_OPENCV,
        str(file),
        (value("fx"), value("fy"), value("cx"), value("cy")),
        (int(value("width")), int(value("height"))),
    )
