"""Mend a cage where it is safe to do so, and finer and symmetric versions of it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import axis_index, checked_number, checked_whole, shown
from ..core.names import agreed, checked_choice, counted
from ..errors import InputError
from ..mesh.mesh import ClosedMesh, MeshTopology
from ..mesh.queries import crossing_faces
from ..mesh.surface import PolygonFaces
from ..mesh.validity import coincident_vertices, inward_parts

#: Least cosine between the normal of a quad that closes a hole and those at its corners: 37 degrees.
MIN_QUAD_FLATNESS = 0.8

#: The corners of a face, and of all.
Face = list[int]
Faces = list[Face]


def repaired_faces(cage: ClosedMesh, largest_hole: int = 12) -> tuple[Faces, tuple[str, ...]]:
    """Mended faces, the corners of each, and a line for each repair; the cage's own and no lines where none was."""
    # In order: faces name one vertex at a place (others stay, unused); faces with a vertex twice or repeated go;
    # neighbours are wound alike; small holes are closed with the least area and no new vertices; parts turn outward.
    # Left for `check`: edges of three faces, crossing faces, wide holes, surfaces with one side only.
    largest_hole = checked_whole(largest_hole, "largest_hole", 3)
    faces: Faces = [list(face) for face in cage.polygons]
    notes: list[str] = []
    for step in (_merged, _without_repeats, _wound_alike):
        faces = step(cage.vertices, faces, notes)
        if not faces:
            raise InputError("the cage has no face left that encloses anything: begin with another cage")
    faces = _closed(cage.vertices, faces, largest_hole, notes)
    faces = _outward(cage.vertices, faces, notes)
    return faces, tuple(notes)


def _merged(vertices: np.ndarray, faces: Faces, notes: list[str]) -> Faces:
    pairs = coincident_vertices(ClosedMesh(vertices, faces))
    if len(pairs):
        place = dict(pairs[:, ::-1].tolist())
        faces = [[place.get(corner, corner) for corner in face] for face in faces]
        notes.append(
            f"merged {counted(len(pairs), 'vertex', 'vertices')} into others at their place, the first "
            f"{pairs[0, 1]} into "
            f"{pairs[0, 0]}; they stay in the list, unused"
        )
    return faces


def _without_repeats(vertices: np.ndarray, faces: Faces, notes: list[str]) -> Faces:
    # what is left of a face of four or more corners that names one twice in a row is a face
    shorter = [[corner for k, corner in enumerate(face) if corner != face[k - 1]] for face in faces]
    improper = [k for k, face in enumerate(shorter) if len(set(face)) < len(face) or len(face) < 3]
    if improper:
        notes.append(
            f"removed {counted(len(improper), 'face')} that {agreed(len(improper), 'names', 'name')} a vertex twice, "
            f"the first {improper[0]}"
        )
    narrowed = sum(len(new) < len(old) for new, old in zip(shorter, faces, strict=True)) - sum(
        len(shorter[k]) < len(faces[k]) for k in improper
    )
    if narrowed:
        notes.append(f"took a corner that they named twice out of {counted(narrowed, 'face')}")
    left = [face for k, face in enumerate(shorter) if k not in set(improper)]
    first: dict[tuple[int, ...], Face] = {}
    for face in left:
        first.setdefault(tuple(sorted(face)), face)
    if len(first) < len(left):
        notes.append(f"removed {counted(len(left) - len(first), 'face')} on the vertices of another")
    return list(first.values())


def _sides(face: Face) -> Iterator[tuple[int, int]]:
    """The edges of a face, in its direction."""
    return zip(face, [*face[1:], face[0]], strict=True)


def _topology(vertices: np.ndarray, faces: Faces) -> MeshTopology:
    return MeshTopology(len(vertices), np.concatenate(faces), np.array([len(face) for face in faces]))


