"""The cameras that a command's view options name."""

from __future__ import annotations

import pathlib

from ..scene.load import load_scene
from ..view.camera import Camera, framing_orbit


def image_size(args) -> tuple[int, int] | None:
    if args.size is None:
        return None
    if len(args.size) > 2:
        raise ValueError(f"--size takes a width, or a width and a height, got {len(args.size)} numbers")
    return args.size[0], args.size[-1]


def chosen_camera(args, points):
    """The camera of add_view; points (n, 3) that should be seen where none is given."""
    size = image_size(args)
    if args.camera is not None:
        if args.eye is not None or args.target is not None:
            raise ValueError("--camera and --eye / --target exclude each other")
        camera = scene_camera(args.camera)
        return camera if size is None else fitted(camera, *size)
    width, height = size or (400, 400)
    view = {"up": args.up, "fov_degrees": args.fov, "width": width, "height": height}
    framed = framing_orbit(points, 1, elevation_degrees=25.0, start_degrees=-60.0, **view)[0]
    if args.eye is None and args.target is None:
        return framed
    target = chosen_target(args, points)
    eye = framed.centre + target - middle(points) if args.eye is None else args.eye
    return Camera.look_at(eye, target, **view)


def chosen_target(args, points):
    """(3,) what the camera of add_view looks at, or turns around: the middle of what there is to see by default."""
    import numpy as np

    return middle(points) if args.target is None else np.asarray(args.target, np.float64)


def middle(points):
    """(3,) middle of the bounding box of points (n, 3)."""
    return (points.min(axis=0) + points.max(axis=0)) / 2


def fitted(camera, width: int, height: int):
    """The same view at another size; refused where that would squeeze it."""
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise ValueError(
            f"--size {width} {height} would squeeze a {camera.width}x{camera.height} picture: give "
            f"{width} {round(width * camera.height / camera.width)}"
        )
    return camera.resized(width, height)


def scene_cameras(text: str) -> list:
    """The cameras that SCENE[:SPLIT] names, in the order of the pictures."""
    path, split = text, "train"
    if not pathlib.Path(path).exists() and ":" in path:
        path, _, split = path.rpartition(":")
    return load_scene(path, split=split).cameras


def scene_camera(text: str):
    """The camera that SCENE:[SPLIT:]INDEX names."""
    path, separator, index = text.rpartition(":")
    if not separator or not index.isdigit():
        raise ValueError(f"--camera must be SCENE:INDEX or SCENE:SPLIT:INDEX, got {text!r}")
    cameras = scene_cameras(path)
    if int(index) >= len(cameras):
        raise ValueError(f"{path!r} has pictures 0 to {len(cameras) - 1}, got {index}")
    return cameras[int(index)]
