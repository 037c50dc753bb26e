"""Effort: how large and how fine a picture may be, so that it is there in time. Learned from pictures before it."""

from __future__ import annotations

import dataclasses
import math

#: Seconds that a picture may take while the hand moves, on a CPU and on CUDA.
MOVING_SECONDS = {"cpu": 0.05, "cuda": 0.022}

#: Cells of lattices that are tried on a CPU while the hand moves, and the least side of a picture, pixels.
COARSE_CELLS = (16, 20, 24, 32, 48, 64, 96, 128)
LEAST_SIDE = 200

#: March steps that are taken as one on a CPU while the hand moves.
MOVING_STEP = {"cpu": 3.0, "cuda": 1.0}

#: Quality of JPEGs while the hand moves, of pictures with few pixels then, which the page enlarges, and at rest.
MOVING_QUALITY, SMALL_QUALITY, SHARP_QUALITY = 75, 90, 92
SMALL_PIXELS = 100_000

#: How much a new measurement counts, and how far pictures may be off before their size changes.
LEARNING, SLACK = 0.35, 1.25

#: What a first guess says, on a CPU: seconds per cell of a lattice to the power of 2.5, and per pixel.
FIRST_POSE, FIRST_PIXEL = 3e-6, 2e-6


@dataclasses.dataclass(frozen=True)
class Effort:
    """What goes into one picture."""

    width: int  # of the picture, pixels; so is the height
    height: int
    cells: int  # of the lattices along the longest side of a cage
    step: float  # march steps of the field that are taken as one
    supersampling: int  # rays along each side of a pixel
    quality: int  # of the JPEG
    sharp: bool  # whether it is as good as the settings ask for


class Pace:
    """What poses and pixels cost on this machine, measured as pictures are made."""

    def __init__(self, cuda: bool):
        self.kind = "cuda" if cuda else "cpu"
        self._pose: dict[tuple[str, int], float] = {}  # (coordinates, cells) -> seconds
        self._pixel = {True: FIRST_PIXEL, False: 3.0 * FIRST_PIXEL}  # sharp -> seconds, supersampling left out
        self._scale = 0.0  # of the last picture while the hand moved

    def learn(self, effort: Effort, coordinates: str, pose: float | None, render: float) -> None:
        """Take in what a picture took, seconds for the pose (None: it was there already) and for the pixels."""
        if pose is not None:
            key = (coordinates, effort.cells)
            self._pose[key] = _mixed(self._pose.get(key), pose)
        pixels = effort.width * effort.height * effort.supersampling**2
        self._pixel[effort.sharp] = _mixed(self._pixel[effort.sharp], render / pixels)

    def pose_seconds(self, coordinates: str, cells: int) -> float:
        """What a pose is thought to take, by the nearest lattice that was measured."""
        known = [(abs(math.log(cells / c)), c, t) for (kind, c), t in self._pose.items() if kind == coordinates]
        if not known:
            return FIRST_POSE * cells**2.5 * (1.0 if coordinates == "harmonic" else 2.0)
        _, near, seconds = min(known)
        return seconds * (cells / near) ** 2.5

    def sharp(self, width: int, height: int, cells: int, supersampling: int) -> Effort:
        """The picture that the settings ask for."""
        return Effort(width, height, cells, 1.0, supersampling, SHARP_QUALITY, True)

    def sharp_seconds(self, effort: Effort, coordinates: str) -> float:
        """What a sharp picture is thought to take."""
        pixels = effort.width * effort.height * effort.supersampling**2
        return self.pose_seconds(coordinates, effort.cells) + pixels * self._pixel[True]

    def moving(self, width: int, height: int, cells: int, coordinates: str, posing: bool) -> Effort:
        """A picture that is there in time while the hand moves, of at most so many pixels (but LEAST_SIDE) and cells.
        `posing`: whether the pose changes, not the view alone."""
        budget = MOVING_SECONDS[self.kind]
        if self.kind == "cpu":
            good = [c for c in COARSE_CELLS if c <= cells and self.pose_seconds(coordinates, c) < 0.4 * budget]
            cells = min(cells, good[-1] if good else COARSE_CELLS[0])
        left = budget - (self.pose_seconds(coordinates, cells) if posing and self._pose else 0.0)
        scale = math.sqrt(max(left, 0.2 * budget) / self._pixel[False] / (width * height))
        least = min(1.0, LEAST_SIDE / max(width, height))
        scale = min(1.0, max(scale, least))
        if self._scale and max(scale / self._scale, self._scale / scale) < SLACK and scale < 1.0:
            scale = max(self._scale, least)  # a size that flickers disturbs more than a few pixels
        self._scale = min(1.0, scale)
        size = max(1, round(width * self._scale)), max(1, round(height * self._scale))
        quality = SMALL_QUALITY if size[0] * size[1] < SMALL_PIXELS else MOVING_QUALITY
        return Effort(*size, cells, MOVING_STEP[self.kind], 1, quality, False)


def _mixed(known: float | None, seen: float) -> float:
    return seen if known is None else (1.0 - LEARNING) * known + LEARNING * seen
