"""Field files: our own .npz, and the .npz of Plenoxels (svox2)."""

from __future__ import annotations

import numpy as np

from .field import BASIS_COUNT, VoxelField
from .files import atomic_path, require_file

FORMAT_VERSION = 1
SVOX2_KEYS = ("radius", "center", "links", "density_data", "sh_data", "basis_type")
SVOX2_BASIS_SH = 1


def save_field(field: VoxelField, path, *, format: str = "warpcage") -> None:
    """Write a field to `path` (.npz), atomically.

    "warpcage": packed occupancy bits, density float32, SH float16, bounds float64, background, rendering weights
    float16, format version. "svox2": the keys of Plenoxels' SparseGrid.save (half-precision SH).
    Raises ValueError for another format, or a path that does not end in .npz.
    """
    if not str(path).endswith(".npz"):
        raise ValueError(f"a field file ends in .npz, got {str(path)!r}")
    writers = {"warpcage": _own_contents, "svox2": _svox2_contents}
    if format not in writers:
        raise ValueError(f"field format {format!r} is not known: {', '.join(writers)}")
    contents = writers[format](field)
    with atomic_path(path) as temporary:
        np.savez(temporary, **contents)


def load_field(path, *, scene_scale: float = 1.0, device=None) -> VoxelField:
    """Read a field.

    scene_scale: the factor by which the scene's positions were multiplied before the field was optimised; bounds are
    divided and densities multiplied by it. svox2 scales NeRF-synthetic scenes by 2/3. Raises FileNotFoundError, or
    ValueError for a file that is neither format or whose parts do not fit.
    """
    path = require_file(path, "field file")
    if not (np.isfinite(scene_scale) and scene_scale > 0):
        raise ValueError(f"scene_scale must be positive, got {scene_scale}")
    try:
        with np.load(path, allow_pickle=False) as archive:
            contents = {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{path} is no .npz field file: {error}") from error
    if str(contents.get("format", "")) == "warpcage":
        parts = _read_own(contents, path)
    elif all(name in contents for name in SVOX2_KEYS):
        parts = _read_svox2(contents, path)
    else:
        raise ValueError(f"{path} is neither a warpcage nor a Plenoxels field: it holds {', '.join(sorted(contents))}")
    bounds, links, density, sh, options = parts
    if links.max(initial=-1) >= len(density) or len(density) != len(sh):
        raise ValueError(f"{path}: links name {links.max(initial=-1) + 1} rows, density holds {len(density)}, "
                         f"sh {len(sh)}")
    if not (np.isfinite(density).all() and np.isfinite(sh).all()):
        raise ValueError(f"{path} holds densities or colours that are not finite")
    return VoxelField(bounds / scene_scale, links, density * np.float32(scene_scale), sh, device=device, **options)


def _own_contents(field: VoxelField) -> dict:
    links = field.grid.links.numpy()
    occupied = links >= 0
    order = links[occupied]  # the file's rows are in memory order
    contents = {
        "format": np.array("warpcage"),
        "version": np.array(FORMAT_VERSION),
        "bounds": field.bounds,
        "background": field.background,
        "resolution": np.array(field.resolution, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": field.grid.density.numpy()[order],
        "sh": _as_half(field.grid.sh.numpy()[order]),  # (rows, rgb, basis)
    }
    if field.weights is not None:
        contents["weights"] = _as_half(field.weights.numpy()[order])
    return contents


def _read_own(contents: dict, path) -> tuple:
    version = int(contents["version"])
    if version > FORMAT_VERSION:
        raise ValueError(f"{path} has format version {version}, this warpcage reads up to {FORMAT_VERSION}: upgrade")
    missing = [name for name in ("bounds", "resolution", "occupancy", "density", "sh") if name not in contents]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}")
    shape = tuple(int(n) for n in contents["resolution"])
    occupied = np.unpackbits(contents["occupancy"], count=int(np.prod(shape))).astype(bool).reshape(shape)
    links = np.full(shape, -1, np.int32)
    links[occupied] = np.arange(occupied.sum(), dtype=np.int32)
    options = {"background": contents.get("background", "white")}
    if "weights" in contents:
        options["weights"] = contents["weights"].astype(np.float32)
    sh = contents["sh"].astype(np.float32).transpose(0, 2, 1)
    return contents["bounds"], links, contents["density"].astype(np.float32), sh, options


def _svox2_contents(field: VoxelField) -> dict:
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
    if int(contents["basis_type"]) != SVOX2_BASIS_SH:
        raise ValueError(f"{path} has basis_type {int(contents['basis_type'])}, only spherical harmonics (1) are read")
    radius = np.broadcast_to(np.asarray(contents["radius"], np.float64).ravel(), (3,))
    center = np.broadcast_to(np.asarray(contents["center"], np.float64).ravel(), (3,))
    coefficients = np.asarray(contents["sh_data"], np.float32)
    basis_count = coefficients.shape[-1] // 3
    if coefficients.ndim != 2 or basis_count * 3 != coefficients.shape[-1] or basis_count not in (1, 4, 9):
        raise ValueError(f"{path}: sh_data must hold 3, 12 or 27 values a row, got {coefficients.shape}")
    sh = np.zeros((len(coefficients), BASIS_COUNT, 3), np.float32)
    sh[:, :basis_count] = coefficients.reshape(-1, 3, basis_count).transpose(0, 2, 1)
    links = np.maximum(np.asarray(contents["links"], np.int32), -1)  # svox2 may keep distances as negative links
    density = np.asarray(contents["density_data"], np.float32).reshape(-1)
    return np.stack([center - radius, center + radius]), links, density, sh, {}


def _as_half(values: np.ndarray) -> np.ndarray:
    """float16, values beyond its range cut to the largest."""
    return np.clip(values, -65504.0, 65504.0).astype(np.float16)