def _wound_alike(vertices: np.ndarray, faces: Faces, notes: list[str]) -> Faces:
    """Flip faces until neighbours agree: a walk over each part from its first face."""
    topology = _topology(vertices, faces)
    if not len(topology.clashing_edges):
        return faces
    neighbors: dict[tuple[int, int], list] = {}
    for row, face in enumerate(faces):
        for a, b in _sides(face):
            neighbors.setdefault((min(a, b), max(a, b)), []).append((row, a < b))
    flip = np.full(len(faces), -1)
    for seed in range(len(faces)):
        if flip[seed] >= 0:
            continue
        flip[seed], queue = 0, [seed]
        for row in queue:
            for edge in _sides(faces[row]):
                both = neighbors[min(edge), max(edge)]
                if len(both) != 2:
                    continue
                (one, forward), (two, other) = both if both[0][0] == row else both[::-1]
                if flip[two] < 0:
                    flip[two] = flip[one] ^ int(forward == other)
                    queue.append(two)
    for part in range(topology.part_count):  # of each part the smaller share gets flipped
        rows = topology.parts == part
        if flip[rows].mean() > 0.5:
            flip[rows] ^= 1
    flipped = [face[::-1] if turned == 1 else face for face, turned in zip(faces, flip, strict=True)]
    if len(_topology(vertices, flipped).clashing_edges) >= len(topology.clashing_edges):
        return faces  # a surface with one side
    notes.append(
        f"flipped {counted(int(np.count_nonzero(flip)), 'face')} that "
        f"{agreed(int(np.count_nonzero(flip)), 'was', 'were')} wound against their neighbours, the first "
        f"{np.flatnonzero(flip)[0]}"
    )
    return flipped


def _closed(vertices: np.ndarray, faces: Faces, largest_hole: int, notes: list[str]) -> Faces:
    walked = {side for face in faces for side in _sides(face)}
    onward = {
        b: a for a, b in walked if (b, a) not in walked
    }  # along the hole, in the direction of faces that close it
    taken = {(min(a, b), max(a, b)) for a, b in walked}
    faces = list(faces)
    while onward:
        first = min(onward)
        loop = [first]
        while loop[-1] in onward:
            loop.append(onward.pop(loop[-1]))
            if loop[-1] == first:
                break
        loop = loop[:-1]
        if len(loop) < 3 or len(loop) > largest_hole or loop[0] != first:
            continue
        patch = [loop] if _ends_as_quad(vertices, faces, loop) else _least_area(vertices, loop, taken)
        if patch is None:
            continue
        faces += patch
        taken |= {(min(a, b), max(a, b)) for face in patch for a, b in _sides(face)}
        notes.append(f"closed a hole of {len(loop)} edges at vertex {first} with {counted(len(patch), 'face')}")
    return faces


def _ends_as_quad(vertices: np.ndarray, faces: Faces, loop: Face) -> bool:
    """Whether a hole among quads can be closed by another one that is nearly flat and crosses no face."""
    rim = {(b, a) for a, b in _sides(loop)}
    around = {len(face) for face in faces if not rim.isdisjoint(_sides(face))}
    corners = vertices[loop]
    if len(loop) != 4 or around != {4} or PolygonFaces(vertices, np.array(loop, np.int32), np.array([4])).cut.size:
        return False
    normal = np.cross(corners[2] - corners[0], corners[3] - corners[1])
    halves = np.cross(np.roll(corners, -1, axis=0) - corners, np.roll(corners, 1, axis=0) - corners)  # at each corner
    lengths = np.linalg.norm(halves, axis=1) * np.linalg.norm(normal)
    if (halves @ normal < MIN_QUAD_FLATNESS * lengths).any():
        return False
    return not (crossing_faces(ClosedMesh(vertices, [*faces, loop])) == len(faces)).any()


def _least_area(vertices: np.ndarray, loop: Face, taken: set[tuple[int, int]]) -> Faces | None:
    """Triangles, n - 2, of the least total area over a polygon of n vertices (Barequet and Sharir 1995).
    Their inner edges must not be among the edges `taken`; None where that is not possible."""
    n, points = len(loop), vertices[loop]
    cost = np.zeros((n, n))
    middle = np.zeros((n, n), dtype=int)
    for span in range(2, n):
        for i in range(n - span):
            k = i + span
            if span < n - 1 and (min(loop[i], loop[k]), max(loop[i], loop[k])) in taken:
                cost[i, k] = np.inf
                continue
            inner = np.arange(i + 1, k)
            area = 0.5 * np.linalg.norm(np.cross(points[inner] - points[i], points[k] - points[i]), axis=1)
            total = cost[i, inner] + cost[inner, k] + area
            cost[i, k], middle[i, k] = total.min(), inner[np.argmin(total)]
    if not np.isfinite(cost[0, n - 1]):
        return None
    found: Faces = []
    spans = [(0, n - 1)]
    for i, k in spans:
        if k - i >= 2:
            j = middle[i, k]
            found.append([loop[i], loop[j], loop[k]])
            spans += [(i, j), (j, k)]
    return found


