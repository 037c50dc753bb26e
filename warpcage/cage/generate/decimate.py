"""Decimation that only moves outward, as progressive hulls do (Sander et al. 2000, "Silhouette clipping")."""

from __future__ import annotations

import numpy as np
import warp as wp

from ...core.devices import launch
from ...core.reports import Progress, report_progress
from ...kernels.mesh.collapses import measure_collapses


def on_cpu(values: np.ndarray, dtype) -> wp.array:
    """A Warp array of the same memory, where values are C-contiguous."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu", copy=False)


#: Share of the vertices that one round takes away at most, where they do not touch each other's faces.
_ROUND = 0.08

#: How much room, in cubes of the sides of faces to come, the shape of a collapse may cost.
_SIDE_COST, _SHAPE_COST = 0.05, 0.02

#: Sides of faces to come by which a place may lie behind a plane: last digits decide no less.
_ON_PLANE = 1e-9

#: Digits of a cost, in cubes of the sides, that order collapses: those of equal cost go by their number.
_COST_DIGITS = 9

#: New faces must not turn farther than by this cosine, nor be flatter than this evenness (1 for equilateral).
_MIN_TURN, _MIN_EVEN = 0.2, 0.15


def progressive_hull(
    vertices, faces, vertex_count: int, progress: bool | Progress = False
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a closed manifold surface around the one given, with fewer vertices.
    They are `vertex_count`, or more where no collapse is left."""
    # Cheapest first (room, long edges, uneven faces). It stays manifold and outside the one before; faces do not fold.
    vertices, faces = np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    side = np.sqrt(2.0 * area / (np.sqrt(3.0) * vertex_count))
    first = len(vertices)
    while len(vertices) > vertex_count:
        report_progress(progress, first - len(vertices), first - vertex_count, "cage: decimate")
        edges, places, costs = _collapses(vertices, faces, side)
        if not len(edges):
            break
        most = min(max(int(_ROUND * len(vertices)), 1), len(vertices) - vertex_count)
        chosen = _apart(edges, costs, faces, len(vertices), most)
        vertices[edges[chosen, 0]] = places[chosen]
        number = np.arange(len(vertices))
        number[edges[chosen, 1]] = edges[chosen, 0]
        faces = number[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
    return vertices, faces


def _collapses(vertices, faces, side):
    """Edges (e, 2) that may collapse, where to (e, 3) and at which cost (e,)."""
    ring, edges = _rings(faces, len(vertices)), _edges(faces)
    edges = edges[_keeps_manifold(edges, faces, len(vertices))]
    u, v = edges.T
    # the faces around both ends, those of the edge itself once: (e, 2 r), -1 for none
    around = np.concatenate([ring[u], ring[v]], axis=1)
    shares_u = (faces[ring[v]] == u[:, None, None]).any(axis=2)
    around[:, ring.shape[1] :][shares_u] = -1
    there = around >= 0
    corners = vertices[faces[around]]
    cross = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]) * there[..., None]
    double_area = np.sqrt(np.einsum("eri,eri->er", cross, cross))
    normals = cross / np.maximum(double_area, 1e-300)[..., None]
    offsets = np.einsum("eri,eri->er", normals, corners[:, :, 0])
    mean = cross.sum(axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)

    best = np.full(len(edges), np.inf)
    places = np.zeros((len(edges), 3))
    measured = EdgeCollapses(vertices, faces, edges, around, normals, offsets, double_area, mean, side)
    for base in _bases(vertices[u], vertices[v], normals, offsets, double_area):
        # a shape only adds to the cost: it is asked for where the room alone is cheaper
        rows, place, room, shape = measured.at(base, side**3 * best)
        cost = np.round(room / side**3 + shape, _COST_DIGITS)
        better = cost < best[rows]
        best[rows[better]], places[rows[better]] = cost[better], place[better]
    fine = np.isfinite(best)
    return edges[fine], places[fine], best[fine]


