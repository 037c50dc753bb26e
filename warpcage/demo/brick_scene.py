"""The brick scene: pictures of the brick model, written as a NeRF-synthetic folder."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import shutil
import tempfile
from collections.abc import Iterator

import numpy as np
import warp as wp

from ..errors import InputError
from ..view.camera import Camera
from ..view.pictures import to_uint8, write_png
from .bricks import brick_model
from .raycast import render_mesh_views
from .viewpoints import CAMERA_ANGLE_X, orbit_eyes, reference_cameras, require_counts, spread_eyes


def write_brick_scene(
    path: str | os.PathLike[str],
    *,
    train_views: int = 60,
    test_views: int = 8,
    size: int = 100,  # pixels along each side of a picture
    seed: int = 0,  # places the training cameras
    samples: int = 3,  # rays along each side of a pixel
    device: wp.DeviceLike = None,
) -> pathlib.Path:
    """Render the brick model to a NeRF-synthetic folder, new, empty or an earlier one, whole or not at all."""
    # transforms_<split>.json has camera_angle_x and Blender's camera axes (+y up, -z forward), <split>/r_<i>.png is
    # RGBA of straight alpha. The cameras lie on the upper hemisphere, 4 units from the origin.
    path = pathlib.Path(path)
    require_counts(train_views, test_views, size)
    if path.exists() and not _is_replaceable(path):
        raise InputError(f"{str(path)!r} is there and is not a brick scene: give a new or an empty folder")
    model = brick_model()
    with _atomic_folder(path) as folder:
        for split, eyes in {"train": spread_eyes(train_views, seed), "test": orbit_eyes(test_views)}.items():
            cameras = reference_cameras(eyes, np.zeros(3), size)
            _write_split(folder, split, render_mesh_views(*model, cameras, samples=samples, device=device), cameras)
    return path


def _write_split(folder: pathlib.Path, split: str, views: np.ndarray, cameras: list[Camera]) -> None:
    frames = []
    for index, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        write_png(folder / split / f"r_{index}.png", to_uint8(view))
        pose = camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV to Blender axes
        frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose.tolist()})
    content = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _is_replaceable(path: pathlib.Path) -> bool:
    ours = {"train", "test", "transforms_train.json", "transforms_test.json"}
    return path.is_dir() and {entry.name for entry in path.iterdir()} in (set(), ours)


@contextlib.contextmanager
def _atomic_folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A temporary folder beside `path` that takes its place when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    work = pathlib.Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        new = work / "new"
        new.mkdir()
        yield new
        if path.exists():
            os.replace(path, work / "old")
        os.replace(new, path)
    finally:
        shutil.rmtree(work, ignore_errors=True)
