"""Pictures of a scene with their cameras: read, shrunk, masked, and freed of distortion."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ..core.checks import warn_caller
from ..core.memory import free_host_bytes
from ..core.reports import Progress, report_progress
from ..errors import InputError, MissingFileError
from ..view.camera import Camera
from ..view.pictures import Rows, read_rows, shrink, shrink_weights, shrunk_size
from .box import Bounds, find_box
from .lenses import Intrinsics, Part, pinhole_parts
from .masks import opacity_rows, with_masks
from .parsing import PictureFinder, held_out, is_file, names_apart, smaller_copies
from .scene import Scene
from .sizes import (
    Size,
    View,
    fitted_sizes,
    frames_of_sizes,
    of_copies,
    require_known_sizes,
    sizes_there,
    times,
    upright,
)

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in OpenCV's order; the first few may be given

#: Largest zoom that hides what lies beyond the edge of an undistorted picture.
MAX_ZOOM = 4.0

#: Shortest focal length in shares of a side, 171 degrees: shorter ones are not in pixels, but shares or millimetres.
SHORTEST_FOCAL = 0.04


def distort(x: np.ndarray, y: np.ndarray, coefficients: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Distorted coordinates of pinhole coordinates x = (u - cx) / fx, y = (v - cy) / fy, of any shape."""
    # x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    # y' = y (the same) + p1 (r^2 + 2 y^2) + 2 p2 x y
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * (8 - len(coefficients)))
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


def undistorted_intrinsics(intrinsics: Intrinsics, size: Size, coefficients: Sequence[float], where: str) -> Intrinsics:
    """Intrinsics, pixels, of the pinhole picture of the same size; ValueError where the coefficients fold the picture.
    The focal length is longer where the lens's picture does not reach the corners of the pinhole one."""
    fx, fy, cx, cy = intrinsics

    def holds(zoom: float) -> bool:
        rows, columns = (np.linspace(0.5, side - 0.5, min(side, 65)) for side in (size[1], size[0]))
        grid = np.meshgrid(columns, rows)
        with np.errstate(all="ignore"):
            u, v = _source(grid, (fx * zoom, fy * zoom, cx, cy), intrinsics, coefficients)
            inside = (u >= 0) & (u <= size[0]) & (v >= 0) & (v <= size[1])
            turns = _turns(u, v)
        return bool(inside.all() and (turns > 0).all())

    if holds(1.0):
        return intrinsics
    low, high = 1.0, MAX_ZOOM
    if not holds(high):
        named = ", ".join(f"{name}={value:g}" for name, value in zip(COEFFICIENTS, coefficients, strict=False) if value)
        raise InputError(f"{where}: lens distortion {named} folds the picture or leaves none of it")
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return fx * high, fy * high, cx, cy


def undistort(image: np.ndarray, lens: Intrinsics, pinhole: Intrinsics, coefficients: Sequence[float]) -> np.ndarray:
    """Resample the picture (h, w, c) float32 of a lens to that of a pinhole camera, bilinearly."""
    grid = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    return _sampled(image, *_source(grid, pinhole, lens, coefficients))


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A picture (h, w, c) float32 at places (k, l) of it, pixels, bilinearly."""
    height, width = image.shape[:2]
    u, v = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)  # half a pixel at the edge repeats it
    left, top = np.minimum(u.astype(int), max(width - 2, 0)), np.minimum(v.astype(int), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (u - left).astype(np.float32)[..., None], (v - top).astype(np.float32)[..., None]
    upper = image[top, left] * (1 - across) + image[top, right] * across
    lower = image[bottom, left] * (1 - across) + image[bottom, right] * across
    return upper * (1 - down) + lower * down


def _source(grid, pinhole, lens, coefficients):
    """Pixels of the lens's picture that show what the pixels `grid` = (u, v) of the pinhole picture do."""
    x, y = distort((grid[0] - pinhole[2]) / pinhole[0], (grid[1] - pinhole[3]) / pinhole[1], coefficients)
    return x * lens[0] + lens[2], y * lens[1] + lens[3]


def _turns(u, v) -> np.ndarray:
    """Signed area of each cell of the resampling grid: positive where the picture is not folded."""
    u_x, v_x = (np.diff(each, axis=1)[:-1] for each in (u, v))
    u_y, v_y = (np.diff(each, axis=0)[:, :-1] for each in (u, v))
    return u_x * v_y - v_x * u_y


