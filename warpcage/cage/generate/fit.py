"""Move a cage's vertices so that its faces keep off the object: spread evenly, drawn close, cleared exactly."""

from __future__ import annotations

import functools

import numpy as np

from ...mesh.mesh import ClosedMesh

#: Pieces that the sides of faces are cut in for samples, least and most; drawing needs fewer: a face is short in many.
_MIN_PIECES, _MAX_PIECES, _MAX_DRAWN_PIECES = 8, 40, 24

#: Pieces of a face's sides where vertices are pulled, and the barycentric weight from which a sample is near a corner.
_PULL_PIECES, _NEAR_CORNER = 6, 0.3

#: Rounds of drawing, which end settled, and of clearing, which end before where nothing is short.
_DRAWN_ROUNDS, _CLEAR_ROUNDS = 100, 40

#: Times that exact distances are asked for while clearing; each raises the faces found short.
_CLEAR_CHECKS = 6

#: Voxels beyond `need` that spreading and drawing keep faces at: interpolated distances err by about that on average.
_LEVEL = 0.1

#: Share of the way to the mean of its neighbours that a vertex goes in the first round; it sinks to 0 with the rounds.
_SPREAD_SMOOTHING, _DRAWN_SMOOTHING = 0.3, 0.1

#: Share of its least room that a vertex is pulled by: its neighbours, pulled as well, take up the rest.
_PULL = 0.5

#: Voxels of shortfall that carry a face against the pressure: less is stiffer, and then the steps do not settle.
_SOFTNESS = 0.02

#: Longest first step of drawing: share of the mean edge, and of `need` or a voxel, that no face may pass.
_STEP_OF_EDGE, _STEP_OF_NEED = 0.08, 0.5

#: Least share of the longest step that is left at the end, and what keeps the steps of vertices at rest finite (slopes
#: are of the size of 1).
_LAST_STEP, _STEADY = 0.02, 0.05

#: Decay a round of Adam's means of the slope and of its square: shorter than usual, as there are 100 rounds only.
_MEAN_DECAY, _SQUARE_DECAY = 0.8, 0.9

#: Voxels that clearing aims beyond what must hold, and the shortfall, in voxels, that ends its rounds.
_CLEAR_AIM, _CLEAR_END = 0.02, 0.01

#: Rounds of clearing that may pass without the worst shortfall sinking to this share of what it was before.
_PATIENCE, _PROGRESS = 8, 0.9

#: Voxels more than what exact distances find short that a face is raised by, so that it is clear at the next check.
_LIFT = 0.03

#: Share of `need` below which the distance's slope is no guide to where out is: the object all but touches the face.
_BLIND = 0.5


def _same(vertices):
    return vertices


def spread(shell, vertices, faces, need, mirror, rounds: int) -> np.ndarray:
    """Vertices smoothed along the surface, pulled towards the object as far as the faces around them allow, and pushed
    off it, in turns."""
    level, edges = need + _LEVEL * shell.spacing, ClosedMesh(vertices, faces).edges
    for turn in range(rounds):
        vertices = smoothed(vertices, faces, edges, _SPREAD_SMOOTHING * (1.0 - turn / rounds))
        vertices = pulled(shell, vertices, faces, level)
        vertices = pushed(shell, vertices, faces, level, need, _MIN_PIECES)
    return (mirror or _same)(vertices)


def drawn_close(shell, vertices, faces, need, mirror=None, rounds: int = _DRAWN_ROUNDS) -> np.ndarray:
    """Vertices of the least volume: the faces sink under an even pressure until the object's distance carries them."""
    # Descends on volume + sum over faces of area * mean (shortfall^2) / (2 softness) over the samples that are short,
    # by Adam (Kingma and Ba 2015) of each vertex's own scale; steps shrink, and never let a face pass what it must keep
    # off. Then faces are pushed back to where they belong and smoothed along the surface.
    mirror, edges = mirror or _same, ClosedMesh(vertices, faces).edges
    level, softness = need + _LEVEL * shell.spacing, _SOFTNESS * shell.spacing
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    pieces = int(np.clip(np.ceil(lengths.max() / max(need, shell.spacing)), _MIN_PIECES, _MAX_DRAWN_PIECES))
    longest = min(_STEP_OF_EDGE * lengths.mean(), _STEP_OF_NEED * max(need, shell.spacing))
    mean, square = np.zeros_like(vertices), np.zeros((len(vertices), 1))
    for turn in range(rounds):
        left = 1.0 - turn / rounds
        weights = sample_weights(pieces)
        short = level - shell.closed_distance_on_faces(vertices, faces, weights)
        f, s = np.nonzero(short > 0.0)
        weights, short = weights[s], short[f, s]
        away = ways_out(shell, points_on(vertices, faces[f], weights), level - short, need, vertices, faces[f])
        slope = _slope(vertices, faces, f, weights, short / softness, away)
        mean = _MEAN_DECAY * mean + (1.0 - _MEAN_DECAY) * slope
        square = _SQUARE_DECAY * square + (1.0 - _SQUARE_DECAY) * (slope * slope).sum(axis=1, keepdims=True)
        ahead = mean / (1.0 - _MEAN_DECAY ** (turn + 1))
        scale = np.sqrt(square / (1.0 - _SQUARE_DECAY ** (turn + 1)))
        vertices = _shared_push(vertices, faces[f], weights, short, away)
        vertices = vertices - longest * (left * left + _LAST_STEP) * ahead / (scale + _STEADY)
        vertices = smoothed(mirror(vertices), faces, edges, _DRAWN_SMOOTHING * left)
    return mirror(pushed(shell, vertices, faces, level, need, pieces))


