"""Move a cage's vertices so that its faces keep off the object: spread evenly, drawn close, cleared exactly."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import warp as wp

from ...core.devices import RecordedLaunches
from ...kernels.mesh.contacts import MEAN_DECAY, SQUARE_DECAY, descend, measure_contacts, push_vertices, smooth_vertices
from ...mesh.mesh import ClosedMesh
from .decimate import corner_rings
from .distance import on_cpu
from .mirror import Mirror

#: Pieces that the sides of faces are cut in for samples: in spreading, at most in clearing, least and most in drawing,
#: which needs fewer: a face is short in many.
_SPREAD_PIECES, _MAX_PIECES, _MIN_DRAWN_PIECES, _MAX_DRAWN_PIECES = 8, 40, 5, 24

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

#: How far off the object vertices are drawn: where three walls meet at `need`, and share of the mean side between them;
#: and the share of the way to the mean of their neighbours that those farther off go inward in a round.
_CORNER, _OFF, _INWARD = 1.75, 0.2, 0.3

#: Share of its least room that a vertex is pulled by: its neighbours, pulled as well, take up the rest.
_PULL = 0.5

#: Voxels of shortfall that carry a face against the pressure: less is stiffer, and then the steps do not settle.
_SOFTNESS = 0.02

#: Longest first step of drawing: share of the mean edge, and of `need` or a voxel, that no face may pass.
_STEP_OF_EDGE, _STEP_OF_NEED = 0.08, 0.5

#: Least share of the longest step that is left at the end.
_LAST_STEP = 0.02

#: Voxels that clearing aims beyond what must hold, and the shortfall, in voxels, that ends its rounds.
_CLEAR_AIM, _CLEAR_END = 0.02, 0.01

#: Rounds of clearing that may pass without the worst shortfall sinking to this share of what it was before.
_PATIENCE, _PROGRESS = 8, 0.9

#: Voxels more than what exact distances find short that a face is raised by, so that it is clear at the next check.
_LIFT = 0.03

#: Share of `need` below which the distance's slope is no guide to where out is: the object all but touches the face.
_BLIND = 0.5

#: Steps of a face's samples, and of what lies around a vertex, as `launch` counts them; and most faces that one thread
#: looks at: others would begin as it ends.
_FACE_WORK, _VERTEX_WORK, _FEW_FACES = 100, 4, 2048


class HeldFaces:
    """Faces (f, 3) of a closed mesh about an object's shell, whose vertices (v, 3) are pushed, drawn and smoothed."""

    def __init__(self, shell, vertices, faces, need, mirror=None):
        self.shell, self.faces, self._mirror, self._launch = shell, faces, mirror, RecordedLaunches("cpu")
        self._threads = 1 if len(faces) <= _FEW_FACES else None
        self.vertices, self._next = np.array(vertices, dtype=np.float64), np.empty(vertices.shape)
        self._places, self._next_places = (on_cpu(each, wp.vec3d) for each in (self.vertices, self._next))
        self._rings = [on_cpu(part, wp.int32) for part in corner_rings(faces, len(vertices))]
        self._triangles, self._blind = on_cpu(faces.astype(np.int32), wp.vec3i), wp.float64(_BLIND * need)
        self._shortest, self._areas = np.empty(len(faces)), np.empty(len(faces))
        shortest, areas, weights = (
            on_cpu(e, wp.float64) for e in (self._shortest, self._areas, np.empty(3 * len(faces)))
        )
        moves, slopes = (on_cpu(np.empty((3 * len(faces), 3)), wp.vec3d) for _ in range(2))
        self._found, self._asked, self._slopes = [shortest, areas, moves, weights, slopes], [moves, weights], slopes
        self._touched = np.empty(vertices.shape)
        means, squares = np.zeros_like(self.vertices), np.zeros(len(self.vertices))
        self._adam = [on_cpu(means, wp.vec3d), on_cpu(squares, wp.float64)]

    def ask(self, pieces, levels, softness: float = 1.0) -> None:
        """Faces are cut in pieces (f,) and kept off at levels (f,)."""
        counts = (pieces + 1) * (pieces + 4) // 2  # of rows and samples
        self._touched[:] = np.nan  # nowhere yet
        held = [on_cpu((np.cumsum(counts) - counts).astype(np.int32), wp.int32), on_cpu(self._touched, wp.vec3d)]
        held += [on_cpu(np.full(len(pieces), -1.0), wp.float64), on_cpu(np.zeros(counts.sum(), np.float32), wp.float32)]
        sampled = [on_cpu(pieces, wp.int32), on_cpu(levels, wp.float64), self._blind, wp.float64(softness)]
        self._sampled = [*sampled, self.shell.grid, *held]

    def touch(self) -> float:
        """How far faces are short of the levels asked for at most; what that asks of the vertices is kept."""
        inputs = [self._places, self._triangles, *self._sampled]
        options: dict[str, Any] = {"threads": self._threads, "work": _FACE_WORK}
        self._launch(measure_contacts, len(self.faces), inputs, self._found, **options)
        self._touched[:] = self.vertices
        return float(self._shortest.max())

    @property
    def spread(self) -> float:
        """Side of a vertex's share of the area, as squares, at the last touch."""
        return float(np.sqrt(self._areas.sum() / len(self.vertices)))

    def push(self) -> None:
        """Vertices moved as the last touch asks for."""
        self._move(push_vertices, [*self._rings, self._places, *self._asked])
        if isinstance(self._mirror, Mirror):
            self.vertices[:] = self._mirror.farther(self._next, self.vertices)
        else:
            self.mirror()

    def descend(self, turn: int, step: float) -> None:
        """A step down what the last touch found, in round `turn`, of `step` at most, and its push."""
        scale = len(self.vertices) / self._areas.sum()
        numbers = (scale, step, 1.0 - float(MEAN_DECAY) ** (turn + 1), 1.0 - float(SQUARE_DECAY) ** (turn + 1))
        inputs = [*self._rings, self._places, *self._asked, self._slopes, *map(wp.float64, numbers), *self._adam]
        self._move(descend, inputs)
        self.mirror()

    def smooth(self, share: float, limit: float = np.inf, inward: float = 0.0) -> None:
        """Each vertex a `share` of the way to the mean of its neighbours, along the surface only."""
        self._move(
            smooth_vertices,
            [
                *self._rings,
                self._places,
                self._triangles,
                wp.float64(share),
                self.shell.grid,
                wp.float64(limit),
                wp.float64(inward),
            ],
        )

    def pull(self, level: float) -> None:
        """Each vertex towards the object by half of the least room that the samples near it have."""
        weights = sample_weights(_PULL_PIECES)
        room = self.shell.distance_on_faces(self.vertices, self.faces, _PULL_PIECES) - level
        least = np.full(len(self.vertices), np.inf)
        for k in range(3):
            np.minimum.at(least, self.faces[:, k], room[:, weights[:, k] > _NEAR_CORNER].min(axis=1))
        self.vertices -= _PULL * np.maximum(least, 0.0)[:, None] * self.shell.outward(self.vertices)

    def mirror(self) -> None:
        if self._mirror is not None:
            self.vertices[:] = self._mirror(self.vertices)

    def _move(self, kernel, inputs) -> None:
        options: dict[str, Any] = {"threads": self._threads, "work": _VERTEX_WORK}
        self._launch(kernel, len(self.vertices), inputs, [self._next_places], **options)
        self.vertices, self._next = self._next, self.vertices
        self._places, self._next_places = self._next_places, self._places


