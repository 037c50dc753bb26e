"""What is known of a pose before its pictures: near rigid, of the same volume, symmetric, near the pose before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..cage.generate.distance import bounds_of
from ..cage.generate.mirror import mirror_axes, reflected
from ..core.checks import checked_number
from ..core.names import checked_choice
from ..errors import InputError
from ..mesh.mesh import ClosedMesh

#: Weights of priors where `regularize` does not name them.
DEFAULT_WEIGHTS = {"rigid": 0.05, "volume": 0.0, "start": 0.0, "symmetry": 0.0}

#: Pairs of vertices whose distances are compared with their mirror images, at most.
MAX_PAIRS = 20_000


class Rigidity:
    """How far a pose is from moving every vertex with its neighbours rigidly, as a share of the edges' squares."""

    # "As-Rigid-As-Possible Surface Modeling" (Sorkine and Alexa 2007), Eq. 3 with weights 1 / length^2, over the edges
    # of the rest cage. Rotations are the best ones of each pose, so that the gradient holds them (envelope theorem).

    def __init__(self, rest: ClosedMesh):
        self._rest = rest.vertices
        self._first, self._second = np.concatenate([rest.edges, rest.edges[:, ::-1]]).T
        self._edges = self._rest[self._first] - self._rest[self._second]
        self._weights = 1.0 / np.maximum((self._edges**2).sum(axis=1), 1e-12 * rest.size**2) / len(self._edges)

    def __call__(self, vertices: np.ndarray) -> tuple[float, np.ndarray]:
        """The energy, and its gradient (v, 3)."""
        off = vertices[self._first] - vertices[self._second] - self._turned(vertices)
        weighted = self._weights[:, None] * off
        return float((weighted * off).sum()), 2 * self._gathered(weighted)

    def matrix(self) -> np.ndarray:
        """(v, v) of the energy's squares: half its gradient is this times the vertices, less `right_side`."""
        matrix = np.zeros((len(self._rest), len(self._rest)))
        np.add.at(matrix, (self._first, self._second), -2 * self._weights)  # each edge is there both ways
        matrix[np.diag_indices(len(matrix))] = -matrix.sum(axis=1)
        return matrix

    def right_side(self, vertices: np.ndarray) -> np.ndarray:
        """(v, 3) what the best rotations of a pose ask for (Sorkine and Alexa 2007, Eq. 8 and 9)."""
        return self._gathered(self._weights[:, None] * self._turned(vertices))

    def _turned(self, vertices: np.ndarray) -> np.ndarray:
        """(e, 3) edges at rest, each turned by the best rotation of its first vertex."""
        posed = vertices[self._first] - vertices[self._second]
        outer = self._weights[:, None, None] * posed[:, :, None] * self._edges[:, None, :]
        sums = np.zeros((len(vertices), 3, 3))
        np.add.at(sums, self._first, outer)
        u, _, vt = np.linalg.svd(sums)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        return np.einsum("eij,ej->ei", (u @ vt)[self._first], self._edges)

    def _gathered(self, by_edges: np.ndarray) -> np.ndarray:
        """(v, 3) sums over the edges of each vertex, with their signs."""
        sums = np.zeros_like(self._rest)
        np.add.at(sums, self._first, by_edges)
        np.add.at(sums, self._second, -by_edges)
        return sums


def volume_change(rest: ClosedMesh, vertices: np.ndarray) -> tuple[float, np.ndarray]:
    """Square of the change of volume, as a share of that at rest, and its gradient (v, 3)."""
    gradient, before = np.zeros_like(vertices), _corners(rest, rest.vertices)
    a, b, c = _corners(rest, vertices)
    volume = np.einsum("fi,fi->", before[0], np.cross(before[1], before[2])) / 6
    change = np.einsum("fi,fi->", a, np.cross(b, c)) / 6 / volume - 1
    for corner, slope in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
        np.add.at(gradient, rest.faces[:, corner], slope / 6)
    return float(change**2), 2 * change / volume * gradient


def _corners(mesh: ClosedMesh, vertices: np.ndarray) -> list[np.ndarray]:
    """Corners of the triangles, three (f, 3), from their middle."""
    return [(vertices - vertices.mean(axis=0))[mesh.faces[:, corner]] for corner in range(3)]


class Asymmetry:
    """Mean square of what distances of vertices differ by from those of their mirror images, squares over the size's
    square: 0 for what is its own mirror image across any plane."""

    def __init__(self, rest: ClosedMesh):
        from scipy.spatial import KDTree

        axes = mirror_axes(rest.vertices)
        if not axes:
            raise InputError("regularize symmetry: the cage at rest is no mirror image of itself across x, y or z")
        axis = "xyz".index(axes[0])
        middle = 0.5 * float(bounds_of(rest.vertices)[:, axis].sum())
        self._images = np.asarray(KDTree(rest.vertices).query(reflected(rest.vertices, axis, middle))[1])
        pairs = np.stack(np.triu_indices(len(rest.vertices), 1), axis=1)
        self._pairs = pairs[:: -(-len(pairs) // MAX_PAIRS)]
        self._unit = rest.size**2

    def __call__(self, vertices: np.ndarray) -> tuple[float, np.ndarray]:
        """The energy, and its gradient (v, 3)."""
        (a, b), (c, d) = self._pairs.T, self._images[self._pairs.T]
        here, there = vertices[a] - vertices[b], vertices[c] - vertices[d]
        off = ((here**2).sum(axis=1) - (there**2).sum(axis=1)) / self._unit
        slope, gradient = 4 * off[:, None] / (len(off) * self._unit), np.zeros_like(vertices)
        for corner, way in ((a, here), (b, -here), (c, -there), (d, there)):
            np.add.at(gradient, corner, slope * way)
        return float((off**2).mean()), gradient


class Priors:
    """The sum of all priors of a fit, each by its weight."""

    def __init__(self, rest: ClosedMesh, start: np.ndarray, regularize: float | Mapping[str, float]):
        given: Any = regularize if isinstance(regularize, Mapping) else {"rigid": regularize}
        for name, weight in given.items():
            checked_choice(name, "a prior of regularize", tuple(DEFAULT_WEIGHTS))
            checked_number(weight, f"regularize {name}", 0)
        self._weights = DEFAULT_WEIGHTS | dict(given)
        self._rest, self._start, self._rigidity = rest, start, Rigidity(rest)
        self._asymmetry = Asymmetry(rest) if self._weights["symmetry"] else None

    def __call__(self, vertices: np.ndarray) -> tuple[float, np.ndarray]:
        """The weighted sum for a pose, and its gradient (v, 3)."""
        weights, moved = self._weights, (vertices - self._start) / self._rest.size
        loss, gradient = 0.0, np.zeros_like(vertices)
        terms = {
            "rigid": lambda: self._rigidity(vertices),
            "volume": lambda: volume_change(self._rest, vertices),
            "symmetry": lambda: self._asymmetry(vertices) if self._asymmetry else (0.0, 0.0),
            "start": lambda: ((moved**2).sum(axis=1).mean(), 2 * moved / (len(moved) * self._rest.size)),
        }
        for name, term in terms.items():
            if weights[name]:
                value, slope = term()
                loss, gradient = loss + weights[name] * float(value), gradient + weights[name] * slope
        return loss, gradient
