"""What a fit of a pose moves: the whole cage, a few smooth shapes of it, or all vertices."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ..core.checks import real_array
from ..core.names import checked_choice
from ..errors import InputError
from ..mesh.mesh import ClosedMesh

#: Smooth shapes of "handles", the whole cage's motion among them.
HANDLES = 16

#: What `parameters` may name.
PARAMETERS = ("rigid", "affine", "handles", "vertices")

#: Below this angle, radians, the derivative of a rotation is that of a small one.
SMALL_ANGLE = 1e-6


class Motion(Protocol):
    """Vertices of the cage as a function of some numbers, zero at its start."""

    count: int

    def vertices(self, numbers: np.ndarray) -> np.ndarray: ...

    def pulled(self, numbers: np.ndarray, by_vertices: np.ndarray) -> np.ndarray: ...


class RigidMotion:
    """A rotation vector about the middle, radians, and a shift in units of the size."""

    count = 6

    def __init__(self, start: np.ndarray, size: float):
        self._center, self._size = start.mean(axis=0), size
        self._offsets = start - self._center

    def vertices(self, numbers: np.ndarray) -> np.ndarray:
        """(v, 3) where the numbers (6,) take the vertices."""
        turned = self._turned(numbers[:3])
        return self._center + self._size * numbers[3:] + turned

    def pulled(self, numbers: np.ndarray, by_vertices: np.ndarray) -> np.ndarray:
        """Gradient by the numbers (6,), from that by the vertices (v, 3)."""
        turned = self._turned(numbers[:3])
        torque = np.cross(turned, by_vertices).sum(axis=0)
        return np.concatenate([_left_jacobian(numbers[:3]).T @ torque, self._size * by_vertices.sum(axis=0)])

    def _turned(self, vector: np.ndarray) -> np.ndarray:
        """The offsets (v, 3) from the middle after a turn."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(vector).apply(self._offsets)


def _left_jacobian(vector: np.ndarray) -> np.ndarray:
    """(3, 3) which small turn a change of a rotation vector adds after it (Chirikjian 2011, Eq. 10.86)."""
    angle = np.linalg.norm(vector)
    if angle < SMALL_ANGLE:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + (1 - np.cos(angle)) / angle * cross + (1 - np.sin(angle) / angle) * cross @ cross


class LinearMotion:
    """The start plus shares (v, k) of k vectors; or plus k displacements (k, v, 3), each times a number."""

    def __init__(self, start: np.ndarray, basis: np.ndarray):
        self._start, self._basis = start, basis
        self.count = 3 * basis.shape[1] if basis.ndim == 2 else len(basis)

    def vertices(self, numbers: np.ndarray) -> np.ndarray:
        """(v, 3) where the numbers take the vertices."""
        if self._basis.ndim == 2:
            return self._start + self._basis @ numbers.reshape(-1, 3)
        return self._start + np.tensordot(numbers, self._basis, 1)

    def pulled(self, numbers: np.ndarray, by_vertices: np.ndarray) -> np.ndarray:
        """Gradient by the numbers, from that by the vertices (v, 3)."""
        if self._basis.ndim == 2:
            return (self._basis.T @ by_vertices).ravel()
        return np.tensordot(self._basis, by_vertices, 2)


def affine_basis(start: np.ndarray, size: float) -> np.ndarray:
    """(v, 4) shares of an affine map of the vertices: their places, and one."""
    return np.column_stack([start - start.mean(axis=0), np.full(len(start), size)])


def smooth_basis(cage: ClosedMesh, count: int | None = None) -> np.ndarray:
    """(v, k) the smoothest shapes over the cage's edges, all where `count` is None; rough ones are shorter."""
    # Eigenvectors of the graph's Laplacian (manifold harmonics, Vallet and Levy 2008), each divided by the root of its
    # eigenvalue as in preconditioned descent (Nicolet, Jacobson and Jakob 2021): a step then is a smooth motion first.
    first, second = cage.edges.T
    lengths = np.linalg.norm(cage.vertices[first] - cage.vertices[second], axis=1)
    vertices = len(cage.vertices)
    matrix = np.zeros((vertices, vertices))
    np.add.at(matrix, (np.r_[first, second], np.r_[second, first]), -np.tile(lengths.mean() / lengths, 2))
    matrix[np.diag_indices(vertices)] = -matrix.sum(axis=1)
    values, vectors = np.linalg.eigh(matrix)
    weights = 1.0 / np.sqrt(1.0 + np.maximum(values, 0.0) / values[min(4, vertices - 1)])
    return cage.size * np.sqrt(vertices) * (vectors * weights)[:, :count]


def checked_parameters(parameters: Any, rest: ClosedMesh) -> str | np.ndarray:
    """A name of `PARAMETERS`, or a basis (v, k) or (k, v, 3) as float64, each of which moves some vertex by the size of
    the cage."""
    if isinstance(parameters, str):
        return checked_choice(parameters, "parameters", PARAMETERS)
    basis, vertex_count = real_array(parameters, "parameters"), len(rest.vertices)
    is_shares = basis.ndim == 2 and basis.shape[0] == vertex_count and basis.shape[1]
    is_shapes = basis.ndim == 3 and basis.shape[1:] == (vertex_count, 3) and basis.shape[0]
    if not (is_shares or is_shapes) or not np.isfinite(basis).all():
        raise InputError(
            f"parameters must be a name or finite numbers ({vertex_count}, k) or (k, {vertex_count}, 3), "
            f"got {basis.shape}"
        )
    lengths = np.abs(basis) if is_shares else np.linalg.norm(basis, axis=2, keepdims=True)
    largest = lengths.max(axis=0 if is_shares else 1, keepdims=True)
    if not largest.any():
        raise InputError("parameters are a basis of zeros, which moves nothing")
    return rest.size * basis / np.where(largest > 0, largest, 1)
