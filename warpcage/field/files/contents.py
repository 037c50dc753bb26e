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
    """Background layers on the host.

    Attributes:
        center: (3,) float64 centre of all cubes, world units.
        half: Half side of the innermost cube, world units.
        side: Cells along an edge of a cube.
        values: (layers, nodes, 4) float32 red, green, blue and optical depth.
        unseen: (4,) float32 what nodes hold that no picture showed, or None.
    """

    center: np.ndarray
    half: float
    side: int
    values: np.ndarray
    unseen: np.ndarray | None

    def shrunk(self, divisor: float) -> LayerContents:
        """The layers of a smaller world.

        Args:
            divisor: Old lengths over new ones.

        Returns:
            The layers.
        """
        return dataclasses.replace(self, center=self.center / divisor, half=self.half / divisor)


@dataclasses.dataclass(frozen=True)
class OuterContents:
    """An outer field on the host.

    Attributes:
        center: (3,) float64 middle of the box that it surrounds, world units.
        half: (3,) float64 half sides of that box, world units.
        links: (n, n, n) int32, row of each voxel of contracted space or -1.
        values: (rows, 4) float32 red, green, blue and density per unit of contracted length.
        sky: (nodes, 3) float32 colours of a cube at infinity.
    """

    center: np.ndarray
    half: np.ndarray
    links: np.ndarray
    values: np.ndarray
    sky: np.ndarray

    def shrunk(self, divisor: float) -> OuterContents:
        """The outer field of a smaller world.

        Args:
            divisor: Old lengths over new ones.

        Returns:
            The outer field.
        """
        return dataclasses.replace(self, center=self.center / divisor, half=self.half / divisor)


@dataclasses.dataclass(frozen=True)
class FieldContents:
    """A voxel field on the host, as field files read and write it.

    Attributes:
        bounds: (2, 3) float64, world units.
        links: (nx, ny, nz) int32, row of each voxel or -1.
        density: (rows,) float32 per world unit.
        sh: (rows, 9, 3) coefficients of red, green and blue, or (rows, 24) of luminance and differences of colour;
            float32, or float16 as files have them.
        weights: (rows,) float32 largest rendering weights, or None.
        background: (3,) colour, or None where the file does not say.
        up: (3,) direction, or None where the file does not say.
        straightening: (4, 4) rigid motion from the coordinates of the scene's files, or None where they are the same.
        supersampling: Rays along each side of a pixel, or None where the file does not say.
        layers: Background layers, or None.
        outer: An outer field, or None.
    """

    bounds: np.ndarray
    links: np.ndarray
    density: np.ndarray
    sh: np.ndarray
    weights: np.ndarray | None = None
    background: np.ndarray | None = None
    up: np.ndarray | None = None
    straightening: np.ndarray | None = None
    supersampling: int | None = None
    layers: LayerContents | None = None
    outer: OuterContents | None = None

    def options(self) -> dict[str, Any]:
        """What is known beside the voxels and layers, by the names of VoxelField's arguments."""
        names = ("weights", "background", "up", "straightening", "supersampling")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def rgb_harmonics(sh: np.ndarray) -> np.ndarray:
    """Harmonics of red, green and blue up to degree 2, for formats that know no others.

    Args:
        sh: (rows, 9, 3), or (rows, 24) of luminance and differences of colour.

    Returns:
        (rows, 9, 3) float32: the same function, but for its part of degree 3.
    """
    if sh.ndim == 3:
        return sh
    differences = np.zeros((2, len(sh), BASIS_COUNT), np.float32)
    differences[0, :, :4], differences[1, :, :4] = sh[:, _ORANGE], sh[:, _GREEN]
    orange, green = differences
    luminance = sh[:, _LUMINANCE]
    grey = luminance - 0.5 * green
    return np.stack([grey + orange, luminance + green, grey - orange], axis=-1)


def surface_node_count(side: int) -> int:
    """Number of lattice points on the surface of a cube.

    Args:
        side: Cells along an edge.

    Returns:
        6 side^2 + 2.
    """
    return 6 * int(side) ** 2 + 2


def voxel_side(bounds: np.ndarray, shape: tuple[int, ...]) -> float:
    """The smallest side of a voxel.

    Args:
        bounds: (2, 3) lower and upper corner, world units.
        shape: Voxels along each axis.

    Returns:
        The side, world units.
    """
    return float(((bounds[1] - bounds[0]) / shape).min())


def as_half(values: np.ndarray) -> np.ndarray:
    """Numbers in half precision, those beyond its range cut to the largest.

    Args:
        values: float32 of any shape.

    Returns:
        float16 of the same shape.
    """
    return np.clip(values, -MAX_HALF, MAX_HALF).astype(np.float16)


def as_single(values: np.ndarray) -> np.ndarray:
    """Numbers in single precision, converted by all threads.

    Args:
        values: Of any shape, rows along the first axis.

    Returns:
        float32 of the same shape, a copy.
    """
    singles = np.empty(values.shape, np.float32)

    def convert(rows: slice) -> None:
        singles[rows] = values[rows]

    _by_rows(convert, values)
    return singles


def are_finite(values: np.ndarray) -> bool:
    """Whether all numbers of an array are finite, looked through by all threads."""
    return all(_by_rows(lambda rows: bool(np.isfinite(values[rows]).all()), values))


def numbered(occupied: np.ndarray) -> np.ndarray:
    """Number the set voxels in memory order, by all threads.

    Args:
        occupied: (nx, ny, nz) bool.

    Returns:
        (nx, ny, nz) int32, the number of each or -1.
    """
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
