"""Selection files: which voxels of a field belong to an object, for the field that they were chosen in."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from typing import Any

import numpy as np

from ..core.checks import checked_path
from ..core.files import DAMAGED, PathLike, atomic_path, damage, not_a, read_json, require_file
from ..core.npz import read_npz
from ..errors import InputError

#: How selection files end.
SELECTION_ENDINGS = (".npz", ".json")

_FORMAT, _VERSION, _WHAT = "warpcage selection", 1, "selection file"

#: Most voxels along a side of what is chosen, as of fields.
_MAX_SIDE = 4096

#: Corners of the boxes of two fields may differ by this share of a voxel: files hold all digits, but users may not.
_SAME_PLACE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class SelectionContents:
    """What a selection file holds."""

    bounds: np.ndarray  # (2, 3) float64 box of the field, world units
    occupied: str  # digest of which voxels of the field hold values
    mask: np.ndarray  # (nx, ny, nz) bool, the chosen voxels
    notes: tuple[str, ...]  # a line for each part that was left out
    floor: tuple[np.ndarray, float] | None  # normal (3,) and offset of the plane that they were cut off at, world units


def occupancy_digest(occupied: np.ndarray) -> str:
    """32 hexadecimal digits that identify a field's voxels with values, (nx, ny, nz) bool."""
    return hashlib.blake2b(np.packbits(occupied.ravel()).tobytes(), digest_size=16).hexdigest()


def save_selection(contents: SelectionContents, path: PathLike) -> None:
    """Write a selection file, whole or not at all: packed bits in .npz, runs of voxels in .json."""
    ending = checked_path(path, "the selection file").suffix.lower()
    if ending not in SELECTION_ENDINGS:
        raise InputError(f"selection file {str(path)!r} must end in {' or '.join(SELECTION_ENDINGS)}")
    cells = np.argwhere(contents.mask)
    begin = cells.min(axis=0) if len(cells) else np.zeros(3, int)
    end = cells.max(axis=0) + 1 if len(cells) else np.zeros(3, int)
    block = contents.mask[tuple(slice(a, b) for a, b in zip(begin, end, strict=True))]
    document: dict[str, Any] = {
        "format": _FORMAT,
        "version": _VERSION,
        "bounds": contents.bounds.tolist(),
        "resolution": list(contents.mask.shape),
        "occupied": contents.occupied,
        "begin": begin.tolist(),
        "shape": list(block.shape),
        "notes": list(contents.notes),
    }
    if contents.floor is not None:
        document["floor"] = {"normal": contents.floor[0].tolist(), "offset": contents.floor[1]}
    with atomic_path(path) as temporary:
        if ending == ".npz":
            text, bits = np.array(json.dumps(document)), np.packbits(block.ravel())
            np.savez_compressed(temporary, selection=text, chosen=bits)
        else:
            # how many voxels in turn are not chosen and chosen, in memory order of the block
            turns = np.flatnonzero(np.diff(block.ravel(), prepend=False, append=False))
            document["runs"] = np.diff(turns, prepend=0).tolist()
            temporary.write_text(json.dumps(document) + "\n", encoding="utf-8")


def load_selection(path: PathLike) -> SelectionContents:
    """Read a selection file."""
    path = require_file(path, _WHAT)
    try:
        if path.suffix.lower() == ".json":
            document = read_json(path, _WHAT)
            return _read(document, lambda size: _from_runs(document["runs"], size))
        arrays = read_npz(path, _WHAT, {"selection", "chosen"}.__contains__)
        if set(arrays) != {"selection", "chosen"} or arrays["selection"].dtype.kind != "U":
            raise InputError(not_a(_WHAT))
        content = json.loads(str(arrays["selection"]))
        return _read(content, lambda size: _from_bits(arrays["chosen"], size))
    except DAMAGED as error:
        raise InputError(f"{path}: {damage(_WHAT, error)}") from None
    except (ValueError, json.JSONDecodeError) as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _read(document: Any, chosen) -> SelectionContents:
    """The contents of a document; chosen: takes the size of its block and returns (size,) bool."""
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise InputError(not_a(_WHAT))
    if document["version"] != _VERSION:
        raise InputError(f"it is of version {document['version']!r}, this release reads version {_VERSION}")
    bounds = np.asarray(document["bounds"], np.float64)
    sizes = [_whole(document[name], least) for name, least in (("resolution", 2), ("begin", 0), ("shape", 0))]
    resolution, begin, shape = sizes
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
        raise InputError("its bounds must be two corners, the lower one first")
    if any(a + b > n for a, b, n in zip(begin, shape, resolution, strict=True)):
        raise InputError(f"its block of {shape} voxels from {begin} leaves the field of {resolution}")
    mask = np.zeros(resolution, bool)
    block = chosen(math.prod(shape)).reshape(shape)
    mask[tuple(slice(a, a + b) for a, b in zip(begin, shape, strict=True))] = block
    floor = document.get("floor")
    if floor is not None:
        normal, offset = np.asarray(floor["normal"], np.float64), float(floor["offset"])
        if normal.shape != (3,) or not np.isfinite([*normal, offset]).all() or not normal.any():
            raise InputError("its floor must have a normal of three numbers and an offset")
        floor = normal, offset
    notes = tuple(str(note) for note in document.get("notes", ()))
    return SelectionContents(bounds, str(document["occupied"]), mask, notes, floor)


def _whole(values: Any, least: int) -> list[int]:
    """Three whole numbers of a document."""
    fits = isinstance(values, list) and len(values) == 3
    if not fits or not all(type(each) is int and least <= each <= _MAX_SIDE for each in values):
        raise InputError(f"its sizes must be three whole numbers from {least} to {_MAX_SIDE}, got {values!r}")
    return values


def _from_bits(bits: np.ndarray, size: int) -> np.ndarray:
    if bits.dtype != np.uint8 or bits.shape != ((size + 7) // 8,):
        raise InputError("its voxels are not as many as it says")
    return np.unpackbits(bits, count=size).astype(bool)


def _from_runs(runs: Any, size: int) -> np.ndarray:
    lengths = np.asarray(runs)
    if lengths.ndim != 1 or (len(lengths) and (lengths.dtype.kind != "i" or lengths.min() < 0 or lengths.sum() > size)):
        raise InputError("its runs must be whole numbers of no more voxels than it says")
    lengths = np.concatenate([lengths.astype(np.int64), [size - int(lengths.sum())]])
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)


def same_box(one: np.ndarray, two: np.ndarray, voxel_size: np.ndarray) -> bool:
    """Whether two boxes (2, 3) are the same but for a thousandth of a voxel."""
    return bool((np.abs(one - two) <= _SAME_PLACE * voxel_size).all())