#: Bytes a pixel that files decode to: 4 of Pillow's, and as many again where colours are looked up; 24 with 16 bits a
#: channel, as a frame, as an array and in this machine's order.
DECODED_BYTES = 24

#: Copies of its floats that a strip becomes on the way, and bytes a pixel that undoing a lens takes besides.
COPIES, LENS_BYTES = 5, 300

#: Bytes of floats that a strip holds.
STRIP_BYTES = 1 << 22

#: Most pictures that are read at once, as many as a pool of threads has by itself.
MAX_WORKERS = 32


#: Rounding of opacity 1 where opaque pictures were shrunk or undistorted.
ALPHA_ROUNDING = 1e-5


def views_there(views: list[View], listing: pathlib.Path) -> list[View]:
    """The views whose picture is there; all of them where none is, so that the first is named as missing. It warns
    where some are missing, and raises FileNotFoundError for more than half; listing: the file that lists them."""
    there = [view for view in views if is_file(view.file)]
    there = there or [view for view in views if smaller_copies(view.file, listing)]
    if not there or len(there) == len(views):
        return views
    missing = next(view.file for view in views if view not in there)
    count = f"{listing} lists {len(views)} pictures, {len(views) - len(there)} of them are not there"
    if 2 * len(there) < len(views):
        raise MissingFileError(f"{count}, more than half; the first is {str(missing)!r}")
    warn_caller(f"{count} and are left out, the first is {_printable(missing.name)}")
    return there


def files_of(views: list[View]) -> list[pathlib.Path]:
    """The pictures of views."""
    return [view.file for view in views]


def held_out_scene(folder: pathlib.Path, views: list[View], split: str, **options: Any) -> Scene:
    """The scene of a split of all views of a format that has no splits: every eighth is `test`; see `make_scene`."""
    chosen = [views[index] for index in held_out(len(views), split, folder)]
    return make_scene(folder, chosen, beside=files_of(views), **options)


def listed_scene(
    folder: pathlib.Path, views: list[View], split: str, listing: pathlib.Path, finder: PictureFinder, **options: Any
) -> Scene:
    """`held_out_scene` of the views, by name, whose pictures are there; listing: the file that lists them."""
    views = sorted(views_there(views, listing), key=lambda view: str(view.file))
    finder.warn_of_changed_names(listing)
    return held_out_scene(folder, views, split, **options)


