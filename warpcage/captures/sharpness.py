"""How sharp a picture is, and how far the view moves between two: what frames of a video are picked by."""

from __future__ import annotations

import numpy as np

#: Pictures are compared at this width or height, whichever is longer, pixels.
COMPARED_SIZE = 640

#: Motion is measured at this size: shifts of a few of its pixels stay where brightness is linear in them.
MOTION_SIZE = 96

#: Details below this have no edges to judge: a wall, the sky, a lens that is covered. In steps of 8 bits.
LEAST_DETAIL = 0.3


def sharpness(grey: np.ndarray) -> float:
    """How much fine detail a picture (h, w), 0 to 255, some COMPARED_SIZE pixels long, has for the coarse detail that
    it has: some 0.2 for blurred to 1 for sharp pictures; 0 where there is nothing to see."""
    # The root mean square of what a binomial blur takes away, over that of what a second, twice as wide one does. Blur
    # takes fine detail first, so that the ratio falls with it, while the content, which both see, hardly matters.
    if min(grey.shape) < 16:
        return 0.0
    picture = np.asarray(grey, np.float32)
    once = _blurred(picture)
    thin = once[::2, ::2]
    coarse = float(np.sqrt(np.mean((thin - _blurred(thin)) ** 2)))
    fine = float(np.sqrt(np.mean((picture - once) ** 2)))
    return fine / coarse if coarse > LEAST_DETAIL else 0.0


def motion(before: np.ndarray, after: np.ndarray) -> float:
    """How far the view moves between two pictures (h, w), MOTION_SIZE pixels long: mean shift along the gradients of
    brightness, as a share of the longer side; 0 where there is nothing to see."""
    # Normal flow (Horn and Schunck 1981). It grows slower than the true shift beyond two of the pixels.
    first, second = (_blurred(np.asarray(picture, np.float32)) for picture in (before, after))
    down, across = np.gradient(0.5 * (first + second))
    slope = np.hypot(down, across)
    weight = float((slope * slope).sum())
    if weight < slope.size:
        return 0.0
    return float((np.abs(second - first) * slope).sum()) / weight / max(first.shape)


def shrunk_grey(grey: np.ndarray, size: int) -> np.ndarray:
    """A picture (h, w) uint8 as float32, its longer side at most `size`, by averages of whole squares."""
    factor = -(-max(grey.shape) // size)
    height, width = (side // factor * factor for side in grey.shape)
    if factor <= 1 or not height or not width:
        return grey.astype(np.float32)
    blocks = grey[:height, :width].reshape(height // factor, factor, width // factor, factor)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def _blurred(picture: np.ndarray) -> np.ndarray:
    """The binomial blur (1 2 1) / 4 along both axes, with edges repeated."""
    padded = np.pad(picture, 1, mode="edge")
    rows = 0.25 * (padded[:-2] + padded[2:]) + 0.5 * padded[1:-1]
    return 0.25 * (rows[:, :-2] + rows[:, 2:]) + 0.5 * rows[:, 1:-1]
