"""Closed solids of one colour, from which the reference models are built."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

Color = tuple[float, float, float]

#: vertices (v, 3) float64, faces (f, 3) int, counterclockwise seen from outside, and a colour in [0, 1]
Part = tuple[np.ndarray, np.ndarray, Color]

#: vertices (v, 3) float64, faces (f, 3) int32, colours (f, 3) float32
Model = tuple[np.ndarray, np.ndarray, np.ndarray]


def box(low: ArrayLike, high: ArrayLike, color: Color) -> Part:
    """A box along the axes between two opposite corners (3,)."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    vertices = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * (high - low) + low
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]), color


def cylinder(start: ArrayLike, end: ArrayLike, radius: float, color: Color, *, segments: int) -> Part:
    """A closed prism over a regular polygon, its axis from start (3,) to end (3,)."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    turn = 2 * np.pi * np.arange(segments) / segments
    ring = radius * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side))
    vertices = np.concatenate([start + ring, end + ring, [start], [end]])
    i = np.arange(segments)
    j = (i + 1) % segments
    n, low, high = segments, np.full(segments, 2 * segments), np.full(segments, 2 * segments + 1)
    columns = ((i, j, j + n), (i, j + n, i + n), (low, j, i), (high, i + n, j + n))
    return vertices, np.concatenate([np.stack(column, axis=1) for column in columns]), color


def ball(center: ArrayLike, radius: float, color: Color, *, subdivisions: int = 4) -> Part:
    """A subdivided icosahedron."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(sphere.vertices) + center, np.asarray(sphere.faces), color


def turned(part: Part, degrees: float, offset: ArrayLike) -> Part:
    """A part turned about y (x towards z) and then moved by offset (3,)."""
    vertices, faces, color = part
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + offset, faces, color


def joined(parts: Iterable[Part]) -> Model:
    """One model of all parts, which stay separate surfaces."""
    return merged([(points, faces, np.broadcast_to(color, faces.shape)) for points, faces, color in parts])


def merged(models: Sequence[Model]) -> Model:
    """One model of several, which stay separate surfaces."""
    first = np.cumsum([0] + [len(vertices) for vertices, _, _ in models])
    faces = [model[1] + begin for model, begin in zip(models, first, strict=False)]
    vertices, colors = (np.concatenate([model[n] for model in models]) for n in (0, 2))
    return vertices, np.concatenate(faces).astype(np.int32), colors.astype(np.float32)


def centered(vertices: np.ndarray) -> np.ndarray:
    """Vertices (v, 3) moved so that the middle of their bounding box is the origin."""
    return vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
