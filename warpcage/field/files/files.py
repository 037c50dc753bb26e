"""Field files: our own .npz, and the .npz of Plenoxels (svox2)."""

from __future__ import annotations

import pathlib

import numpy as np

from ...core.files import atomic_path, read_npz
from . import compact
from .contents import FieldContents
from .own import compact_arrays, own_arrays, read_own
from .svox2 import SVOX2_KEYS, read_svox2, svox2_arrays


def save_field(field: FieldContents, path, *, format: str = "warpcage") -> None:
    """Write a field to `path` (.npz), atomically.

    "warpcage": packed occupancy bits, density float32, SH float16, bounds float64, background, rendering weights
    float16, background layers as RGBA bytes, format version. "compact": the same quantised and deflated, a third of
    the size (see `warpcage.field.voxel_field.files.compact`).
    "svox2": the keys of Plenoxels' SparseGrid.save (half-precision SH), which leaves background layers out and warns.
    Raises ValueError for another format, or a path that does not end in .npz.
    """
    if not str(path).endswith(".npz"):
        raise ValueError(f"a field file ends in .npz, got {str(path)!r}")
    writers = {"warpcage": own_arrays, "compact": compact_arrays, "svox2": svox2_arrays}
    if format not in writers:
        raise ValueError(f"field format {format!r} is not known: {', '.join(writers)}")
    contents = writers[format](field)
    with atomic_path(path) as temporary:
        if format == "compact":
            compact.write(temporary, contents)
        else:
            np.savez(temporary, **contents)


def load_field(path, *, scene_scale: float = 1.0) -> FieldContents:
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
        field = read_own(contents, path)
    elif all(name in contents for name in SVOX2_KEYS):
        field = read_svox2(contents, path)
    elif str(contents.get("format", "")) == "warpcage fit":
        raise ValueError(f"{path} is the checkpoint of a fit, no field yet: run the same fit with it to the end")
    else:
        raise ValueError(f"{path} is neither a warpcage nor a Plenoxels field: it holds {', '.join(sorted(contents))}")
    named = int(field.links.max(initial=-1)) + 1
    if named > len(field.density) or len(field.density) != len(field.sh):
        raise ValueError(f"{path}: links name {named} rows, density holds {len(field.density)}, sh {len(field.sh)}")
    for name in ("density", "sh", "weights"):
        values = getattr(field, name)
        if values is not None and not np.isfinite(values).all():
            raise ValueError(f"{path}: {name} holds values that are not finite")
    field.bounds = field.bounds / scene_scale
    field.density = field.density * np.float32(scene_scale)
    if field.layers is not None:
        field.layers |= {name: field.layers[name] / scene_scale for name in ("center", "half")}
    return field
