"""ClosedMesh: vertices, faces and topology of a triangle mesh. All maps take one."""

from __future__ import annotations

import copy
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import as_host_points, is_device_array
from .topology import MeshTopology

Mesh = TypeVar("Mesh", bound="ClosedMesh")


class TriangleMesh(Protocol):
    """Anything with vertices and triangles: a trimesh.Trimesh, a ClosedMesh, or the like."""

    @property
    def vertices(self) -> ArrayLike:
        """(v, 3) world units."""
        ...

    @property
    def faces(self) -> ArrayLike:
        """(f, 3) indices of vertices."""
        ...


class ClosedMesh:
    """A triangle mesh that is meant to be closed and to look outward; immutable.

    The constructor refuses only what cannot be held. It holds an open, inverted or tangled mesh, so that the mesh can
    be described and mended. What computes on it calls `warpcage.mesh.usable.require_usable` first.

    Messages call it a cage: users make one as a `warpcage.Cage`.

    Args:
        vertices: (v, 3) finite floats, world units. They are kept as float64 in the order given.
        faces: (f, 3) whole numbers, indices of vertices, anticlockwise seen from outside. They are kept as int32.

    Raises:
        ValueError: For other shapes, values that are not finite, or indices that point nowhere.
    """

    # __weakref__: mesh/usable.py remembers what it found for as long as the mesh lives
    __slots__ = ("_vertices", "_faces", "_topology", "_bounds", "__weakref__")

    def __init__(self, vertices: ArrayLike, faces: ArrayLike):
        self._vertices = _checked_vertices(vertices)
        self._faces = _checked_faces(faces, len(self._vertices))
        self._topology: MeshTopology | None = None
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
        """Edges, holes and connected parts, worked out once for a mesh and all its poses."""
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
        """Enclosed volume, world units cubed: negative where the faces look inward, meaningless for an open mesh."""
        return float(self.part_volumes().sum())

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First, second and third corner of each face, (f, 3) each, relative to the middle of the bounding box."""
        local = self.vertices - self.bounds.mean(axis=0)
        return local[self.faces[:, 0]], local[self.faces[:, 1]], local[self.faces[:, 2]]

    def part_volumes(self) -> np.ndarray:
        """The volume of each connected part.

        Returns:
            (part_count,) float64, world units cubed: negative where the faces of the part look inward.
        """
        a, b, c = self.corners
        cones = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
        return np.bincount(self.topology.parts, weights=cones, minlength=self.topology.part_count)

    def with_vertices(self: Mesh, vertices: ArrayLike) -> Mesh:
        """A mesh of the same class with the same faces and other vertices.

        Args:
            vertices: (v, 3) finite floats, world units, in the order of this mesh.

        Returns:
            The other mesh. It shares faces and topology with this one.

        Raises:
            ValueError: For another number of vertices, another shape or values that are not finite.
        """
        checked = _checked_vertices(vertices)
        if len(checked) != len(self.vertices):
            raise ValueError(f"with_vertices needs {len(self.vertices)} vertices as the cage has, got {len(checked)}")
        self._topology = self.topology  # worked out before it is shared
        posed = copy.copy(self)
        posed._vertices, posed._bounds = checked, None
        return posed


def require_mesh(value: object, what: str) -> None:
    """Refuse an object that is no mesh; the message begins with `what`: "`what` a Cage, got ..."."""
    if not isinstance(value, ClosedMesh):
        raise ValueError(f"{what} a Cage, got {type(value).__name__}")


def _checked_vertices(vertices: ArrayLike) -> np.ndarray:
    """(v, 3) float64, a read-only copy."""
    checked = np.array(as_host_points(vertices, name="cage vertices"), dtype=np.float64, order="C", copy=True)
    checked.setflags(write=False)
    return checked


def _checked_faces(given: Any, vertex_count: int) -> np.ndarray:
    """(f, 3) int32, a read-only copy."""
    faces = np.asarray(given.numpy() if is_device_array(given) and hasattr(given, "numpy") else given)
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
