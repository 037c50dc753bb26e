"""A tight cage: the object closed and offset on a grid, decimated outward, drawn close while it stays around."""

from __future__ import annotations

import concurrent.futures
import importlib
import math
import sys
import threading
import warnings
from typing import Any

import numpy as np
import warp as wp

from ...core.devices import launch
from ...core.names import error_line
from ...core.reports import Progress, report_progress
from ...errors import InputError, MissingPackageError
from ...kernels.mesh.crossings import count_crossings
from ...mesh.faces import face_area
from ...mesh.mesh import ClosedMesh
from ...mesh.queries import intersecting_faces
from ...mesh.validity import require_usable, winding_numbers
from ..shapes import box
from .decimate import Sizing, edge_length, progressive_hull, relative_sizes
from .distance import ObjectShell, ObjectVoxels, on_cpu
from .fit import cleared, drawn_close, spread
from .mirror import Mirror, joined_halves
from .parts import part_sizing, symmetric_sizing

#: Closing radii tried, in lengths of the cage's edges: the first gives the tightest cage.
CLOSINGS = (0.45, 0.7, 1.0, 1.5, 2.2, 3.3, 5.0)

#: Those tried where parts shall stay apart: the first that the count allows is taken.
PART_CLOSINGS = (0.1, 0.2, 0.3, *CLOSINGS)

#: Share of the way from `need` to the closing radius at which the surface to decimate lies.
_START = 0.4

#: Side of voxels, in those that there are, from which other ones are made.
_WORTH = 1.5

#: Cubes along a cage's edge where that surface is marched, and voxels along a cube at most.
_CUBES, _MAX_STEP = 4, 3

#: Voxels off the object where the smoothed distance has a surface, whatever the object: smoothing over one voxel lifts
#: the distance to a sheet, a line and a point to 0.8, 1.3 and 1.6 at the object itself.
_MIN_LEVEL = 1.8

#: Rounds of spreading, tried in this order, as many may tangle a thin surface; shares of the way from there to drawn
#: close; and the rounds tried where nothing else holds: the surface given holds the object by construction. Where faces
#: that would cross others go back, rounds matter little, and a closing that does not hold is known sooner.
_ROUNDS, _DRAWN, _LAST_ROUNDS = (25, 10, 4), (1.0, 0.0, 0.75, 0.5, 0.25), (0,)
_APART_ROUNDS = (25, 4)

#: What is wrong with a cage that cannot be cleared, with one that is neither spread evenly nor drawn, and with one that
#: has spikes: the last two hold, but a wider closing may give a better one.
NOT_CLEAR = "its faces cannot be kept off the object"
_LOOSE, STRAYS = "it could not be drawn close", "a vertex is far off the object"

#: Share of the object's voxels from which free places that a closing fills are worth a word.
_FILLED = 0.05

#: Cosine between the normals of neighbours below which they lie on each other: they meet at less than 2.6 degrees.
_FOLDED = -0.999

#: Least share of a way, beyond none, that vertices go whose faces would pass through others.
MIN_WAY = 0.2

#: Mean sides of faces, beyond what `need` explains, that vertices may be off the object.
_CORNER, _FARTHEST = 1.75, 1.5

#: Times more vertices that decimation begins with at most, where a sizing has them dense.
_DENSEST = 1.5

#: Vertices of the surface that a progressive hull begins with, for each that it leaves, and whether the last rounds are
#: tried: all closings are tried with the first, then, where none of them holds, with the next.
_ATTEMPTS = ((6, False), (9, False), (4, False), (6, True))


