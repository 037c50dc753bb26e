"""Decimation that only moves outward, in the manner of progressive hulls (Sander et al. 2000, "Silhouette clipping").

Each collapse of an edge puts the new vertex on the outer side of the planes of all faces that it takes away or bends,
so that every surface on the way holds the one before.
"""

from __future__ import annotations

import numpy as np

#: Share of the vertices that one round takes away at most, where they do not touch each other's faces.
_ROUND = 0.08

#: How much room, in cubes of the sides of faces to come, the shape of a collapse may cost.
_SIDE_COST, _SHAPE_COST = 0.05, 0.02

#: Sides of faces to come by which a place may lie behind a plane: last digits decide no less.
_ON_PLANE = 1e-9

#: Digits of a cost, in cubes of the sides, that order collapses: those of equal cost go by their number.
_COST_DIGITS = 9

#: New faces must not turn farther than by this cosine, nor be flatter than this evenness (1 for equilateral).
_LEAST_TURN, _LEAST_EVEN = 0.2, 0.15


def nested(vertices, faces, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a closed manifold surface with fewer vertices around the one given.

    Cheapest first: room added, long edges and uneven faces cost. Ends at `vertex_count`, or above it where no collapse
    is left that keeps the surface manifold, outside the one before, and its faces from folding.
    """
    vertices, faces = np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    side = np.sqrt(2.0 * area / (np.sqrt(3.0) * vertex_count))
    while len(vertices) > vertex_count:
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
    for base in _bases(vertices[u], vertices[v], normals, offsets, double_area):
        place, reached = _lifted(base, mean, normals, offsets, there, _ON_PLANE * side)
        room = (double_area * (np.einsum("eri,ei->er", normals, place) - offsets)).sum(axis=1) / 6.0
        # a shape only adds to the cost: it is asked for where the room alone is cheaper
        rows = np.flatnonzero(reached & (room < side**3 * best))
        near = (each[rows] for each in (place, around, there, normals, u, v))
        shape = _shape_cost(vertices, faces, side, *near)
        cost = np.round(room[rows] / side**3 + shape, _COST_DIGITS)
        better = cost < best[rows]
        best[rows[better]], places[rows[better]] = cost[better], place[rows[better]]
    fine = np.isfinite(best)
    return edges[fine], places[fine], best[fine]


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


def _lifted(base, mean, normals, offsets, there, least):
    """base (e, 3) moved along `mean` to the outer side of every plane, and whether that can be done (e,).

    least: a length; what is not so far behind a plane lies on it.
    """
    climb = np.einsum("eri,ei->er", normals, mean)
    below = np.where(there, offsets - np.einsum("eri,ei->er", normals, base), 0.0)
    short = below > least
    steps = np.where(short, below / np.maximum(climb, 0.05), 0.0)
    return base + steps.max(axis=1)[:, None] * mean, ~(short & (climb < 0.05)).any(axis=1)


def _shape_cost(vertices, faces, side, place, around, there, normals, u, v) -> np.ndarray:
    """(e,) what long edges and uneven faces cost; inf where a face would fold or lose its shape."""
    triangles = faces[around]
    moved = (triangles == u[:, None, None]) | (triangles == v[:, None, None])
    kept = there & (moved.sum(axis=2) == 1)  # those of the edge itself vanish
    corners = np.where(moved[..., None], place[:, None, None, :], vertices[triangles])
    sides = corners[:, :, [1, 2, 0]] - corners
    cross = np.cross(sides[:, :, 0], sides[:, :, 1])
    double_area = np.sqrt(np.einsum("eri,eri->er", cross, cross))
    squares = np.einsum("erki,erki->ker", sides, sides)
    even = 2.0 * np.sqrt(3.0) * double_area / np.maximum(squares.sum(axis=0), 1e-300)
    turn = np.einsum("eri,eri->er", cross, normals) / np.maximum(double_area, 1e-300)
    bad = kept & ~((turn > _LEAST_TURN) & (even > _LEAST_EVEN))
    longest = np.sqrt(np.where(kept, squares.max(axis=0), 0.0).max(axis=1)) / side
    uneven = np.where(kept, 1.0 / np.maximum(even, 1e-3) - 1.0, 0.0).sum(axis=1)
    cost = _SIDE_COST * longest**3 + _SHAPE_COST * uneven
    return np.where(bad.any(axis=1), np.inf, cost)


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
    # the two vertices across the edge lose a face each
    opposite = {}
    for face in faces.tolist():
        for k in range(3):
            opposite[face[k], face[(k + 1) % 3]] = face[(k + 2) % 3]
    across = np.array([[opposite[a, b], opposite[b, a]] for a, b in edges.tolist()]).reshape(-1, 2)
    merged = degree[edges].sum(axis=1) - 4
    return (common == 2) & (degree[across] > 3).all(axis=1) & (merged >= 3) & (merged <= 10)


def _apart(edges, costs, faces, count, most) -> np.ndarray:
    """Indices of the cheapest edges, at most so many, whose faces share no vertex."""
    near = [set() for _ in range(count)]
    for face in faces.tolist():
        for corner in face:
            near[corner].update(face)
    taken, chosen = set(), []
    for k in np.argsort(costs, kind="stable").tolist():
        touched = near[edges[k, 0]] | near[edges[k, 1]]
        if taken.isdisjoint(touched):
            taken |= touched
            chosen.append(k)
            if len(chosen) == most:
                break
    return np.array(chosen)
