"""Triangles of a generated cage joined to quads, by a matching of most weight, and kept off the object as patches."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from ...mesh.faces import column_cross, column_dot
from ...mesh.mesh import ClosedMesh
from ...mesh.surface import CELLS, PolygonFaces
from .decimate import meeting_rings
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

#: Share of its weight that a quad loses where it must be pushed off the object, and how far, in mean sides, for all of
#: that.
_PUSH_COST, _FAR_PUSH = 0.3, 0.1

#: Pieces of the sides of a patch's triangles where it is looked at for that.
_PUSH_PIECES = 3

#: Rounds in which patches are drawn close.
_DRAWN_ROUNDS = 40

#: Times that quads which push what does not hold are cut, first what does not itself, before all that push are.
_TURNS = 5

#: Moves, in sizes of the object, that are none.
_MOVED = 1e-12


def quad_cage(voxels: ObjectVoxels, cage: ClosedMesh, plane: tuple[int, float] | None = None) -> ClosedMesh:
    """A cage of as many quads as hold, and of triangles elsewhere, with the vertices of one of triangles, moved a
    little. plane: axis and place of a mirror plane of the cage."""
    mirror = None if plane is None else Mirror.of(cage.vertices, plane)
    # a wider shell would fill the gaps between parts, and their walls would be pushed out of what is filled
    shell = voxels.narrow_shell
    side = float(np.linalg.norm(np.diff(cage.vertices[cage.edges], axis=1), axis=2).mean())

    def pushed(quads: np.ndarray) -> np.ndarray:
        corners = quads.reshape(-1).astype(np.int32)
        fine = PolygonFaces(cage.vertices, corners, np.full(len(quads), 4)).refined(CELLS)
        distance = shell.distance_on_faces(fine.operator @ cage.vertices, fine.faces.astype(np.int64), _PUSH_PIECES)
        short = np.zeros(len(quads))
        np.maximum.at(short, fine.owner, voxels.need - distance.min(axis=1))
        return short / side

    joined = paired(cage.vertices, cage.faces, None if mirror is None else mirror.partner, pushed)
    for rounds in (_DRAWN_ROUNDS, 0):  # drawing may pass a speck, which is left outside
        found = _held(shell, cage, joined, voxels.need, mirror, rounds)
        if found is None:
            break
        # coarser triangles, which some coordinates take, lie on both sides of the patches
        coarse, fine = found.refined(1), found.refined(CELLS)
        inside = (crossings(voxels.skin, coarse.vertices, coarse.faces) >= 1).all()
        if inside and not (tangle(shell, coarse.vertices, coarse.faces) or flaw(shell, fine.vertices, fine.faces)):
            _log.info("quads: %d of %d faces", sum(len(face) == 4 for face in found.polygons), found.face_count)
            return found
    return cage


def paired(
    vertices: np.ndarray, faces: np.ndarray, partner: np.ndarray | None = None, pushed: Callable | None = None
) -> np.ndarray:
    """Quads (q, 4), each two of the triangles (f, 3) of a closed mesh that share an edge: the matching of most weight.
    partner (v,): of vertices across a mirror plane; pushed: how far (q,) quads must move, in sides, to hold."""
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
    if pushed is not None:
        weights[wanted] *= 1.0 - _PUSH_COST * np.minimum(pushed(quads[wanted]) / _FAR_PUSH, 1.0)
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
        self.by_length = False  # whether the longer of the moves count for more
        self._entries = operator.tocoo()

    def __call__(self, moved: np.ndarray) -> np.ndarray:
        # each goes by the mean move of what follows from it and was moved: a middle alone lifts all of its corners
        step = moved - self._operator @ self.vertices
        entries = self._entries
        asked = np.flatnonzero((np.abs(step[entries.row]) > _MOVED).any(axis=1))
        moves = step[entries.row[asked]]
        share, own = entries.data[asked], entries.col[asked]
        share = share * np.linalg.norm(moves, axis=1) if self.by_length else share
        total = np.bincount(own, share, len(self.vertices))[:, None]
        steps = row_sums([own], [share[:, None] * moves], len(self.vertices))
        after = self.vertices + steps / np.where(total > 0.0, total, 1.0)
        self.vertices = after if self._mirror is None else self._mirror.farther(self.vertices, after)
        return self._operator @ self.vertices


class _Patches:
    """The cage of these quads (q, 4) and, elsewhere, of the triangles of another one, as the patches of its faces about
    an object."""

    def __init__(self, shell: ObjectShell, cage: ClosedMesh, quads: np.ndarray, need: float, mirror: Mirror | None):
        self.cage = ClosedMesh(cage.vertices, quads.tolist() + _left(cage.faces, quads))
        polygons = self.cage.polygon_faces
        assert polygons is not None
        fine = polygons.refined(CELLS)
        self._shell, self._need, self._mirror, self._polygons = shell, need, mirror, polygons
        self.operator, self.owner, self.faces = fine.operator, fine.owner, fine.faces.astype(np.int64)
        self._measured, self._short = np.full((fine.operator.shape[0], 3), np.nan), np.zeros(len(self.faces))

    def moved(self, vertices: np.ndarray, rounds: int = 0) -> tuple[np.ndarray, bool]:
        """Vertices (v, 3) drawn close in so many rounds and kept off the object, and whether they were."""
        followed, places = _Followed(vertices, self.operator, self._mirror), self.operator @ vertices
        if rounds:
            places = drawn_close(self._shell, places, self.faces, self._need, followed, rounds)
        followed.by_length = True  # half as many rounds: few samples are short, by different lengths
        clear = cleared(self._shell, places, self.faces, self._need, followed)[1]
        return followed.vertices, clear

    def short(self, vertices: np.ndarray) -> np.ndarray:
        """(p,) whether faces are too near to the object, the cage's vertices being at (v, 3)."""
        places = self.operator @ vertices
        moved = (places != self._measured).any(axis=1)[self.faces].any(axis=1)
        self._short[moved] = shortfall(self._shell, places, self.faces[moved], self._need)
        self._measured = places
        return self._of_faces(self._short > 0.0)

    def wrong(self, vertices: np.ndarray, clear: bool = False) -> np.ndarray:
        """(p,) whether faces fold, meet others, or are too near to the object, unless they are known to be clear."""
        places = self.operator @ vertices
        found = np.zeros(self.cage.face_count, bool) if clear else self.short(vertices)
        found[PolygonFaces(vertices, self._polygons.corners, self._polygons.sizes).cut] = True
        found[self.owner[folded_pairs(places, self.faces)]] = True
        rings, ring = np.unique(self.faces.max(axis=1), return_inverse=True)  # those about middles: the fewest
        return found | self._of_faces(meeting_rings(places, self.faces, rings)[ring])

    def _of_faces(self, triangles: np.ndarray) -> np.ndarray:
        found = np.zeros(self.cage.face_count, bool)
        found[self.owner[triangles]] = True
        return found

    def corners(self, chosen: np.ndarray) -> np.ndarray:
        """(v,) whether vertices are of faces chosen (p,), or of their mirror images."""
        polygons = self._polygons
        found = np.zeros(len(self.cage.vertices), bool)
        found[polygons.corners[chosen[polygons.owner]]] = True
        return found if self._mirror is None else found | found[self._mirror.partner]

    def touching(self, vertices: np.ndarray) -> np.ndarray:
        """(p,) whether faces have one of the vertices (v,)."""
        return np.logical_or.reduceat(vertices[self._polygons.corners], self._polygons.starts)

    def without(self, cut: np.ndarray) -> np.ndarray:
        """The quads (q, 4) but those that are cut, (p,) bool, and their mirror images."""
        quads = {frozenset(face): face for face in self.cage.polygons if len(face) > 3}
        gone = {frozenset(self.cage.polygons[face]) for face in np.flatnonzero(cut)}
        gone |= set() if self._mirror is None else {frozenset(self._mirror.partner[list(f)].tolist()) for f in gone}
        return np.array([quads[face] for face in quads if face not in gone], dtype=np.int64).reshape(-1, 4)