def make_scene(
    folder: pathlib.Path,  # which pictures and masks must not lead out of: see `Bounds`
    views: list[View],
    *,
    downscale: int,
    background: np.ndarray,  # (3,) colour behind transparent pixels
    masks: bool | str = True,  # as for `load_scene`
    beside: Sequence[pathlib.Path] = (),  # pictures of other splits, by which all splits are cut to the same size
    bounds: np.ndarray | None = None,  # (2, 3) box of the object, world units
    points: np.ndarray | None = None,  # (m, 3) points of a reconstruction, world units
    point_colors: np.ndarray | None = None,  # (m, 3) in [0, 1]
    to_source: np.ndarray | None = None,  # (4, 4) as Scene has it
    progress: bool | Progress = False,
) -> Scene:
    """Read the pictures of views, undo their distortion, shrink them and put them on the background."""
    # The bounds are taken from the points, if there are no others: those that the cameras look at.
    _refuse_doubles(views)
    views, beside, downscale, factor = of_copies(folder, views, beside, downscale)
    views = with_masks(folder, views, masks, beside)
    allowed = Bounds(folder)
    for view in views:
        for file in view.files:
            allowed.require(file, view.where)
    if masks == "split" and any(view.mask is None for view in views):
        raise InputError(f"{views[0].where}: masks='split' needs a mask file for every picture")
    views, sizes = _parted(*fitted_sizes(upright(views), factor, folder))  # of the files
    intrinsics = [view.intrinsics_of(size) for view, size in zip(views, sizes, strict=True)]
    shapes = [size if view.part is None else view.part.size for view, size in zip(views, sizes, strict=True)]
    has_parts = any(view.part is not None for view in views)
    frames, canvas = frames_of_sizes(
        shapes, [] if has_parts else sizes_there(beside, upright=any(view.turned for view in views))
    )
    if frames is shapes:
        require_known_sizes(views, shapes)
    pinholes = [pinhole_intrinsics(*each) for each in zip(views, intrinsics, frames, strict=True)]
    cameras = [_camera(*each) for each in zip(views, pinholes, frames, strict=True)]
    shrunk = [shrunk_size(frame, downscale) for frame in frames]
    cameras = [camera.resized(*size) for camera, size in zip(cameras, shrunk, strict=True)]
    split, width, height = masks == "split", *shrunk_size(canvas, downscale)
    is_counted = any(view.is_counted or size != (width, height) for view, size in zip(views, shrunk, strict=True))
    spans = [frame if view.part is None else size for view, frame, size in zip(views, frames, sizes, strict=True)]
    workers = _workers(views, spans, canvas, downscale, split, is_counted)
    images = np.empty((len(views), height, width, 3), np.float32)
    alphas = np.empty((len(views), height, width), np.float32)
    surroundings = np.empty_like(images) if split else None
    weights = np.empty_like(alphas) if is_counted else None

    def load(group: list[int]) -> None:
        read = _reader(views[group[0]], background, split)
        whole = None if views[group[0]].part is None else read(0, None, None)
        for index in group:
            view = views[index]
            if whole is None:
                lenses = intrinsics[index], pinholes[index]
                keep(index, _strips(view, read, *lenses, frames[index], downscale, split))
            else:
                keep(index, [_resampled(view, *whole, intrinsics[index], frames[index], downscale, background)])

    def keep(index: int, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> None:
        top, columns = 0, slice(shrunk[index][0])
        for array, empty in ((images, background), (alphas, 0.0), (surroundings, 0.0), (weights, 0.0)):
            if array is not None:  # beyond a smaller picture
                array[index, shrunk[index][1] :] = array[index, :, columns.stop :] = empty
        for part, counted in parts:
            alpha, rows = part[..., 3], slice(top, top + len(part))
            images[index, rows, columns] = part[..., :3] + (1.0 - alpha[..., None]) * background
            alphas[index, rows, columns] = alpha
            if surroundings is not None:
                surroundings[index, rows, columns] = part[..., 4:]
            if weights is not None:
                weights[index, rows, columns] = counted
            top += len(part)

    groups: dict[pathlib.Path, list[int]] = {}  # the views that each file becomes
    for index, view in enumerate(views):
        groups.setdefault(view.file, []).append(index)
    with ThreadPoolExecutor(workers) as pool:
        try:
            for index, _ in enumerate(pool.map(load, groups.values())):
                report_progress(progress, index + 1, len(groups), "read pictures")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    # opaque images say nothing about the object's outline; averages of ones are not 1 to the last bit
    shown = (alpha[: size[1], : size[0]] for alpha, size in zip(alphas, shrunk, strict=True))
    opaque = all(alpha.min() > 1.0 - ALPHA_ROUNDING for alpha in shown)
    if 2 * (hidden := sum(not alpha.any() for alpha in alphas)) > len(views):
        warn_caller(f"{folder}: masks hide all of {hidden} of {len(views)} pictures: they keep what is white")
    has_points = points is not None and len(points) > 0
    try:
        found = find_box(cameras, points) if bounds is None and has_points else None
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None
    return Scene(
        images,
        None if opaque else alphas,
        cameras,
        background,
        _names(views, beside),
        bounds=bounds if found is None else found.bounds,
        found=found,
        to_source=to_source,
        surroundings=None if opaque else surroundings,
        captured=any(view.mask is not None for view in views),
        points=points if has_points else None,
        point_colors=point_colors if has_points else None,
        weights=None if weights is None or weights.min() == 1.0 else weights,
    )


def _refuse_doubles(views: list[View]) -> None:
    """Refuse a picture that is listed twice."""
    seen = {}
    for view in views:
        key = os.path.abspath(view.file)
        if key in seen:
            raise InputError(f"{view.where}: image {view.file.name!r} is listed twice, first in {seen[key]}")
        seen[key] = view.where


def _parted(views: list[View], sizes: list[Size]) -> tuple[list[View], list[Size]]:
    """The views, those of lenses as the pinhole views that their pictures become; and the size of the file of each."""
    parted, of_files, known = [], [], {}
    for view, size in zip(views, sizes, strict=True):
        parts = [view]
        if view.lens is not None:
            given = view.intrinsics_of(size)
            key = (view.lens, given, size)
            if key not in known:
                _camera(view, given, size)  # refuses what cannot be a camera
                known[key] = pinhole_parts(view.lens, given, size, view.where)
            parts = [dataclasses.replace(view, pose=_turned(view.pose, part), part=part) for part in known[key]]
        parted += parts
        of_files += [size] * len(parts)
    return parted, of_files


def _turned(pose: np.ndarray, part: Part) -> np.ndarray:
    """The pose of a part of what a camera sees."""
    turn = np.eye(4)
    turn[:3, :3] = part.rotation
    return pose @ turn


def pinhole_intrinsics(view: View, intrinsics: Intrinsics, size: Size) -> Intrinsics:
    """(fx, fy, cx, cy) of a view's picture without its distortion, or of the part that it is."""
    if view.part is not None:
        return view.part.intrinsics
    if not any(view.distortion):
        return intrinsics
    _camera(view, intrinsics, size)  # refuses what cannot be a camera
    return undistorted_intrinsics(intrinsics, size, view.distortion, view.where)


def _camera(view: View, intrinsics: Intrinsics, size: Size) -> Camera:
    """A view's camera; errors name its file."""
    fx, fy, cx, cy = intrinsics
    width, height = size
    if 0 < fx < SHORTEST_FOCAL * width or 0 < fy < SHORTEST_FOCAL * height:
        raise InputError(f"{view.where}: a focal length of {min(fx, fy):.3g} pixels is too short for {width}x{height}")
    try:
        return Camera(fx, fy, cx, cy, width, height, view.pose)
    except ValueError as error:
        raise InputError(f"{view.where}: {error}") from error


def _workers(views: list[View], spans: list[Size], canvas: Size, downscale: int, split: bool, is_counted: bool) -> int:
    """How many pictures are read at once. Refuses pictures that the machine cannot hold, before the first is read."""
    width, height = shrunk_size(canvas, downscale)
    held = len(views) * width * height * (4 * ((7 if split else 4) + is_counted) + 1)
    flights = (flight_bytes(*each, downscale, split) for each in zip(views, spans, strict=True))
    flight, free, size = max(flights), free_host_bytes(), canvas
    if flight >= free:
        raise InputError(
            f"reading a picture of {times(size)} needs {flight / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free: "
            "shrink the files"
        )
    if held > free - flight:
        least = downscale * int(np.ceil(np.sqrt(held / (free - flight))))
        raise InputError(
            f"{len(views)} pictures of {width}x{height} need {(held + flight) / 2**30:.1f} GiB, {free / 2**30:.1f} GiB "
            f"are free: give downscale={least} or more"
        )
    return max(1, min(MAX_WORKERS, (os.cpu_count() or 1) + 4, len(views), (free - held) // flight))


def flight_bytes(view: View, size: Size, downscale: int, split: bool) -> int:
    """Memory that a picture takes while it is read: what its files decode to, and floats of a strip or of all of it."""
    pixels = size[0] * size[1]
    numbers = 8 if split else 4
    bent = pixels if any(view.distortion) else 0
    if view.part is not None:
        bent = view.part.size[0] * view.part.size[1]
    files = DECODED_BYTES * (1 + len(view.mask_files)) * pixels
    return files + COPIES * 4 * numbers * size[0] * _strip_rows(view, size, downscale, numbers) + LENS_BYTES * bent


def _strip_rows(view: View, size: Size, downscale: int, numbers: int) -> int:
    """Rows of a picture that are handled at once: all where a lens is undone, or where squares do not fit into it."""
    width, height = size
    if any(view.distortion) or view.part is not None or width % downscale or height % downscale:
        return height
    return min(height, downscale * max(1, STRIP_BYTES // (4 * numbers * width * downscale)))


#: Gives rows of a picture from one to another (None: the end), up to a column (None: all): (k, l, 4 or 7) float32,
#: colour times opacity, opacity, and where masks split what they take away; and (k, l) how much each pixel counts.
Reader = Callable[[int, int | None, int | None], tuple[np.ndarray, np.ndarray]]


def _reader(view: View, background: np.ndarray, split: bool) -> Reader:
    """Decodes the files of a view."""
    files = view.file, view.mask, view.counted, view.ignored
    rows = [None if file is None else read_rows(file, upright=file in view.turned) for file in files]
    picture, mask, counted, ignored = rows
    mask, counted = (each if each is None else opacity_rows(each) for each in (mask, counted))
    assert picture is not None

    def read(first: int, last: int | None, width: int | None) -> tuple[np.ndarray, np.ndarray]:
        def rows_of(rows: Rows) -> np.ndarray:
            return rows(first, last)[:, :width]

        rgba = _premultiplied(rows_of(picture), None if mask is None else rows_of(mask))
        weights = np.ones(rgba.shape[:2], np.float32)
        if counted is not None:
            weights = rows_of(counted)[..., 0]
        if ignored is not None:
            colors = rows_of(ignored)  # grey, grey and opacity, colours, or colours and opacity
            is_ignored = colors[..., : 3 if colors.shape[-1] > 2 else 1].any(axis=-1)
            weights = np.where(is_ignored, np.float32(0.0), weights)
        if split:
            whole = _premultiplied(rows_of(picture), None)
            around = whole[..., :3] + (1.0 - whole[..., 3:]) * background - rgba[..., :3]
            rgba = np.concatenate([rgba, around], axis=-1)
        return rgba, weights

    return read


def _strips(
    view: View, read: Reader, lens: Intrinsics, pinhole: Intrinsics, size: Size, downscale: int, split: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """A picture from top to bottom as a Reader gives it, without its distortion, shrunk."""
    step = _strip_rows(view, size, downscale, 8 if split else 4)
    for first in range(0, size[1], step):
        rgba, weights = read(first, min(first + step, size[1]), size[0])
        if any(view.distortion):
            rgba = undistort(rgba, lens, pinhole, view.distortion)
            if view.is_counted:
                weights = _least(undistort(_with_zeros(weights), lens, pinhole, view.distortion))
        yield shrink(rgba, downscale).astype(np.float32, copy=False), shrink_weights(weights, downscale)


def _with_zeros(weights: np.ndarray) -> np.ndarray:
    """Weights (h, w) and where they are 0, to be resampled together: see `_least`."""
    return np.stack([weights, weights == 0.0], axis=-1, dtype=np.float32)


def _least(resampled: np.ndarray) -> np.ndarray:
    """The weights of what `_with_zeros` gives once it is resampled: what is made of an ignored pixel too is ignored."""
    weights, touched = np.moveaxis(resampled, -1, 0)
    return np.where(touched > 0.0, np.float32(0.0), weights)


def _resampled(
    view: View,
    whole: np.ndarray,
    weights: np.ndarray,
    lens: Intrinsics,
    size: Size,
    downscale: int,
    background: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The part of a picture, as a Reader gives it, that a view shows, shrunk; what it does not show does not count."""
    assert view.part is not None and view.lens is not None
    rays = view.part.rays(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    u, v, seen = view.lens.pixels(rays, lens, (whole.shape[1], whole.shape[0]))
    both = np.concatenate([whole, _with_zeros(weights)], axis=-1)
    if view.lens.is_round:
        both, u = np.concatenate([both[:, -1:], both, both[:, :1]], axis=1), u + 1.0
    both = _sampled(both, u, v)
    part, weights = both[..., :-2], _least(both[..., -2:])
    part[~seen] = 0.0
    part[~seen, :4] = (*background, 1.0)  # no opacity is known there
    weights = np.where(seen, weights, np.float32(0.0))
    return shrink(part, downscale).astype(np.float32, copy=False), shrink_weights(weights, downscale)


def _premultiplied(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """(h, w, 4) float32, colour times opacity, and opacity."""
    if image.shape[-1] < 3:  # grey, with or without alpha
        image = np.concatenate([np.repeat(image[..., :1], 3, axis=-1), image[..., 1:]], axis=-1)
    if image.shape[-1] == 3:
        image = np.concatenate([image, np.ones_like(image[..., :1])], axis=-1)
    if mask is not None:
        image[..., 3] *= mask[..., 0]
    image[..., :3] *= image[..., 3:]
    return image


def _names(views: list[View], beside: Sequence[pathlib.Path]) -> list[str]:
    """File names without ending, with folders where pictures of any split have the same, and sides of a cube."""
    files = list(dict.fromkeys([*files_of(views), *beside]))
    names = dict(zip(files, names_apart(files), strict=True))
    sides = ["" if view.part is None or not view.part.name else f"_{view.part.name}" for view in views]
    return [_printable(names[view.file] + side) for view, side in zip(views, sides, strict=True)]


def _printable(name: str) -> str:
    """A file name, of which bytes that are no text are written as numbers."""
    return name.encode("utf-8", "backslashreplace").decode()
