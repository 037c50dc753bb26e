"""Move the vertices of a cage so that its faces, not only its vertices, keep their distance from the object."""

from __future__ import annotations

import numpy as np

from .cage import Cage


def fitted(shell, vertices, faces, need, rounds: int = 60, tighten: bool = True) -> np.ndarray:
    """Vertices moved so that every face keeps `need` from the object, close to it, and triangles are even.

    Alternates smoothing along the surface, a pull towards the object as far as the faces around a vertex allow, and a
    push of every sample of a face that is too close, shared over its corners by barycentric weight. Without `tighten`
    vertices are only pushed outward.
    """
    vertices = vertices.copy()
    edges = Cage(vertices, faces).edges
    level = need + 0.1 * shell.spacing
    for turn in range(3 * rounds):
        if turn < rounds and tighten:
            vertices = smoothed(vertices, faces, edges, 0.3 * (1.0 - turn / rounds))
            vertices = pulled(shell, vertices, faces, level)
        # coarse samples while the shape is found, then those that the last check looks at
        count = 8 if turn < rounds else pieces(shell, vertices, edges)
        vertices, worst = pushed(shell, vertices, faces, level, count)
        if turn >= rounds and worst <= 0.05 * shell.spacing:
            break
    return vertices


def smoothed(vertices, faces, edges, share) -> np.ndarray:
    """Each vertex a `share` of the way to the mean of its neighbours, along the surface only."""
    total, count = np.zeros_like(vertices), np.zeros(len(vertices))
    for a, b in ((0, 1), (1, 0)):
        np.add.at(total, edges[:, a], vertices[edges[:, b]])
        np.add.at(count, edges[:, a], 1.0)
    step = share * (total / count[:, None] - vertices)
    normals = _vertex_normals(vertices, faces)
    return vertices + step - np.einsum("vi,vi->v", step, normals)[:, None] * normals


def pulled(shell, vertices, faces, level) -> np.ndarray:
    """Each vertex towards the object by half of the least room that the samples near it have."""
    samples, weights = face_samples(vertices, faces, 6)
    room = shell.closed_distance(samples) - level
    least = np.full(len(vertices), np.inf)
    for k in range(3):
        near = weights[:, k] > 0.3
        np.minimum.at(least, faces[:, k], room[:, near].min(axis=1))
    return vertices - 0.5 * np.maximum(least, 0.0)[:, None] * shell.outward(vertices)


def pushed(shell, vertices, faces, level, pieces) -> tuple[np.ndarray, float]:
    """Vertices moved outward so that the samples of their faces come to `level`, and the largest shortfall before."""
    samples, weights = face_samples(vertices, faces, pieces)
    short = level - shell.closed_distance(samples)
    worst = float(short.max())
    f, s = np.nonzero(short > 0.0)
    if not len(f):
        return vertices, worst
    move = short[f, s, None] * shell.outward(samples[f, s])
    # the corners that carry a sample share its move so that the sample itself makes all of it (least squares)
    share = weights[s] / (weights[s] ** 2).sum(axis=1, keepdims=True)
    total, weight = np.zeros_like(vertices), np.zeros(len(vertices))
    # samples far too close count for more than those nearly clear, which a plain mean would let dilute the move
    urgency = weights[s] * short[f, s, None]
    for k in range(3):
        np.add.at(total, faces[f, k], (urgency[:, k] * share[:, k])[:, None] * move)
        np.add.at(weight, faces[f, k], urgency[:, k])
    return vertices + total / np.where(weight > 0.0, weight, 1.0)[:, None], worst


def face_samples(vertices, faces, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (f, s, 3) on a regular grid of each face, corners included, and their barycentric weights (s, 3)."""
    i, j = np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1), indexing="ij")
    kept = i + j <= pieces
    weights = np.stack([pieces - i[kept] - j[kept], i[kept], j[kept]], axis=1) / pieces
    return np.einsum("sk,fki->fsi", weights, vertices[faces]), weights


def pieces(shell, vertices, edges) -> int:
    """Pieces to cut the sides of faces in so that samples lie about half a voxel apart."""
    longest = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max()
    return int(np.clip(np.ceil(2.0 * longest / shell.spacing), 8, 40))


def _vertex_normals(vertices, faces) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