def _held(
    shell: ObjectShell, cage: ClosedMesh, quads: np.ndarray, need: float, mirror: Mirror | None, rounds: int
) -> ClosedMesh | None:
    """The cage with as many of the quads (q, 4) as hold, drawn close in so many rounds and kept off the object; None
    where none does."""
    if not len(quads):
        return None
    patches = _Patches(shell, cage, quads, need, mirror)
    drawn, clear = patches.moved(cage.vertices, rounds)
    if not patches.wrong(drawn, clear).any():
        return patches.cage.with_vertices(drawn)
    vertices = cage.vertices
    for turn in itertools.count():
        held, clear = patches.moved(vertices)
        wrong = patches.wrong(held, clear)
        if not wrong.any():
            break
        # what does not hold goes back to where triangles did, and quads that push there are cut
        back, pushed = patches.corners(wrong), patches.short(cage.vertices)
        cut = pushed & (wrong if turn == 0 else patches.touching(back) if turn < _TURNS else True)
        left = patches.without(cut if cut.any() else wrong)
        if len(left) in (0, len(quads)):
            return None
        vertices, quads = np.where(back[:, None], cage.vertices, held), left
        patches = _Patches(shell, cage, quads, need, mirror)
    # on the way to where they are drawn close, a part of it about faces that would not hold
    share = np.ones(len(held))
    while True:
        vertices = held + share[:, None] * (drawn - held)
        back = patches.corners(patches.wrong(vertices))
        if not share[back].any():
            return patches.cage.with_vertices(vertices)
        share[back] = np.where(share[back] > MIN_WAY, 0.5 * share[back], 0.0)
