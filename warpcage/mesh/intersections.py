"""Which faces of a triangle mesh pass through each other."""

from __future__ import annotations

import numpy as np

#: Overlaps and crossings below this share of the mesh's size are touching, not intersecting.
TOUCHING = 1e-9


def intersecting_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pairs (k, 2) of faces that cross or overlap, lower index first. vertices (v, 3), faces (f, 3).

    Faces may share vertices and edges; neighbours intersect when they fold onto each other. Every pair whose bounding
    boxes overlap is tested, edges against triangles (Moeller and Trumbore 1997) and, in one plane, by separating axes.
    """
    faces = np.asarray(faces, dtype=np.int64)
    vertices = np.asarray(vertices, dtype=np.float64)
    vertices = vertices - vertices[faces.reshape(-1)].mean(axis=0)
    size = np.ptp(vertices[faces.reshape(-1)], axis=0).max()
    if size == 0.0:
        return np.zeros((0, 2), dtype=np.int64)
    corners = vertices[faces] / size
    pairs = _overlapping_boxes(corners)
    one, two = pairs.T
    shared = (faces[one][:, :, None] == faces[two][:, None, :]).any(axis=2).sum(axis=1)

    crossing = np.zeros(len(pairs), dtype=bool)
    for a, b in ((one, two), (two, one)):
        for k in range(3):
            start, end = faces[a, k], faces[a, (k + 1) % 3]
            # an edge that begins or ends at a corner of the triangle touches it there and nowhere else
            apart = ~((faces[b] == start[:, None]) | (faces[b] == end[:, None])).any(axis=1)
            crossing[apart] |= _segments_cross(corners[a[apart], k], corners[a[apart], (k + 1) % 3], corners[b[apart]])

    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)
    heights = np.abs(np.einsum("pki,pi->pk", corners[two] - corners[one][:, :1], normals[one])).max(axis=1)
    flat = np.flatnonzero((heights < 1e-7) & (shared < 3) & (lengths[one, 0] > 0.0) & (lengths[two, 0] > 0.0))
    crossing[flat] |= _overlap_in_plane(corners[one[flat]], corners[two[flat]], normals[one[flat]])
    crossing |= shared == 3
    return pairs[crossing]


def _overlapping_boxes(corners: np.ndarray) -> np.ndarray:
    """Pairs (p, 2), i < j, of triangles (f, 3, 3) whose bounding boxes overlap."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    pairs = []
    for first in range(0, len(corners), 256):
        rows = slice(first, min(first + 256, len(corners)))
        meet = np.ones((rows.stop - first, len(corners)), dtype=bool)
        for axis in range(3):
            meet &= low[rows, None, axis] <= high[None, :, axis]
            meet &= low[None, :, axis] <= high[rows, None, axis]
        i, j = np.nonzero(meet)
        later = j > i + first
        pairs.append(np.stack([i[later] + first, j[later]], axis=1))
    return np.concatenate(pairs)


def _segments_cross(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Whether segments (p, 3) - (p, 3) pass through the inside of triangles (p, 3, 3)."""
    u, v, along = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0], end - start
    normal = np.cross(along, v)
    determinant = np.einsum("pi,pi->p", u, normal)
    scale = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1) * np.linalg.norm(along, axis=1)
    steep = np.abs(determinant) > 1e-9 * scale
    inverse = 1.0 / np.where(steep, determinant, 1.0)
    offset = start - triangle[:, 0]
    b = np.einsum("pi,pi->p", offset, normal) * inverse
    turned = np.cross(offset, u)
    c = np.einsum("pi,pi->p", along, turned) * inverse
    t = np.einsum("pi,pi->p", v, turned) * inverse
    inside = (b > TOUCHING) & (c > TOUCHING) & (b + c < 1.0 - TOUCHING)
    return steep & inside & (t > TOUCHING) & (t < 1.0 - TOUCHING)


def _overlap_in_plane(one: np.ndarray, two: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Whether triangles (p, 3, 3) of one plane overlap in more than a line: no edge separates them."""
    separated = np.zeros(len(one), dtype=bool)
    for a in (one, two):
        for k in range(3):
            axis = np.cross(normal, a[:, (k + 1) % 3] - a[:, k])
            length = np.linalg.norm(axis, axis=1, keepdims=True)
            axis = axis / np.where(length > 0.0, length, 1.0)
            p, q = np.einsum("pki,pi->pk", one, axis), np.einsum("pki,pi->pk", two, axis)
            separated |= (p.max(axis=1) <= q.min(axis=1) + TOUCHING) | (q.max(axis=1) <= p.min(axis=1) + TOUCHING)
    return ~separated
