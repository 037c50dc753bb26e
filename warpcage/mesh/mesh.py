"""ClosedMesh: vertices, faces and topology of a triangle mesh, fans of faces, principal axes. All maps take one."""

from __future__ import annotations

import copy
import functools
import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import as_host_array, as_host_points
from ..core.devices import launch
from ..core.names import agreed, counted
from ..errors import InputError
from .surface import CELLS, PolygonFaces


@dataclass(frozen=True)
class FaceFans:
    """Triangles turned and ordered so that most begin with an edge of the one before.
    Around a vertex a, (a, c, d) follows (a, b, c), and so on."""

    faces: np.ndarray  # (f, 3) int32 indices of vertices
    order: np.ndarray  # (f,) int: which face of the mesh each of them is


def face_fans(faces: np.ndarray) -> FaceFans:
    """The triangles (f, 3) of a usable mesh in few fans, about f / 4."""
    faces = np.asarray(faces)
    # of the faces left around a: c and the face's number by b
    following: list[dict[int, tuple[int, int]]] = [{} for _ in range(int(faces.max()) + 1)]
    for f, (a, b, c) in enumerate(faces.tolist()):
        following[a][b], following[b][c], following[c][a] = (c, f), (a, f), (b, f)
    heap = [(-len(around), hub) for hub, around in enumerate(following) if around]  # those with most faces left first
    heapq.heapify(heap)
    turned, order = [], []
    while heap:
        count, hub = heapq.heappop(heap)
        around = following[hub]
        if -count != len(around):  # others have taken faces since
            if around:
                heapq.heappush(heap, (-len(around), hub))
            continue
        starts = set(around) - {c for c, _ in around.values()}
        while around:
            b = min(starts) if starts else min(around)
            starts.discard(b)
            while b in around:
                c, f = around.pop(b)
                del following[b][c], following[c][hub]
                turned.append((hub, b, c))
                order.append(f)
                b = c
    return FaceFans(np.array(turned, dtype=np.int32), np.array(order))


def prepared_fans(vertices: wp.array, faces: wp.array, size: float, out: wp.array | None = None) -> wp.array:
    """What closed forms read of faces (f,) vec3i in the order of `face_fans`, see the kernel `prepare_fans`: (2 f,)
    vec4. size: of the mesh, in the vertices' unit; out: filled, None makes a new array."""
    from ..kernels.mesh.fans import prepare_fans  # here, as files are read and written without kernels

    fans = wp.empty(2 * faces.size, dtype=wp.vec4, device=faces.device) if out is None else out  # pyright: ignore[reportArgumentType]
    launch(prepare_fans, faces.size, [vertices, faces, size], [fans], device=faces.device)
    return fans


def prepared_quads(vertices: wp.array, quads: wp.array, size: float, out: wp.array | None = None) -> wp.array:
    """What closed forms read of quads (q,) vec4i, see the kernel `prepare_quads`: (3 q,) vec4. size, out: as above."""
    from ..kernels.coordinates.quad_mean_value import prepare_quads

    planes = wp.empty(3 * quads.size, dtype=wp.vec4, device=quads.device) if out is None else out  # pyright: ignore[reportArgumentType]
    launch(prepare_quads, quads.size, [vertices, quads, size], [planes], device=quads.device)
    return planes


