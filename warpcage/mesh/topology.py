"""What the faces of a mesh tell on their own: edges, holes, fans, connected parts."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike

from ..core.names import agreed, counted
from .fans import FaceFans, face_fans


class MeshTopology:
    """Edges and connected parts of triangles (f, 3): they depend on faces alone, so all poses share them."""

    # Where something is wrong the attributes hold what is wrong itself, so that an error can name the first one.

    def __init__(self, vertex_count: int, faces: ArrayLike):
        self._faces = faces = np.asarray(faces, dtype=np.int64)
        face_count = len(faces)
        starts = faces.reshape(-1)
        ends = np.roll(faces, -1, axis=1).reshape(-1)
        owner = np.repeat(np.arange(face_count), 3)
        proper = starts != ends

        # (k,) faces that name a vertex twice
        self.repeated_faces = np.unique(owner[~proper])
        # (k,) vertices of some face, and of none, ascending
        self.used_vertices = np.unique(starts)
        self.unused_vertices = np.setdiff1d(np.arange(vertex_count), self.used_vertices)

        low, high = np.minimum(starts, ends)[proper], np.maximum(starts, ends)[proper]
        keys, edge, uses = np.unique(low * vertex_count + high, return_inverse=True, return_counts=True)
        # (e, 2): every edge once, lower index first; the loop of a face that repeats a vertex is no edge
        self.edges = np.stack([keys // vertex_count, keys % vertex_count], axis=1).astype(np.int32)
        forward = np.bincount(edge, weights=(starts < ends)[proper], minlength=len(keys))
        # (k, 2) of one face only, of three or more, and of two that walk it in the same direction, so that one looks
        # inward
        self.open_edges = self.edges[uses == 1]
        self.crowded_edges = self.edges[uses > 2]
        self.clashing_edges = self.edges[(uses == 2) & (forward != 1)]

        # corners next to each other around a vertex, and faces next to each other over an edge
        order = np.argsort(edge, kind="stable")
        same = np.flatnonzero(edge[order][1:] == edge[order][:-1])
        one, two = np.flatnonzero(proper)[order[same]], np.flatnonzero(proper)[order[same + 1]]
        # (f,) the part of each face, 0 to part_count - 1, connected over edges
        self.parts, self.part_count = connected_parts(face_count, owner[one], owner[two])
        # (k,) vertices whose faces form more than one fan
        self.pinched_vertices = self._pinched_vertices(vertex_count, starts, one, two)

    @staticmethod
    def _pinched_vertices(vertex_count: int, starts: np.ndarray, one: np.ndarray, two: np.ndarray) -> np.ndarray:
        """Vertices whose corners fall into several fans; one, two (k,): half-edges (corners) that share an edge."""
        after_one, after_two = one // 3 * 3 + (one + 1) % 3, two // 3 * 3 + (two + 1) % 3
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