def shell_cage(
    voxels: ObjectVoxels,
    vertex_count: int,
    plane: tuple[int, float] | None = None,
    progress: bool | Progress = False,
    sizing: Sizing = None,
    detail: str = "even",
) -> ClosedMesh:
    """Try ever wider closings until a cage comes out that holds. plane: of symmetry, of the object too, (axis,
    place)."""
    points, spacing, need = voxels.points, voxels.spacing, voxels.need
    shell = ObjectShell(voxels, need + max(0.06 * voxels.size, 2.0 * spacing))
    edge = edge_length(*shell.surface(max(need, _MIN_LEVEL * spacing)), vertex_count)
    closings, apart, reasons, finest = CLOSINGS, detail == "parts", [], None
    if apart:
        closings, finest = PART_CLOSINGS, voxels.narrow_shell
        sizing = part_sizing(finest, max(need, _MIN_LEVEL * spacing), sizing)
        sizing = symmetric_sizing(sizing, plane) if plane else sizing
    for fine, last in _ATTEMPTS:
        found, shells = [], []
        for closing in closings:
            coarse = closing * edge / 16.0  # wide closings need no fine voxels
            if coarse < _WORTH * spacing:
                coarse = spacing
            room = max(closing * edge, 2.0 * coarse, (_MIN_LEVEL * coarse - need) / _START)
            if coarse != voxels.spacing:
                voxels = ObjectVoxels(points, coarse, need)
            shell = ObjectShell(voxels, need + room)
            level = need + _START * room
            # cubes with a node in each ball of the level's radius: nothing thin is missed
            step = int(np.clip(min(edge / _CUBES, level) / coarse, 1, _MAX_STEP))
            surface = shell.surface(level, step, plane)
            count = fine * vertex_count * denser(*surface, sizing)
            if plane:
                start = joined_halves(*decimated(*surface, half_of(count, *surface, plane)), plane)
            else:
                start = decimated(*surface, int(count))
            mirror = Mirror.of(start[0], plane) if plane else None
            hull = progressive_hull(*start, vertex_count, progress, sizing, apart, mirror)
            mirror = Mirror.of(hull[0], plane) if plane else None
            cage, reason = sound(shell, *hull, need, vertex_count, mirror, last, sizing, apart)
            if cage:
                found.append(cage)
                shells.append(shell)
            if not reason:
                break
            reasons.append(reason)
        if found:
            cage = best_cage(voxels, found, sizing)
            if finest:
                say_closed(finest, shells[[each is cage for each in found].index(True)], cage, progress)
            return cage
    if plane:
        raise InputError(", ".join(dict.fromkeys(reasons)))
    # no closing is wider than a box, which holds as it is
    cage, reason = sound(
        shell, *split_box(voxels.bounds, 1.5 * shell.reach, vertex_count), need, vertex_count, last=True
    )
    if cage is None:
        raise InputError(f"{reason}; before: {', '.join(dict.fromkeys(reasons))}")
    return cage


def say_closed(finest: ObjectShell, shell: ObjectShell, cage: ClosedMesh, progress: bool | Progress) -> None:
    """One line where a cage, made of `shell`, has fewer parts or holes than the object's `finest` shell, or closes
    gaps."""
    import scipy.ndimage

    need, unit = finest.voxels.need, finest.spacing
    level = max(need, _MIN_LEVEL * unit)
    before, after, lost = ClosedMesh(*finest.surface(level)).topology, cage.topology, []
    # what is free before and filled now, over what there is
    free = np.argwhere(finest.closed > level)
    places = ((finest.lower + free * unit - shell.lower) / shell.spacing).T
    # of cells with a corner that is filled: most are far outside
    around = scipy.ndimage.minimum_filter(shell.closed, 2, origin=-1, mode="nearest")
    ends = np.array(shell.closed.shape)[:, None] - 1
    cells = np.clip(np.floor(places).astype(np.int64), 0, ends)
    places = places[:, around[tuple(cells)] <= 0.5 * need]
    filled = scipy.ndimage.map_coordinates(shell.closed, places, order=1, mode="nearest") <= 0.5 * need
    if filled.sum() > _FILLED * (finest.closed.size - len(free)):
        lost.append(f"gaps narrower than {200.0 * shell.reach / finest.voxels.size:.0f} % of the object's size")
    holes, kept = before.genus or 0, after.genus or 0
    if holes > kept:
        lost.append(f"{holes - kept} of {holes} holes")
    if before.part_count > after.part_count:
        lost.append(f"the space between {before.part_count} parts, of which it has {after.part_count}")
    if lost:
        line = f"a cage of {len(cage.vertices)} vertices closes {' and '.join(lost)}: more vertices keep more of them"
        report_progress(progress, 1, 1, line)
        warnings.warn(line, stacklevel=2)


def denser(vertices, faces, sizing: Sizing) -> float:
    """How many times denser than evenly vertices lie where a sizing has them densest, at most `_DENSEST` times."""
    if sizing is None:
        return 1.0
    least = np.quantile(relative_sizes(sizing, vertices), 0.1) * edge_length(vertices, faces, 1, sizing)
    return float(np.clip((edge_length(vertices, faces, 1) / least) ** 2, 1.0, _DENSEST))


def half_of(count, vertices, faces, plane: tuple[int, float]) -> int:
    """What to ask of `decimated` for a half (v, 3), (f, 3) that has `count` vertices once it is joined."""
    # of the half V - F / 2 does change, as its rim gets shorter; of what it is joined to it does not
    whole, triangles = joined_halves(vertices, faces, plane)
    return int(0.5 * (count - (len(whole) - 0.5 * len(triangles)) + 2 * len(vertices) - len(faces)))


