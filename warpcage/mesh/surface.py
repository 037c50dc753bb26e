"""Faces of more than three corners, and the triangles that solvers see of them: all corners of a face enter alike."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import warp as wp

from ..core.devices import launch
from ..kernels.coordinates import refined
from .polygons import concave_polygons

#: Cells along each edge of a face, of surfaces where nothing else is asked for.
CELLS = 2


def in_strips(quads: list[list[int]]) -> np.ndarray:
    """Quads (f, 4) int32 in another order, and turned, so that many begin with the edge opposite to that of the quad
    before: maps work it out once."""
    sides = {
        (a, b): (f, k)
        for f, quad in enumerate(quads)
        if quad[2] != quad[3]  # triangles are not turned
        for k, (a, b) in enumerate(zip(quad, [*quad[1:], quad[0]], strict=True))
    }
    ordered: list[list[int]] = []
    left = dict.fromkeys(range(len(quads)))
    while left:
        f, turn = next(iter(left)), 0
        while f in left:
            del left[f]
            ordered.append(quads[f][turn:] + quads[f][:turn])
            f, turn = sides.get((ordered[-1][3], ordered[-1][2]), (f, 0))
    return np.array(ordered, np.int32).reshape(-1, 4)


class RefinedFaces:
    """The triangles of a surface. The vertices of the mesh come first, in their order."""

    def __init__(self, operator: Any, faces: np.ndarray, owner: np.ndarray, quads: np.ndarray):
        faces.setflags(write=False)
        self.quads = quads  # (q, 4) int32: faces of four corners; other triangles, whose last corner stands twice
        self.operator = operator  # (v', v) sparse: the vertices of the surface from those of the mesh
        self.faces, self.owner = faces, owner  # (f', 3) int32, in the order of the faces (f',) that they are of
        self.topology: Any = None  # of these triangles, once it is known


def merge_rows(rows: Any, operator: Any, merged: Any) -> None:
    """Sum rows (v' + k, n) of the vertices of a surface to those of the mesh that it is of, in `merged` (v + k, n); the
    last k stay as they are. operator: (v', v), of the surface, or an array. Sums in float64 are kept in float32."""
    if isinstance(operator, np.ndarray):
        if rows.device.is_cpu:  # a tenth of the kernel's time
            sums = operator.T @ rows.numpy().reshape(len(operator), -1)
            merged.numpy()[:, : rows.shape[1]] = sums.reshape(len(sums), *rows.numpy().shape[1:])
            return
        from scipy import sparse

        operator = sparse.csc_matrix(operator)
    columns, device = operator.tocsc(), rows.device
    number = wp.float64 if rows.dtype in (wp.float64, wp.vec4d) else wp.float32
    places = [wp.array(each, dtype=wp.int32, device=device) for each in (columns.indptr, columns.indices)]
    shares = wp.array(columns.data, dtype=number, device=device)
    inputs = [rows, *places, shares, operator.shape[0]]
    launch(refined.merge_rows, rows.shape[1], inputs, [merged], device=device, work=operator.nnz)


class PolygonFaces:
    """Faces of any number of corners, and how they are cut and refined: the same for all poses of a mesh."""

    # Between its corners a face of four is the bilinear patch; one of n is n bilinear patches, each between a corner,
    # the middle of the face and those of the two edges there. A cell is four triangles around its middle, which err by
    # half as much as twice as many along diagonals do, and favour none: one cell a patch, or one for all of a face.
    # Faces that would fold so, in the plane that fits them, are cut into triangles between their corners.

    def __init__(self, vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray):
        """vertices: (v, 3), which decide what is cut; corners: (c,) int32, those of one face after those of another;
        sizes: (p,) how many each face has, at least 3."""
        self.vertex_count, self.corners, self.sizes = len(vertices), corners, sizes
        self.starts = np.cumsum(sizes) - sizes
        self.owner = np.repeat(np.arange(len(sizes)), sizes)  # (c,) the face of each corner
        self.triangle_owner = np.repeat(np.arange(len(sizes)), sizes - 2)  # (t,) the face of each triangle
        first = self.starts - np.arange(len(sizes)) * 2  # of the triangles of each face
        step = np.arange(len(self.triangle_owner)) - first[self.triangle_owner] + 1
        start = self.starts[self.triangle_owner]
        self.triangles = corners[np.stack([start, start + step, start + step + 1], axis=1)]  # (t, 3) int32: fans
        cuts = concave_polygons(vertices, [face.tolist() for face in np.split(corners, self.starts[1:])])
        for number, places in cuts.items():
            cut = corners[self.starts[number] + np.array(places)]
            self.triangles[first[number] : first[number] + len(cut)] = cut
        self.triangles.setflags(write=False)
        self._refined: dict[int, RefinedFaces] = {}
        self.cut = self._folded(vertices)  # (k,) faces that are refined as the triangles that they are cut into

    def same_as(self, other: PolygonFaces) -> bool:
        """Whether others are the same faces in the same order, however they are cut."""
        return np.array_equal(self.sizes, other.sizes) and np.array_equal(self.corners, other.corners)

    @property
    def array(self) -> np.ndarray:
        """(p, n) int32 corners of all faces, with -1 behind the last of those that have fewer than n."""
        array = np.full((len(self.sizes), int(self.sizes.max())), -1, dtype=np.int32)
        array[np.arange(array.shape[1]) < self.sizes[:, None]] = self.corners
        return array

    def fanned(self) -> np.ndarray:
        """(c, 3) int64 triangles between each edge of a face and a vertex in its middle: v + the number of the face."""
        last = self.starts + self.sizes - 1
        following = np.arange(1, len(self.corners) + 1)
        following[last] = self.starts
        middles = self.vertex_count + self.owner
        return np.stack([self.corners, self.corners[following], middles], axis=1).astype(np.int64)

    def refined(self, cells: int) -> RefinedFaces:
        """The triangles of all faces, with so many `cells` along each edge, 1 or 2; worked out once."""
        if cells not in self._refined:
            self._refined[cells] = self._refine(cells)
        return self._refined[cells]

    def _refine(self, cells: int) -> RefinedFaces:
        whole = self.sizes > 3
        whole[self.cut] = False
        triangles = ~whole[self.triangle_owner]
        pieces = [(self.triangle_owner[triangles], self.triangles[triangles].astype(np.int64))]
        pieces += [(numbers, self._faces(numbers)) for numbers in self._by_size(np.flatnonzero(whole))]
        edges, number = _edges([corners for _, corners in pieces])
        made = _Vertices(self.vertex_count)
        middles = [part + self.vertex_count for part in number]
        if cells > 1:
            made.add(edges, np.array([0.5, 0.5]))
        faces, owners = [], []
        for (which, corners), after in zip(pieces, middles, strict=True):
            n, before = corners.shape[1], np.roll(after, 1, axis=1)  # the middles of the edges at each corner
            if n == 3:
                thirds = [np.stack([corners[:, k], after[:, k], before[:, k]], axis=1) for k in range(3)]
                found = np.stack([*thirds, after], axis=1) if cells > 1 else corners[:, None]
            elif cells == 1:
                middle = made.add(corners, np.full(n, 1.0 / n))[:, None]
                found = np.stack(
                    [corners, np.roll(corners, -1, axis=1), np.broadcast_to(middle, corners.shape)], axis=2
                )
            else:
                middle = np.broadcast_to(made.add(corners, np.full(n, 1.0 / n))[:, None], corners.shape)
                shares = np.full(n, 0.25 / n)
                shares[[0, 1, -1]] += [0.5, 0.125, 0.125]
                cell = np.stack([made.add(np.roll(corners, -k, axis=1), shares) for k in range(n)], axis=1)
                around = [corners, after, middle, before, corners]
                sides = [np.stack([one, two, cell], axis=2) for one, two in itertools.pairwise(around)]
                found = np.stack(sides, axis=2)
            faces.append(found.reshape(-1, 3))
            owners.append(np.repeat(which, found[0].size // 3 if len(found) else 0))
        owner = np.concatenate(owners)
        order = np.argsort(owner, kind="stable")
        owner, triangles = owner[order], np.concatenate(faces)[order].astype(np.int32)
        four = whole & (self.sizes == 4)
        quads = self.corners[self.starts[four, None] + np.arange(4)]
        quads = in_strips([*quads.tolist(), *triangles[~four[owner]][:, [0, 1, 2, 2]].tolist()])
        return RefinedFaces(made.operator(), triangles, owner, quads)

    def _by_size(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Numbers of faces, those of one size together."""
        return [numbers[self.sizes[numbers] == size] for size in np.unique(self.sizes[numbers])]

    def _faces(self, numbers: np.ndarray) -> np.ndarray:
        """(k, n) int64 corners of faces of one size."""
        places = np.arange(int(self.sizes[numbers[0]]))
        return self.corners[self.starts[numbers, None] + places].astype(np.int64)

    def _folded(self, vertices: np.ndarray) -> np.ndarray:
        """(k,) faces of four and more corners, ascending, of which a triangle would not look along its normal."""
        folded = [np.zeros(0, np.int64)]
        for numbers in self._by_size(np.flatnonzero(self.sizes > 3)):
            points = vertices[self._faces(numbers)]
            points = points - points[:, :1]
            following, middle = np.roll(points, -1, axis=1), points.mean(axis=1, keepdims=True)
            normal = np.cross(points, following).sum(axis=1)  # Newell 1972
            after = 0.5 * (points + following)
            before = np.roll(after, 1, axis=1)
            cell = 0.25 * (points + after + middle + before)
            around = [points, after, np.broadcast_to(middle, points.shape), before, points]
            sides = [(one - cell, two - cell) for one, two in itertools.pairwise(around)]
            sides.append((points - middle, following - middle))
            heights = [np.einsum("kni,ki->kn", np.cross(*side), normal).min(axis=1) for side in sides]
            folded.append(numbers[np.min(heights, axis=0) <= 0.0])
        return np.sort(np.concatenate(folded))


def _edges(faces: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Ends (e, 2) of all edges of faces (k, n), and the number of the edge behind each corner, (k, n)."""
    ends = [np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2) for corners in faces]
    edges, number = np.unique(np.sort(np.concatenate(ends), axis=1), axis=0, return_inverse=True)
    parts = np.split(number.reshape(-1), np.cumsum([corners.size for corners in faces])[:-1])
    return edges, [part.reshape(corners.shape) for part, corners in zip(parts, faces, strict=True)]


class _Vertices:
    """The vertices of a surface as sums of those of its mesh, which come first."""

    def __init__(self, count: int):
        own = np.arange(count)
        self._own, self._count, self._entries = count, count, [(own, own, np.ones(count))]

    def add(self, corners: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """The numbers (k,) of new ones, each the sum of corners (k, n) by shares (n,)."""
        rows = self._count + np.arange(len(corners))
        self._count += len(corners)
        places = np.repeat(rows, corners.shape[1]), corners.reshape(-1)
        self._entries.append((*places, np.broadcast_to(shares, corners.shape).reshape(-1)))
        return rows

    def operator(self) -> Any:
        """(v', v) sparse."""
        from scipy import sparse

        rows, columns, shares = (np.concatenate(parts) for parts in zip(*self._entries, strict=True))
        return sparse.csr_matrix((shares, (rows, columns)), shape=(self._count, self._own))
