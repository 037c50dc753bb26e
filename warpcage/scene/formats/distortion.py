"""Lens distortion, in the model of OpenCV and COLMAP (Brown 1971), undone by resampling."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Names of the coefficients, in OpenCV's order, of which the first few may be given.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

#: The picture is never enlarged beyond this to get rid of what lies past its edge.
MAX_ZOOM = 4.0


#: Focal lengths and principal point (fx, fy, cx, cy), pixels.
Intrinsics = tuple[float, float, float, float]


def distort(x: np.ndarray, y: np.ndarray, coefficients: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Where a lens puts points of pinhole coordinates x = (u - cx) / fx, y = (v - cy) / fy, of any shape."""
    # x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    # y' = y (the same) + p1 (r^2 + 2 y^2) + 2 p2 x y
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * (8 - len(coefficients)))
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


def undistorted_intrinsics(
    intrinsics: Intrinsics, size: tuple[int, int], coefficients: Sequence[float], where: str
) -> Intrinsics:
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
        raise ValueError(f"{where}: lens distortion {named} folds the picture or leaves none of it")
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return fx * high, fy * high, cx, cy


def undistort(image: np.ndarray, lens: Intrinsics, pinhole: Intrinsics, coefficients: Sequence[float]) -> np.ndarray:
    """Resample the picture (h, w, c) float32 of a lens to that of a pinhole camera, bilinearly."""
    height, width = image.shape[:2]
    grid = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    u, v = _source(grid, pinhole, lens, coefficients)
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
