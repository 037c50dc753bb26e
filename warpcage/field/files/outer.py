"""Outer fields inside field files: RGBA bytes of the voxels that hold values."""

from __future__ import annotations

import pathlib

import numpy as np

from ...core.files import require_numbers
from ...core.memory import free_host_bytes
from .contents import OuterContents

#: Names in the archive begin with this.
PREFIX = "outer_"

#: The arrays of an outer field.
OUTER_NAMES = tuple(PREFIX + name for name in ("center", "half", "side", "occupancy", "rgba", "sky"))

#: Fewest and most voxels along a side of contracted space.
MIN_SIDE, MAX_SIDE = 4, 1290

#: Bytes that a node, and a voxel that holds values, take while they are read.
NODE_BYTES, ROW_BYTES = 10, 40

#: Opacity of a voxel, of 255, above which nothing is told apart: 254.5 stands for all of it.
MOST_OPACITY = 254.5


def outer_arrays(outer: OuterContents) -> dict[str, np.ndarray]:
    """The arrays of an outer field, by name."""
    occupied = outer.links >= 0
    values = outer.values[outer.links[occupied]]  # the file's rows are in memory order
    side = len(outer.links)
    # colours to 1/255 of [0, 1], densities as the opacity of a voxel to 1/255, below full opacity
    rgba = np.empty(values.shape, np.uint8)
    rgba[:, :3] = np.rint(255 * np.clip(values[:, :3], 0, 1))
    rgba[:, 3] = np.rint(255 * -np.expm1(-np.maximum(values[:, 3], 0) * (4.0 / side)))
    contents = {
        "center": outer.center,
        "half": outer.half,
        "side": np.array(side),
        "occupancy": np.packbits(occupied.ravel()),
        "rgba": rgba,
        "sky": np.rint(255 * np.clip(outer.sky, 0, 1)).astype(np.uint8),
    }
    return {PREFIX + name: array for name, array in contents.items()}


def read_outer(contents: dict[str, np.ndarray], path: pathlib.Path) -> OuterContents | None:
    """The outer field of a file's arrays, or None where it has none; path: for messages."""
    if PREFIX + "side" not in contents:
        return None

    def read(name: str, shape: tuple[int, ...]) -> np.ndarray:
        return require_numbers(contents, PREFIX + name, shape, path)

    side = int(read("side", ()))
    if not MIN_SIDE <= side <= MAX_SIDE:
        raise ValueError(f"{path}: an outer field has {MIN_SIDE} to {MAX_SIDE} voxels along a side, got {side}")
    count = side**3
    if NODE_BYTES * count > free_host_bytes():
        raise ValueError(f"{path}: an outer field of {side}^3 needs more memory than is free")
    packed = read("occupancy", (-(-count // 8),))
    if packed.dtype != np.uint8:
        raise ValueError(f"{path}: {PREFIX}occupancy must be uint8, got {packed.dtype}")
    occupied = np.unpackbits(packed, count=count).astype(bool).reshape(side, side, side)
    rows = int(occupied.sum())
    if ROW_BYTES * rows > free_host_bytes():
        raise ValueError(f"{path}: an outer field of {rows} voxels needs more memory than is free")
    rgba = read("rgba", (rows, 4))
    if rgba.dtype != np.uint8:
        raise ValueError(f"{path}: {PREFIX}rgba must be uint8, got {rgba.dtype}")
    links = np.full(occupied.shape, -1, np.int32)
    links[occupied] = np.arange(rows, dtype=np.int32)
    sky = require_numbers(contents, PREFIX + "sky", (None, 3), path).astype(np.float32) / 255
    values = np.empty((rows, 4), np.float32)
    values[:, :3] = rgba[:, :3] / np.float32(255)
    values[:, 3] = -np.log1p(-np.minimum(rgba[:, 3], MOST_OPACITY) / 255) * (side / 4.0)
    return OuterContents(read("center", (3,)), read("half", (3,)), links, values, sky)
