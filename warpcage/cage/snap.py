"""Snapping: the walls of a local cage move to where they cut least matter."""

from __future__ import annotations

import numpy as np

from ..core.checks import checked_positive
from ..field.voxel_field import VoxelField
from ..mesh.patches import normals_of, vertices_of
from .cage import Cage
from .walls import MIN_SAMPLES, face_samples, in_matter, wall_groups

#: Faces of one wall meet at less than this angle, degrees: walls move as a whole, and stay flat.
WALL_ANGLE = 5.0

#: A place that cuts this share of the matter more than the best is as good, if it is nearer.
AS_GOOD = 0.02


def snap_to_gaps(cage: Cage, field: VoxelField, reach: float) -> Cage:
    """A cage whose flat walls moved, each along its normal, to the nearest gap in the matter of a field.
    `reach`: how far a wall may move, world units."""
    # At a gap a part takes all of itself along. Walls that cut nothing stay; those not flat move face by face.
    reach = checked_positive(reach, "reach")
    cage.require_usable("the cage to snap")
    walls = wall_groups(cage, np.arange(cage.face_count), WALL_ANGLE)
    shifts = np.array([wall_shift(cage, wall, field, reach) for wall in walls])
    normals = np.stack([wall_normal(cage, wall) for wall in walls])
    around: list[list[int]] = [[] for _ in cage.vertices]
    for number, wall in enumerate(walls):
        for vertex in vertices_of(cage, wall):
            around[vertex].append(number)
    moved = cage.vertices.copy()
    for vertex, numbers in enumerate(around):
        if numbers and shifts[numbers].any():
            moved[vertex] += np.linalg.lstsq(normals[numbers], shifts[numbers], rcond=1e-3)[0]  # where its walls meet
    snapped = cage.with_vertices(moved)
    snapped.require_usable(f"the cage snapped within {reach:g}")
    return snapped


def wall_shift(cage: Cage, wall: np.ndarray, field: VoxelField, reach: float) -> float:
    """How far a wall (k,) of faces moves along its normal: to the nearest of the places that cut least matter."""
    points, _ = face_samples(cage, wall, float(field.voxel_size.min()))
    step = 0.5 * float(field.voxel_size.min())
    places = step * np.arange(-int(reach / step), int(reach / step) + 1)
    places = places[np.argsort(np.abs(places), kind="stable")]
    normal = wall_normal(cage, wall)
    here = int(in_matter(field, points).sum())
    if here < MIN_SAMPLES:
        return 0.0
    cut = np.array([in_matter(field, points + place * normal).sum() for place in places])
    return float(places[np.argmax(cut <= cut.min() + AS_GOOD * here)])


def wall_normal(cage: Cage, wall: np.ndarray) -> np.ndarray:
    """(3,) unit normal of a wall, outward: the mean of its faces' by area."""
    normal = normals_of(cage, wall).sum(axis=0)
    return normal / np.linalg.norm(normal)


def cut_matter(cage: Cage, field: VoxelField) -> int:
    """How much matter the walls of a cage cut, in samples, one a voxel."""
    points, _ = face_samples(cage, np.arange(cage.face_count), float(field.voxel_size.min()))
    return int(in_matter(field, points).sum())
