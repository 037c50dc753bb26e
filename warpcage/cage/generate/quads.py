"""Triangles of a generated cage joined to quads, by a matching of most weight, and kept off the object as patches."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from ...mesh.faces import column_cross, column_dot
from ...mesh.mesh import ClosedMesh
from ...mesh.queries import crossing_faces
from ...mesh.surface import CELLS, PolygonFaces
from .distance import ObjectShell, ObjectVoxels
from .fit import cleared, drawn_close, row_sums, shortfall
from .mirror import Mirror
from .shell import MIN_WAY, crossings, flaw, folded_pairs, tangle

_log = logging.getLogger(__name__)

#: What a quad weighs, whatever its shape, so that few triangles are left; a square one weighs 1 more.
_ANY_QUAD = 0.5

#: Least shape of a quad (a square has 1, one with a corner of 0 or 180 degrees 0), and least cosine between the normals
#: of its two triangles.
_MIN_SHAPE, _MIN_FLAT = 0.12, 0.3

#: How near to the best matching the search may end, as a share of its weight.
_MATCHING_GAP = 2e-3

#: Times that quads which do not hold are cut into their triangles again, before all are.
_ROUNDS = 6

#: Rounds in which patches are drawn close, after their triangles were; where none hold so, they are kept off alone.
_DRAWN_ROUNDS = (40, 0)

#: Moves, in sizes of the object, that are none.
_MOVED = 1e-12


def quad_cage(voxels: ObjectVoxels, cage: ClosedMesh, plane: tuple[int, float] | None = None) -> ClosedMesh:
    """A cage of as many quads as hold, and of triangles elsewhere, with the vertices of one of triangles, moved a
    little. plane: axis and place of a mirror plane of the cage."""
    mirror = None if plane is None else Mirror.of(cage.vertices, plane)
    partner = None if mirror is None else mirror.partner
    joined = paired(cage.vertices, cage.faces, partner)
    shell = ObjectShell(voxels, voxels.need + max(0.06 * voxels.size, 2.0 * voxels.spacing))
    for turn in range(_ROUNDS + 1):
        faces = [list(quad) for quad in joined] + _left(cage.faces, joined)
        found, wrong = _held(shell, ClosedMesh(cage.vertices, faces), voxels.need, mirror)
        if found is not None:
            _log.info("quads: %d of %d faces", len(joined), len(faces))
            return found
        kept = [k for k in range(len(joined)) if k not in wrong] if turn < _ROUNDS - 1 else []
        if partner is not None:  # both of a pair stay, or neither
            there = {frozenset(joined[k].tolist()) for k in kept}
            kept = [k for k in kept if frozenset(partner[joined[k]].tolist()) in there]
        joined = joined[kept if len(kept) < len(joined) else []]
    return cage


def paired(vertices: np.ndarray, faces: np.ndarray, partner: np.ndarray | None = None) -> np.ndarray:
    """Quads (q, 4), each two of the triangles (f, 3) of a closed mesh that share an edge: the matching of most weight.
    partner (v,): of each vertex across a mirror plane, to whose sides quads are the same."""
    from scipy import sparse
    from scipy.optimize import Bounds, LinearConstraint, milp

    faces = np.asarray(faces, dtype=np.int64)
    starts, ends, tops = (np.concatenate([faces[:, k - j] for j in range(3)]) for k in (0, 1, 2))
    owner, count = np.tile(np.arange(len(faces)), 3), len(vertices)
    key = np.minimum(starts, ends) * count + np.maximum(starts, ends)
    one, two = np.argsort(key, kind="stable").reshape(-1, 2).T  # both half-edges of each edge of a closed mesh
    quads = np.stack([starts[one], tops[two], ends[one], tops[one]], axis=1)
    weights = quad_weights(vertices, quads)
    wanted = np.flatnonzero(weights > 0.0)
    if not len(wanted):
        return quads[:0]
    rows, columns = np.concatenate([owner[one[wanted]], owner[two[wanted]]]), np.tile(np.arange(len(wanted)), 2)
    once = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(faces), len(wanted)))
    limits: list[Any] = [LinearConstraint(once, ub=1.0)]
    most = np.ones(len(wanted))
    if partner is not None:
        place = {frozenset(quad): k for k, quad in enumerate(quads[wanted].tolist())}
        other = np.array([place.get(frozenset(quad), -1) for quad in partner[quads[wanted]].tolist()])
        most[other < 0] = 0.0
        both = np.flatnonzero(other > np.arange(len(wanted)))
        pairs = np.concatenate([both, other[both]]), np.tile(np.arange(len(both)), 2)
        signs = np.repeat([1.0, -1.0], len(both))
        same = sparse.csr_matrix((signs, (pairs[1], pairs[0])), shape=(len(both), len(wanted)))
        limits += [LinearConstraint(same, lb=0.0, ub=0.0)] if len(both) else []
    # a matching is a whole-numbered point of these constraints (Edmonds 1965); rounded weights decide ties alike
    found = milp(
        -np.round(weights[wanted], 6),
        constraints=limits,
        integrality=np.ones(len(wanted)),
        bounds=Bounds(0.0, most),  # pyright: ignore[reportArgumentType]
        options={"mip_rel_gap": _MATCHING_GAP},
    )
    return quads[wanted[found.x > 0.5]]


def quad_weights(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """What quads (q, 4) are worth, by their shape and flatness; 0 for those that are too bent, pointed or folded."""
    corners = vertices[quads]
    before, behind = np.roll(corners, 1, axis=1) - corners, np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(before, axis=2) * np.linalg.norm(behind, axis=2)
    angles = np.arccos(np.clip((before * behind).sum(axis=2) / lengths, -1.0, 1.0))
    # as Remacle et al. 2012, "Blossom-Quad", equation 1
    shape = 1.0 - np.abs(0.5 * np.pi - angles).max(axis=1) / (0.5 * np.pi)
    a, b, c, d = (corners[:, k].T for k in range(4))
    halves = column_cross(b - a, c - a), column_cross(c - a, d - a)
    sizes = np.sqrt(column_dot(halves[0], halves[0]) * column_dot(halves[1], halves[1]))
    flat = column_dot(*halves) / sizes
    weights = np.where((shape > _MIN_SHAPE) & (flat > _MIN_FLAT), _ANY_QUAD + shape * flat, 0.0)
    weights[PolygonFaces(vertices, quads.reshape(-1).astype(np.int32), np.full(len(quads), 4)).cut] = 0.0
    return weights


def cut_across(cage: ClosedMesh, chosen: np.ndarray) -> ClosedMesh:
    """The cage with the quads that have vertices on both sides, chosen ones and others by (v,) bool, as triangles."""
    faces: list[tuple[int, ...]] = []
    for face in cage.polygons:
        whole = len(face) == 3 or len(set(chosen[list(face)].tolist())) == 1
        faces += [face] if whole else [face[:3], (face[0], *face[2:])]
    return ClosedMesh(cage.vertices, faces)


def _left(faces: np.ndarray, quads: np.ndarray) -> list[list[int]]:
    """The triangles (f, 3) that no quad (q, 4) has taken."""
    taken = {frozenset(quad[k] for k in three) for quad in quads.tolist() for three in ((0, 1, 2), (0, 2, 3))}
    return [face for face in faces.tolist() if frozenset(face) not in taken]


class _Followed:
    """The vertices (v, 3) of a cage that go along with those of its patches (v', 3), as these are moved."""

    def __init__(self, vertices: np.ndarray, operator: Any, mirror: Mirror | None):
        self.vertices, self._operator, self._mirror = vertices, operator, mirror
        self._entries = operator.tocoo()

    def __call__(self, moved: np.ndarray) -> np.ndarray:
        # each goes by the mean move of what follows from it and was moved: a middle alone lifts all of its corners
        step = moved - self._operator @ self.vertices
        entries = self._entries
        asked = np.flatnonzero((np.abs(step[entries.row]) > _MOVED).any(axis=1))
        share, own = entries.data[asked], entries.col[asked]
        total = np.bincount(own, share, len(self.vertices))[:, None]
        steps = row_sums([own], [share[:, None] * step[entries.row[asked]]], len(self.vertices))
        after = self.vertices + steps / np.where(total > 0.0, total, 1.0)
        self.vertices = after if self._mirror is None else self._mirror.farther(self.vertices, after)
        return self._operator @ self.vertices


def _held(
    shell: ObjectShell, cage: ClosedMesh, need: float, mirror: Mirror | None
) -> tuple[ClosedMesh | None, set[int]]:
    """The cage with its patches drawn close and kept off the object, or None and the numbers of the faces that do not
    hold."""
    if cage.polygon_faces is None:
        return cage, set()
    fine, wrong = cage.polygon_faces.refined(CELLS), set()
    faces = fine.faces.astype(np.int64)
    for rounds in _DRAWN_ROUNDS:
        followed = _Followed(cage.vertices, fine.operator, mirror)
        vertices = fine.operator @ cage.vertices
        vertices = drawn_close(shell, vertices, faces, need, followed, rounds) if rounds else vertices
        vertices, clear = cleared(shell, vertices, faces, need, followed)
        found = cage.with_vertices(followed.vertices)
        wrong = _not_holding(shell, found, fine, 0.0 if clear else need)
        if wrong:
            found, still = _withdrawn(shell, cage, found, wrong, fine, need, mirror)
            vertices = fine.operator @ found.vertices
            if still:  # fewest quads are cut, but some: triangles alone would be wrong again
                cut = [{face for face in each if len(cage.polygons[face]) > 3} for each in (wrong, still)]
                wrong = min(filter(None, cut), key=len, default=still)
                continue
        # coarser triangles, which some coordinates take, lie on both sides of the patches
        coarse = found.refined(1)
        inside = (crossings(shell.voxels.skin, coarse.vertices, coarse.faces) >= 1).all()
        if inside and not tangle(shell, coarse.vertices, coarse.faces) and not flaw(shell, vertices, faces):
            return found, set()
        wrong = set(range(cage.face_count))
    return None, wrong


def _not_holding(shell: ObjectShell, cage: ClosedMesh, fine: Any, need: float) -> set[int]:
    """Numbers of the faces of a cage that fold, cross others, or whose patches, `fine`, are nearer than `need` to the
    object (0: they are known to be clear)."""
    vertices, faces = fine.operator @ cage.vertices, fine.faces.astype(np.int64)
    wrong = {*_folded(cage).tolist(), *crossing_faces(cage).reshape(-1).tolist()}
    wrong |= set(fine.owner[folded_pairs(vertices, faces)].reshape(-1).tolist())
    if need:
        short = shortfall(shell, vertices, faces, need)
        wrong |= set(fine.owner[short > 0.0].tolist())
    return wrong


def _withdrawn(
    shell: ObjectShell, before: ClosedMesh, after: ClosedMesh, wrong: set[int], fine: Any, need: float, mirror: Any
) -> tuple[ClosedMesh, set[int]]:
    """A cage on its way from before, where triangles hold, to after, a part of the way about faces that would not; and
    those that do not hold all the same. fine: its patches."""
    share, moves, polygons = np.ones(len(before.vertices)), after.vertices - before.vertices, before.polygons
    while wrong:
        rows = np.unique(np.concatenate([polygons[face] for face in wrong]))
        rows = rows if mirror is None else np.union1d(rows, mirror.partner[rows])
        if not share[rows].any():
            break
        share[rows] = np.where(share[rows] > MIN_WAY, 0.5 * share[rows], 0.0)
        after = before.with_vertices(before.vertices + share[:, None] * moves)
        wrong = _not_holding(shell, after, fine, need)
    return after, wrong


def _folded(cage: ClosedMesh) -> np.ndarray:
    """(k,) faces whose patches fold where the vertices are now."""
    polygons = cage.polygon_faces
    assert polygons is not None
    return PolygonFaces(cage.vertices, polygons.corners, polygons.sizes).cut
