"""Mend a cage where that is safe: repeated vertices and faces, small holes, faces that look the wrong way.

No vertex is moved, added or renumbered, so that the mended cage still matches poses made from the broken file.
"""

from __future__ import annotations

import numpy as np

from ..mesh.closed_mesh import ClosedMesh
from ..mesh.topology import MeshTopology
from ..mesh.usable import coincident_vertices, inward_parts


def repaired_faces(cage: ClosedMesh, largest_hole: int = 12) -> tuple[np.ndarray, tuple[str, ...]]:
    """Mended faces (f, 3) and what was done, a line each; the same faces and no lines where nothing was wrong.

    Done in this order: faces use one of the vertices at a place (the others stay, unused); faces that name a vertex
    twice or repeat another go; neighbours are wound alike; holes of at most `largest_hole` edges are closed by the
    smallest area, without new vertices; parts look outward. What could not be mended is left for `check` to tell:
    edges of three faces, crossing faces, wide holes, surfaces with one side only.
    Raises ValueError for a `largest_hole` below 3, or where no face is left.
    """
    if not isinstance(largest_hole, int | np.integer) or largest_hole < 3:
        raise ValueError(f"largest_hole must be a whole number of at least 3 edges, got {largest_hole!r}")
    faces, notes = cage.faces.astype(np.int64), []
    for step in (_merged, _without_repeats, _wound_alike):
        faces = step(cage.vertices, faces, notes)
        if not len(faces):
            raise ValueError("the cage has no face left that encloses anything: begin with another")
    faces = _closed(cage.vertices, faces, largest_hole, notes)
    faces = _outward(cage.vertices, faces, notes)
    return (faces if notes else cage.faces), tuple(notes)


def _merged(vertices, faces, notes):
    pairs = coincident_vertices(ClosedMesh(vertices, faces))
    if len(pairs):
        place = np.arange(len(vertices))
        place[pairs[:, 1]] = pairs[:, 0]
        faces = place[faces]
        notes.append(
            f"merged {len(pairs)} vertices into others at their place, the first {pairs[0, 1]} into "
            f"{pairs[0, 0]}; they stay in the list, unused"
        )
    return faces


def _without_repeats(vertices, faces, notes):
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not proper.all():
        notes.append(
            f"removed {np.count_nonzero(~proper)} faces that name a vertex twice, the first "
            f"{np.flatnonzero(~proper)[0]}"
        )
    faces = faces[proper]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        repeated = np.setdiff1d(np.arange(len(faces)), first)
        notes.append(f"removed {len(repeated)} faces on the vertices of another")
    return faces[np.sort(first)]


def _wound_alike(vertices, faces, notes):
    """Flip faces until neighbours agree: a walk over each part from its first face."""
    topology = MeshTopology(len(vertices), faces)
    if not len(topology.clashing_edges):
        return faces
    neighbours: dict[tuple[int, int], list] = {}
    for row, face in enumerate(faces.tolist()):
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            neighbours.setdefault((min(a, b), max(a, b)), []).append((row, a < b))
    flip = np.full(len(faces), -1)
    for seed in range(len(faces)):
        if flip[seed] >= 0:
            continue
        flip[seed], queue = 0, [seed]
        for row in queue:
            a, b, c = faces[row].tolist()
            for edge in ((a, b), (b, c), (c, a)):
                both = neighbours[min(edge), max(edge)]
                if len(both) != 2:
                    continue
                (one, forward), (two, other) = both if both[0][0] == row else both[::-1]
                if flip[two] < 0:
                    flip[two] = flip[one] ^ int(forward == other)
                    queue.append(two)
    # the smaller share of each part is what gets flipped
    for part in range(topology.part_count):
        rows = topology.parts == part
        if flip[rows].mean() > 0.5:
            flip[rows] ^= 1
    flipped = np.where(flip[:, None] == 1, faces[:, ::-1], faces)
    if len(MeshTopology(len(vertices), flipped).clashing_edges) >= len(topology.clashing_edges):
        return faces  # a surface with one side
    notes.append(
        f"flipped {np.count_nonzero(flip)} faces that were wound against their neighbours, the first "
        f"{np.flatnonzero(flip)[0]}"
    )
    return flipped


def _closed(vertices, faces, largest_hole, notes):
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    walked = set(zip(start.tolist(), end.tolist(), strict=True))
    onward = {b: a for a, b in walked if (b, a) not in walked}  # along the hole, the way its own faces must go
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
        notes.append(f"closed a hole of {len(loop)} edges at vertex {first} with {len(patch)} faces")
    return faces


def _least_area(vertices, loop, taken) -> np.ndarray | None:
    """Triangles (n - 2, 3) over a polygon (n vertex numbers) of the least total area, by the numbers of its vertices;
    none of its new edges may be there already (Barequet and Sharir 1995)."""
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


def _outward(vertices, faces, notes):
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
    notes.append(f"flipped the {np.count_nonzero(rows)} faces of {len(inward)} parts that looked inward")
    return np.where(rows[:, None], faces[:, ::-1], faces)
