"""End a cage at the plane that its object stands on, so that it holds nothing of what is below."""

from __future__ import annotations

import numpy as np

from ...field.planes import Plane
from ...mesh.mesh import ClosedMesh
from ...mesh.queries import inside_mesh, intersecting_faces
from ...mesh.validity import first_problem
from .fitting import row_sums

#: Rounds in which the rim on the plane is widened until it holds the object, and how far in each, in voxels.
_ROUNDS, _STEP = 24, 0.25

#: Objects are looked at up to this height above the plane, in mean edges of the cage: there its faces have moved.
_LOOKED_AT = 2.0


def ended_at(floor: Plane, cage: ClosedMesh, points: np.ndarray, spacing: float) -> np.ndarray:
    """Vertices (v, 3), world units, of a usable cage that ends at a plane; the object's points (n, 3), above it, stay
    inside. `spacing`: side of a voxel of the cage's making, world units."""
    # What lies below the plane moves up to it: at the rim to where the cage passed through the plane, so that its
    # section there stays, and straight up within. Where faces near the plane then leave some of the object out, the rim
    # is widened along the plane.
    vertices, heights = cage.vertices, floor.heights(cage.vertices)
    below = heights < 0.0
    if not below.any():
        return vertices
    if below.all():
        raise ValueError("all of it lies below the plane that the object stands on")
    ends = cage.edges[below[cage.edges[:, 0]] != below[cage.edges[:, 1]]]
    low, high = np.where(below[ends[:, 0], None], ends, ends[:, ::-1]).T
    share = heights[high] / (heights[high] - heights[low])
    passed = vertices[high] + share[:, None] * (vertices[low] - vertices[high])
    count = np.bincount(low, minlength=len(vertices))
    rim = count > 0
    moved = vertices - np.where(below, heights, 0.0)[:, None] * floor.normal
    moved[rim] = (row_sums([low], [passed], len(vertices)) / np.maximum(count, 1)[:, None])[rim]

    # what is near the plane must stay inside: elsewhere no face has moved
    edge = float(np.linalg.norm(np.diff(vertices[cage.edges], axis=1), axis=2).mean())
    near = points[floor.heights(points) < _LOOKED_AT * edge]
    outward = _sideways_normals(cage, floor.normal)
    for _ in range(_ROUNDS):
        now = ClosedMesh(moved, cage.faces)
        trouble = first_problem(now)
        if trouble or len(intersecting_faces(now.vertices, now.faces)):
            raise ValueError(f"cut at the plane below the object it {trouble or 'passes through itself'}")
        left = near[~inside_mesh(near, now, device="cpu")]
        if not len(left):
            return moved
        # the vertices of the rim that are nearest to what is left out, and their neighbours a little
        rows = np.flatnonzero(rim)
        distance = np.linalg.norm(moved[rows][:, None] - left[None, :2000], axis=2)
        pushed = np.exp(-0.5 * ((distance.min(axis=1) - distance.min()) / edge) ** 2)
        moved = moved.copy()
        moved[rows] += _STEP * spacing * pushed[:, None] * outward[rows]
    raise ValueError("cut at the plane below the object it leaves some of the object out")


def _sideways_normals(cage: ClosedMesh, normal: np.ndarray) -> np.ndarray:
    """(v, 3) directions out of a cage along a plane, 0 where a vertex looks straight up or down."""
    a, b, c = cage.corners
    faces = np.cross(b - a, c - a)
    total = row_sums(list(cage.faces.T), [faces] * 3, len(cage.vertices))
    total = total - (total @ normal)[:, None] * normal
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0.0, length, 1.0)
