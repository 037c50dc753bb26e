"""What field files hold: plain NumPy arrays, whatever the format."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.threads import run_parallel

#: Voxels that a grid may have, empty ones included: kernels count them in int32.
MAX_VOXELS = 2**31 - 1

#: Harmonics of degree 0 to 2, which each channel of an RGB row has.
BASIS_COUNT = 9

#: Numbers of a row of either kind (kernels/field/harmonics): 3 x 9 of red, green and blue; or 16 of luminance and 4 of
#: each of two differences of colour.
RGB_NUMBERS, LUMINANCE_NUMBERS = 3 * BASIS_COUNT, 24

#: Of a luminous row, those of degree 0 to 2, by their places in an RGB row's channel.
_LUMINANCE, _ORANGE, _GREEN = slice(0, BASIS_COUNT), slice(16, 20), slice(20, 24)

#: Numbers that a thread converts or looks through at once.
PART_NUMBERS = 1 << 22

#: The largest float16.
MAX_HALF = 65504.0


@dataclasses.dataclass(frozen=True)
class LayerContents:
    """Background layers on the host."""

    # (3,) float64 centre of all cubes, world units
    center: np.ndarray
    # half side of the innermost cube, world units
    half: float
    # cells along an edge of a cube
    side: int
    # (layers, nodes, 4) float32 red, green, blue and optical depth
    values: np.ndarray
    # (4,) float32 what nodes hold that no picture showed
    unseen: np.ndarray | None

    def shrunk(self, divisor: float) -> LayerContents:
        """The layers of a smaller world; divisor: old lengths over new ones."""
        return dataclasses.replace(self, center=self.center / divisor, half=self.half / divisor)


@dataclasses.dataclass(frozen=True)
class OuterContents:
    """An outer field on the host."""

    # (3,) float64 middle and half sides of the box that it surrounds, world units
    center: np.ndarray
    half: np.ndarray
    # (n, n, n) int32, row of each voxel of contracted space or -1
    links: np.ndarray
    # (rows, 4) float32 red, green, blue and density per unit of contracted length
    values: np.ndarray
    # (nodes, 3) float32 colours of a cube at infinity
    sky: np.ndarray

    def shrunk(self, divisor: float) -> OuterContents:
        """The outer field of a smaller world; divisor: old lengths over new ones."""
        return dataclasses.replace(self, center=self.center / divisor, half=self.half / divisor)


@dataclasses.dataclass(frozen=True)
class FieldContents:
    """A voxel field on the host, as field files read and write it; None is what the file does not say."""

    # (2, 3) float64, world units
    bounds: np.ndarray
    # (nx, ny, nz) int32, row of each voxel or -1
    links: np.ndarray
    # (rows,) float32 per world unit
    density: np.ndarray
    # (rows, 9, 3) coefficients of red, green and blue, or (rows, 24) of luminance and differences of colour; float32,
    # or float16 as files have them
    sh: np.ndarray
    # (rows,) float32 largest rendering weights
    weights: np.ndarray | None = None
    # (3,) colour and (3,) direction
    background: np.ndarray | None = None
    up: np.ndarray | None = None
    # (4, 4) rigid motion from the coordinates of the scene's files; None where they are the same
    straightening: np.ndarray | None = None
    # rays along each side of a pixel
    supersampling: int | None = None
    layers: LayerContents | None = None
    outer: OuterContents | None = None

    def options(self) -> dict[str, Any]:
        """What is known beside the voxels and layers, by the names of VoxelField's arguments."""
        names = ("weights", "background", "up", "straightening", "supersampling")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def rgb_harmonics(sh: np.ndarray) -> np.ndarray:
    """Harmonics (rows, 9, 3) of red, green and blue up to degree 2, for formats that know no others.
    The same function, but for its part of degree 3; (rows, 24) are of luminance and differences of colour."""
    if sh.ndim == 3:
        return sh
    differences = np.zeros((2, len(sh), BASIS_COUNT), np.float32)
    differences[0, :, :4], differences[1, :, :4] = sh[:, _ORANGE], sh[:, _GREEN]
    orange, green = differences
    luminance = sh[:, _LUMINANCE]
    grey = luminance - 0.5 * green
    return np.stack([grey + orange, luminance + green, grey - orange], axis=-1)


def surface_node_count(side: int) -> int:
    """Number of lattice points on the surface of a cube of `side` cells along an edge."""
    return 6 * int(side) ** 2 + 2


def voxel_side(bounds: np.ndarray, shape: tuple[int, ...]) -> float:
    """The smallest side of a voxel, world units, of (nx, ny, nz) voxels in bounds (2, 3)."""
    return float(((bounds[1] - bounds[0]) / shape).min())


def as_half(values: np.ndarray) -> np.ndarray:
    """Numbers as float16, those beyond its range cut to the largest."""
    return np.clip(values, -MAX_HALF, MAX_HALF).astype(np.float16)


def as_single(values: np.ndarray) -> np.ndarray:
    """A float32 copy of numbers in rows along the first axis, converted by all threads."""
    singles = np.empty(values.shape, np.float32)

    def convert(rows: slice) -> None:
        singles[rows] = values[rows]

    _by_rows(convert, values)
    return singles


def are_finite(values: np.ndarray) -> bool:
    """Whether all numbers of an array are finite, looked through by all threads."""
    return all(_by_rows(lambda rows: bool(np.isfinite(values[rows]).all()), values))


def numbered(occupied: np.ndarray) -> np.ndarray:
    """Number the set voxels of (nx, ny, nz) bool in memory order, by all threads; int32, -1 for others."""
    links = np.empty(occupied.shape, np.int32)
    begins = np.zeros(len(occupied) + 1, np.int64)

    def count(layers: slice) -> None:
        begins[layers.start + 1 : layers.stop + 1] = np.count_nonzero(occupied[layers], axis=(1, 2))

    def number(layers: slice) -> None:
        links[layers] = -1
        first, last = int(begins[layers.start]), int(begins[layers.stop])
        links[layers][occupied[layers]] = np.arange(first, last, dtype=np.int32)

    _by_rows(count, occupied)
    np.cumsum(begins, out=begins)
    _by_rows(number, occupied)
    return links


def _by_rows(task: Callable[[slice], Any], values: np.ndarray) -> list[Any]:
    """Run a task on the rows of an array in parts; returns what each gave."""
    size = max(1, PART_NUMBERS * len(values) // max(values.size, 1))
    parts = [slice(begin, min(begin + size, len(values))) for begin in range(0, len(values), size)]
    return run_parallel([functools.partial(task, part) for part in parts]) if parts else []
