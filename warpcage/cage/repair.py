"""Mend a cage where it is safe to do so, and finer and symmetric versions of it."""

from __future__ import annotations

import numpy as np

from ..core.checks import axis_index, checked_number, checked_whole
from ..core.names import agreed, checked_choice, counted
from ..errors import InputError
from ..mesh.mesh import ClosedMesh, MeshTopology
from ..mesh.validity import coincident_vertices, inward_parts


def repaired_faces(cage: ClosedMesh, largest_hole: int = 12) -> tuple[np.ndarray, tuple[str, ...]]:
    """Mended faces (f, 3) and a line for each repair; the cage's own faces and no lines where none was."""
    # In order: faces name one vertex at a place (others stay, unused); faces with a vertex twice or repeated go;
    # neighbours are wound alike; small holes are closed with the least area and no new vertices; parts turn outward.
    # Left for `check`: edges of three faces, crossing faces, wide holes, surfaces with one side only.
    largest_hole = checked_whole(largest_hole, "largest_hole", 3)
    faces, notes = cage.faces.astype(np.int64), []
    for step in (_merged, _without_repeats, _wound_alike):
        faces = step(cage.vertices, faces, notes)
        if not len(faces):
            raise InputError("the cage has no face left that encloses anything: begin with another cage")
    faces = _closed(cage.vertices, faces, largest_hole, notes)
    faces = _outward(cage.vertices, faces, notes)
    return (faces if notes else cage.faces), tuple(notes)


def _merged(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    pairs = coincident_vertices(ClosedMesh(vertices, faces))
    if len(pairs):
        place = np.arange(len(vertices))
        place[pairs[:, 1]] = pairs[:, 0]
        faces = place[faces]
        notes.append(
            f"merged {counted(len(pairs), 'vertex', 'vertices')} into others at their place, the first "
            f"{pairs[0, 1]} into "
            f"{pairs[0, 0]}; they stay in the list, unused"
        )
    return faces


def _without_repeats(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not proper.all():
        notes.append(
            f"removed {counted(int(np.count_nonzero(~proper)), 'face')} that "
            f"{agreed(int(np.count_nonzero(~proper)), 'names', 'name')} a vertex twice, the first "
            f"{np.flatnonzero(~proper)[0]}"
        )
    faces = faces[proper]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        repeated = np.setdiff1d(np.arange(len(faces)), first)
        notes.append(f"removed {counted(len(repeated), 'face')} on the vertices of another")
    return faces[np.sort(first)]


def _wound_alike(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    """Flip faces until neighbours agree: a walk over each part from its first face."""
    topology = MeshTopology(len(vertices), faces)
    if not len(topology.clashing_edges):
        return faces
    neighbors: dict[tuple[int, int], list] = {}
    for row, face in enumerate(faces.tolist()):
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            neighbors.setdefault((min(a, b), max(a, b)), []).append((row, a < b))
    flip = np.full(len(faces), -1)
    for seed in range(len(faces)):
        if flip[seed] >= 0:
            continue
        flip[seed], queue = 0, [seed]
        for row in queue:
            a, b, c = faces[row].tolist()
            for edge in ((a, b), (b, c), (c, a)):
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
    flipped = np.where(flip[:, None] == 1, faces[:, ::-1], faces)
    if len(MeshTopology(len(vertices), flipped).clashing_edges) >= len(topology.clashing_edges):
        return faces  # a surface with one side
    notes.append(
        f"flipped {counted(int(np.count_nonzero(flip)), 'face')} that "
        f"{agreed(int(np.count_nonzero(flip)), 'was', 'were')} wound against their neighbours, the first "
        f"{np.flatnonzero(flip)[0]}"
    )
    return flipped


def _closed(vertices: np.ndarray, faces: np.ndarray, largest_hole: int, notes: list[str]) -> np.ndarray:
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    walked = set(zip(start.tolist(), end.tolist(), strict=True))
    onward = {
        b: a for a, b in walked if (b, a) not in walked
    }  # along the hole, in the direction of faces that close it
    taken = {(min(a, b), max(a, b)) for a, b in walked}
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
        patch = _least_area(vertices, loop, taken)
        if patch is None:
            continue
        faces = np.concatenate([faces, patch])
        taken |= {(min(a, b), max(a, b)) for f in patch.tolist() for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
        notes.append(f"closed a hole of {len(loop)} edges at vertex {first} with {counted(len(patch), 'face')}")
    return faces


def _least_area(vertices: np.ndarray, loop: list[int], taken: set[tuple[int, int]]) -> np.ndarray | None:
    """Triangles (n - 2, 3) of the least total area over a polygon of n vertices (Barequet and Sharir 1995).
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
    found, spans = [], [(0, n - 1)]
    for i, k in spans:
        if k - i >= 2:
            j = middle[i, k]
            found.append((loop[i], loop[j], loop[k]))
            spans += [(i, j), (j, k)]
    return np.array(found)


def _outward(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    cage = ClosedMesh(vertices, faces)
    topology = cage.topology
    if not (topology.closed and topology.manifold) or len(topology.clashing_edges):
        return faces
    inward = inward_parts(cage)
    inward = inward[cage.part_volumes()[inward] < 0.0]
    if not len(inward):
        return faces
    if cage.volume < 0.0 and not len(inward_parts(ClosedMesh(vertices, faces[:, ::-1]))):  # cavities and all
        notes.append(f"flipped all {len(faces)} faces: the cage looked inward")
        return faces[:, ::-1]
    rows = np.isin(topology.parts, inward)
    notes.append(f"flipped the {np.count_nonzero(rows)} faces of {counted(len(inward), 'part')} that looked inward")
    return np.where(rows[:, None], faces[:, ::-1], faces)


def subdivided(cage: ClosedMesh, times: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Every face cut in four at the middles of its edges, 1 to 4 times; vertices (v, 3) begin with the cage's."""
    vertices, faces = cage.vertices, cage.faces.astype(np.int64)
    for _ in range(checked_whole(times, "times", 1, 4)):
        vertices, faces = cut_in_four(vertices, faces)
    return vertices, faces


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
