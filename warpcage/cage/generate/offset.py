"""A tight cage: the object closed and offset, decimated outward, drawn close while its faces keep their distance."""

from __future__ import annotations

import numpy as np

from ...mesh.mesh import ClosedMesh
from ...mesh.queries import inside_mesh, intersecting_faces
from ...mesh.validity import require_usable, winding_numbers
from ..shapes import box
from .fitting import cleared, drawn_close, shortfall, spread
from .nested import nested
from .shell import ObjectShell

#: Closing radii tried, in lengths of the cage's edges: the first gives the tightest cage.
_CLOSINGS = (0.45, 0.7, 1.0, 1.5, 2.2, 3.3, 5.0)

#: Share of the way from `need` to the closing radius at which the surface to decimate lies.
_START = 0.4

#: Voxels off the object where the smoothed distance has a surface, whatever the object: smoothing over one voxel lifts
#: the distance to a sheet, a line and a point to 0.8, 1.3 and 1.6 at the object itself.
_LEAST_LEVEL = 1.8

#: Rounds of spreading, tried in this order, as many may tangle a thin surface; shares of the way from there to drawn
#: close; and the rounds tried where nothing else holds: the surface given holds the object by construction.
_ROUNDS, _DRAWN, _LAST_ROUNDS = (25, 10, 4), (1.0, 0.75, 0.5, 0.25, 0.0), (0,)

#: What is wrong with a cage that is neither spread evenly nor drawn: it holds, but a wider closing may be tighter.
_LOOSE = "it could not be drawn close"

#: Vertices of the surface that nested decimation begins with, for each that it leaves, and whether the last rounds are
#: tried: all closings are tried with the first, then, where none of them holds, with the next.
_ATTEMPTS = ((6, False), (9, False), (4, False), (6, True))


def shell_cage(points, spacing, slack, margin, vertex_count, symmetry=None) -> ClosedMesh:
    """Try ever wider closings until a cage comes out that holds; slack: how far the object may lie off its points."""
    size = np.ptp(points, axis=0).max()
    need = slack + margin
    shell = ObjectShell(points, spacing, need + max(0.06 * size, 2.0 * spacing), need)
    edge = edge_length(shell, max(need, _LEAST_LEVEL * spacing), vertex_count)
    reasons = []
    for fine, last in _ATTEMPTS:
        found = []
        for closing in _CLOSINGS:
            # wide closings need no fine voxels
            coarse = max(spacing, closing * edge / 16.0)
            room = max(closing * edge, 2.0 * coarse, (_LEAST_LEVEL * coarse - need) / _START)
            shell = ObjectShell(points, coarse, need + room, need)
            step = 2 if edge > 8.0 * coarse else 1
            start = decimated(*shell.surface(need + _START * (shell.reach - need), step), fine * vertex_count)
            cage, reason = sound(shell, *nested(*start, vertex_count), need, vertex_count, last=last)
            found += [cage] if cage else []
            if not reason:
                break
            reasons.append(reason)
        if found:
            return min(found, key=lambda cage: cage.volume)
    # no closing is wider than a box, which holds as it is
    cage, reason = sound(shell, *split_box(points, 1.5 * shell.reach, vertex_count), need, vertex_count, last=True)
    if cage is None:
        raise ValueError(f"{reason}; before: {', '.join(dict.fromkeys(reasons))}")
    return cage


def split_box(points, room, vertex_count) -> tuple[np.ndarray, np.ndarray]:
    """The box `room` off points (p, 3), its longest edges split in the middle up to `vertex_count` vertices."""
    corners, triangles = box(points.min(axis=0) - room, points.max(axis=0) + room)
    vertices, faces = list(corners), [tuple(face) for face in triangles.tolist()]
    while len(vertices) < vertex_count:
        edges = np.array([(face[k], face[(k + 1) % 3]) for face in faces for k in range(3)])
        lengths = np.linalg.norm(np.subtract(*np.moveaxis(np.array(vertices)[edges], 1, 0)), axis=1)
        # equal edges are taken by their order, not by the last digits of their lengths
        a, b = edges[np.argmax(np.round(lengths / lengths.max(), 9))].tolist()
        vertices.append(0.5 * (vertices[a] + vertices[b]))
        halves = []
        for face in faces:
            if a in face and b in face:
                halves += [tuple(len(vertices) - 1 if corner == end else corner for corner in face) for end in (a, b)]
            else:
                halves.append(face)
        faces = halves
    return np.array(vertices), np.array(faces)


def sound(shell, vertices, faces, need, vertex_count, mirror=None, last=False) -> tuple[ClosedMesh | None, str]:
    """The cage of these faces, drawn as close as holds, and what is wrong with it; or None and why there is none.
    `mirror`: function of the vertices that makes them symmetric, or None; `last`: take them as they are if need be."""
    if abs(len(vertices) - vertex_count) > 0.1 * vertex_count:
        return None, f"decimation left {len(vertices)} vertices"
    start, reasons = vertices, []
    for rounds in _LAST_ROUNDS if last else _ROUNDS:
        even = spread(shell, start, faces, need, mirror, rounds)
        reason = tangle(shell, even, faces)
        if reason:
            reasons.append(reason)
            continue
        close = drawn_close(shell, even, faces, need, mirror)
        for share in _DRAWN:
            vertices = even + share * (close - even)
            reason = tangle(shell, vertices, faces)
            if not reason:
                vertices = cleared(shell, vertices, faces, need, mirror)
                reason = flaw(shell, vertices, faces, need)
            if not reason:
                return ClosedMesh(vertices, faces), _LOOSE if rounds < _ROUNDS[0] and share == 0.0 else ""
        reasons.append(reason)
    return None, reasons[0]


def flaw(shell, vertices, faces, need) -> str:
    """Why a cage does not hold; empty when it does."""
    cage = ClosedMesh(vertices, faces)
    try:
        require_usable(cage, "it")
    except ValueError as error:
        return str(error)
    if shortfall(shell, vertices, faces, cage.edges, need).max() > 0.0:
        return "its faces cannot be kept off the object"
    if not inside_mesh(shell.skin, cage).all():
        return "it leaves a part of the object out"
    return tangle(shell, vertices, faces)


def tangle(shell, vertices, faces) -> str:
    """What moving it a little will not mend; empty where nothing is."""
    if (winding_numbers(shell.inside_parts, vertices, faces) < 0.5).any():
        return "it leaves a part of the object out"
    if len(intersecting_faces(vertices, faces)):
        return "it passes through itself"
    return ""


def edge_length(shell, level, vertex_count) -> float:
    """Edge of the equilateral triangles, two a vertex, that would cover the object's offset surface."""
    vertices, faces = shell.surface(level)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return float(np.sqrt(2.0 * area / (np.sqrt(3.0) * vertex_count)))


def decimated(vertices, faces, vertex_count) -> tuple[np.ndarray, np.ndarray]:
    """The surface with about `vertex_count` vertices: quadric edge collapse (Garland and Heckbert 1997)."""
    import pymeshlab

    # V - E + F = V - F / 2 does not change in a collapse that keeps the topology
    target = 2 * vertex_count - (2 * len(vertices) - len(faces))
    meshes = pymeshlab.MeshSet(verbose=False)  # pyright: ignore[reportAttributeAccessIssue]
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))  # pyright: ignore[reportAttributeAccessIssue]
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(target), qualitythr=1.0, preservenormal=True, preservetopology=True, planarquadric=True,
        planarweight=0.01,
    )  # fmt: skip
    result = meshes.current_mesh()
    return np.array(result.vertex_matrix()), np.array(result.face_matrix())
