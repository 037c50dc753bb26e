"""NeRF-synthetic (Blender) folders: transforms_<split>.json beside RGBA images (Mildenhall et al. 2020)."""

from __future__ import annotations

import json
import pathlib
from concurrent.futures import ThreadPoolExecutor

import imageio.v3 as iio
import numpy as np

from ..camera import Camera
from ..scene import Scene, shrink

MARK = "transforms_train.json with camera_angle_x"


def is_scene(folder: pathlib.Path) -> bool:
    transforms = sorted(folder.glob("transforms_*.json"))
    return bool(transforms) and "camera_angle_x" in _read_json(transforms[0])


def read(folder: pathlib.Path, *, split: str, downscale: int, background: np.ndarray) -> Scene:
    """Read a split; camera axes are turned from Blender's (+y up, -z forward) to OpenCV's."""
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        names = [p.stem.removeprefix("transforms_") for p in sorted(folder.glob("transforms_*.json"))]
        there = ", ".join(names) or "none"
        raise FileNotFoundError(f"split {split!r} of {str(folder)!r} is not there; splits: {there}")
    transforms = _read_json(path)
    angle = transforms.get("camera_angle_x")
    if not isinstance(angle, int | float) or not 0 < angle < np.pi:
        raise ValueError(f"{path}: camera_angle_x must lie between 0 and pi, got {angle}")
    frames = transforms.get("frames") or []
    if not frames:
        raise ValueError(f"{path} holds no frames")

    files, poses = [], []
    for index, frame in enumerate(frames):
        if "file_path" not in frame or np.shape(frame.get("transform_matrix")) != (4, 4):
            raise ValueError(f"{path}: frame {index} needs file_path and a 4x4 transform_matrix")
        file = folder / frame["file_path"]
        files.append(file if file.suffix.lower() in (".png", ".jpg", ".jpeg") else file.with_name(file.name + ".png"))
        poses.append(np.asarray(frame["transform_matrix"], dtype=np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0]))

    with ThreadPoolExecutor() as pool:
        loaded = list(pool.map(lambda file: _read_premultiplied(file, downscale), files))
    sizes = {size for _, size in loaded}
    if len(sizes) > 1:
        odd = next(file for file, (_, size) in zip(files, loaded, strict=True) if size != loaded[0][1])
        raise ValueError(f"images of one split must have one size: {files[0].name} is {loaded[0][1]}, "
                         f"{odd.name} is {dict(zip(files, [s for _, s in loaded], strict=True))[odd]} (height, width)")
    full_height, full_width = loaded[0][1]
    rgba = np.stack([image for image, _ in loaded])
    height, width = rgba.shape[1:3]
    focal = 0.5 * full_width / np.tan(0.5 * angle)
    camera_args = (focal * width / full_width, focal * height / full_height, width / 2, height / 2, width, height)
    cameras = [Camera(*camera_args, pose) for pose in poses]
    alphas = rgba[..., 3]
    images = rgba[..., :3] + (1.0 - alphas[..., None]) * background
    if (alphas == 1.0).all():  # opaque images say nothing about the object's outline
        alphas = None
    return Scene(images, alphas, cameras, background, [file.stem for file in files])


def _read_premultiplied(file: pathlib.Path, downscale: int) -> tuple[np.ndarray, tuple[int, int]]:
    """(h, w, 4) float32 with colour times alpha, shrunk, and the full (height, width)."""
    if not file.is_file():
        raise FileNotFoundError(f"image {str(file)!r} is not there")
    try:
        pixels = iio.imread(file)
    except Exception as error:
        raise ValueError(f"image {str(file)!r} cannot be read: {error}") from error
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3):
        raise ValueError(f"image {str(file)!r} must hold 8 or 16 bits a channel, got {pixels.dtype} {pixels.shape}")
    image = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[-1] in (1, 2):  # grey, with or without alpha
        image = np.concatenate([np.repeat(image[..., :1], 3, axis=-1), image[..., 1:]], axis=-1)
    if image.shape[-1] == 3:
        image = np.concatenate([image, np.ones_like(image[..., :1])], axis=-1)
    image[..., :3] *= image[..., 3:]
    return shrink(image, downscale).astype(np.float32), pixels.shape[:2]


def _read_json(path: pathlib.Path) -> dict:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is no JSON file: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a JSON object")
    return content
