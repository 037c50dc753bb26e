"""Boxes and cylinders that reference objects are built from."""

from __future__ import annotations

import numpy as np


def _box(low, high, colour):
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    vertices = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * (high - low) + low
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]), colour


def _cylinder(start, end, radius, colour, *, segments):
    """A closed prism over a regular polygon, its axis from start to end."""
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
    return vertices, np.concatenate([np.stack(column, axis=1) for column in columns]), colour


def _placed(part, degrees, offset):
    """A part turned about y (x towards z) and moved."""
    vertices, faces, colour = part
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + offset, faces, colour