class EdgeCollapses:
    """Collapses of edges (e, 2) to places, lifted along mean (e, 3), that are tried one after the other.
    around (e, r): faces around the edges, -1 for none; normals, offsets and double_area (e, r, ...): their planes."""

    def __init__(self, vertices, faces, edges, around, normals, offsets, double_area, mean, side):
        self._side, self._count = side, len(edges)
        self._edges, self._means = on_cpu(edges.astype(np.int32), wp.vec2i), on_cpu(mean, wp.vec3d)
        self._planes = [
            on_cpu(around.astype(np.int32), wp.int32),
            on_cpu(normals, wp.vec3d),
            on_cpu(offsets, wp.float64),
            on_cpu(double_area, wp.float64),
        ]
        self._surface = [on_cpu(vertices, wp.vec3d), on_cpu(faces.astype(np.int32), wp.vec3i)]

    def at(self, base, room_allowed) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The edges (n,) that may collapse to places lifted from base (e, 3) and add less than the room allowed (e,);
        those places (n, 3), the room (n,) that they add, and what long edges and uneven faces cost (n,)."""
        place, (room, square, uneven) = np.empty((self._count, 3)), np.empty((3, self._count))
        limits = [on_cpu(room_allowed, wp.float64), *map(wp.float64, (_ON_PLANE * self._side, _MIN_TURN, _MIN_EVEN))]
        inputs = [self._edges, on_cpu(base, wp.vec3d), self._means, *self._planes, *limits, *self._surface]
        outputs = [on_cpu(place, wp.vec3d), *(on_cpu(found, wp.float64) for found in (room, square, uneven))]
        launch(measure_collapses, self._count, inputs, outputs, device="cpu")
        rows = np.flatnonzero(square >= 0.0)
        longest = np.sqrt(square[rows]) / self._side
        return rows, place[rows], room[rows], _SIDE_COST * longest**3 + _SHAPE_COST * uneven[rows]


def _bases(one, two, normals, offsets, double_area):
    """Places to lift the new vertex from: the ends of the edge, its middle, and where all planes nearly meet."""
    middle = 0.5 * (one + two)
    # least squares of the distances to the planes (Garland and Heckbert 1997), held to the middle
    matrix = np.einsum("er,eri,erj->eij", double_area, normals, normals)
    hold = 1e-2 * np.trace(matrix, axis1=1, axis2=2)
    matrix = matrix + hold[:, None, None] * np.eye(3)
    right = np.einsum("er,eri,er->ei", double_area, normals, offsets) + hold[:, None] * middle
    meeting = np.linalg.solve(matrix, right[..., None])[..., 0]
    return middle, one, two, meeting


def _edges(faces) -> np.ndarray:
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return pairs[pairs[:, 0] < pairs[:, 1]]  # closed and wound alike: every edge is walked once each way


def _rings(faces, count) -> np.ndarray:
    """(v, r) faces around each vertex, -1 beyond the last."""
    corner = np.argsort(faces.reshape(-1), kind="stable")
    degree = np.bincount(faces.reshape(-1), minlength=count)
    first = np.cumsum(degree) - degree
    rings = np.full((count, degree.max()), -1)
    rings[faces.reshape(-1)[corner], np.arange(len(corner)) - np.repeat(first, degree)] = corner // 3
    return rings


def _keeps_manifold(edges, faces, count) -> np.ndarray:
    """(e,) whether the ends have two neighbours in common and no vertex is left with three faces (link condition)."""
    import scipy.sparse

    both = np.concatenate([edges, edges[:, ::-1]])
    near = scipy.sparse.csr_matrix((np.ones(len(both)), tuple(both.T)), shape=(count, count))
    common = np.asarray((near[edges[:, 0]].multiply(near[edges[:, 1]])).sum(axis=1)).reshape(-1)
    degree = np.bincount(faces.reshape(-1), minlength=count)
    # the two vertices across the edge lose a face each; every edge is walked once each way, by the face before it
    walked = (faces * count + np.roll(faces, -1, axis=1)).reshape(-1)
    order = np.argsort(walked)
    places = np.searchsorted(walked[order], np.stack([edges @ [count, 1], edges @ [1, count]], axis=1))
    across = np.roll(faces, -2, axis=1).reshape(-1)[order[places]]
    merged = degree[edges].sum(axis=1) - 4
    return (common == 2) & (degree[across] > 3).all(axis=1) & (merged >= 3) & (merged <= 10)


def _apart(edges, costs, faces, count, most) -> np.ndarray:
    """Indices of the cheapest edges, at most so many, whose faces share no vertex."""
    one = faces.reshape(-1)
    order = np.argsort(one, kind="stable")
    neighbors = np.roll(faces, -1, axis=1).reshape(-1)[order].tolist()
    last = np.cumsum(np.bincount(one, minlength=count)).tolist()
    taken, chosen = set(), []
    for k in np.argsort(costs, kind="stable").tolist():
        touched = set(edges[k].tolist())
        for end in edges[k].tolist():
            touched.update(neighbors[last[end - 1] if end else 0 : last[end]])
        if taken.isdisjoint(touched):
            taken |= touched
            chosen.append(k)
            if len(chosen) == most:
                break
    return np.array(chosen)
