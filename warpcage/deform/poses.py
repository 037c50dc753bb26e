"""Poses of a Deformer: their check, points and samples under them, and how far two maps are from inverse."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..cage.pose_file import posed_cage
from ..coordinates.coordinates import deform_points
from ..core.arrays import PointsLike, as_given, as_host_points, as_points, empty_array, is_device_array, require_finite
from ..core.checks import checked_step
from ..core.devices import launch
from ..edits.edits import CageEdit
from ..edits.falloff import FalloffBand
from ..errors import InputError
from ..field.voxel_field import VoxelField
from ..kernels.edits.structs import MAPPED
from ..kernels.render import samples
from ..mesh.match import require_same_faces, with_faces_of
from ..mesh.validity import require_usable
from ..render.sampled import SampledField
from ..render.view import PosedEdits

#: A pose of one cage: the Cage, its vertices (v, 3), or a file.
PoseLike: TypeAlias = "Cage | PointsLike | str | os.PathLike[str]"

#: What is posed: a cage, an edit, or several in their order.
RestLike: TypeAlias = Cage | CageEdit | Sequence[Cage | CageEdit]

#: Cells along the longest side of the posed cage's box, of the grid at whose nodes the maps are compared.
CELLS = 24


def checked_poses(edits: Sequence[CageEdit], bands: Sequence[FalloffBand | None], deformed: Any) -> list[Cage | None]:
    """The cages of a pose, one per edit, as callers give it; whether they can be used is for the edits to find."""
    cages = list(deformed) if isinstance(deformed, list | tuple) else [deformed]
    if len(cages) != len(edits):
        raise InputError(f"a pose needs one cage per edit, {len(edits)}, got {len(cages)}")
    numbered = enumerate(zip(edits, cages, bands, strict=True))
    return [checked_pose(edit, cage, index, band) for index, (edit, cage, band) in numbered]


def checked_pose(edit: CageEdit, cage: Any, index: int, band: FalloffBand | None = None) -> Cage | None:
    """The posed cage of an edit, with the walls of its band at rest; None for an edit that removes.
    `cage` is what the caller gave; `index` is the number of the edit, for messages."""
    if edit.remove:
        return None
    cage = posed_cage(edit.cage, cage, f"the pose of edit {index} must be")
    require_same_faces(edit.cage, cage)
    cage = with_faces_of(edit.cage, cage)
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


def canonical_points(
    field: VoxelField | SampledField,
    edits: PosedEdits,
    points: Any,
    directions: Any,
    step: float | None,
    return_outside: bool,
) -> tuple[Any, ...]:
    """`Deformer.to_canonical` of posed edits of a field."""
    step, device = checked_step(step, field.step), field.device
    origin, kernel_origin = np.zeros(3), field.center
    dtype = np.float64 if getattr(points, "dtype", None) == np.float64 else np.float32
    if is_device_array(points):
        x = as_points(points, device)
    else:
        origin, kernel_origin = field.center, np.zeros(3)
        x = as_points(as_host_points(points) - origin, device)
    d = as_points(directions, device, name="directions")
    if x.shape != d.shape:
        raise InputError(f"there must be as many directions as points, got {d.shape[0]} for {x.shape[0]}")
    outputs = [empty_array(x.shape[0], kind, device) for kind in (wp.vec3, wp.vec3, wp.int32, wp.uint8)]
    launch(
        edits.map_kernel(),
        x.shape[0],
        [edits.array, wp.vec3(*kernel_origin), x, d, step],
        outputs,
        device=device,
        work=edits.sample_work,
    )
    if not return_outside:
        outputs = outputs[:3]
    if is_device_array(points) or is_device_array(directions):
        require_finite(("points", x), ("directions", d))
    if is_device_array(points):
        return tuple(as_given(array, points) for array in outputs)
    canonical, *others = (array.numpy() for array in outputs)
    canonical = (canonical.astype(np.float64) + origin).astype(dtype)
    still = others[1] != MAPPED  # what did not move keeps its last bit
    canonical[still] = np.asarray(points, dtype).reshape(-1, 3)[still]
    return (canonical, *others)


def posed_samples(
    field: VoxelField | SampledField, edits: PosedEdits, points: Any, directions: Any, step: float | None, is_arc: bool
) -> tuple[Any, Any]:
    """`Deformer.sample` of posed edits of a field; is_arc: optical depth is in canonical arc length."""
    step, device = checked_step(step, field.step), field.device
    x, d = as_points(points, device), as_points(directions, device, name="directions")
    here, along, region = canonical_points(field, edits, x, d, step, False)
    ahead, region_ahead = (empty_array(0, kind, device) for kind in (wp.vec3, wp.int32))
    if is_arc:
        ahead = empty_array(len(x), wp.vec3, device)
        launch(samples.move_along, len(x), [x, d, step], [ahead], device=device)
        ahead, _, region_ahead = canonical_points(field, edits, ahead, d, step, False)
    rgb, density = field.sample(here, along)
    posed, bad = empty_array(len(x), wp.float32, device), wp.zeros(1, dtype=int, device=device)
    box = [wp.vec3(*corner) for corner in field.bounds.tolist()]
    inputs = [density, here, region, ahead, region_ahead, *box, step]
    launch(samples.pose_densities, len(x), inputs, [posed, bad], device=device)
    if int(bad.numpy()[0]):
        raise InputError("densities of a field must be finite and 0 or more")
    return as_given(rgb, points), as_given(posed, points)