def spread(shell, vertices, faces, need, mirror, rounds: int) -> np.ndarray:
    """Vertices smoothed along the surface, pulled towards the object as far as the faces around them allow, and pushed
    off it, in turns."""
    level, held = need + _LEVEL * shell.spacing, HeldFaces(shell, vertices, faces, need, mirror)
    held.ask(np.full(len(faces), _SPREAD_PIECES, np.int32), np.full(len(faces), level))
    for turn in range(rounds):
        held.smooth(_SPREAD_SMOOTHING * (1.0 - turn / rounds))
        held.pull(level)
        held.touch()
        held.push()
    return mirror(held.vertices) if mirror else held.vertices


def drawn_close(shell, vertices, faces, need, mirror=None, rounds: int = _DRAWN_ROUNDS) -> np.ndarray:
    """Vertices of the least volume: the faces sink under an even pressure until the object's distance carries them."""
    # Descends on volume + sum over faces of area * mean (shortfall^2) / (2 softness) over the samples that are short,
    # by Adam of each vertex's own scale; steps shrink, and never let a face pass what it must keep off. Then faces are
    # pushed back to where they belong and smoothed along the surface.
    level, softness = np.full(len(faces), need + _LEVEL * shell.spacing), _SOFTNESS * shell.spacing
    finest = max(need, shell.spacing)
    pieces = np.clip(np.ceil(longest_sides(vertices, faces) / finest), _MIN_DRAWN_PIECES, _MAX_DRAWN_PIECES)
    edges = ClosedMesh(vertices, faces).edges
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    longest = min(_STEP_OF_EDGE * lengths.mean(), _STEP_OF_NEED * finest)
    held = HeldFaces(shell, vertices, faces, need, mirror)
    held.ask(pieces.astype(np.int32), level, softness)
    held.touch()
    limit = _CORNER * need + _OFF * held.spread
    for turn in range(rounds):
        left = 1.0 - turn / rounds
        held.touch()
        held.descend(turn, longest * (left * left + _LAST_STEP))
        held.smooth(_DRAWN_SMOOTHING * left, limit, _INWARD)
    held.touch()
    held.push()
    return held.vertices


