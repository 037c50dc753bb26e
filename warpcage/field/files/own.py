"""The project's own field files."""

from __future__ import annotations

import math
import pathlib
from typing import Any

import numpy as np

from ...core.files import require_numbers
from ...core.memory import free_host_bytes
from . import compact
from .contents import (
    BASIS_COUNT,
    LUMINANCE_NUMBERS,
    MAX_VOXELS,
    FieldContents,
    as_half,
    as_single,
    numbered,
    voxel_side,
)
from .layers import layer_arrays, read_layers
from .outer import outer_arrays, read_outer

#: Files with an outer field are of version 4, of luminous rows of version 3, others with background layers of version
#: 2; the rest stays readable by older releases.
FORMAT_VERSION, LUMINOUS_VERSION, LAYERS_VERSION = 4, 3, 2

#: The arrays of a plain file, without its layers.
OWN_NAMES = (
    *("format", "version", "bounds", "background", "up", "straightening", "supersampling"),
    *("resolution", "occupancy", "density", "sh", "weights"),
)


def own_arrays(field: FieldContents) -> dict[str, Any]:
    """The arrays of a plain file, by name, of a field with background, up and supersampling."""
    occupied = field.links >= 0
    order = field.links[occupied]  # the file's rows are in memory order
    contents = {
        "format": np.array("warpcage"),
        "version": np.array(_least_version(field)),
        "bounds": field.bounds,
        "background": field.background,
        "up": field.up,
        "supersampling": np.array(field.supersampling),
        "resolution": np.array(field.links.shape, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": field.density[order],
        "sh": _file_harmonics(field.sh[order]),
    }
    if field.straightening is not None:
        contents["straightening"] = field.straightening
    if field.weights is not None:
        contents["weights"] = as_half(field.weights[order])
    if field.layers is not None:
        contents |= layer_arrays(field.layers)
    if field.outer is not None:
        contents |= outer_arrays(field.outer)
    return contents


def _least_version(field: FieldContents) -> int:
    """The oldest version of the format that can hold a field."""
    if field.outer is not None:
        return FORMAT_VERSION
    if field.sh.ndim == 2:
        return LUMINOUS_VERSION
    return 1 if field.layers is None else LAYERS_VERSION


def _file_harmonics(sh: np.ndarray) -> np.ndarray:
    """Harmonics as files have them: (rows, rgb, basis), or luminous rows as they are."""
    return as_half(sh if sh.ndim == 2 else sh.transpose(0, 2, 1))


def _read_harmonics(contents: dict[str, np.ndarray], rows: int, path: pathlib.Path) -> np.ndarray:
    """Harmonics of either kind; halves stay halves."""
    luminous = "sh" in contents and contents["sh"].ndim == 2
    shape = (rows, LUMINANCE_NUMBERS) if luminous else (rows, 3, BASIS_COUNT)
    sh = require_numbers(contents, "sh", shape, path)
    if sh.dtype != np.float16:
        sh = as_single(sh)
    return sh if luminous else sh.transpose(0, 2, 1)


def read_own(contents: dict[str, np.ndarray], path: pathlib.Path) -> FieldContents:
    """The field of a plain or compact file's arrays; path: for messages."""
    version = int(require_numbers(contents, "version", (), path))
    if version > FORMAT_VERSION:
        raise ValueError(f"{path} has format version {version}, this warpcage reads up to {FORMAT_VERSION}: upgrade")
    shape = tuple(int(n) for n in require_numbers(contents, "resolution", (3,), path))
    count = math.prod(shape)
    if min(shape) < 2 or count > MAX_VOXELS or 6 * count > free_host_bytes():
        raise ValueError(
            f"{path}: resolution must be at least 2 along each axis, and small enough that links fit into memory, "
            f"got {shape}"
        )
    packed = require_numbers(contents, "occupancy", (-(-count // 8),), path)
    if packed.dtype != np.uint8:
        raise ValueError(f"{path}: occupancy must be uint8, got {packed.dtype}")
    occupied = np.unpackbits(packed, count=count).view(bool).reshape(shape)
    rows = int(np.count_nonzero(occupied))
    bounds = require_numbers(contents, "bounds", (2, 3), path)
    if compact.is_packed(contents):
        if not (bounds[1] > bounds[0]).all():
            raise ValueError(f"{path}: bounds must be lower below upper, got {bounds.tolist()}")
        contents = compact.unpack(contents, rows, voxel_side(bounds, shape), path)
    require_numbers(contents, "density", (rows,), path)
    links = numbered(occupied)
    background, up = (
        require_numbers(contents, name, (3,), path) if name in contents else None for name in ("background", "up")
    )
    straightening = supersampling = weights = None
    if "straightening" in contents:
        straightening = require_numbers(contents, "straightening", (4, 4), path)
    if "supersampling" in contents:
        supersampling = int(require_numbers(contents, "supersampling", (), path))
    if "weights" in contents:
        weights = as_single(require_numbers(contents, "weights", (rows,), path))
    return FieldContents(
        contents["bounds"],
        links,
        as_single(contents["density"]),
        _read_harmonics(contents, rows, path),
        weights=weights,
        background=background,
        up=up,
        straightening=straightening,
        supersampling=supersampling,
        layers=read_layers(contents, path),
        outer=read_outer(contents, path),
    )
