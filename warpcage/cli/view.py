"""The cameras that a command's view options name."""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

from ..scene.load import load_scene
from ..view.camera import Camera, framing_orbit

#: Width and height of a picture, and where a camera stands, in degrees, where neither is given.
DEFAULT_SIZE, ELEVATION, AZIMUTH = (400, 400), 25.0, -60.0


def image_size(args: argparse.Namespace) -> tuple[int, int] | None:
    """Width and height of --size, None where it is not given."""
    if args.size is None:
        return None
    if len(args.size) > 2:
        raise ValueError(f"--size takes a width, or a width and a height, got {len(args.size)} numbers")
    return args.size[0], args.size[-1]


def chosen_camera(args: argparse.Namespace, points: np.ndarray) -> Camera:
    """The camera of the view options. Where none is given, it sees all points (n, 3)."""
    size = image_size(args)
    if args.camera is not None:
        if args.eye is not None or args.target is not None:
            raise ValueError("--camera cannot be combined with --eye or --target")
        camera = scene_camera(args.camera)
        return camera if size is None else fitted(camera, *size)
    width, height = size or DEFAULT_SIZE
    view = {"up": args.up, "fov_degrees": args.fov, "width": width, "height": height}
    framed = framing_orbit(points, 1, elevation_degrees=ELEVATION, start_degrees=AZIMUTH, **view)[0]
    if args.eye is None and args.target is None:
        return framed
    target = chosen_target(args, points)
    eye = framed.centre + target - middle(points) if args.eye is None else args.eye
    return Camera.look_at(eye, target, **view)


def chosen_target(args: argparse.Namespace, points: np.ndarray) -> np.ndarray:
    """(3,) what the camera looks at, or turns around. Where it is not given, the middle of the points (n, 3)."""
    return middle(points) if args.target is None else np.asarray(args.target, np.float64)


def middle(points: np.ndarray) -> np.ndarray:
    """(3,) middle of the bounding box of points (n, 3)."""
    return (points.min(axis=0) + points.max(axis=0)) / 2


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """The same view at another size. Raises ValueError where that would squeeze it."""
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise ValueError(
            f"--size {width} {height} would squeeze a {camera.width}x{camera.height} picture: give "
            f"{width} {round(width * camera.height / camera.width)}"
        )
    return camera.resized(width, height)


def scene_cameras(text: str) -> list[Camera]:
    """The cameras that SCENE[:SPLIT] names, in the order of the pictures."""
    path, split = text, "train"
    if not pathlib.Path(path).exists() and ":" in path:
        path, _, split = path.rpartition(":")
    return load_scene(path, split=split).cameras


def sized_cameras(args: argparse.Namespace, text: str) -> list[Camera]:
    """The cameras that SCENE[:SPLIT] names, at --size where it is given."""
    cameras, size = scene_cameras(text), image_size(args)
    return cameras if size is None else [fitted(camera, *size) for camera in cameras]


def scene_camera(text: str) -> Camera:
    """The camera that SCENE:[SPLIT:]INDEX names."""
    path, separator, index = text.rpartition(":")
    if not separator or not index.isdigit():
        raise ValueError(f"--camera must be SCENE:INDEX or SCENE:SPLIT:INDEX, got {text!r}")
    cameras = scene_cameras(path)
    if int(index) >= len(cameras):
        raise ValueError(f"{path!r} has pictures 0 to {len(cameras) - 1}, got {index}")
    return cameras[int(index)]
