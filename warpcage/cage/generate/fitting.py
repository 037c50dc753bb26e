"""Move the vertices of a cage so that its faces, not only its vertices, keep their distance from the object.

Three steps: spread the vertices evenly, draw the faces close, clear what is still too near, by exact distances.
"""

from __future__ import annotations

import numpy as np

from ...mesh.closed_mesh import ClosedMesh

#: Most pieces that the sides of faces are cut in for samples.
_MOST_PIECES = 40


def _same(vertices):
    return vertices


def spread(shell, vertices, faces, need, mirror=None, rounds: int = 25) -> np.ndarray:
    """Vertices smoothed along the surface, pulled towards the object as far as the faces around them allow, and pushed
    off it, in turns."""
    level, edges = need + 0.1 * shell.spacing, ClosedMesh(vertices, faces).edges
    for turn in range(rounds):
        vertices = smoothed(vertices, faces, edges, 0.3 * (1.0 - turn / rounds))
        vertices = pulled(shell, vertices, faces, level)
        vertices = pushed(shell, vertices, faces, level, 8)
    return (mirror or _same)(vertices)


def drawn_close(shell, vertices, faces, need, mirror=None, rounds: int = 100) -> np.ndarray:
    """Vertices of the least volume: the faces sink under an even pressure until the object's distance carries them.

    Descends on volume + sum over faces of area * mean (shortfall^2) / (2 softness), the mean over the samples that are
    short, with steps by Adam (Kingma and Ba 2015) of each vertex's own scale; they shrink, and are never so long that a
    face could pass what it must keep off. With each step faces are pushed back to where they belong and smoothed along
    the surface.
    """
    mirror, edges = mirror or _same, ClosedMesh(vertices, faces).edges
    level, softness = need + 0.1 * shell.spacing, 0.02 * shell.spacing
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    pieces = int(np.clip(np.ceil(lengths.max() / max(need, shell.spacing)), 8, 24))
    longest = min(0.08 * lengths.mean(), 0.5 * max(need, shell.spacing))
    mean, square = np.zeros_like(vertices), np.zeros((len(vertices), 1))
    for turn in range(rounds):
        left = 1.0 - turn / rounds
        samples, weights = face_samples(vertices, faces, pieces)
        short = level - shell.closed_distance(samples)
        f, s = np.nonzero(short > 0.0)
        weights, short, away = weights[s], short[f, s], shell.outward(samples[f, s])
        slope = _slope(vertices, faces, f, weights, short / softness, away)
        mean = 0.8 * mean + 0.2 * slope
        square = 0.9 * square + 0.1 * (slope * slope).sum(axis=1, keepdims=True)
        ahead, scale = mean / (1.0 - 0.8 ** (turn + 1)), np.sqrt(square / (1.0 - 0.9 ** (turn + 1)))
        vertices = _shared_push(vertices, faces[f], weights, short, away)
        vertices = vertices - longest * (left * left + 0.02) * ahead / (scale + 0.05)
        vertices = smoothed(mirror(vertices), faces, edges, 0.1 * left)
    return mirror(pushed(shell, vertices, faces, level, pieces))