class MeshTopology:
    """Edges and connected parts of triangles (f, 3): they depend on faces alone, so all poses share them.
    Attributes list the faces, edges and vertices at fault, so that errors can name the first one."""

    def __init__(self, vertex_count: int, faces: ArrayLike, sizes: np.ndarray | None = None):
        # sizes (f,): faces are the corners (c,) of faces of so many
        self._faces = faces = np.asarray(faces, dtype=np.int64)
        sizes = np.full(len(faces), 3) if sizes is None else sizes
        face_count = len(sizes)
        starts = faces.reshape(-1)
        following = np.arange(1, len(starts) + 1)
        following[np.cumsum(sizes) - 1] -= sizes
        ends = starts[following]
        owner = np.repeat(np.arange(face_count), sizes)
        proper = starts != ends

        self.repeated_faces = np.unique(owner[~proper])  # (k,) faces that name a vertex twice
        self.used_vertices = np.unique(starts)  # (k,) vertices of some face, and of none, ascending
        self.unused_vertices = np.setdiff1d(np.arange(vertex_count), self.used_vertices)

        low, high = np.minimum(starts, ends)[proper], np.maximum(starts, ends)[proper]
        keys, edge, uses = np.unique(low * vertex_count + high, return_inverse=True, return_counts=True)
        # (e, 2): every edge once, lower index first; the loop of a face that repeats a vertex is no edge
        self.edges = np.stack([keys // vertex_count, keys % vertex_count], axis=1).astype(np.int32)
        forward = np.bincount(edge, weights=(starts < ends)[proper], minlength=len(keys))
        self.open_edges = self.edges[uses == 1]  # (k, 2), of one face only
        self.crowded_edges = self.edges[uses > 2]  # of three or more
        self.clashing_edges = self.edges[(uses == 2) & (forward != 1)]  # walked one way twice: one looks inward

        # corners next to each other around a vertex, and faces next to each other over an edge
        order = np.argsort(edge, kind="stable")
        same = np.flatnonzero(edge[order][1:] == edge[order][:-1])
        one, two = np.flatnonzero(proper)[order[same]], np.flatnonzero(proper)[order[same + 1]]
        self.parts, self.part_count = connected_parts(face_count, owner[one], owner[two])  # (f,) connected over edges
        self.pinched_vertices = self._pinched_vertices(vertex_count, starts, following, one, two)  # with several fans

    @staticmethod
    def _pinched_vertices(
        vertex_count: int, starts: np.ndarray, following: np.ndarray, one: np.ndarray, two: np.ndarray
    ) -> np.ndarray:
        """Vertices whose corners fall into several fans; one, two (k,): half-edges (corners) that share an edge."""
        after_one, after_two = following[one], following[two]
        # the half-edge's start corner meets whichever corner of the other face lies at the same vertex
        against = starts[one] == starts[after_two]
        first = np.concatenate([one, after_one])
        second = np.concatenate([np.where(against, after_two, two), np.where(against, two, after_two)])
        fan, _ = connected_parts(len(starts), first, second)
        fans = np.unique(starts * len(starts) + fan) // len(starts)  # the vertex of each fan
        return np.flatnonzero(np.bincount(fans, minlength=vertex_count) > 1)

    @functools.cached_property
    def problem(self) -> str:
        """What makes every mesh of these faces unusable: a line that follows its name, empty where nothing does."""
        if len(self.open_edges):
            a, b = self.open_edges[0]
            return (
                f"is open: {counted(len(self.open_edges), 'edge')} "
                f"{agreed(len(self.open_edges), 'has', 'have')} one face only, the first from "
                f"vertex {a} to {b}: close it"
            )
        if len(self.crowded_edges):
            a, b = self.crowded_edges[0]
            return (
                f"is not manifold: {counted(len(self.crowded_edges), 'edge')} "
                f"{agreed(len(self.crowded_edges), 'has', 'have')} more than two faces, the first from vertex "
                f"{a} to {b}"
            )
        if len(self.repeated_faces):
            return f"has degenerate faces: face {self.repeated_faces[0]} names a vertex twice"
        if len(self.pinched_vertices):
            return (
                "is not manifold: parts of it only touch at "
                f"{counted(len(self.pinched_vertices), 'vertex', 'vertices')}, the first "
                f"{self.pinched_vertices[0]}: split them"
            )
        if len(self.clashing_edges):
            a, b = self.clashing_edges[0]
            return (
                f"is wound inconsistently: the two faces at {counted(len(self.clashing_edges), 'edge')} "
                "clash, the first from "
                f"vertex {a} to {b}: flip faces until all are anticlockwise seen from outside"
            )
        return ""

    @functools.cached_property
    def fans(self) -> FaceFans:
        """The faces in the order in which closed forms are quickest. For usable meshes."""
        return face_fans(self._faces)

    @property
    def closed(self) -> bool:
        """Whether no edge is open."""
        return len(self.open_edges) == 0

    @property
    def manifold(self) -> bool:
        """Whether no edge has more than two faces and no vertex more than one fan."""
        return len(self.crowded_edges) == 0 and len(self.pinched_vertices) == 0

    @property
    def genus(self) -> int | None:
        """Number of handles over all parts (0 for a ball, 1 for a torus); None unless closed and manifold."""
        if not (self.closed and self.manifold) or len(self.repeated_faces):
            return None
        used = int(self.edges.max()) + 1 - np.count_nonzero(self.unused_vertices <= self.edges.max())
        euler = used - len(self.edges) + len(self.parts)
        return int(2 * self.part_count - euler) // 2


def connected_parts(count: int, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, int]:
    """Label the connected parts of a graph of `count` nodes and edges with ends first and second, (k,) each.
    Returns (count,) int labels, in the order of each part's first node, and the number of parts."""
    label = np.arange(count)
    while True:
        low = np.minimum(label[first], label[second])
        # hook the roots of both ends below the lower one, then flatten
        before = label.copy()
        np.minimum.at(label, before[first], low)
        np.minimum.at(label, before[second], low)
        while not np.array_equal(label, label[label]):
            label = label[label]
        if np.array_equal(label, before):
            break
    roots, labels = np.unique(label, return_inverse=True)
    return labels, len(roots)


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
    """A mesh that is meant to be closed and to look outward, immutable, of vertices (v, 3), world units, and faces,
    anticlockwise seen from outside: triangles (f, 3), or polygons; ValueError for arrays of other shapes or values."""

    # An open, inverted or tangled mesh is held, so that it can be described and mended; what computes on a mesh calls
    # `mesh.validity.require_usable` first. Messages call it a cage: users make one as a `warpcage.Cage`.

    # __weakref__: mesh/validity.py remembers what it found for as long as the mesh lives
    __slots__ = ("__weakref__", "_bounds", "_faces", "_object_name", "_operator", "_polygons", "_quads", "_surfaces",
                 "_topology", "_vertices")  # fmt: skip

    def __init__(self, vertices: ArrayLike, faces: ArrayLike | Sequence[Sequence[int]]):
        self._vertices = _checked_vertices(vertices)
        self._faces, self._polygons = _checked_faces(faces, self._vertices)
        self._surfaces: dict[int, Any] = {}  # by cells
        self._operator: Any = None
        self._quads: np.ndarray | None = None
        self._topology: MeshTopology | None = None
        self._bounds: np.ndarray | None = None
        self._object_name = ""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.vertices)} vertices, {self.face_count} faces, size {self.size:.4g})"

    @property
    def vertices(self) -> np.ndarray:
        """(v, 3) float64, world units, read-only."""
        return self._vertices

    @property
    def faces(self) -> np.ndarray:
        """(f, 3) int32, read-only: the triangles, or those between their own corners into which polygons are cut."""
        return self._faces

    @property
    def face_count(self) -> int:
        """How many faces there are, a polygon being one."""
        return len(self._faces) if self._polygons is None else len(self._polygons.sizes)

    @property
    def face_array(self) -> np.ndarray:
        """(f, n) int32, the faces as they came, as the constructor takes them.

        Behind the last corner of a face of fewer than n it is -1.
        """
        return self._faces if self._polygons is None else self._polygons.array

    @property
    def polygons(self) -> tuple[tuple[int, ...], ...]:
        """The faces as they came, each as the numbers of its vertices."""
        polygons = self._polygons
        faces = self._faces if polygons is None else np.split(polygons.corners, polygons.starts[1:])
        return tuple(tuple(face.tolist()) for face in faces)

    @property
    def polygon_faces(self) -> PolygonFaces | None:
        """How faces of more than three corners are cut and refined; None where all are triangles."""
        return self._polygons

    @property
    def surface(self: Mesh) -> Mesh:
        """The mesh of triangles that lies between the corners of all faces: this one where all are triangles.

        All corners of a face enter alike: one of four is the bilinear patch between them, to a sixteenth of its warp.
        The vertices of this mesh come first, in their order.
        """
        return self.refined()

    def refined(self: Mesh, cells: int = CELLS) -> Mesh:
        """As `surface`, with another number of cells.

        Args:
            cells: Along each edge of a face of more than three corners, 1 or 2: a face of four is the bilinear patch to
                a quarter or a sixteenth of its warp.

        Returns:
            The mesh of triangles.
        """
        if self._polygons is None:
            return self
        if cells not in self._surfaces:
            refined, fine = self._polygons.refined(cells), copy.copy(self)
            fine._polygons, fine._surfaces, fine._bounds = None, {}, None
            fine._faces, fine._operator, fine._quads = refined.faces, refined.operator, refined.quads
            fine._vertices = refined.operator @ self._vertices
            fine._vertices.setflags(write=False)
            fine._topology = refined.topology
            refined.topology = fine.topology
            self._surfaces[cells] = fine
        return self._surfaces[cells]

    @property
    def own_count(self) -> int:
        """How many of the vertices the others follow from by `operator`: all where there is none."""
        return len(self._vertices) if self._operator is None else self._operator.shape[1]

    @property
    def quads(self) -> np.ndarray | None:
        """Of a surface, (q, 4) int32: faces of four corners, triangles, whose last stands twice; None for others."""
        return self._quads

    @property
    def operator(self) -> Any:
        """Of a surface, (v, u) sparse: its vertices from those of the mesh that it is of; None for other meshes."""
        return self._operator

    @property
    def object_name(self) -> str:
        """The name of the object of a file that the mesh was read as, and is a pose of; "" for others."""
        return self._object_name

    @property
    def topology(self) -> MeshTopology:
        """Edges, holes and connected parts of the faces as they came, worked out once for a mesh and all its poses."""
        if self._topology is None:
            faces = (self._faces,) if self._polygons is None else (self._polygons.corners, self._polygons.sizes)
            self._topology = MeshTopology(len(self.vertices), *faces)
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
        """The three corners of each triangle of `surface`, (f, 3) each, relative to the middle of the bounding box."""
        surface = self.surface
        local = surface.vertices - self.bounds.mean(axis=0)
        return local[surface.faces[:, 0]], local[surface.faces[:, 1]], local[surface.faces[:, 2]]

    def part_volumes(self) -> np.ndarray:
        """(part_count,) float64 volume of each connected part, world units cubed: negative where it looks inward."""
        a, b, c = self.corners
        cones = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
        parts = self.topology.parts
        if self._polygons is not None:
            parts = parts[self._polygons.refined(CELLS).owner]
        return np.bincount(parts, weights=cones, minlength=self.topology.part_count)

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
            raise InputError(f"a cage of these faces needs {len(self.vertices)} vertices, got {len(checked)}")
        self._topology = self.topology  # worked out before it is shared
        posed = copy.copy(self)
        posed._vertices, posed._bounds, posed._surfaces = checked, None, {}
        return posed

    def named(self: Mesh, name: str) -> Mesh:
        """The same mesh with another `object_name`.

        Args:
            name: The name.

        Returns:
            The mesh with it.
        """
        renamed = copy.copy(self)
        renamed._object_name = name
        return renamed


