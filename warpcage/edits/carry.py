"""Points that go with edits, such as the vertices of a mesh, forward by coordinates of the cages at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..coordinates.coordinates import deform_points
from ..core.names import FIELD_COORDINATES
from ..errors import InputError
from .edits import CageEdit


def carried_points(
    points: np.ndarray,
    edits: Sequence[CageEdit],
    poses: Sequence[Cage | None],
    *,
    coordinates: str = FIELD_COORDINATES,
    device: wp.DeviceLike = None,
) -> np.ndarray:
    """Where points (n, 3) go, float64: an edit takes those in its cage along, wherever the ones before it left them.
    `poses` are the posed cages, one an edit; edits must move and nothing else."""
    if any(edit.keep_source or edit.remove or edit.falloff or edit.fragments for edit in edits):
        raise InputError(
            "points go with edits that move alone, one of these copies, removes, fades or takes fragments along: bake "
            "the field (warpcage bake) and take the surface of that"
        )
    places = np.array(points, dtype=np.float64)
    for edit, pose in zip(edits, poses, strict=True):
        if pose is None or np.array_equal(pose.vertices, edit.cage.vertices):
            continue
        inside = edit.cage.contains(places, device=device)
        if inside.any():
            places[inside] = deform_points(places[inside], edit.cage, pose, coordinates, device=device)
    return places
