"""Nested cubes of voxels around a field, as arrays of its file."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from ...core.files import require_numbers
from ...core.memory import free_host_bytes
from ...errors import InputError

#: Names in the archive begin with this.
SHELL_PREFIX = "shells_"

#: The arrays of nested cubes.
SHELL_NAMES = tuple(
    SHELL_PREFIX + name for name in ("center", "half", "cubes", "side", "places", "nodes", "rgba", "slopes", "sky")
)

#: Most nested cubes, of which the last is 2^11 times as large as the box; and most bricks along the side of one.
MAX_SHELLS, MAX_BRICKS = 12, 256

#: Cells along a side of a brick, and its nodes.
BRICK, BRICK_NODES = 8, 729

#: Bytes that an entry of the table, a brick and a row take while they are read.
ENTRY_BYTES, BRICK_BYTES, ROW_BYTES = 6, 6 * BRICK_NODES, 80

#: Opacity of a voxel, of 255, that stands for all of it; and steps of a slope of 1.
MOST_OPACITY, SLOPE_STEPS = 254.5, 127.0


@dataclasses.dataclass(frozen=True)
class ShellContents:
    """Nested cubes around a field on the host."""

    center: np.ndarray  # (3,) float64 middle and half sides of the box that they surround, world units
    half: np.ndarray
    cubes: int
    side: int  # entries of the table along a side of a cube
    places: np.ndarray  # (bricks, 4) int32 first entry, cube after cube along x, and size
    nodes: np.ndarray  # (bricks, 729) bool, nodes that have rows of their own, in the rows' order
    values: np.ndarray  # (rows, 4) float32 red, green, blue and density per half side of the cube
    slopes: np.ndarray  # (rows, 3) float32 change of the colours along x, y and z of the direction
    sky: np.ndarray  # (nodes, 3) float32 colours of a cube at infinity

    def shrunk(self, divisor: float) -> ShellContents:
        """The nested cubes of a smaller world; divisor: old lengths over new ones."""
        return dataclasses.replace(self, center=self.center / divisor, half=self.half / divisor)


def shell_arrays(shells: ShellContents) -> dict[str, np.ndarray]:
    """The arrays of nested cubes, by name."""
    rgba = np.empty(shells.values.shape, np.uint8)  # colours and, for densities, opacities of a voxel below 1, to 1/255
    rgba[:, :3] = np.rint(255 * np.clip(shells.values[:, :3], 0, 1))
    depths = np.maximum(shells.values[:, 3], 0) * _voxel_lengths(shells.places, shells.nodes, shells.side)
    rgba[:, 3] = np.rint(255 * -np.expm1(-depths))
    contents = {
        "center": shells.center,
        "half": shells.half,
        "cubes": np.array(shells.cubes),
        "side": np.array(shells.side),
        "places": shells.places.astype(np.int16),
        "nodes": np.packbits(shells.nodes.ravel()),
        "rgba": rgba,
        "slopes": np.rint(SLOPE_STEPS * np.clip(shells.slopes, -1, 1)).astype(np.int8),
        "sky": np.rint(255 * np.clip(shells.sky, 0, 1)).astype(np.uint8),
    }
    return {SHELL_PREFIX + name: array for name, array in contents.items()}


def _voxel_lengths(places: np.ndarray, nodes: np.ndarray, side: int) -> np.ndarray:
    """(rows,) float32 side of each row's voxel over half the side of its cube."""
    sizes = np.repeat(places[:, 3].astype(np.float32), nodes.sum(axis=1))
    return sizes * np.float32(2.0 / (BRICK * side))


def read_shells(contents: dict[str, np.ndarray], path: pathlib.Path) -> ShellContents | None:
    """The nested cubes of a file's arrays, or None where it has none; path: for messages."""
    if SHELL_PREFIX + "side" not in contents:
        return None

    def read(name: str, shape: tuple[int | None, ...], kind: type | None = None) -> np.ndarray:
        array = require_numbers(contents, SHELL_PREFIX + name, shape, path)
        if kind is not None and array.dtype != kind:
            raise InputError(f"{path}: {SHELL_PREFIX}{name} must be {np.dtype(kind)}, got {array.dtype}")
        return array

    cubes, side = int(read("cubes", ())), int(read("side", ()))
    if not (1 <= cubes <= MAX_SHELLS and 1 <= side <= MAX_BRICKS):
        raise InputError(
            f"{path}: there must be 1 to {MAX_SHELLS} nested cubes of 1 to {MAX_BRICKS} bricks along a side, "
            f"got {cubes} of {side}"
        )
    places = read("places", (None, 4), np.int16).astype(np.int32)
    if ENTRY_BYTES * cubes * side**3 + BRICK_BYTES * len(places) > free_host_bytes():
        raise InputError(f"{path}: {cubes} nested cubes of {side}^3 bricks need more memory than is free")
    require_apart(places, cubes, side, path)
    packed = read("nodes", (-(-len(places) * BRICK_NODES // 8),), np.uint8)
    nodes = np.unpackbits(packed, count=len(places) * BRICK_NODES).astype(bool).reshape(-1, BRICK_NODES)
    rows = int(nodes.sum())
    if ROW_BYTES * rows > free_host_bytes():
        raise InputError(f"{path}: nested cubes of {rows} voxels need more memory than is free")
    rgba, slopes = read("rgba", (rows, 4), np.uint8), read("slopes", (rows, 3), np.int8)
    values = np.empty((rows, 4), np.float32)
    values[:, :3] = rgba[:, :3] / np.float32(255)
    values[:, 3] = -np.log1p(-np.minimum(rgba[:, 3], MOST_OPACITY) / 255) / _voxel_lengths(places, nodes, side)
    sky = read("sky", (None, 3)).astype(np.float32) / 255
    slopes = slopes.astype(np.float32) / np.float32(SLOPE_STEPS)
    return ShellContents(read("center", (3,)), read("half", (3,)), cubes, side, places, nodes, values, slopes, sky)


def require_apart(places: np.ndarray, cubes: int, side: int, path: pathlib.Path) -> None:
    """Refuse bricks that lie outside their cube or cover what another one does."""
    sizes = places[:, 3]
    inside = (places[:, :3] >= 0).all() and (places[:, 0] < cubes * side).all() and (sizes >= 1).all()
    ends = np.stack([places[:, 0] % side, places[:, 1], places[:, 2]], axis=1) + sizes[:, None]
    if not inside or (ends > side).any():
        raise InputError(f"{path}: {SHELL_PREFIX}places must lie within {cubes} cubes of {side}^3")
    covered = np.zeros((cubes * side, side, side), np.uint8)
    for size in np.unique(sizes):
        corners = places[sizes == size, :3]
        for offset in np.ndindex(*3 * [int(size)]):
            np.add.at(covered, tuple((corners + offset).T), 1)
    if covered.max(initial=0) > 1:
        raise InputError(f"{path}: {SHELL_PREFIX}places must not overlap")
