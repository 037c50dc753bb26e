"""Cut a polygon into triangles that do not fold, concave or not."""

from __future__ import annotations

import numpy as np

#: A polygon is plane when its vertices lie within this share of its size.
_FLAT = 0.1


def cut_polygon(vertices: np.ndarray, polygon: list[int]) -> list[tuple[int, int, int]]:
    """Triangles (n - 2) over a polygon, wound as it is; vertices (v, 3), polygon n vertex numbers.

    The fan from its first vertex where no triangle of it looks backward, which depends on nothing but the order; else
    ears are cut off, the best shaped first (Meisters 1975). A polygon without area or far from plane is cut as a fan.
    """
    fan = [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    points = vertices[polygon] - vertices[polygon[0]]
    normal = 0.5 * np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)  # Newell 1972
    length = np.linalg.norm(normal)
    if length == 0.0 or not np.isfinite(length):
        return fan
    normal /= length
    if np.ptp(points @ normal) > _FLAT * np.ptp(points, axis=0).max():
        return fan  # far from plane: no cut is the right one, so one that any pose shares
    if (_heights(vertices, np.array(fan), normal) > 1e-9 * length).all():
        return fan
    ears, left = [], list(polygon)
    while len(left) > 3:
        ring = np.array([(left[k - 1], left[k], left[(k + 1) % len(left)]) for k in range(len(left))])
        best = max(range(len(left)), key=lambda k: _ear_quality(vertices, ring[k], left, normal))
        ears.append(tuple(int(corner) for corner in ring[best]))
        del left[best]
    return [*ears, tuple(left)]


def _heights(vertices, triangles, normal) -> np.ndarray:
    """Area of triangles (t, 3) seen along the normal; negative where they look backward."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a) @ normal


def _ear_quality(vertices, ear, left, normal) -> float:
    """Area over the square of the longest side; below zero where the ear looks backward or holds another vertex."""
    a, b, c = vertices[ear]
    area = float(0.5 * np.cross(b - a, c - a) @ normal)
    longest = max(float(((p - q) ** 2).sum()) for p, q in ((a, b), (b, c), (c, a)))
    if area <= 0.0 or longest == 0.0:
        return -1.0 + area / max(longest, 1e-300)
    others = vertices[[index for index in left if index not in ear]]
    sides = [np.cross(q - p, others - p) @ normal for p, q in ((a, b), (b, c), (c, a))]
    holds = np.logical_and.reduce([side >= -1e-9 * longest for side in sides]).any()
    return -0.5 if holds else area / longest
