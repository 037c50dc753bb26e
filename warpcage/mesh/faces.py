"""Edges, normals and stretch of all faces of a cage at once, as columns (3, f), in few array calls: poses need them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def face_edges(cage, faces=None) -> tuple[np.ndarray, np.ndarray]:
    """From the first corner of each face to its second and third: (3, f) float64 each, world units. faces (f, 3):
    instead of the cage's own."""
    lower, upper = cage.bounds
    vertices = (cage.vertices - 0.5 * (lower + upper)).T
    first, second, third = (cage.faces if faces is None else faces).T
    a = vertices[:, first]
    return vertices[:, second] - a, vertices[:, third] - a


def column_cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of the columns of two (3, n)."""
    return a[_NEXT] * b[_LAST] - a[_LAST] * b[_NEXT]


def column_dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (n,) of the columns of two (3, n)."""
    return np.einsum("in,in->n", a, b)


def face_area(cage) -> float:
    """Area of all faces, world units squared."""
    cross = column_cross(*face_edges(cage))
    return 0.5 * float(np.sqrt(column_dot(cross, cross)).sum())


@dataclass(frozen=True)
class StretchTarget:
    """What `stretched_normals` needs of the faces that are stretched to: unit normals (3, f), zero where there is no
    area, and products (f,) of the two edges s, t from the first corner of each."""

    normals: np.ndarray
    ss: np.ndarray
    st: np.ndarray
    tt: np.ndarray

    @classmethod
    def of(cls, cage, faces=None) -> StretchTarget:
        """faces (f, 3): instead of the cage's own."""
        s, t = face_edges(cage, faces)
        normals = column_cross(s, t)
        length = np.sqrt(column_dot(normals, normals))
        normals *= np.divide(1.0, length, out=np.zeros_like(length), where=length > 0.0)
        return cls(normals, column_dot(s, s), column_dot(s, t), column_dot(t, t))


def stretched_normals(source, target: StretchTarget) -> np.ndarray:
    """The target's unit normals times how much each face is stretched from the Cage `source`: (3, f). Stretch (Lipman
    et al. 2008, 3-D), with u, v two edges of a face of area A in the source and s, t the same in the target:
    sqrt(|s|^2 |v|^2 - 2 (s.t)(u.v) + |t|^2 |u|^2) / (sqrt(8) A).
    """
    u, v = face_edges(source)
    cross = column_cross(u, v)
    energy = target.ss * column_dot(v, v) - 2.0 * target.st * column_dot(u, v) + target.tt * column_dot(u, u)
    return target.normals * np.sqrt(np.maximum(0.5 * energy, 0.0) / column_dot(cross, cross))
