"""Mean value weights in float64 on the host, for a few points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..mesh.mesh import ClosedMesh

#: Numbers that are worked on at once: edges or faces times points. With more, in processes that have freed no large
#: array before, the C library gives memory back after each chunk, and the page faults take as long as the work.
CHUNK = 3 << 11

#: A face whose corners, seen from a point, span less than this (the sine of a solid corner) lies in one plane with it.
FLAT = 1e-10


def host_mean_value_weights(points: np.ndarray, mesh: ClosedMesh) -> np.ndarray:
    """Mean value coordinates (n, v) float64, of sum 1 in each row, of points (n, 3) off a usable mesh's surface."""
    from scipy import sparse

    points = np.asarray(points, dtype=np.float64)
    edges, of_face, sign = _face_edges(mesh)
    faces = mesh.faces.astype(np.int64)
    corner = np.arange(3 * len(faces))
    gather = sparse.csr_matrix(
        (np.ones(len(corner)), (faces.T.reshape(-1), corner)), shape=(len(mesh.vertices), len(corner))
    )
    weights = np.empty((len(points), len(mesh.vertices)))
    step = max(1, CHUNK // len(edges))
    for first in range(0, len(points), step):
        part = points[first : first + step]
        found = gather @ _corner_weights(part, mesh.vertices, faces, edges, of_face, sign)
        weights[first : first + step] = (found / found.sum(axis=0)).T
    return weights


def mean_value_gradients(points: np.ndarray, mesh: ClosedMesh, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean value coordinates (n, v) and their gradients (n, 3, v), per world unit, by forward differences.
    Points (n, 3) are farther than `step`, the length of the differences, from the surface; world units."""
    stencil = points[:, None] + np.concatenate([np.zeros((1, 3)), step * np.eye(3)])
    weights = host_mean_value_weights(stencil.reshape(-1, 3), mesh).reshape(len(points), 4, -1)
    return weights[:, 0], (weights[:, 1:] - weights[:, :1]) / step


def _face_edges(mesh: ClosedMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (e, 2); of each face those from corner k on, (3, f); and whether they run so, (3, f, 1) 1 or -1."""
    faces = mesh.faces.astype(np.int64)
    directed = np.stack([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    ends = np.sort(directed, axis=2)
    keys = ends[..., 0] * len(mesh.vertices) + ends[..., 1]
    unique, number = np.unique(keys, return_inverse=True)
    edges = np.stack(np.divmod(unique, len(mesh.vertices)), axis=1)
    sign = np.where(directed[..., 0] == ends[..., 0], 1.0, -1.0)
    return edges, number.reshape(keys.shape), sign[..., None]


def _corner_weights(
    points: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    edges: np.ndarray,
    of_face: np.ndarray,
    sign: np.ndarray,
) -> np.ndarray:
    """(3 f, n) weights of the corners of all faces, first corners first."""
    # With u_i unit vectors to a face's corners, theta_ij the angles and n_ij the unit normals of their planes, and the
    # mean vector m = sum_ij theta_ij n_ij / 2, corner i weighs m . (u_j x u_k) / (det(u_i, u_j, u_k) |v_i - x|) (Ju,
    # Schaefer and Warren 2005; Floater, Kos and Reimers 2005); none where a face is in plane with x, off it.
    # x, y and z are arrays of their own, so that none is stacked
    ray = [vertices[:, k, None] - points[None, :, k] for k in range(3)]  # of (v, n)
    length = np.sqrt(_dot(ray, ray))
    for part in ray:
        part /= length
    a, b = _taken(ray, edges[:, 0]), _taken(ray, edges[:, 1])
    cross = _cross(a, b)  # of (e, n)
    sine = np.sqrt(_dot(cross, cross))
    share = np.arctan2(sine, _dot(a, b))
    share /= np.maximum(sine, 1e-300, out=sine)
    share *= 0.5
    planes = [_taken(cross, of_face[k]) for k in range(3)]
    for plane, signs in zip(planes, sign, strict=True):
        for part in plane:
            part *= signs
    shares = [share.take(of_face[k], axis=0) for k in range(3)]
    mean = [_dot(shares, [plane[k] for plane in planes]) for k in range(3)]
    determinant = _dot(_taken(ray, faces[:, 0]), planes[1])
    flat = np.abs(determinant) < FLAT
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, determinant))
    corners = np.empty((3, *inverse.shape))
    for k in range(3):
        np.multiply(_dot(mean, planes[(k + 1) % 3]), inverse, out=corners[k])
        corners[k] /= length.take(faces[:, k], axis=0)
    return corners.reshape(-1, len(points))


def _taken(parts: Sequence[np.ndarray], rows: np.ndarray) -> list[np.ndarray]:
    return [part.take(rows, axis=0) for part in parts]


def _dot(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> np.ndarray:
    total = a[0] * b[0]
    total += a[1] * b[1]
    total += a[2] * b[2]
    return total


def _cross(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> list[np.ndarray]:
    parts = []
    for one, two in ((1, 2), (2, 0), (0, 1)):
        part = a[one] * b[two]
        part -= a[two] * b[one]
        parts.append(part)
    return parts