def require_mesh(value: object, what: str, expected: str = "a Cage") -> None:
    """Refuse an object that is no mesh, by the message "`what` a Cage, got ..."."""
    if not isinstance(value, ClosedMesh):
        raise InputError(f"{what} {expected}, got {type(value).__name__}")


def _checked_vertices(vertices: ArrayLike) -> np.ndarray:
    """(v, 3) float64, a read-only copy."""
    checked = np.array(as_host_points(vertices, name="cage vertices"), dtype=np.float64, order="C", copy=True)
    checked.setflags(write=False)
    return checked


def _checked_faces(given: Any, vertices: np.ndarray) -> tuple[np.ndarray, PolygonFaces | None]:
    """(f, 3) int32, a read-only copy; and where a face has more than three corners, all of them as they came."""
    given = as_host_array(given, "cage faces")
    if isinstance(given, list | tuple) and len({np.size(face) for face in given}) > 1:
        rows = [np.asarray(face) for face in given]
        corners, sizes = np.concatenate([row.reshape(-1) for row in rows]), np.array([row.size for row in rows])
        if any(row.ndim != 1 for row in rows) or sizes.min() < 3:
            raise InputError(f"cage faces must be lists of at least 3 vertices each, got one of {sizes.min()}")
    else:
        array = np.asarray(given)
        if array.ndim != 2 or array.shape[1] < 3 or len(array) == 0:
            raise InputError(f"cage faces must be (f, 3) triangles or polygons, at least one, got {array.shape}")
        held = np.ones(array.shape, dtype=bool)
        held[:, 3:] = np.logical_and.accumulate(array[:, 3:] != -1, axis=1)  # what is behind the last corner
        corners, sizes = array[held], held.sum(axis=1)
        if (array[~held] != -1).any():
            row = int(np.flatnonzero(((array != -1) & ~held).any(axis=1))[0])
            raise InputError(f"cage face {row} is {array[row].tolist()}: -1 stands behind the last corner only")
    if corners.dtype.kind not in "iu":
        raise InputError(f"cage faces must be whole numbers, got {corners.dtype}")
    wrong = (corners < 0) | (corners >= len(vertices))
    if wrong.any():
        row = int(np.searchsorted(np.cumsum(sizes), np.flatnonzero(wrong)[0], side="right"))
        face = np.split(corners, np.cumsum(sizes)[:-1])[row].tolist()
        if not len(vertices):
            raise InputError("cage vertices must be (n, 3), at least one, got none")
        raise InputError(f"cage face {row} is {face}, indices must be 0 to {len(vertices) - 1}")
    corners = np.array(corners, dtype=np.int32)
    if (sizes == 3).all():
        faces = corners.reshape(-1, 3)
        faces.setflags(write=False)
        return faces, None
    polygons = PolygonFaces(vertices, corners, sizes)
    return polygons.triangles, polygons


