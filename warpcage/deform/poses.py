"""Poses of a Deformer: what is checked of them, and how far apart the two maps that a pose has are."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..cage.motion import posed_cage
from ..coordinates.coordinates import deform_points
from ..core.arrays import as_host_points
from ..edits.edits import CageEdit
from ..edits.falloff import FalloffBand
from ..mesh.match import require_same_faces
from ..mesh.validity import require_usable

#: Cells along the longest side of the posed cage's box, of the grid at whose nodes the maps are compared.
CELLS = 24


def checked_pose(edit: CageEdit, cage: Any, index: int, band: FalloffBand | None = None) -> Cage | None:
    """The posed cage of an edit, with the walls of its band at rest; None for an edit that removes.
    `cage` is what the caller gave; `index` is the number of the edit, for messages."""
    if edit.remove:
        return None
    cage = posed_cage(edit.cage, cage, f"the pose of edit {index} must be")
    require_same_faces(edit.cage, cage)
    if band is None:
        return cage
    require_usable(cage, "the deformed cage")
    cage = band.held(cage)
    require_usable(cage, "the deformed cage, its cut walls held at rest,")
    return cage


def inverse_error(
    rest: Cage, posed: Cage, coordinates: str, points: Any, device: wp.DeviceLike
) -> tuple[np.ndarray, np.ndarray]:
    """See `Deformer.inverse_error`."""
    if points is None:
        low, high = posed.bounds
        side = posed.size / CELLS
        axes = [np.arange(a + 0.5 * side, b, side) for a, b in zip(low, high, strict=True)]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        places = places[posed.contains(places, device=device)]
    else:
        places = as_host_points(points)
    options: dict[str, Any] = {"coordinates": coordinates, "device": device, "outside": "nan"}
    errors = np.full(len(places), np.nan)
    origins = deform_points(places, posed, rest, **options)
    held = np.flatnonzero(np.isfinite(origins).all(axis=1))
    moved = deform_points(origins[held], rest, posed, **options)
    errors[held] = np.linalg.norm(moved - places[held], axis=1)
    return places, errors
