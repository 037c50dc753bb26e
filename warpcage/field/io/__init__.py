"""Field files: our own, compact ones, and checkpoints of svox2."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable

import numpy as np

from ...core.checks import Cuts, checked_path, checked_positive, listed
from ...core.files import atomic_path
from ...core.npz import npz_names, read_npz
from ...errors import InputError
from ...view.pictures import PictureCuts
from . import field_file
from .field_file import LAYER_NAMES, OUTER_NAMES, OWN_NAMES, FieldContents, are_finite, own_arrays, read_own, voxel_side
from .svox2 import SVOX2_KEYS, SVOX2_LAYERS, read_svox2, svox2_arrays

#: The arrays that are read of a file; others may be there.
KNOWN_NAMES = frozenset((*OWN_NAMES, *field_file.COMPACT_NAMES, *LAYER_NAMES, *OUTER_NAMES, *SVOX2_KEYS))

#: Bytes of memory that a byte of these arrays takes: float16 becomes float32, which is transposed, then copied.
ROOM = 6


def _write_compact(path: pathlib.Path, field: FieldContents, cuts: Cuts) -> None:
    side = voxel_side(field.bounds, field.links.shape)
    field_file.write(path, field_file.pack(own_arrays(field, cuts), side, cuts))


#: Files of volumes for other programs, NanoVDB and OpenVDB, which are written alone.
VOLUME_ENDINGS = (".nvdb", ".vdb")

#: What writes a field to a path, by the name of the format.
WRITERS: dict[str, Callable[[pathlib.Path, FieldContents, Cuts], None]] = {
    "warpcage": lambda path, field, cuts: np.savez(path, **own_arrays(field, cuts)),
    "compact": _write_compact,
    "svox2": lambda path, field, cuts: np.savez(path, **svox2_arrays(field, cuts)),
}


def save_field(field: FieldContents, path: str | os.PathLike[str], *, format: str = "warpcage") -> None:
    """Write a field to a file (.npz), or as a volume (.nvdb, .vdb), whole or not at all."""
    if pathlib.Path(path).suffix.lower() in VOLUME_ENDINGS:
        from .volumes import write_volume

        with atomic_path(path) as temporary:
            write_volume(temporary, field)
        return
    if not str(path).endswith(".npz"):
        raise InputError(f"a field file ends in .npz, got {str(path)!r}")
    if format not in WRITERS:
        raise InputError(f"field format {format!r} is not known: {', '.join(WRITERS)}")
    cuts = PictureCuts()  # bytes of a background's colours are cut as those of pictures are
    with atomic_path(path) as temporary:
        # "warpcage": packed occupancy bits, float32 densities, float16 harmonics and weights, the rest as RGBA bytes.
        # "compact": quantised and deflated, a third. "svox2": Plenoxels' SparseGrid.save; warns of what it leaves out.
        WRITERS[format](temporary, field, cuts)
    cuts.warn(path)


def load_field(path: str | os.PathLike[str], *, scene_scale: float = 1.0) -> FieldContents:
    """Read a field; scene_scale: factor on the scene's positions before the field was optimised, undone here."""
    scene_scale = checked_positive(scene_scale, "scene_scale")  # svox2 scales NeRF-synthetic scenes by 2/3
    path = checked_path(path, "the field file")
    field = _read(read_npz(path, "field file", KNOWN_NAMES.__contains__, room=ROOM), path)
    _check(field, path)
    return dataclasses.replace(
        field,
        bounds=field.bounds / scene_scale,
        straightening=_unscaled(field.straightening, scene_scale),
        density=field.density * np.float32(scene_scale),
        layers=None if field.layers is None else field.layers.shrunk(scene_scale),
        outer=None if field.outer is None else field.outer.shrunk(scene_scale),
        refined=None if field.refined is None else field.refined.shrunk(scene_scale),
    )


def _unscaled(motion: np.ndarray | None, scene_scale: float) -> np.ndarray | None:
    """A rigid motion (4, 4) of a world whose positions were multiplied by a factor, without that factor."""
    if motion is None:
        return None
    motion = np.array(motion, dtype=np.float64)
    motion[:3, 3] /= scene_scale
    return motion


def _read(contents: dict[str, np.ndarray], path: pathlib.Path) -> FieldContents:
    """The field of a file's arrays, in the format that they say."""
    name = str(contents.get("format", ""))
    if name == "warpcage":
        return read_own(contents, path)
    if all(key in contents for key in SVOX2_KEYS):
        return read_svox2(contents, path, SVOX2_LAYERS in npz_names(path, "field file"))
    if name == "warpcage fit":
        raise InputError(f"{path} is the checkpoint of a fit, not yet a field: run the same fit with it to the end")
    names = npz_names(path, "field file")
    if "selection" in names:
        raise InputError(f"{path} is a selection, not a field: give it by --selection, with the field that it is of")
    raise InputError(f"{path} is neither a warpcage nor a Plenoxels field: it holds {listed(names)}")


def _check(field: FieldContents, path: pathlib.Path) -> None:
    """Refuse rows that are missing, or values that are not finite."""
    named = int(field.links.max(initial=-1)) + 1
    if named > len(field.density) or len(field.density) != len(field.sh):
        raise InputError(f"{path}: links name {named} rows, density holds {len(field.density)}, sh {len(field.sh)}")
    for name in ("density", "sh", "weights"):
        values = getattr(field, name)
        if values is not None and not are_finite(values):
            raise InputError(f"{path}: {name} holds values that are not finite")