#: The axes by name, the longest first.
OWN_AXES = ("long", "middle", "short")

#: Least ratio of the variances along two principal axes that are distinguished.
_MIN_RATIO = 1.05


def principal_axes(mesh: ClosedMesh) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of a mesh's surface, whatever the size of its faces: (3, 3) unit vectors, one a row, right-handed,
    and (3,) variances along them, world units squared, the longest first."""
    corners = np.stack(mesh.corners, axis=1)  # of its surface
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = max(float(areas.sum()), 1e-300)
    corners = corners - (areas[:, None] * corners.mean(axis=1)).sum(axis=0) / total
    middles = corners.mean(axis=1)
    # covariance of the area: A / 12 (9 m m' + a a' + b b' + c c') for a face of area A, corners a, b, c, middle m
    second = 9.0 * np.einsum("f,fi,fj->ij", areas, middles, middles)
    second += np.einsum("f,fki,fkj->ij", areas, corners, corners)
    variances, vectors = np.linalg.eigh(second / (12.0 * total))
    axes = vectors.T[::-1].copy()
    for axis in axes[:2]:  # towards the positive side of the nearest world axis
        axis *= np.sign(axis[np.argmax(np.abs(axis))])
    axes[2] = np.cross(axes[0], axes[1])
    return axes, variances[::-1]


def own_axis(mesh: ClosedMesh, name: str) -> str | np.ndarray:
    """A mesh's own axis (3,) by its name: "long", "middle" or "short", "-long" against it; other names are left as they
    are."""
    plain = name[1:] if name[:1] in ("-", "+") else name
    if plain not in OWN_AXES:
        return name
    axes, variances = principal_axes(mesh)
    index = OWN_AXES.index(plain)
    for one in (index - 1, index):
        if 0 <= one < 2 and variances[one] < _MIN_RATIO * variances[one + 1]:
            raise InputError(
                f"the cage has no {plain!r} axis: it reaches as far in other directions; name x, y, z or a direction"
            )
    return -axes[index] if name[0] == "-" else axes[index]
