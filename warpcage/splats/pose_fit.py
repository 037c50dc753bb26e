"""What a pose of a cage is made of: the map that fits it best, and what that leaves of each vertex and normal."""

from __future__ import annotations

import numpy as np

from ..mesh.faces import StretchTarget, column_cross, column_dot, face_edges, stretched_normals
from ..mesh.mesh import ClosedMesh

#: Rows of x, y, z, x, y, of which cross products take slices.
_AROUND = np.array([0, 1, 2, 0, 1])


class PoseFit:
    """Fits poses of a cage, for which every pose waits on the host: what the cage at rest says is worked out once.
    origin: (3,) world point that everything is relative to."""

    def __init__(self, rest: ClosedMesh, coordinates: str, origin: np.ndarray):
        self._origin, self._size = origin, rest.size
        self._local = rest.vertices - origin
        self._green = coordinates == "green"
        # Numbers r_j of a pose: a vertex each, for Green coordinates then a face each.
        self.row_count = len(rest.vertices) + (len(rest.faces) if self._green else 0)
        used = np.ones(len(rest.vertices), dtype=bool)
        if not self._green:
            used[rest.topology.unused_vertices] = False  # they may lie anywhere
        self._mean = used / used.sum()
        self._centre = self._mean @ self._local
        spread = np.where(used[:, None], self._local - self._centre, 0.0)
        self._spread, self._square_sum = spread, (spread**2).sum()
        # directions that the vertices of an almost flat cage do not span are left out
        self._inverse = np.linalg.pinv(spread / self._size, rcond=1e-9) / self._size
        if self._green:
            self._normals = rest.size * stretched_normals(rest, StretchTarget.of(rest))
            self._first, self._second, self._third = rest.faces.T.astype(np.intp)
            u, v = face_edges(rest)
            cross = column_cross(u, v)
            scale = 0.5 * rest.size**2 / column_dot(cross, cross)
            self._ss, self._tt = scale * column_dot(v, v), scale * column_dot(u, u)
            self._st = -2.0 * scale * column_dot(u, v)

    def targets(self, deformed: ClosedMesh, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fit a pose: A - 1 (3, 3) and t (3,) float64, relative to the origin, and in `out` (v + row_count, 3) float32
        the posed vertices, relative to the origin, and then r_j."""
        count = len(self._local)
        posed = deformed.vertices - self._origin
        middle = self._mean @ posed
        around = posed - middle
        if self._green:
            matrix = nearest_similarity(self._spread, around, self._square_sum)
            # r_j of stretched normals are times the size.
            out[2 * count :] = (self._tilts(around) - matrix @ self._normals).T
        else:
            matrix = (self._inverse @ around).T
        out[:count] = posed
        # relative to the centres, so that nothing is lost far from the origin
        out[count : 2 * count] = around - (self._local - self._centre) @ matrix.T
        return matrix - np.eye(3), middle - matrix @ self._centre

    def _tilts(self, vertices: np.ndarray) -> np.ndarray:
        """(3, f) stretched normals of posed faces times the size; as `stretched_normals`, in few array calls."""
        columns = vertices.T.take(_AROUND, axis=0)
        first = columns.take(self._first, axis=1)
        s = columns.take(self._second, axis=1) - first  # (5, f)
        t = columns.take(self._third, axis=1) - first
        normals = s[1:4] * t[2:5] - s[2:5] * t[1:4]
        ss, st, tt = (np.einsum("if,if->f", a[:3], b[:3]) for a, b in ((s, s), (s, t), (t, t)))
        energy = np.maximum(self._ss * ss + self._st * st + self._tt * tt, 0.0)
        squared = np.einsum("if,if->f", normals, normals)
        normals *= np.sqrt(np.divide(energy, squared, out=np.zeros_like(squared), where=squared > 0.0))
        return normals


def nearest_similarity(a: np.ndarray, b: np.ndarray, square_sum: float) -> np.ndarray:
    """The rotation times a scale (3, 3) that takes points a (v, 3) around 0 nearest to b; square_sum: of a."""
    # Umeyama 1991.
    u, s, vt = np.linalg.svd(b.T @ a)
    matrix = u @ vt
    if np.linalg.det(matrix) < 0.0:  # it would turn over
        u[:, 2] *= -1.0
        s[2] *= -1.0
        matrix = u @ vt
    return (s.sum() / square_sum) * matrix


def fit_similarity(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The similarity that takes points (v, 3) nearest to others: rotation times scale (3, 3) and offset (3,)."""
    centre, middle = source.mean(axis=0), target.mean(axis=0)
    a = source - centre
    matrix = nearest_similarity(a, target - middle, (a**2).sum())
    return matrix, middle - matrix @ centre