def split_box(bounds, room, vertex_count) -> tuple[np.ndarray, np.ndarray]:
    """The box `room` off bounds (2, 3), its longest edges split in the middle up to `vertex_count` vertices."""
    corners, triangles = box(bounds[0] - room, bounds[1] + room)
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


def sound(
    shell,
    vertices,
    faces,
    need,
    vertex_count,
    mirror: Mirror | None = None,
    last=False,
    sizing: Sizing = None,
    apart=False,
) -> tuple[ClosedMesh | None, str]:
    """The cage of these faces, drawn as close as holds, and what is wrong with it; or None and why there is none.
    `mirror`: makes the vertices symmetric; `last`: take them as they are if need be."""
    if abs(len(vertices) - vertex_count) > max(0.1 * vertex_count, mirror is not None):
        return None, f"decimation left {len(vertices)} vertices"
    start, reasons = vertices, []
    for rounds in _LAST_ROUNDS if last else _APART_ROUNDS if apart else _ROUNDS:
        even = spread(shell, start, faces, need, mirror, rounds)
        if apart:
            even = untangled(start, even, faces, mirror)
        reason = tangle(shell, even, faces)
        if reason:
            reasons.append(reason)
            continue
        close = drawn_close(shell, even, faces, need, mirror)
        if apart:
            close = untangled(even, close, faces, mirror)
        tried: dict[float, tuple[np.ndarray, str]] = {}
        for share in _DRAWN:
            tried[share] = kept_off(shell, even + share * (close - even), faces, need, mirror)
            if (not tried[share][1]) == (share > 0.0):  # where what is not drawn does not hold, little in between does
                break
        held = [share for share, (_, wrong) in tried.items() if not wrong]
        if held:
            cage = ClosedMesh(tried[max(held)][0], faces)
            loose = rounds < _ROUNDS[0] and max(held) == 0.0
            return cage, _LOOSE if loose else STRAYS if strays(shell.voxels, cage, sizing) else ""
        reasons.append(tried[0.0][1])
    return None, reasons[0]


def kept_off(shell, vertices, faces, need, mirror: Mirror | None) -> tuple[np.ndarray, str]:
    """Vertices (v, 3) once their faces are kept off the object, and what is wrong with them then."""
    reason = tangle(shell, vertices, faces)
    if reason:
        return vertices, reason
    vertices, clear = cleared(shell, vertices, faces, need, mirror)
    return vertices, flaw(shell, vertices, faces) if clear else NOT_CLEAR


def untangled(before, after, faces, mirror: Mirror | None = None) -> np.ndarray:
    """Vertices (v, 3) moved from before (v, 3), where no faces pass through each other, to after (v, 3) or, where some
    would, a part of the way."""
    share = np.ones(len(before))
    while True:
        vertices = before + share[:, None] * (after - before)
        pairs = intersecting_faces(vertices, faces)
        if not len(pairs):
            return vertices
        rows = np.unique(faces[pairs])
        rows = rows if mirror is None else np.union1d(rows, mirror.partner[rows])
        if not share[rows].any():
            return vertices
        share[rows] = np.where(share[rows] > MIN_WAY, 0.5 * share[rows], 0.0)


def strays(voxels: ObjectVoxels, cage: ClosedMesh, sizing: Sizing = None) -> bool:
    """Whether a vertex is farther off the object than the count of vertices explains."""
    side = math.sqrt(face_area(cage) / len(cage.vertices))
    if sizing is not None:  # where it is 1
        one = edge_length(cage.vertices, cage.faces, 1, sizing) / edge_length(cage.vertices, cage.faces, 1)
        side = side * one * relative_sizes(sizing, cage.vertices)
    bound = np.broadcast_to(_CORNER * voxels.need + _FARTHEST * side, len(cage.vertices))
    return bool((voxels.exact_distance(cage.vertices, bound, float(bound.max())) > bound).any())


def best_cage(voxels: ObjectVoxels, cages: list[ClosedMesh], sizing: Sizing = None) -> ClosedMesh:
    """The tightest of cages whose vertices keep near, or else of all."""
    return min(cages, key=lambda cage: (strays(voxels, cage, sizing), cage.volume))


def flaw(shell, vertices, faces) -> str:
    """Why a cage whose faces keep off the object does not hold; empty when it does."""
    cage = ClosedMesh(vertices, faces)
    try:
        require_usable(cage, "it")
    except ValueError as error:
        return str(error)
    if (crossings(shell.voxels.skin, vertices, faces) < 1).any():
        return "it leaves a part of the object out"
    return tangle(shell, vertices, faces)