def cleared(
    shell, vertices, faces, need, mirror=None, rounds: int = _CLEAR_ROUNDS, checks: int = _CLEAR_CHECKS
) -> tuple[np.ndarray, bool]:
    """Vertices pushed outward until every face keeps its distance from the object's points, as far as that converges,
    and whether it did."""
    # by distances on the grid, to a level that rises by the shortfall of exact distances
    held, lift, unit = HeldFaces(shell, vertices, faces, need, mirror), np.zeros(len(faces)), shell.spacing
    measured, short = np.full(vertices.shape, np.nan), np.zeros(len(faces))
    for _ in range(checks):
        pieces, levels = sampling(held.vertices, faces, unit, need)
        held.ask(pieces, levels + lift + _CLEAR_AIM * unit)
        worst = [np.inf]
        for _ in range(rounds):
            worst.append(held.touch())
            if worst[-1] <= _CLEAR_END * unit or worst[-1] > _PROGRESS * min(worst[:-_PATIENCE], default=np.inf):
                break
            held.push()
        moved = (held.vertices != measured).any(axis=1)[faces].any(axis=1)
        short[moved] = shortfall(shell, held.vertices, faces[moved], need)
        if short.max() <= 0.0:
            return held.vertices, True
        measured = held.vertices.copy()
        lift = lift + np.where(short > 0.0, short + _LIFT * unit, 0.0)
    return held.vertices, False


def shortfall(shell, vertices, faces, need) -> np.ndarray:
    """(f,) how much too near each face is, at its samples, to the object's points for keeping `need`; at least 0."""
    pieces, levels = sampling(vertices, faces, shell.spacing, need)
    counts, samples, distance = shell.near_samples(vertices, faces, pieces, levels)
    short, f = np.zeros(len(faces)), np.repeat(np.arange(len(faces)), counts)
    exact = shell.voxels.exact_distance(samples, distance + shell.spacing, levels[f])
    np.maximum.at(short, f, levels[f] - exact)
    return short


def longest_sides(vertices, faces) -> np.ndarray:
    """(f,) length of the longest side of each face."""
    corners = vertices[faces]
    return np.sqrt(((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1))


def sampling(vertices, faces, spacing, need) -> tuple[np.ndarray, np.ndarray]:
    """Pieces (f,) to cut the sides of faces in, so that samples lie about half a voxel apart, and how far (f,) samples
    must be off a point so that the face between them, at most side / sqrt(3) of a piece away, is `need` off it."""
    longest = longest_sides(vertices, faces)
    count = np.clip(np.ceil(2.0 * longest / spacing), 1, _MAX_PIECES)
    return count.astype(np.int32), np.hypot(need, longest / count / np.sqrt(3.0))


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


def row_sums(rows, parts, count: int) -> np.ndarray:
    """Sums (count, 3) of the values (n, 3) of several parts at their rows (n,), added one after the other: to the bit
    what np.add.at makes, in a fraction of its time."""
    row, values = np.concatenate(rows), np.concatenate(parts)
    return np.stack([np.bincount(row, values[:, i], count) for i in range(values.shape[1])], axis=1)
