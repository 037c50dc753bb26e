"""What cage generation takes: counts, margins and points on the object."""

from __future__ import annotations

import numpy as np

from .fitting import face_samples

_LEAST_COUNT, _MOST_COUNT = 8, 2000


# -- Voxels


def _spacing(extent, vertex_count) -> float:
    """Side of a voxel: about 64^3 of them in the box, more for cages of many vertices, at most 160 along a side."""
    size = extent.max()
    finer = np.clip(vertex_count / 200.0, 1.0, 4.0) ** (1.0 / 3.0)
    filled = np.prod(np.maximum(extent, size / 160.0)) ** (1.0 / 3.0) / 64.0
    return float(max(filled, size / 160.0) / finer)


def surface_points(vertices, faces, spacing) -> np.ndarray:
    """Points on faces no more than `spacing` from their neighbours: a regular grid on each, by number of pieces."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.maximum(np.ceil(longest / spacing).astype(np.int64), 1)
    found = []
    for count in np.unique(pieces[pieces > 1]):
        samples, _ = face_samples(vertices, faces[pieces == count], int(count))
        found.append(samples.reshape(-1, 3))
    return np.concatenate(found) if found else np.zeros((0, 3))


def checked_count(vertex_count, name: str = "vertex_count") -> int:
    whole = isinstance(vertex_count, int | np.integer) and not isinstance(vertex_count, bool)
    if not whole or not _LEAST_COUNT <= vertex_count <= _MOST_COUNT:
        raise ValueError(f"{name} must be a whole number, {_LEAST_COUNT} to {_MOST_COUNT}, got {vertex_count!r}")
    return int(vertex_count)
