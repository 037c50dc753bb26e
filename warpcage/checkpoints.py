"""Field files: our own .npz, and the .npz of Plenoxels (svox2)."""

from __future__ import annotations

import math
import pathlib

import numpy as np

from . import compact
from .archives import read_npz, require_numbers
from .background import LayeredBackground
from .background_files import background_contents, read_background
from .field import BASIS_COUNT, VoxelField
from .files import atomic_path
from .memory import free_host_bytes
from .notices import warn_caller

#: Files with background layers are of version 2, those without stay readable by older releases.
FORMAT_VERSION = 2
SVOX2_KEYS = ("radius", "center", "links", "density_data", "sh_data", "basis_type")
SVOX2_BASIS_SH = 1

#: Voxels that a grid may have, empty ones included: kernels count them in int32.
MAX_VOXELS = 2**31 - 1


def save_field(field: VoxelField, path, *, format: str = "warpcage") -> None:
    """Write a field to `path` (.npz), atomically.

    "warpcage": packed occupancy bits, density float32, SH float16, bounds float64, background, rendering weights
    float16, background layers as RGBA bytes, format version. "compact": the same quantised and deflated, a third of
    the size (see warpcage.compact).
    "svox2": the keys of Plenoxels' SparseGrid.save (half-precision SH), which leaves background layers out and warns.
    Raises ValueError for another format, or a path that does not end in .npz.
    """
    if not str(path).endswith(".npz"):
        raise ValueError(f"a field file ends in .npz, got {str(path)!r}")
    writers = {"warpcage": _own_contents, "compact": _compact_contents, "svox2": _svox2_contents}
    if format not in writers:
        raise ValueError(f"field format {format!r} is not known: {', '.join(writers)}")
    contents = writers[format](field)
    with atomic_path(path) as temporary:
        if format == "compact":
            compact.write(temporary, contents)
        else:
            np.savez(temporary, **contents)


