"""Edges and normals of all faces of a cage at once, as columns (3, f): what every pose needs, with few array calls."""

from __future__ import annotations

import numpy as np

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def face_edges(cage) -> tuple[np.ndarray, np.ndarray]:
    """From the first corner of each face to its second and third: (3, f) float64 each, world units."""
    vertices = (cage.vertices - cage.bounds.mean(axis=0)).T
    first, second, third = cage.faces.T
    a = vertices[:, first]
    return vertices[:, second] - a, vertices[:, third] - a


def column_cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of the columns of two (3, n)."""
    return a[_NEXT] * b[_LAST] - a[_LAST] * b[_NEXT]


def column_dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (n,) of the columns of two (3, n)."""
    return np.einsum("in,in->n", a, b)