def _outward(vertices: np.ndarray, faces: Faces, notes: list[str]) -> Faces:
    cage = ClosedMesh(vertices, faces)
    topology = cage.topology
    if not (topology.closed and topology.manifold) or len(topology.clashing_edges):
        return faces
    inward = inward_parts(cage)
    inward = inward[cage.part_volumes()[inward] < 0.0]
    if not len(inward):
        return faces
    turned = [face[::-1] for face in faces]
    if cage.volume < 0.0 and not len(inward_parts(ClosedMesh(vertices, turned))):  # cavities and all
        notes.append(f"flipped all {len(faces)} faces: the cage looked inward")
        return turned
    rows = np.isin(topology.parts, inward)
    notes.append(f"flipped the {np.count_nonzero(rows)} faces of {counted(len(inward), 'part')} that looked inward")
    return [back if row else face for face, back, row in zip(faces, turned, rows, strict=True)]


def subdivided(
    cage: ClosedMesh, times: int = 1, *, faces: ArrayLike | None = None, vertices: ArrayLike | None = None
) -> tuple[np.ndarray, np.ndarray | Faces]:
    """Faces cut at the middles of their edges, 1 to 4 times; see `Cage.subdivide`. Vertices (v, 3) begin with the
    cage's; faces as a ClosedMesh takes them."""
    times = checked_whole(times, "times", 1, 4)
    everywhere = faces is None and vertices is None
    if faces is not None and vertices is not None:
        raise InputError("subdivide takes faces or vertices, not both")
    if everywhere and cage.polygon_faces is None:
        places, found = cage.vertices, cage.faces.astype(np.int64)
        for _ in range(times):
            places, found = cut_in_four(places, found)
        return places, found
    chosen = np.full(cage.face_count, everywhere)
    if faces is not None:
        chosen[_numbers(faces, "faces", cage.face_count)] = True
    around = set() if vertices is None else set(_numbers(vertices, "vertices", len(cage.vertices)).tolist())
    polygons, cuts = cage.polygon_faces, {}
    if polygons is not None:  # what is solved on them as triangles is cut as these are
        corners = cage.polygons
        for number in polygons.cut.tolist():
            cuts[corners[number]] = polygons.triangles[polygons.triangle_owner == number].tolist()
    places, found, marks = cage.vertices, [list(face) for face in cage.polygons], chosen.tolist()
    for _ in range(times):
        if around:
            marks = [not around.isdisjoint(face) for face in found]
        places, found, marks = _cut_at_middles(places, found, marks, cuts)
    return places, found


def _numbers(given: ArrayLike, name: str, count: int) -> np.ndarray:
    """(k,) numbers of faces or vertices, checked."""
    numbers = np.atleast_1d(np.asarray(given))
    whole = numbers.ndim == 1 and numbers.dtype.kind in "iu" and len(numbers) > 0
    if not whole or numbers.min() < 0 or numbers.max() >= count:
        raise InputError(f"{name} must be whole numbers from 0 to {count - 1}, at least one, got {shown(given)}")
    return numbers


def _cut_at_middles(
    vertices: np.ndarray, faces: Faces, chosen: list[bool], cuts: dict[tuple[int, ...], Faces]
) -> tuple[np.ndarray, Faces, list[bool]]:
    """Chosen faces with the middles of edges and, of more than three corners, of faces as further vertices; those
    beside them join these. Also which faces are of chosen ones. cuts: triangles of faces that are none before."""
    # As red-green refinement does (Bank, Sherman and Weiser 1983): a triangle of one edge cut in two is halved, of two
    # it is cut as a chosen one, and so is a quad of three. Which pieces there are depends on the faces alone, so that
    # all poses of a mesh get the same, and on no order of vertices, so that mirrored faces get mirrored ones.
    rows = [(face, mine, mine) for face, mine in zip(faces, chosen, strict=True)]
    split: set[tuple[int, int]] = set()
    while True:
        split |= {key for face, _, whole in rows if whole for key in _edge_keys(face)}
        before, rows = rows, []
        for face, mine, whole in before:
            count = sum(key in split for key in _edge_keys(face))
            pieces = cuts.get(tuple(face)) if count else None
            if pieces is None:
                rows.append((face, mine, whole or count == len(face) or (len(face) < 5 and count == len(face) - 1)))
            else:
                rows += [(piece, mine, whole) for piece in pieces]
        if rows == before:
            break
    edges = sorted(split)
    number = {key: len(vertices) + k for k, key in enumerate(edges)}
    first, middles = len(vertices) + len(edges), []
    found: Faces = []
    marks: list[bool] = []
    for face, mine, _ in rows:
        after = [number.get(key) for key in _edge_keys(face)]
        pieces, inner = _pieces(face, after, first + len(middles))
        if inner:
            middles.append(vertices[face].mean(axis=0))
        found += pieces
        marks += [mine] * len(pieces)
    halves = vertices[np.array(edges, dtype=np.int64).reshape(-1, 2)].mean(axis=1)
    return np.concatenate([vertices, halves, np.array(middles).reshape(-1, 3)]), found, marks


