"""Decimation that only moves outward, as progressive hulls do (Sander et al. 2000, "Silhouette clipping")."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from ...core.devices import launch
from ...core.reports import Progress, report_progress
from ...errors import InputError
from ...kernels.mesh.collapses import INFINITE, MIN_NEIGHBORS, CollapseRules, Planes, measure_collapses
from ...kernels.mesh.meetings import find_meeting_rings
from ...mesh.faces import column_cross, column_dot
from .distance import on_cpu
from .mirror import Mirror, reflected

#: Relative lengths (n,) of a cage's edges about points (n, 3), world units: any positive numbers, of which only ratios
#: count. None for the same everywhere.
Sizing = Callable[[np.ndarray], np.ndarray] | None

#: Share of the vertices that one round takes away at most, where they do not touch each other's faces: evenly, and with
#: a sizing, where a larger one leaves no choice of the place.
_ROUND, _SIZED_ROUND = 0.08, 0.05

#: Rounds for which a collapse waits whose faces would pass through others.
_WAIT = 4

#: How much room, in cubes of the sides of faces to come, the shape of a collapse may cost.
_SIDE_COST, _SHAPE_COST = 0.05, 0.02

#: Sides of faces to come by which a place may lie behind a plane: last digits decide no less.
_ON_PLANE = 1e-9

#: Sides of faces to come that a new vertex may lie beyond where it is lifted from: no spikes of little room.
_MAX_LIFT = 1.0

#: New faces must not turn farther than by this cosine, nor be flatter than this evenness (1 for equilateral).
_MIN_TURN, _MIN_EVEN = 0.2, 0.15

#: The cost of an edge that cannot collapse, and steps of measuring one, as `launch` counts them.
_NONE, _COLLAPSE_WORK = float(INFINITE), 64


def progressive_hull(
    vertices,
    faces,
    vertex_count: int,
    progress: bool | Progress = False,
    sizing: Sizing = None,
    apart: bool = False,
    mirror: Mirror | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a closed manifold surface around the one given, with `vertex_count` vertices
    or more where no collapse is left; `sizing`: where they lie denser; `apart`: no faces pass through others."""
    # mirror: of a surface that no edge crosses from one side of the plane to the other; then the count may be one less
    # Cheapest first (room, long edges, uneven faces). It stays manifold and outside the one before; faces do not fold.
    vertices, faces = np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)
    side = edge_length(vertices, faces, vertex_count, sizing)
    first, share = len(vertices), _ROUND if sizing is None else _SIZED_ROUND
    waiting = np.zeros((0, 3), dtype=np.int64)  # edges that would cross others, and rounds for which they wait
    while len(vertices) > vertex_count:
        report_progress(progress, first - len(vertices), first - vertex_count, "cage: decimate")
        edges, places, costs = _collapses(vertices, faces, side, sizing)
        if len(waiting):
            free = ~np.isin(edges @ [len(vertices), 1], waiting[:, :2] @ [len(vertices), 1])
            edges, places, costs = edges[free], places[free], costs[free]
        if mirror is not None:
            edges, places, costs = _on_one_side(vertices, faces, edges, places, costs, mirror)
        if not len(edges):
            break
        most = min(max(int(share * len(vertices)), 1), len(vertices) - vertex_count)
        chosen = _apart(edges, costs, faces, len(vertices), most)
        edges, places, owner = edges[chosen], places[chosen], np.arange(len(chosen))
        if mirror is not None:
            edges, places, owner = _on_both_sides(edges, places, mirror, most)
        crossing = _crossing(vertices, faces, edges, places, owner) if apart else np.zeros(len(edges), bool)
        number, vertices, faces = _collapsed(vertices, faces, edges[~crossing], places[~crossing])
        mirror = mirror and mirror.renumbered(number)
        waiting[:, 2] -= not crossing.all()  # so that it ends where there are only such
        waiting = np.concatenate([waiting, np.insert(edges[crossing], 2, _WAIT, axis=1)])
        waiting = waiting[waiting[:, 2] > 0]
        waiting[:, :2] = np.sort(number[waiting[:, :2]], axis=1)
    return vertices, faces