def _slope(vertices, faces, f, weights, load, away) -> np.ndarray:
    """Slope (v, 3) of the volume and of what carries it, over the mean area around a vertex.
    A contact has a face f (n,), barycentric weights (n, 3), a strength load (n,) and a direction away (n, 3)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = 0.5 * np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    # the samples that carry a face share its area, were it one only
    carried = (area / np.maximum(np.bincount(f, minlength=len(faces)), 1))[f, None] * load[:, None] * away
    thirds, rows, parts = normals / 3.0, [], []
    for k in range(3):
        rows += [faces[:, k], faces[f, k]]
        parts += [thirds, -weights[:, k, None] * carried]
    return row_sums(rows, parts, len(vertices)) * (len(vertices) / area.sum())


def cleared(
    shell, vertices, faces, need, mirror=None, rounds: int = _CLEAR_ROUNDS, checks: int = _CLEAR_CHECKS
) -> np.ndarray:
    """Vertices pushed outward until every face keeps its distance from the object's points, as far as that converges
    (see `shortfall`). By distances on the grid, to a level that rises by the shortfall of exact distances."""
    mirror = mirror or _same
    edges, lift, unit = ClosedMesh(vertices, faces).edges, np.zeros(len(faces)), shell.spacing
    for _ in range(checks):
        count, level = sampling(vertices, edges, unit, need)
        weights = sample_weights(count)
        # only the samples within a voxel of the level are followed between two checks
        f, s = np.nonzero(shell.closed_distance_on_faces(vertices, faces, weights) < level + lift[:, None] + unit)
        worst = [np.inf]
        for _ in range(rounds):
            samples = np.einsum("nk,nki->ni", weights[s], vertices[faces[f]])
            distance = shell.closed_distance(samples)
            short = level + lift[f] + _CLEAR_AIM * unit - distance
            worst.append(short.max(initial=-np.inf))
            if worst[-1] <= _CLEAR_END * unit or worst[-1] > _PROGRESS * min(worst[:-_PATIENCE], default=np.inf):
                break
            low = np.flatnonzero(short > 0.0)
            away = ways_out(shell, samples[low], distance[low], need, vertices, faces[f[low]])
            vertices = mirror(_shared_push(vertices, faces[f[low]], weights[s[low]], short[low], away))
        vertices = mirror(vertices)
        short = shortfall(shell, vertices, faces, edges, need)
        if short.max() <= 0.0:
            break
        lift = lift + np.where(short > 0.0, short + _LIFT * unit, 0.0)
    return vertices


def shortfall(shell, vertices, faces, edges, need) -> np.ndarray:
    """(f,) how much too near each face is, at its samples, to the object's points for keeping `need`; at least 0."""
    count, level = sampling(vertices, edges, shell.spacing, need)
    weights = sample_weights(count)
    # interpolated distances err by less than half a voxel
    distance = shell.closed_distance_on_faces(vertices, faces, weights)
    f, s = np.nonzero(distance < level + 0.5 * shell.spacing)
    short = np.zeros(len(faces))
    exact = shell.exact_distance(points_on(vertices, faces[f], weights[s]), distance[f, s] + shell.spacing, level)
    np.maximum.at(short, f, level - exact)
    return short


def smoothed(vertices, faces, edges, share) -> np.ndarray:
    """Each vertex a `share` of the way to the mean of its neighbours, along the surface only."""
    near = vertices[edges]
    total = row_sums([edges[:, 0], edges[:, 1]], [near[:, 1], near[:, 0]], len(vertices))
    count = np.bincount(edges.reshape(-1), minlength=len(vertices))
    step = share * (total / count[:, None] - vertices)
    normals = _vertex_normals(vertices, faces)
    return vertices + step - np.einsum("vi,vi->v", step, normals)[:, None] * normals


