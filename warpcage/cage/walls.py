"""The walls of a cage, and the matter of a field that they cut."""

from __future__ import annotations

import numpy as np

from ..field.surface import half_opaque_density
from ..field.voxel_field import VoxelField
from ..mesh.mesh import connected_parts
from ..mesh.patches import edges_of, normals_of, triangles_of
from .cage import Cage

#: Samples of a face, one a voxel, that must lie in matter for it to cut matter: less is a speck of a fit.
MIN_SAMPLES = 4

#: Most samples along each side of a face.
MAX_SAMPLES_A_SIDE = 256


def wall_groups(cage: Cage, faces: np.ndarray, angle: float) -> list[np.ndarray]:
    """Faces (k,) of a cage as walls: sets of neighbours that meet at less than an angle, degrees."""
    faces = np.asarray(faces, dtype=np.int64)
    if not len(faces):
        return []
    start, end, owner = edges_of(cage, faces)
    normals = normals_of(cage, faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    keys = np.minimum(start, end) * len(cage.vertices) + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    one, two = owner[order[same]], owner[order[same + 1]]
    flat = np.einsum("ij,ij->i", normals[one], normals[two]) > np.cos(np.radians(angle))
    part, count = connected_parts(len(faces), one[flat], two[flat])
    return [faces[part == number] for number in range(count)]


def cut_faces(cage: Cage, field: VoxelField) -> np.ndarray:
    """The faces (k,) of a cage, ascending, that cut the matter of a field: what is half opaque across two voxels."""
    points, owner = face_samples(cage, np.arange(cage.face_count), float(field.voxel_size.min()))
    counts = np.bincount(owner[in_matter(field, points)], minlength=cage.face_count)
    return np.flatnonzero(counts >= MIN_SAMPLES)


def in_matter(field: VoxelField, points: np.ndarray) -> np.ndarray:
    """Which points (n, 3), world positions, lie in matter: what is half opaque across two voxels."""
    found = ((points > field.bounds[0]) & (points < field.bounds[1])).all(axis=1)
    inner = points[found]
    _, density = field.sample(inner, np.broadcast_to([0.0, 0.0, 1.0], inner.shape))
    found[found] = np.asarray(density) > half_opaque_density(field.voxel_size)
    return found


def face_samples(cage: Cage, faces: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) spread evenly over some faces (k,) of a cage, about `spacing` apart, world units, and which of the
    faces each is on, (n,)."""
    points, owner = [], []
    for (a, b, c), number in zip(*triangles_of(cage, faces), strict=True):
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(c - b))
        count = int(np.clip(np.ceil(longest / spacing), 2, MAX_SAMPLES_A_SIDE))
        u, v = (np.indices((count, count)).reshape(2, -1) + 0.5) / count
        kept = u + v < 1.0
        points.append(a + u[kept, None] * (b - a) + v[kept, None] * (c - a))
        owner.append(np.full(np.count_nonzero(kept), number))
    return np.concatenate(points), np.concatenate(owner)