def load_field(path, *, scene_scale: float = 1.0, device=None) -> VoxelField:
    """Read a field.

    scene_scale: the factor by which the scene's positions were multiplied before the field was optimised; bounds are
    divided and densities multiplied by it. svox2 scales NeRF-synthetic scenes by 2/3. Background layers of a svox2 file
    are left out, with a warning. Raises FileNotFoundError, or ValueError for a file that is neither format or whose
    parts do not fit.
    """
    if not (np.isfinite(scene_scale) and scene_scale > 0):
        raise ValueError(f"scene_scale must be positive, got {scene_scale}")
    path = pathlib.Path(path)
    contents = read_npz(path, "field file")
    if str(contents.get("format", "")) == "warpcage":
        parts = _read_own(contents, path)
    elif all(name in contents for name in SVOX2_KEYS):
        parts = _read_svox2(contents, path)
    elif str(contents.get("format", "")) == "warpcage fit":
        raise ValueError(f"{path} is the checkpoint of a fit, no field yet: run the same fit with it to the end")
    else:
        raise ValueError(f"{path} is neither a warpcage nor a Plenoxels field: it holds {', '.join(sorted(contents))}")
    bounds, links, density, sh, options = parts
    named = int(links.max(initial=-1)) + 1
    if named > len(density) or len(density) != len(sh):
        raise ValueError(f"{path}: links name {named} rows, density holds {len(density)}, "
                         f"sh {len(sh)}")
    for name, values in (("density", density), ("sh", sh), ("weights", options.get("weights", density))):
        if not np.isfinite(values).all():
            raise ValueError(f"{path}: {name} holds values that are not finite")
    behind = read_background(contents, path, scene_scale)
    try:
        if behind is not None:
            options["background_model"] = LayeredBackground(**behind, device=device)
        return VoxelField(bounds / scene_scale, links, density * np.float32(scene_scale), sh, device=device, **options)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _own_contents(field: VoxelField) -> dict:
    links = field.grid.links.numpy()
    occupied = links >= 0
    order = links[occupied]  # the file's rows are in memory order
    contents = {
        "format": np.array("warpcage"),
        "version": np.array(1 if field.background_model is None else FORMAT_VERSION),
        "bounds": field.bounds,
        "background": field.background,
        "up": field.up,
        "supersampling": np.array(field.supersampling),
        "resolution": np.array(field.resolution, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": field.grid.density.numpy()[order],
        "sh": _as_half(field.grid.sh.numpy()[order]),  # (rows, rgb, basis)
    }
    if field.weights is not None:
        contents["weights"] = _as_half(field.weights.numpy()[order])
    if field.background_model is not None:
        contents |= background_contents(field.background_model)
    return contents


def _compact_contents(field: VoxelField) -> dict:
    return compact.pack(_own_contents(field), float(field.voxel_size.min()))


def _read_own(contents: dict, path) -> tuple:
    version = int(require_numbers(contents, "version", (), path))
    if version > FORMAT_VERSION:
        raise ValueError(f"{path} has format version {version}, this warpcage reads up to {FORMAT_VERSION}: upgrade")
    shape = tuple(int(n) for n in require_numbers(contents, "resolution", (3,), path))
    count = math.prod(shape)
    if min(shape) < 2 or count > MAX_VOXELS or 6 * count > free_host_bytes():
        raise ValueError(f"{path}: resolution must be 2 voxels a side or more, and so few that links fit into memory, "
                         f"got {shape}")
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
    options = {name: require_numbers(contents, name, (3,), path) for name in ("background", "up") if name in contents}
    if "supersampling" in contents:
        options["supersampling"] = int(require_numbers(contents, "supersampling", (), path))
    if "weights" in contents:
        options["weights"] = require_numbers(contents, "weights", (rows,), path).astype(np.float32)
    sh = contents["sh"].astype(np.float32).transpose(0, 2, 1)
    return contents["bounds"], links, contents["density"].astype(np.float32), sh, options


def _svox2_contents(field: VoxelField) -> dict:
    if field.background_model is not None:
        warn_caller("a svox2 file holds the field without its background layers")
    half = 0.5 * (field.bounds[1] - field.bounds[0])
    sh = field.grid.sh.numpy()  # (rows, rgb, basis), as svox2 has it
    return {
        "radius": half.astype(np.float32),
        "center": field.center.astype(np.float32),
        "links": field.grid.links.numpy(),
        "density_data": field.grid.density.numpy()[:, None],
        "sh_data": _as_half(sh.reshape(len(sh), -1)),
        "basis_type": np.array(SVOX2_BASIS_SH),
    }


def _read_svox2(contents: dict, path) -> tuple:
    basis = int(require_numbers(contents, "basis_type", (), path))
    if basis != SVOX2_BASIS_SH:
        raise ValueError(f"{path} has basis_type {basis}, only spherical harmonics (1) are read")
    if "background_data" in contents:
        warn_caller(f"the background layers of {path} are left out: only the field of a svox2 file is read")
    radius, center = (np.broadcast_to(require_numbers(contents, name, None, path).astype(np.float64).ravel(), (3,))
                      if contents[name].size in (1, 3) else require_numbers(contents, name, (3,), path)
                      for name in ("radius", "center"))
    coefficients = require_numbers(contents, "sh_data", (None, None), path).astype(np.float32)
    basis_count = coefficients.shape[-1] // 3
    if coefficients.ndim != 2 or basis_count * 3 != coefficients.shape[-1] or basis_count not in (1, 4, 9):
        raise ValueError(f"{path}: sh_data must hold 3, 12 or 27 values a row, got {coefficients.shape}")
    sh = np.zeros((len(coefficients), BASIS_COUNT, 3), np.float32)
    sh[:, :basis_count] = coefficients.reshape(-1, 3, basis_count).transpose(0, 2, 1)
    links = require_numbers(contents, "links", (None, None, None), path)
    if links.dtype.kind != "i" or links.size > MAX_VOXELS:
        raise ValueError(f"{path}: links must be at most {MAX_VOXELS} whole numbers, got {links.dtype} {links.shape}")
    # svox2 may keep distances as negative links
    links = np.clip(links, -1, np.iinfo(np.int32).max).astype(np.int32)
    density = require_numbers(contents, "density_data", None, path).astype(np.float32).reshape(-1)
    return np.stack([center - radius, center + radius]), links, density, sh, {}


def _as_half(values: np.ndarray) -> np.ndarray:
    """float16, values beyond its range cut to the largest."""
    return np.clip(values, -65504.0, 65504.0).astype(np.float16)