def _slope(vertices, faces, f, weights, load, away) -> np.ndarray:
    """Slope (v, 3) of the volume and of what carries it, over the mean area around a vertex.

    f, weights, load, away: (n,) face, (n, 3) barycentric weights, (n,) strength and (n, 3) direction of each contact.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = 0.5 * np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    # the samples that carry a face share its area, were it one only
    carried = (area / np.maximum(np.bincount(f, minlength=len(faces)), 1))[f, None] * load[:, None] * away
    slope = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(slope, faces[:, k], normals / 3.0)
        np.add.at(slope, faces[f, k], -weights[:, k, None] * carried)
    return slope * (len(vertices) / area.sum())


def cleared(shell, vertices, faces, need, mirror=None, rounds: int = 40, checks: int = 6) -> np.ndarray:
    """Vertices pushed outward until every face keeps its distance from the object's points; where that does not come
    about, `shortfall` tells.

    Pushed by distances on the grid, to a level that rises at each face by what exact distances then find short. Only
    the samples within a voxel of it are followed between two checks.
    """
    mirror = mirror or _same
    edges, lift, unit = ClosedMesh(vertices, faces).edges, np.zeros(len(faces)), shell.spacing
    for _ in range(checks):
        count, level = sampling(vertices, edges, unit, need)
        samples, weights = face_samples(vertices, faces, count)
        f, s = np.nonzero(shell.closed_distance(samples) < level + lift[:, None] + unit)
        worst = [np.inf]
        for _ in range(rounds):
            samples = np.einsum("nk,nki->ni", weights[s], vertices[faces[f]])
            short = level + lift[f] + 0.02 * unit - shell.closed_distance(samples)
            worst.append(short.max(initial=-np.inf))
            if worst[-1] <= 0.01 * unit or worst[-1] > 0.9 * min(worst[:-8], default=np.inf):
                break
            low = np.flatnonzero(short > 0.0)
            away = shell.outward(samples[low])
            vertices = mirror(_shared_push(vertices, faces[f[low]], weights[s[low]], short[low], away))
        vertices = mirror(vertices)
        short = shortfall(shell, vertices, faces, edges, need)
        if short.max() <= 0.0:
            break
        lift = lift + np.where(short > 0.0, short + 0.03 * unit, 0.0)
    return vertices


def shortfall(shell, vertices, faces, edges, need) -> np.ndarray:
    """(f,) how much too near each face is, at its samples, to the object's points for keeping `need`; at least 0."""
    count, level = sampling(vertices, edges, shell.spacing, need)
    samples, _ = face_samples(vertices, faces, count)
    # interpolated distances err by less than half a voxel
    f, s = np.nonzero(shell.closed_distance(samples) < level + 0.5 * shell.spacing)
    short = np.zeros(len(faces))
    np.maximum.at(short, f, level - shell.exact_distance(samples[f, s]))
    return short


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


def pushed(shell, vertices, faces, level, pieces) -> np.ndarray:
    """Vertices moved outward so that the samples of their faces come to `level`."""
    samples, weights = face_samples(vertices, faces, pieces)
    short = level - shell.closed_distance(samples)
    f, s = np.nonzero(short > 0.0)
    return _shared_push(vertices, faces[f], weights[s], short[f, s], shell.outward(samples[f, s]))


def _shared_push(vertices, corners, weights, short, away) -> np.ndarray:
    """Vertices moved so that samples go by short (n,) > 0 in the directions away (n, 3).

    corners (n, 3): vertices of each sample's face; weights (n, 3): its barycentric weights.
    """
    move = short[:, None] * away
    # the corners that carry a sample share its move so that the sample itself makes all of it (least squares)
    share = weights / (weights**2).sum(axis=1, keepdims=True)
    total, weight = np.zeros_like(vertices), np.zeros(len(vertices))
    # samples far too close count for more than those nearly clear, which a plain mean would let dilute the move
    urgency = weights * short[:, None]
    for k in range(3):
        np.add.at(total, corners[:, k], (urgency[:, k] * share[:, k])[:, None] * move)
        np.add.at(weight, corners[:, k], urgency[:, k])
    return vertices + total / np.where(weight > 0.0, weight, 1.0)[:, None]


def sampling(vertices, edges, spacing, need) -> tuple[int, float]:
    """Pieces to cut the sides of faces in, so that samples lie about half a voxel apart, and how far the samples must
    be off a point so that the faces between them, at most side / sqrt(3) of a piece away, are `need` off it."""
    longest = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max()
    count = int(np.clip(np.ceil(2.0 * longest / spacing), 8, _MOST_PIECES))
    return count, float(np.hypot(need, longest / count / np.sqrt(3.0)))


def face_samples(vertices, faces, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (f, s, 3) on a regular grid of each face, corners included, and their barycentric weights (s, 3)."""
    i, j = np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1), indexing="ij")
    kept = i + j <= pieces
    weights = np.stack([pieces - i[kept] - j[kept], i[kept], j[kept]], axis=1) / pieces
    return np.einsum("sk,fki->fsi", weights, vertices[faces]), weights


def _vertex_normals(vertices, faces) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