def _collapsed(vertices, faces, edges, places) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New number (v,) of each vertex, and vertices and faces once edges (e, 2) are places (e, 3)."""
    vertices, number = vertices.copy(), np.arange(len(vertices))
    vertices[edges[:, 0]] = places
    number[edges[:, 1]] = edges[:, 0]
    faces = number[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return np.searchsorted(used, number), vertices[used], faces.reshape(-1, 3)


def _on_one_side(vertices, faces, edges, places, costs, mirror: Mirror):
    """The collapses on the plane of a mirror, of places there, and those above it, which their images can go with."""
    on_plane = mirror.partner == np.arange(len(vertices))
    flat, above = on_plane[edges].all(axis=1), ~on_plane & (vertices[:, mirror.axis] > mirror.middle)
    places[flat, mirror.axis] = mirror.middle
    # a vertex on the plane that is across from one of a pair is so from both, and loses two faces
    degree = np.bincount(faces.reshape(-1), minlength=len(vertices))
    few = on_plane & (degree < MIN_NEIGHBORS + 2)
    opposite = np.concatenate([faces[few[faces[:, k]]][:, [k - 2, k - 1]] for k in range(3)])
    blocked = np.isin(edges @ [len(vertices), 1], np.sort(opposite, axis=1) @ [len(vertices), 1])
    free = flat | (above[edges].all(axis=1) & (places[:, mirror.axis] > mirror.middle) & ~blocked)
    return edges[free], places[free], costs[free]


def _on_both_sides(edges, places, mirror: Mirror, most) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first collapses that take away so many vertices, or one more, their images after them, and of which each
    is."""
    paired = (mirror.partner[edges] != edges).any(axis=1)
    count = np.searchsorted(np.cumsum(1 + paired), most) + 1
    edges, places, images = edges[:count], places[:count], np.flatnonzero(paired[:count])
    places = np.concatenate([places, reflected(places[images], mirror.axis, mirror.middle)])
    owner = np.concatenate([np.arange(len(edges)), images])
    return np.concatenate([edges, mirror.partner[edges[images]]]), places, owner


def _crossing(vertices, faces, edges, places, owner) -> np.ndarray:
    """(e,) which of the collapses to take back so that no faces pass through each other, where none did before; those
    of one owner (e,) are taken back together."""
    taken_back = np.zeros(len(edges), dtype=bool)
    while True:
        kept = np.flatnonzero(~taken_back[owner])
        number, moved, triangles = _collapsed(vertices, faces, edges[kept], places[kept])
        crossed = meeting_rings(moved, triangles, number[edges[kept, 0]])
        if not crossed.any():
            return taken_back[owner]
        taken_back[owner[kept[crossed]]] = True


