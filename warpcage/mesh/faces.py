"""Edges, normals and stretch of all faces of a mesh, as columns (3, f): every pose needs them; rows made one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .mesh import ClosedMesh

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def face_edges(mesh: ClosedMesh, faces: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """From the first corner of each face (None: the mesh's own) to its second and to its third: two (3, f) float64,
    world units."""
    lower, upper = mesh.bounds
    vertices = (mesh.vertices - 0.5 * (lower + upper)).T
    first, second, third = (mesh.faces if faces is None else faces).T
    a = vertices.take(first, axis=1)  # take needs a fraction of the time of an index
    return vertices.take(second, axis=1) - a, vertices.take(third, axis=1) - a


def column_cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of columns (3, n), or (3, ..., n)."""
    return a.take(_NEXT, axis=0) * b.take(_LAST, axis=0) - a.take(_LAST, axis=0) * b.take(_NEXT, axis=0)


def column_dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products of columns (3, n), or (3, ..., n): (n,), or (..., n)."""
    return np.einsum("i...,i...->...", a, b)


def face_area(mesh: ClosedMesh) -> float:
    """The area of all faces, world units squared."""
    cross = column_cross(*face_edges(mesh))
    return 0.5 * float(np.sqrt(column_dot(cross, cross)).sum())


@dataclass(frozen=True)
class StretchTarget:
    """What `stretched_normals` needs of the faces that others are stretched to."""

    normals: np.ndarray  # (3, f) unit normals, zero for a face without area
    ss: np.ndarray  # (f,) s . s, world units squared; s, t: the two edges from the first corner of each face
    st: np.ndarray
    tt: np.ndarray

    @classmethod
    def of(cls, mesh: ClosedMesh, faces: np.ndarray | None = None) -> StretchTarget:
        """The target that the faces of a mesh are, or other faces (f, 3) on its vertices."""
        s, t = face_edges(mesh, faces)
        normals = column_cross(s, t)
        length = np.sqrt(column_dot(normals, normals))
        normals *= np.divide(1.0, length, out=np.zeros_like(length), where=length > 0.0)
        return cls(normals, column_dot(s, s), column_dot(s, t), column_dot(t, t))


def stretched_normals(source: ClosedMesh, target: StretchTarget) -> np.ndarray:
    """Unit normals of the target times the stretch of each face from the source to it: (3, f) float64; both have the
    same faces."""
    u, v = face_edges(source)
    cross = column_cross(u, v)
    # Lipman et al. 2008, 3-D, with u, v two edges of a face of area A in the source and s, t the same in the target:
    # sqrt(|s|^2 |v|^2 - 2 (s.t)(u.v) + |t|^2 |u|^2) / (sqrt(8) A)
    energy = target.ss * column_dot(v, v) - 2.0 * target.st * column_dot(u, v) + target.tt * column_dot(u, u)
    return target.normals * np.sqrt(np.maximum(0.5 * energy, 0.0) / column_dot(cross, cross))


def joined_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (v, n) that are exactly alike made one, in the order of the first of each.
    Returns (u,) the rows that stay, and (v,) the new number of each row."""
    # Programs split vertices where normals, places in a texture or materials change.
    _, first, place = np.unique(rows + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    return first[order], number[place.reshape(-1)]