#: A turn about an axis such that no edge of an object, or row of points, is along a ray or under another.
_ASKEW = np.linalg.qr(np.array([[0.83, 0.31, -0.17], [-0.29, 0.71, 0.43], [0.37, -0.23, 0.91]]))[0]

#: Strips that the faces are sorted in for rays.
_STRIPS = 64


def crossings(points, vertices, faces) -> np.ndarray:
    """(n,) winding number of a closed mesh about points (n, 3), none of which is on a face."""
    points, vertices = np.matmul(points, _ASKEW), np.matmul(vertices, _ASKEW)
    corners = vertices[faces][:, :, :2]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    lower = float(boxes[:, 0].min())
    width = float(boxes[:, 2].max() - lower) * (1.0 + 1e-9) / _STRIPS
    begin, end = (np.floor((boxes[:, k] - lower) / width).astype(np.int64) for k in (0, 2))
    counts = end - begin + 1
    face = np.repeat(np.arange(len(faces)), counts)
    strips = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts - begin, counts)
    starts = np.zeros(_STRIPS + 1, dtype=np.int32)
    np.cumsum(np.bincount(strips, minlength=_STRIPS), out=starts[1:])
    found = np.empty(len(points), dtype=np.int32)
    inputs = [on_cpu(points, wp.vec3d), on_cpu(vertices, wp.vec3d), on_cpu(faces.astype(np.int32), wp.vec3i)]
    inputs += [on_cpu(boxes, wp.vec4d), on_cpu(starts, wp.int32)]
    inputs += [on_cpu(face[np.argsort(strips, kind="stable")].astype(np.int32), wp.int32)]
    inputs += [wp.float64(lower), wp.float64(width)]
    launch(count_crossings, len(points), inputs, [on_cpu(found, wp.int32)], device="cpu", work=len(faces) / 8)
    return found


def tangle(shell, vertices, faces) -> str:
    """What moving it a little will not mend; empty where nothing is."""
    if (winding_numbers(shell.voxels.inside_parts, vertices, faces) < 0.5).any():
        return "it leaves a part of the object out"
    if len(intersecting_faces(vertices, faces)):
        return "it passes through itself"
    if len(folded_pairs(vertices, faces)):
        return "two of its faces lie on each other"
    return ""


def folded_pairs(vertices, faces) -> np.ndarray:
    """(k, 2) faces of a closed mesh that share an edge and lie on each other."""
    a, b, c = np.swapaxes(vertices[faces], 0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs = np.lexsort(edges.T).reshape(-1, 2) // 3
    return pairs[np.einsum("ei,ei->e", normals[pairs[:, 0]], normals[pairs[:, 1]]) < _FOLDED]


def _load_pymeshlab() -> Any:
    """PyMeshLab, which is loaded here alone, by a thread that does not end before the process does."""
    try:
        if threading.current_thread() is threading.main_thread() or "pymeshlab" in sys.modules:
            return importlib.import_module("pymeshlab")
        loaded: concurrent.futures.Future = concurrent.futures.Future()
        threading.Thread(target=_load_and_stay, args=(loaded,), name="pymeshlab", daemon=True).start()
        return loaded.result()
    except ImportError as error:
        raise MissingPackageError(
            f"generating a cage needs PyMeshLab ({error_line(error)}): pip install pymeshlab, or take a box, a "
            "cylinder or a cage of your own"
        ) from error


def _load_and_stay(loaded: concurrent.futures.Future) -> None:
    """Load PyMeshLab and wait for ever."""
    # Its Qt frees what it notes of the thread that loaded the plugins where that thread ends, and once more when the
    # process does (~QPluginLoader): malloc then aborts it.
    try:
        loaded.set_result(importlib.import_module("pymeshlab"))
    except BaseException as error:  # the caller's
        loaded.set_exception(error)
    else:
        threading.Event().wait()


def decimated(vertices, faces, vertex_count) -> tuple[np.ndarray, np.ndarray]:
    """The surface with about `vertex_count` vertices: quadric edge collapse (Garland and Heckbert 1997)."""
    pymeshlab = _load_pymeshlab()
    # V - E + F = V - F / 2 does not change in a collapse that keeps the topology
    target = 2 * vertex_count - (2 * len(vertices) - len(faces))
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    # every one: PyMeshLab takes what is left out from the last call in the process, somebody else's too
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(target), targetperc=0.0, qualitythr=1.0, preserveboundary=False, boundaryweight=1.0,
        preservenormal=True, preservetopology=True, optimalplacement=True, planarquadric=True, planarweight=0.01,
        qualityweight=False, autoclean=True, selected=False,
    )  # fmt: skip
    result = meshes.current_mesh()
    return np.array(result.vertex_matrix()), np.array(result.face_matrix())
