"""From what a format says about its pictures to a Scene."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ...core.memory import free_host_bytes
from ...view.camera import Camera
from ...view.pictures import image_size, read_image, shrink
from ..box import view_box
from ..scene import Scene
from .distortion import undistort, undistorted_intrinsics

#: Fewer points of a reconstruction say nothing about where the object is.
MIN_POINTS = 8


@dataclasses.dataclass
class View:
    """One picture and its camera, as a format's reader found them.

    file: the picture. pose: (4, 4) camera to world, OpenCV axes. where: file and field, for messages.
    intrinsics: (fx, fy, cx, cy) in pixels of the file, the centre of the first pixel at (0.5, 0.5); or a function of
    the picture's (width, height) that gives them. size: (width, height) that the format claims, or None.
    distortion: coefficients in the order of distortion.COEFFICIENTS, or empty. mask: picture of the opacity, or None.
    """

    file: pathlib.Path
    pose: np.ndarray
    where: str
    intrinsics: object
    size: tuple[int, int] | None = None
    distortion: tuple[float, ...] = ()
    mask: pathlib.Path | None = None


def make_scene(
    views: list[View],
    *,
    downscale: int,
    background: np.ndarray,
    masks: bool | str = True,
    bounds=None,
    points=None,
    to_source=None,
) -> Scene:
    """Read the pictures of views, undo their distortion, shrink them and put them on the background.

    masks: as in load_scene. bounds, to_source: as Scene has them. points: (n, 3) of a reconstruction, or
    None; the bulk of those that the cameras look at becomes the bounds where none are given.
    Raises FileNotFoundError for pictures that are not there; ValueError for pictures listed twice, of several sizes,
    of another size than their camera's, broken, or too many for the memory.
    """
    _refuse_doubles(views)
    if masks == "split" and any(view.mask is None for view in views):
        raise ValueError(f"{views[0].where}: masks='split' needs a mask file for every picture")
    if not masks:
        views = [dataclasses.replace(view, mask=None) for view in views]
    size = _common_size(views)
    intrinsics = [_intrinsics(view, size) for view in views]
    pinholes = [_pinhole(view, given, size) for view, given in zip(views, intrinsics, strict=True)]
    cameras = [_camera(view, pinhole, size) for view, pinhole in zip(views, pinholes, strict=True)]
    _require_memory(len(views), size, downscale, channels=8 if masks != "split" else 14)

    def load(index: int) -> np.ndarray:
        view = views[index]
        rgba = _premultiplied(view)
        if masks == "split":
            whole = _premultiplied(dataclasses.replace(view, mask=None))
            around = whole[..., :3] + (1.0 - whole[..., 3:]) * background - rgba[..., :3]
            rgba = np.concatenate([rgba, around], axis=-1)
        if any(view.distortion):
            rgba = undistort(rgba, intrinsics[index], pinholes[index], view.distortion)
        return shrink(rgba, downscale).astype(np.float32)

    with ThreadPoolExecutor() as pool:
        rgba = np.stack(list(pool.map(load, range(len(views)))))
    height, width = rgba.shape[1:3]
    cameras = [camera.resized(width, height) for camera in cameras]
    alphas = rgba[..., 3]
    images = rgba[..., :3] + (1.0 - alphas[..., None]) * background
    if (alphas == 1.0).all():  # opaque images say nothing about the object's outline
        alphas = None
    surroundings = rgba[..., 4:] if masks == "split" and alphas is not None else None
    scene = Scene(
        images,
        alphas,
        cameras,
        background,
        _names(views),
        bounds=bounds,
        to_source=to_source,
        surroundings=surroundings,
        captured=any(view.mask is not None for view in views),
    )
    return scene if points is None or bounds is not None else _with_bounds(scene, points)


def _refuse_doubles(views: list[View]) -> None:
    seen = {}
    for view in views:
        key = os.path.abspath(view.file)
        if key in seen:
            raise ValueError(f"{view.where}: image {view.file.name!r} is listed twice, first in {seen[key]}")
        seen[key] = view.where


def _common_size(views: list[View]) -> tuple[int, int]:
    """(width, height) of all pictures, out of their headers."""
    with ThreadPoolExecutor() as pool:
        sizes = list(pool.map(lambda view: image_size(view.file), views))
    for view, size in zip(views, sizes, strict=True):
        if view.size is not None and size != tuple(view.size):
            raise ValueError(
                f"{view.where}: the camera is for {_times(view.size)} pixels, image {view.file.name!r} "
                f"has {_times(size)}"
            )
        if size != sizes[0]:
            raise ValueError(
                f"images of one split must have one size: {views[0].file.name!r} is {_times(sizes[0])}, "
                f"{view.file.name!r} is {_times(size)}"
            )
    for view in views:
        if view.mask is not None and image_size(view.mask) != sizes[0]:
            raise ValueError(
                f"{view.where}: mask {view.mask.name!r} is {_times(image_size(view.mask))}, its image is "
                f"{_times(sizes[0])}"
            )
    return sizes[0]


def _times(size) -> str:
    return f"{size[0]}x{size[1]}"


def _intrinsics(view: View, size) -> tuple[float, float, float, float]:
    given = view.intrinsics(size) if callable(view.intrinsics) else view.intrinsics
    return tuple(float(value) for value in given)


def _pinhole(view: View, intrinsics, size):
    if not any(view.distortion):
        return intrinsics
    _camera(view, intrinsics, size)  # what is no camera cannot be undistorted either
    return undistorted_intrinsics(intrinsics, size, view.distortion, view.where)


def _camera(view: View, intrinsics, size) -> Camera:
    try:
        return Camera(*intrinsics, *size, view.pose)
    except ValueError as error:
        raise ValueError(f"{view.where}: {error}") from error


def _require_memory(count: int, size, downscale: int, channels: int) -> None:
    """Refuse pictures that the machine cannot hold, before the first is read."""
    width, height = (max(1, round(side / downscale)) for side in size)
    needed = count * width * height * channels * 4  # what is read, and what becomes of it
    free = free_host_bytes()
    if needed > free:
        raise ValueError(
            f"{count} pictures of {width}x{height} need {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB "
            f"are free: give downscale={downscale * int(np.ceil(np.sqrt(needed / free)))} or more"
        )


def _premultiplied(view: View) -> np.ndarray:
    """(h, w, 4) float32, colour times opacity, and opacity."""
    image = read_image(view.file)
    if image.shape[-1] < 3:  # grey, with or without alpha
        image = np.concatenate([np.repeat(image[..., :1], 3, axis=-1), image[..., 1:]], axis=-1)
    if image.shape[-1] == 3:
        image = np.concatenate([image, np.ones_like(image[..., :1])], axis=-1)
    if view.mask is not None:
        image[..., 3] *= read_image(view.mask)[..., 0]
    image[..., :3] *= image[..., 3:]
    return image


def _names(views: list[View]) -> list[str]:
    """File names without ending; with the folder where that does not tell them apart."""
    names = [view.file.stem for view in views]
    return names if len(set(names)) == len(names) else [f"{view.file.parent.name}/{view.file.stem}" for view in views]


def _with_bounds(scene: Scene, points: np.ndarray) -> Scene:
    """The scene with a box around the bulk of the points that lie where the cameras look, or of all of them."""
    low, high = view_box(scene)
    seen = points[((points > low) & (points < high)).all(axis=1)]
    bulk = seen if len(seen) >= max(MIN_POINTS, len(points) // 4) else points
    if len(bulk) < MIN_POINTS:
        return scene
    low, high = np.percentile(bulk, [1.0, 99.0], axis=0)  # a few are always far off
    margin = 0.1 * float((high - low).max())
    if not (np.isfinite(margin) and margin > 0):
        return scene
    return dataclasses.replace(scene, bounds=[low - margin, high + margin])
