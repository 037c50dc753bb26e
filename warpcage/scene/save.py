"""A scene as a folder of nerfstudio's format: pictures, masks, points and transforms.json."""

from __future__ import annotations

import json
import pathlib
import re
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.checks import checked_path, warn_caller
from ..core.files import PathLike, atomic_path
from ..core.threads import cpu_threads
from ..errors import InputError
from ..mesh.io.ply import write_ply
from ..view.camera import Camera
from ..view.pictures import write_png
from .parsing import TO_OPENCV

if TYPE_CHECKING:
    from .scene import Scene


def save_scene(scene: Scene, folder: PathLike) -> None:
    """Write a scene to a new or empty folder as `Scene.save` says."""
    folder = checked_path(folder, "the scene")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{str(folder)!r} is there and not an empty folder: name a new one for the scene")
    files = _file_names(scene.names)
    parts = ["images"] + ["masks"] * (scene.captured and scene.alphas is not None)
    for name in parts:
        (folder / name).mkdir(parents=True)
    with ThreadPoolExecutor(cpu_threads()) as pool:
        frames = list(pool.map(lambda index: _write_view(scene, index, folder, files[index]), range(len(scene))))
    if scene.weights is not None:
        partly = int(np.count_nonzero((scene.weights > 0.0) & (scene.weights < 1.0)))
        if partly:
            warn_caller(
                f"{folder}: its masks know pixels that count and those that do not: {partly} of {scene.weights.size} "
                "that count in part count no more"
            )
    content: dict[str, Any] = {"camera_model": "PINHOLE"}
    if scene.points is not None:
        colors = None if scene.point_colors is None else np.round(255.0 * np.clip(scene.point_colors, 0.0, 1.0))
        nothing = np.zeros((0, 3), np.int32)
        data = write_ply(scene.points, nothing, None if colors is None else colors.astype(np.uint8), comment="points")
        (folder / "points.ply").write_bytes(data)
        content["ply_file_path"] = "points.ply"
    if scene.to_source is not None:
        content["applied_transform"] = np.linalg.inv(scene.to_source)[:3].tolist()
    content["frames"] = frames
    with atomic_path(folder / "transforms.json") as temporary:  # last: without it the folder is no scene
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def transforms_frame(file: str, camera: Camera, **more: Any) -> dict[str, Any]:
    """A frame of transforms.json: a picture's file, its camera, and `more` keys."""
    names = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
    numbers = {key: getattr(camera, name) for key, name in names.items()}
    pose = camera.camera_to_world @ TO_OPENCV  # the same back
    return {"file_path": file, **numbers, **more, "transform_matrix": pose.tolist()}


def _file_names(names: list[str]) -> list[str]:
    """Names of files, each its own, that any system can have."""
    found: dict[str, None] = {}
    for name in names:
        plain = re.sub(r"[^\w.-]+", "_", name).strip(".") or "picture"
        free = next(each for each in (plain, *(f"{plain}_{n}" for n in range(2, len(names) + 2))) if each not in found)
        found[free] = None
    return list(found)


def _write_view(scene: Scene, index: int, folder: pathlib.Path, name: str) -> dict[str, Any]:
    """Write the files of a picture. Returns its frame of transforms.json."""
    frame = transforms_frame(f"images/{name}.png", scene.cameras[index])
    picture = scene.cut(index, scene.images[index])
    if scene.alphas is not None:
        alpha = scene.cut(index, scene.alphas[index])[..., None]
        behind = (1.0 - alpha) * scene.background
        if scene.surroundings is not None:
            picture = picture - behind + scene.cut(index, scene.surroundings[index])
        else:  # the colour of what is opaque, which readers put before a background of theirs
            picture = np.where(alpha > 0.0, (picture - behind) / np.maximum(alpha, 1e-6), picture)
        if scene.captured:
            frame["mask_path"] = f"masks/{name}.png"
            write_png(folder / frame["mask_path"], alpha[..., 0])
        else:
            picture = np.concatenate([picture, alpha], axis=-1)
    if scene.weights is not None and (scene.cut(index, scene.weights[index]) < 1.0).any():
        ignored = scene.cut(index, scene.weights[index]) < 1.0  # instant-ngp's way to say it
        write_png(folder / f"images/dynamic_mask_{name}.png", ignored.astype(np.float32))
    write_png(folder / frame["file_path"], np.clip(picture, 0.0, 1.0))
    return frame
