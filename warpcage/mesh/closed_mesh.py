"""ClosedMesh: vertices, faces and topology of a triangle mesh, which all maps take."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from ..core.arrays import as_host_points, is_device_array
from .topology import MeshTopology

Mesh = TypeVar("Mesh", bound="ClosedMesh")


class ClosedMesh:
    """A triangle mesh that is meant to be closed and to look outward; immutable.

    vertices: (v, 3) finite floats in world units, kept as float64 in the order given.
    faces: (f, 3) whole numbers, vertex indices, kept as int32; anticlockwise seen from outside.

    The constructor refuses what cannot be held (other shapes, values that are not finite, indices that point nowhere)
    with a ValueError. An open, inverted or tangled mesh can be held, so that it can be described and mended; what
    computes on it calls `warpcage.mesh.usable.require_usable` first.
    """

    __slots__ = ("_vertices", "_faces", "_topology", "problem", "_bounds")

    def __init__(self, vertices, faces):
        self._set(_checked_vertices(vertices), None, None)
        self._faces = _checked_faces(faces, len(self._vertices))

    def _set(self, vertices, faces, topology):
        vertices.setflags(write=False)
        self._vertices, self._faces, self._topology = vertices, faces, topology
        self.problem: str | None = None  # what mesh.usable found
        self._bounds: np.ndarray | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.vertices)} vertices, {len(self.faces)} faces, size {self.size:.4g})"

    @property
    def vertices(self) -> np.ndarray:
        """(v, 3) float64, world units, read-only."""
        return self._vertices

    @property
    def faces(self) -> np.ndarray:
        """(f, 3) int32, read-only."""
        return self._faces

    @property
    def topology(self) -> MeshTopology:
        """Edges, holes and connected parts; worked out once for a cage and all its poses."""
        if self._topology is None:
            self._topology = MeshTopology(len(self.vertices), self.faces)
        return self._topology

    @property
    def edges(self) -> np.ndarray:
        """(e, 2) int32: every edge once, lower index first."""
        return self.topology.edges

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64: lowest and highest corner of the bounding box of the vertices that faces use; read-only."""
        if self._bounds is None:
            used = self.vertices
            if len(self.topology.unused_vertices):
                used = used[self.topology.used_vertices]
            bounds = np.empty((2, 3))
            used.min(axis=0, out=bounds[0])
            used.max(axis=0, out=bounds[1])
            bounds.setflags(write=False)
            self._bounds = bounds
        return self._bounds

    @property
    def size(self) -> float:
        """Longest side of the bounding box, world units."""
        lower, upper = self.bounds
        return float((upper - lower).max())

    @property
    def volume(self) -> float:
        """Enclosed volume, world units cubed; negative where the faces look inward, meaningless on an open cage."""
        return float(self.part_volumes().sum())

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First, second and third corner of each face, (f, 3) each, relative to the middle of the bounding box."""
        local = self.vertices - self.bounds.mean(axis=0)
        return local[self.faces[:, 0]], local[self.faces[:, 1]], local[self.faces[:, 2]]

    def part_volumes(self) -> np.ndarray:
        """(part_count,) float64: signed volume of each connected part."""
        a, b, c = self.corners
        cones = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
        return np.bincount(self.topology.parts, weights=cones, minlength=self.topology.part_count)

    def with_vertices(self: Mesh, vertices) -> Mesh:
        """A mesh of the same kind with the same faces and these vertices (v, 3). Raises ValueError for another count or
        NaN."""
        vertices = _checked_vertices(vertices)
        if len(vertices) != len(self.vertices):
            raise ValueError(f"with_vertices needs {len(self.vertices)} vertices as the cage has, got {len(vertices)}")
        posed = object.__new__(type(self))
        posed._set(vertices, self.faces, self.topology)
        return posed


def require_mesh(value, what: str) -> None:
    """Raise a ValueError, "`what` a Cage, got ...", unless `value` is a ClosedMesh."""
    if not isinstance(value, ClosedMesh):
        raise ValueError(f"{what} a Cage, got {type(value).__name__}")


def _checked_vertices(vertices) -> np.ndarray:
    vertices = as_host_points(vertices, name="cage vertices")
    return np.array(vertices, dtype=np.float64, order="C", copy=True)


def _checked_faces(faces, vertex_count: int) -> np.ndarray:
    faces = np.asarray(faces.numpy() if is_device_array(faces) and hasattr(faces, "numpy") else faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise ValueError(f"cage faces must be (f, 3) triangles, at least one, got {faces.shape}")
    if faces.dtype.kind not in "iu":
        raise ValueError(f"cage faces must be whole numbers, got {faces.dtype}")
    wrong = (faces < 0) | (faces >= vertex_count)
    if wrong.any():
        row = int(np.flatnonzero(wrong.any(axis=1))[0])
        raise ValueError(f"cage face {row} is {faces[row].tolist()}, indices must be 0 to {vertex_count - 1}")
    faces = np.array(faces, dtype=np.int32, order="C", copy=True)
    faces.setflags(write=False)
    return faces
