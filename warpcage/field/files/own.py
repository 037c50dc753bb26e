"""The project's own field files."""

from __future__ import annotations

import math

import numpy as np

from ...core.files import require_numbers
from ...core.memory import free_host_bytes
from . import compact
from .contents import FieldContents
from .layers import layer_arrays, read_layers

#: Files with background layers are of version 2, those without stay readable by older releases.
FORMAT_VERSION = 2

#: Voxels that a grid may have, empty ones included: kernels count them in int32.
MAX_VOXELS = 2**31 - 1


def own_arrays(field: FieldContents) -> dict:
    """Arrays of a plain file, by name."""
    occupied = field.links >= 0
    order = field.links[occupied]  # the file's rows are in memory order
    contents = {
        "format": np.array("warpcage"),
        "version": np.array(1 if field.layers is None else FORMAT_VERSION),
        "bounds": field.bounds,
        "background": field.background,
        "up": field.up,
        "supersampling": np.array(field.supersampling),
        "resolution": np.array(field.links.shape, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": field.density[order],
        "sh": as_half(field.sh[order].transpose(0, 2, 1)),  # (rows, rgb, basis)
    }
    if field.weights is not None:
        contents["weights"] = as_half(field.weights[order])
    if field.layers is not None:
        contents |= layer_arrays(field.layers)
    return contents


def compact_arrays(field: FieldContents) -> dict:
    """Arrays of a compact file, by name."""
    return compact.pack(own_arrays(field), field.voxel_side)


def read_own(contents: dict, path) -> FieldContents:
    """The field of the arrays of a plain or compact file. Raises ValueError that names the file and what does not
    fit."""
    version = int(require_numbers(contents, "version", (), path))
    if version > FORMAT_VERSION:
        raise ValueError(f"{path} has format version {version}, this warpcage reads up to {FORMAT_VERSION}: upgrade")
    shape = tuple(int(n) for n in require_numbers(contents, "resolution", (3,), path))
    count = math.prod(shape)
    if min(shape) < 2 or count > MAX_VOXELS or 6 * count > free_host_bytes():
        raise ValueError(
            f"{path}: resolution must be 2 voxels a side or more, and so few that links fit into memory, got {shape}"
        )
    packed = require_numbers(contents, "occupancy", (-(-count // 8),), path)
    if packed.dtype != np.uint8:
        raise ValueError(f"{path}: occupancy must be uint8, got {packed.dtype}")
    occupied = np.unpackbits(packed, count=count).astype(bool).reshape(shape)
    rows = int(occupied.sum())
    bounds = require_numbers(contents, "bounds", (2, 3), path)
    if "sh_low" in contents:
        planes = [("sh_low", (27, rows)), ("sh_high", (27, rows)), ("sh_step", ()), ("opacity", (rows,))]
        for name, rest in planes + ([("weight_roots", (rows,))] if "weight_roots" in contents else []):
            require_numbers(contents, name, rest, path)
        if not (bounds[1] > bounds[0]).all():
            raise ValueError(f"{path}: bounds must be lower below upper, got {bounds.tolist()}")
        contents = compact.unpack(contents, float(((bounds[1] - bounds[0]) / shape).min()))
    for name, rest in (("density", (rows,)), ("sh", (rows, None, None))):
        require_numbers(contents, name, rest, path)
    links = np.full(shape, -1, np.int32)
    links[occupied] = np.arange(rows, dtype=np.int32)
    options: dict = {
        name: require_numbers(contents, name, (3,), path) for name in ("background", "up") if name in contents
    }
    if "supersampling" in contents:
        options["supersampling"] = int(require_numbers(contents, "supersampling", (), path))
    if "weights" in contents:
        options["weights"] = require_numbers(contents, "weights", (rows,), path).astype(np.float32)
    sh = contents["sh"].astype(np.float32).transpose(0, 2, 1)
    return FieldContents(
        contents["bounds"],
        links,
        contents["density"].astype(np.float32),
        sh,
        **options,
        layers=read_layers(contents, path),
    )


def as_half(values: np.ndarray) -> np.ndarray:
    """float16, values beyond its range cut to the largest."""
    return np.clip(values, -65504.0, 65504.0).astype(np.float16)