def meeting_rings(vertices, faces, rings) -> np.ndarray:
    """(n,) whether a face around each of the vertices rings (n,) passes through another face."""
    starts, corners = corner_rings(faces, len(vertices))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    boxes = [on_cpu(each(each(a, b), c), wp.vec3d) for each in (np.minimum, np.maximum)]
    found = np.zeros(len(rings), dtype=np.int32)
    inputs = [on_cpu(rings.astype(np.int32), wp.int32), on_cpu(vertices, wp.vec3d)]
    inputs += [on_cpu(faces.astype(np.int32), wp.vec3i), on_cpu(starts, wp.int32), on_cpu(corners // 3, wp.int32)]
    work = len(faces) / 8
    launch(find_meeting_rings, len(rings), [*inputs, *boxes], [on_cpu(found, wp.int32)], device="cpu", work=work)
    return found > 0


def relative_sizes(sizing: Sizing, points: np.ndarray) -> np.ndarray:
    """(n,) what a sizing gives for points (n, 3), checked: positive and finite."""
    if sizing is None:
        return np.ones(len(points))
    found = np.asarray(sizing(points), dtype=np.float64)
    if found.shape != (len(points),) or not (np.isfinite(found) & (found > 0.0)).all():
        raise InputError(f"a sizing must give a positive length for each of {len(points)} points")
    return found


def edge_length(vertices, faces, vertex_count, sizing: Sizing = None) -> float:
    """Edge of the equilateral triangles, two a vertex, that would cover a surface; with a sizing, where that is 1."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if sizing is not None:
        areas = areas / relative_sizes(sizing, (a + b + c) / 3.0) ** 2
    return float(np.sqrt(2.0 * areas.sum() / (np.sqrt(3.0) * vertex_count)))


def _collapses(vertices, faces, side, sizing: Sizing):
    """Edges (e, 2) that may collapse, where to (e, 3) and at which cost (e,)."""
    measured = EdgeCollapses(vertices, faces, side, sizing)
    fine = np.flatnonzero(measured.costs < _NONE)
    return measured.edges[fine], measured.places[fine], measured.costs[fine]


class EdgeCollapses:
    """Edges (e, 2) of a closed mesh, places (e, 3) of the vertices that they may become, and what these cost (e,)."""

    def __init__(self, vertices, faces, side, sizing: Sizing = None):
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        cross = column_cross((b - a).T, (c - a).T)
        double_area = np.sqrt(column_dot(cross, cross))
        normals = cross / np.maximum(double_area, 1e-300)
        planes, rules = Planes(), CollapseRules()
        planes.vertices, planes.faces = on_cpu(vertices, wp.vec3d), on_cpu(faces.astype(np.int32), wp.vec3i)
        starts, corners = corner_rings(faces, len(vertices))
        planes.starts, planes.ring = on_cpu(starts, wp.int32), on_cpu(corners // 3, wp.int32)
        planes.normals, planes.double_areas = on_cpu(normals.T, wp.vec3d), on_cpu(double_area, wp.float64)
        planes.offsets = on_cpu(column_dot(normals, a.T), wp.float64)
        rules.on_plane, rules.most_lift = wp.float64(_ON_PLANE), wp.float64(_MAX_LIFT)
        rules.least_turn, rules.least_even = wp.float64(_MIN_TURN), wp.float64(_MIN_EVEN)
        rules.side_cost, rules.shape_cost = wp.float64(_SIDE_COST), wp.float64(_SHAPE_COST)
        self.edges = _edges(faces)
        self.places, self.costs = np.empty((len(self.edges), 3)), np.empty(len(self.edges))
        middles = 0.5 * (vertices[self.edges[:, 0]] + vertices[self.edges[:, 1]])
        sides = on_cpu(side * relative_sizes(sizing, middles), wp.float64)
        inputs = [on_cpu(self.edges.astype(np.int32), wp.vec2i), sides, planes, rules]
        outputs = [on_cpu(self.places, wp.vec3d), on_cpu(self.costs, wp.float64)]
        launch(measure_collapses, len(self.edges), inputs, outputs, device="cpu", work=_COLLAPSE_WORK)


def corner_rings(faces, count) -> tuple[np.ndarray, np.ndarray]:
    """Corners of faces (f, 3), numbered 3 f + k, vertex after vertex (3 f,), and where those of each start (v + 1,)."""
    starts = np.zeros(count + 1, dtype=np.int32)
    np.cumsum(np.bincount(faces.reshape(-1), minlength=count), out=starts[1:])
    return starts, np.argsort(faces.reshape(-1), kind="stable").astype(np.int32)


def _edges(faces) -> np.ndarray:
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return pairs[pairs[:, 0] < pairs[:, 1]]  # closed and wound alike: every edge is walked once each way


def _apart(edges, costs, faces, count, most) -> np.ndarray:
    """Indices of the cheapest edges, at most so many, whose faces share no vertex."""
    one = faces.reshape(-1)
    order = np.argsort(one, kind="stable")
    neighbors = np.roll(faces, -1, axis=1).reshape(-1)[order].tolist()
    last = np.cumsum(np.bincount(one, minlength=count)).tolist()
    ends, taken, chosen = edges.tolist(), set(), []
    for k in np.argsort(costs, kind="stable").tolist():
        touched = set(ends[k])
        if not taken.isdisjoint(touched):  # most of those that are not chosen
            continue
        for end in ends[k]:
            touched.update(neighbors[last[end - 1] if end else 0 : last[end]])
        if taken.isdisjoint(touched):
            taken |= touched
            chosen.append(k)
            if len(chosen) == most:
                break
    return np.array(chosen)