def _edge_keys(face: Face) -> list[tuple[int, int]]:
    return [(min(a, b), max(a, b)) for a, b in _sides(face)]


def _pieces(face: Face, after: list[Any], middle: int) -> tuple[Faces, bool]:
    """The faces that one is cut in, by the middles of its edges behind each corner (None: that edge is whole), and
    whether its own middle is a corner of them."""
    n, cut = len(face), [k for k, edge in enumerate(after) if edge is not None]
    if not cut:
        return [face], False
    if n == 3 and len(cut) == 3:
        ends = [list(each) for each in zip(face, after, [after[-1], *after[:-1]], strict=True)]
        return [*ends, after], False
    if n == 3 or (n == 4 and len(cut) == 2 and cut[1] - cut[0] == 2):
        # in two, from the middle of the first edge to the opposite corner or middle
        turned, edges = face[cut[0] :] + face[: cut[0]], after[cut[0] :] + after[: cut[0]]
        far = turned[2:3] if n == 3 else edges[2:3]
        rest = turned[3:]
        return [[turned[0], edges[0], *far, *rest], [edges[0], *turned[1 : 2 if n == 3 else 3], *far]], False
    pieces: Faces = []
    for one, two in zip([cut[-1] - n, *cut[:-1]], cut, strict=True):  # what lies between two cut edges
        corners = [face[k % n] for k in range(one + 1, two + 1)]
        around = [after[one], *corners, after[two]]
        if len(corners) == 1:
            pieces.append([corners[0], around[2], middle, around[0]])
        elif len(corners) == 2:
            pieces += [[a, b, middle] for a, b in itertools.pairwise(around)]
        else:
            pieces.append([*around[:3], middle])
            pieces += [[a, b, middle] for a, b in itertools.pairwise(corners[1:-1])]
            pieces.append([*around[-3:], middle])
    return pieces, True


def cut_in_four(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face cut in four at the middles of its edges: vertices (v + e, 3), the given ones first, faces (4 f, 3)."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, middle = np.unique(pairs, axis=0, return_inverse=True)
    ab, bc, ca = middle.reshape(3, -1) + len(vertices)
    a, b, c = faces.T
    divided = [np.stack(corner, axis=1) for corner in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([vertices, vertices[edges].mean(axis=1)]), np.concatenate(divided)


def symmetrised(cage: ClosedMesh, axis: str = "x", *, center: float | None = None, keep: str = "both") -> np.ndarray:
    """Vertices (v, 3) of a nearly symmetric cage, its own mirror image across a plane at `centre`, world units.
    `keep`: "both" takes the mean of both halves, "+" or "-" copies the half on that side to the other."""
    # Faces stay, so squares may be cut along other diagonals on both sides.
    along = axis_index(axis)
    checked_choice(keep, "keep", ("both", "+", "-"))
    middle = float(cage.bounds[:, along].mean()) if center is None else checked_number(center, "center")
    own = cage.vertices
    mirrored = own.copy()
    mirrored[:, along] = 2.0 * middle - mirrored[:, along]
    partner = np.array([np.argmin(((own - image) ** 2).sum(axis=1)) for image in mirrored])
    alone = np.flatnonzero(partner[partner] != np.arange(len(own)))
    if len(alone):
        raise InputError(
            f"{counted(len(alone), 'vertex', 'vertices')} {agreed(len(alone), 'has', 'have')} no partner "
            f"across the plane {axis} = {middle:.4g}, the first "
            f"{alone[0]}: move the plane with centre, or make the cage with symmetry={axis!r}"
        )
    across = mirrored[partner]
    if keep == "both":
        return 0.5 * (own + across)
    side = (own[:, along] >= middle) == (keep == "+")
    middle_ones = partner == np.arange(len(own))
    kept = np.where(side[:, None], own, across)
    return np.where(middle_ones[:, None], 0.5 * (own + across), kept)
