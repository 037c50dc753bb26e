"""Write the brick scene as a NeRF-synthetic folder."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import shutil
import tempfile

import numpy as np

from ..view.camera import Camera
from ..view.pictures import to_uint8, write_png
from .bricks import brick_model
from .raycast import render_mesh_views

#: Horizontal field of view (radians) and camera distance of the NeRF-synthetic scenes.
CAMERA_ANGLE_X = 0.6911112070083618
CAMERA_RADIUS = 4.0


def write_brick_scene(
    path, *, train_views: int = 60, test_views: int = 8, size: int = 100, seed: int = 0, samples: int = 3, device=None
) -> pathlib.Path:
    """Render the brick model to a NeRF-synthetic folder and return its path.

    train_views, test_views: pictures of each split; size: pixels a side; samples x samples rays a pixel; seed: places
    the training cameras. Writes transforms_<split>.json (camera_angle_x, Blender camera axes: +y up, -z forward) and
    <split>/r_<i>.png (RGBA, straight alpha); cameras lie on the upper hemisphere, 4 units from the origin.
    The folder appears complete or not at all; an earlier brick scene there is replaced.
    Raises ValueError for counts below one, or where `path` holds anything else.
    """
    path = pathlib.Path(path)
    if min(train_views, test_views, size) < 1:
        raise ValueError(f"a scene needs views and pixels, got {train_views} + {test_views} views of {size} pixels")
    if path.exists() and not _is_replaceable(path):
        raise ValueError(f"{str(path)!r} is there and is no brick scene: give a new or an empty folder")
    eyes = {"train": _spread_eyes(train_views, seed), "test": _orbit_eyes(test_views)}
    model = brick_model()
    with _atomic_folder(path) as folder:
        for split, places in eyes.items():
            cameras = [
                Camera.look_at(eye, (0.0, 0.0, 0.0), fov_degrees=np.degrees(CAMERA_ANGLE_X), width=size, height=size)
                for eye in places
            ]
            views = render_mesh_views(*model, cameras, samples=samples, device=device)
            _write_split(folder, split, views, cameras)
    return path


def _spread_eyes(count: int, seed: int) -> np.ndarray:
    """Even over the upper hemisphere (a Fibonacci spiral with a turn and small jitter from the seed), (count, 3)."""
    rng = np.random.default_rng(seed)
    height = 0.03 + 0.94 * (np.arange(count) + rng.random(count)) / count
    turn = 2 * np.pi * (rng.random() + np.arange(count) * (np.sqrt(5) - 1) / 2)
    flat = np.sqrt(1 - height**2)
    return CAMERA_RADIUS * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def _orbit_eyes(count: int) -> np.ndarray:
    """Once around, between 15 and 50 degrees up, (count, 3)."""
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    rise = np.radians(32.5 + 17.5 * np.sin(2 * turn + 0.5))
    return CAMERA_RADIUS * np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1)


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
def _atomic_folder(path: pathlib.Path):
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
