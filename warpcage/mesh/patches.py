"""Some faces of a mesh, triangles or polygons: their triangles, normals, edges and vertices."""

from __future__ import annotations

import numpy as np

from .mesh import ClosedMesh
from .surface import CELLS


def triangles_of(mesh: ClosedMesh, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 3, 3), world units, of the triangles of some faces (k,), around the middles of those of more corners.
    And which of these faces each is of, (n,)."""
    polygons = mesh.polygon_faces
    if polygons is None:
        return mesh.vertices[mesh.faces[faces]], np.arange(len(faces))
    refined = polygons.refined(1)
    owner = _places(mesh, faces)[refined.owner]
    return mesh.refined(1).vertices[refined.faces[owner >= 0]], owner[owner >= 0]


def normals_of(mesh: ClosedMesh, faces: np.ndarray) -> np.ndarray:
    """(k, 3) normals of some faces (k,), outward, as long as twice their areas seen along them."""
    corners, owner = triangles_of(mesh, faces)
    normals = np.zeros((len(faces), 3))
    np.add.at(normals, owner, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return normals


def edges_of(mesh: ClosedMesh, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First and last vertex of each edge of some faces (k,), int64, and which of these faces it is of, (n,) each."""
    polygons = mesh.polygon_faces
    if polygons is None:
        rows = mesh.faces[faces].astype(np.int64)
        return rows.reshape(-1), np.roll(rows, -1, axis=1).reshape(-1), np.repeat(np.arange(len(faces)), 3)
    start, end, _ = polygons.fanned().T
    owner = _places(mesh, faces)[polygons.owner]
    return start[owner >= 0], end[owner >= 0], owner[owner >= 0]


def vertices_of(mesh: ClosedMesh, faces: np.ndarray) -> np.ndarray:
    """The vertices (k,), ascending, that some faces (n,) have."""
    polygons = mesh.polygon_faces
    if polygons is None:
        return np.unique(mesh.faces[faces])
    return np.unique(polygons.corners[np.isin(polygons.owner, faces)])


def faces_within(mesh: ClosedMesh, chosen: np.ndarray) -> np.ndarray:
    """The faces (k,), ascending, of which all vertices are chosen, by (v,) bool."""
    polygons = mesh.polygon_faces
    if polygons is None:
        return np.flatnonzero(chosen[mesh.faces].all(axis=1))
    return np.flatnonzero(np.logical_and.reduceat(chosen[polygons.corners], polygons.starts))


def faces_of(mesh: ClosedMesh, triangles: np.ndarray, cells: int = CELLS) -> np.ndarray:
    """The faces (k,), ascending, that some triangles (n,), ascending, of `refined(cells)` are of."""
    polygons = mesh.polygon_faces
    return triangles if polygons is None else np.unique(polygons.refined(cells).owner[triangles])


def face_middles(mesh: ClosedMesh) -> np.ndarray:
    """(f, 3) means of the corners of each face, world units."""
    polygons = mesh.polygon_faces
    if polygons is None:
        return mesh.vertices[mesh.faces].mean(axis=1)
    sums = np.add.reduceat(mesh.vertices[polygons.corners], polygons.starts, axis=0)
    return sums / polygons.sizes[:, None]


def _places(mesh: ClosedMesh, faces: np.ndarray) -> np.ndarray:
    """(f,) where each face of a mesh is among some (k,); -1 for others."""
    places = np.full(mesh.face_count, -1)
    places[faces] = np.arange(len(faces))
    return places