def pulled(shell, vertices, faces, level) -> np.ndarray:
    """Each vertex towards the object by half of the least room that the samples near it have."""
    weights = sample_weights(_PULL_PIECES)
    room = shell.closed_distance_on_faces(vertices, faces, weights) - level
    least = np.full(len(vertices), np.inf)
    for k in range(3):
        near = weights[:, k] > _NEAR_CORNER
        np.minimum.at(least, faces[:, k], room[:, near].min(axis=1))
    return vertices - _PULL * np.maximum(least, 0.0)[:, None] * shell.outward(vertices)


def pushed(shell, vertices, faces, level, need, pieces) -> np.ndarray:
    """Vertices moved outward so that the samples of their faces come to `level`."""
    weights = sample_weights(pieces)
    short = level - shell.closed_distance_on_faces(vertices, faces, weights)
    f, s = np.nonzero(short > 0.0)
    weights, short = weights[s], short[f, s]
    away = ways_out(shell, points_on(vertices, faces[f], weights), level - short, need, vertices, faces[f])
    return _shared_push(vertices, faces[f], weights, short, away)


def ways_out(shell, samples, distance, need, vertices, corners) -> np.ndarray:
    """Unit directions (n, 3) in which samples leave the object: where its distance (n,) at them grows, or their face
    looks. `corners` (n, 3): vertices of each sample's face."""
    away = shell.outward(samples)
    # Where the object passes through a face, the slope may push to a thin wall's wrong side: there the normal counts.
    blind = np.flatnonzero(distance < _BLIND * need)
    if len(blind):
        a, b, c = (vertices[corners[blind, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        share = np.clip(distance[blind] / (_BLIND * need), 0.0, 1.0)[:, None]
        mixed = share * away[blind] + (1.0 - share) * normals
        away[blind] = mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-30)
    return away


def _shared_push(vertices, corners, weights, short, away) -> np.ndarray:
    """Vertices moved so that samples go by short (n,) > 0 in the directions away (n, 3).
    A sample has barycentric weights (n, 3) on a face of vertices corners (n, 3)."""
    move = short[:, None] * away
    # the corners that carry a sample share its move so that the sample itself makes all of it (least squares)
    share = weights / (weights**2).sum(axis=1, keepdims=True)
    # samples far too close count for more than those nearly clear, which a plain mean would let dilute the move
    urgency = weights * short[:, None]
    parts = [(urgency[:, k] * share[:, k])[:, None] * move for k in range(3)]
    total = row_sums(list(corners.T), parts, len(vertices))
    weight = np.bincount(corners.T.reshape(-1), urgency.T.reshape(-1), len(vertices))
    return vertices + total / np.where(weight > 0.0, weight, 1.0)[:, None]


def sampling(vertices, edges, spacing, need) -> tuple[int, float]:
    """Pieces to cut the sides of faces in, so that samples lie about half a voxel apart, and how far the samples must
    be off a point so that the faces between them, at most side / sqrt(3) of a piece away, are `need` off it."""
    longest = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max()
    count = int(np.clip(np.ceil(2.0 * longest / spacing), _MIN_PIECES, _MAX_PIECES))
    return count, float(np.hypot(need, longest / count / np.sqrt(3.0)))


@functools.cache
def sample_weights(pieces: int) -> np.ndarray:
    """Barycentric weights (s, 3) of a regular grid of samples on a face, corners included."""
    i, j = np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1), indexing="ij")
    kept = i + j <= pieces
    weights = np.stack([pieces - i[kept] - j[kept], i[kept], j[kept]], axis=1) / pieces
    weights.flags.writeable = False
    return weights


def face_samples(vertices, faces, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (f, s, 3) on a regular grid of each face, corners included, and their barycentric weights (s, 3)."""
    weights = sample_weights(pieces)
    corners = vertices.T[:, faces, None]  # coordinate by coordinate: a third of the time of one einsum
    samples = corners[:, :, 0] * weights[:, 0] + corners[:, :, 1] * weights[:, 1] + corners[:, :, 2] * weights[:, 2]
    return np.moveaxis(samples, 0, -1), weights


def points_on(vertices, corners, weights) -> np.ndarray:
    """Points (n, 3) of barycentric weights (n, 3) on faces corners (n, 3)."""
    a, b, c = (vertices[corners[:, k]] * weights[:, k, None] for k in range(3))
    return a + b + c


def row_sums(rows, parts, count: int) -> np.ndarray:
    """Sums (count, 3) of the values (n, 3) of several parts at their rows (n,), added one after the other: to the bit
    what np.add.at makes, in a fraction of its time."""
    row, values = np.concatenate(rows), np.concatenate(parts)
    return np.stack([np.bincount(row, values[:, i], count) for i in range(values.shape[1])], axis=1)


def _vertex_normals(vertices, faces) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = row_sums(list(faces.T), [np.cross(b - a, c - a)] * 3, len(vertices))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
