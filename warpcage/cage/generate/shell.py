"""A tight cage: the object closed and offset on a grid, decimated outward, drawn close while it stays around."""

from __future__ import annotations

import concurrent.futures
import functools
import importlib
import math
import sys
import threading
from typing import Any

import numpy as np
import warp as wp

from ...core.devices import launch, resolve_device
from ...core.names import error_line
from ...core.threads import cpu_threads
from ...errors import InputError, MissingPackageError
from ...kernels.mesh.shell import look_up, look_up_directions, look_up_faces, measure_nearest
from ...mesh.mesh import ClosedMesh
from ...mesh.queries import inside_mesh, intersecting_faces
from ...mesh.validity import require_usable, winding_numbers
from ..shapes import box
from .decimate import on_cpu, progressive_hull
from .fit import cleared, drawn_close, shortfall, spread

#: Steps of a look-up, and of a search for the nearest point, as `launch` counts them.
_LOOK_UP_WORK, _SEARCH_WORK = 1, 128

#: How much farther than asked for is searched, so that rounding leaves what is given for the rest above it.
_BEYOND = 1.0 + 1e-9


class ObjectShell:
    """Distances around a solid given by points (p, 3), world units, in a grid that reaches `reach` beyond them.
    Points leave no hole wider than `spacing`, a voxel's side; near `need`, a cage's distance, distances are exact."""

    def __init__(self, points: np.ndarray, spacing: float, reach: float, need: float):
        import scipy.ndimage
        import skimage.filters
        import skimage.measure

        self.spacing, self.reach = float(spacing), float(reach)  # closing radius: fills gaps narrower than twice that
        radius = int(np.ceil(reach / spacing)) + 3
        # centre of voxel 0; the object's bounds, and points a voxel apart from there on, lie in the middle of voxels,
        # where last digits do not decide which voxel is theirs
        self.lower = points.min(axis=0) - radius * spacing
        cell = np.floor((points - self.lower) / spacing + 0.5).astype(np.int64)
        self.solid = np.zeros(cell.max(axis=0) + radius + 2, dtype=bool)
        self.solid[tuple(cell.T)] = True

        deep = np.asarray(scipy.ndimage.binary_erosion(self.solid, np.ones((3, 3, 3), dtype=bool), iterations=2), bool)
        near = np.flatnonzero(~deep[tuple(cell.T)])  # what lies two voxels below the skin is nearest to nothing outside
        places = np.asarray(np.ravel_multi_index(tuple(cell[near].T), self.solid.shape))
        one = first_of_each(places, self.solid.size)
        self.skin = points[near[one]]  # (n, 3) one in each voxel less than two voxels from free space
        # from far off a search among all points is slow and more than is needed: voxels stand for those they hold
        self._coarse = np.sqrt(0.75) * spacing if need > 6.0 * spacing else 0.0
        self._search = (
            NearestInTree(self.lower + cell[near[one]] * spacing)
            if self._coarse
            else NearestInVoxels(points[near], places, self.solid.shape, self.lower, spacing)
        )
        self.distance = self._distances(radius, need, deep)  # (nx, ny, nz) from voxel centres to the nearest point
        beyond = self.distance > reach
        parts = np.asarray(skimage.measure.label(beyond, connectivity=1))
        outside = parts == parts[0, 0, 0]  # the corner is free, so cavities of the dilated object are not part of it
        # by the triangle inequality reach - inward never exceeds the distance to the object; the voxel nearest to the
        # true rim of what is outside may lie half a diagonal behind it, which would keep cages so much farther off
        inward = distance_to(outside, radius) * spacing - np.sqrt(0.75) * spacing
        # signed distance to the object closed by a ball of radius `reach` (Serra 1982), never above `distance`
        self.closed = np.where(outside, self.distance, np.minimum(self.distance, reach - inward)).astype(np.float64)
        self.smooth = skimage.filters.gaussian(self.closed, 1.0, mode="nearest", truncate=3.0)  # surface and slopes
        self._closed = on_cpu(self.closed, wp.float64)
        self._slope = [on_cpu(np.asarray(slope), wp.float64) for slope in np.gradient(self.smooth, spacing)]
        self._grid = (wp.vec3d(*self.lower), wp.float64(self.spacing))

    def _distances(self, radius: int, need: float, deep) -> np.ndarray:
        """Exact within a voxel of `need`, between voxel centres from 2.5 on, 0 deep inside; mixed in between."""
        distance = distance_to(self.solid, radius).astype(np.float64) * self.spacing
        far = np.clip(np.abs(distance - need) / self.spacing - 1.0, 0.0, 1.5) / 1.5
        near = (far < 1.0) & ~deep
        # points lie at most half a diagonal from the middle of their voxel
        about = distance[near] + np.sqrt(0.76) * self.spacing
        exact = self.exact_distance(self.lower + np.argwhere(near) * self.spacing, about)
        distance[near] = (1.0 - far[near]) * exact + far[near] * np.minimum(distance[near], exact)
        return distance

    def surface(self, level: float, step: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (v, 3), world units, and outward faces (f, 3) of the closed object's offset by `level`.
        `step`: voxels a side of the cubes that are marched."""
        import skimage.measure

        nodes, faces, _, _ = skimage.measure.marching_cubes(self.smooth, level=level, step_size=step)
        nodes = nodes.astype(np.float64)
        a, b, c = (nodes[faces[:, k]] for k in range(3))
        if np.einsum("fi,fi->", a, np.cross(b, c)) < 0.0:
            faces = faces[:, ::-1]
        return self.lower + nodes * self.spacing, np.ascontiguousarray(faces)

    def closed_distance(self, x: np.ndarray) -> np.ndarray:
        """`closed` at points x (..., 3), trilinear; beyond the grid its value at the grid's edge."""
        found = np.empty(x.shape[:-1])
        inputs = [on_cpu(x.reshape(-1, 3), wp.vec3d), self._closed, *self._grid]
        launch(look_up, found.size, inputs, [on_cpu(found.reshape(-1), wp.float64)], device="cpu", work=_LOOK_UP_WORK)
        return found

    def closed_distance_on_faces(self, vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """`closed` at the samples (f, s) of barycentric weights (s, 3) on faces (f, 3), as `points_on` has them."""
        found = np.empty((len(faces), len(weights)))
        inputs = [on_cpu(vertices, wp.vec3d), on_cpu(faces.astype(np.int32), wp.vec3i), on_cpu(weights, wp.vec3d)]
        inputs += [self._closed, *self._grid]
        work = _LOOK_UP_WORK * len(weights)
        launch(look_up_faces, len(faces), inputs, [on_cpu(found, wp.float64)], device="cpu", work=work)
        return found

    def exact_distance(self, x: np.ndarray, about: np.ndarray, most: float = math.inf) -> np.ndarray:
        """(n,) distance from x (n, 3) to the object's skin, up to 1.8 voxels less where `need` is more than six voxels.
        `about` (n,): how far it likely is at most; beyond `most` any larger number may come. Both only save time."""
        about, beyond = np.maximum(about, 0.5 * self.spacing), (most + self._coarse) * _BEYOND
        return np.maximum(self._search.distance(x, about, beyond) - self._coarse, 0.0)

    def outward(self, x: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) in which `closed` grows fastest at x (n, 3); zero where it is flat."""
        found = np.empty(x.shape)
        inputs = [on_cpu(x, wp.vec3d), *self._slope, *self._grid]
        work = 3 * _LOOK_UP_WORK
        launch(look_up_directions, len(x), inputs, [on_cpu(found, wp.vec3d)], device="cpu", work=work)
        return found

    @functools.cached_property
    def inside_parts(self) -> np.ndarray:
        """(k, 3) centre of one voxel of each connected part of the object: the one nearest to the part's middle."""
        import skimage.measure

        parts = np.asarray(skimage.measure.label(self.solid, connectivity=3))
        cells = np.argwhere(self.solid)
        part = parts[tuple(cells.T)] - 1
        count = np.bincount(part)
        # a corner of a part would be half outside, and the first to be left out by what can still be moved
        middle = np.stack([np.bincount(part, weights=cells[:, k]) for k in range(3)], axis=1) / count[:, None]
        # in whole numbers of 1e-6: cells at one distance are taken by their order, not by last digits
        off = np.round(((cells - middle[part]) ** 2).sum(axis=1), 6)
        order = np.lexsort((off, part))
        return self.lower + cells[order[np.cumsum(count) - count]] * self.spacing


class NearestInVoxels:
    """Distances to the nearest of points (p, 3) that lie in voxels places (p,) of a grid, numbered row by row."""

    def __init__(self, points, places, shape, lower, spacing):
        starts = np.zeros(math.prod(shape) + 1, dtype=np.int32)
        np.cumsum(np.bincount(places, minlength=len(starts) - 1), out=starts[1:])
        resolve_device("cpu")  # starts Warp
        self._inputs = [
            on_cpu(points[np.argsort(places, kind="stable")], wp.vec3d),
            on_cpu(starts, wp.int32),
            wp.vec3i(*shape),
            wp.vec3d(*lower),
            wp.float64(spacing),
        ]

    def distance(self, x: np.ndarray, about: np.ndarray, most: float = math.inf) -> np.ndarray:
        """(n,) distance from x (n, 3) to the nearest point, to the same bits as SciPy's KDTree; about (n,) > 0: where
        the search begins; most > 0: where it ends."""
        found = np.empty(len(x))
        inputs = [on_cpu(x, wp.vec3d), on_cpu(about, wp.float64), wp.float64(most), *self._inputs]
        launch(measure_nearest, len(x), inputs, [on_cpu(found, wp.float64)], device="cpu", work=_SEARCH_WORK)
        return found


class NearestInTree:
    """Distances to the nearest of points (p, 3), however far they are."""

    def __init__(self, points):
        import scipy.spatial

        # large leaves and no balancing: built in half the time and searched in less, for the same distances
        self._tree = scipy.spatial.KDTree(points, leafsize=32, balanced_tree=False)

    def distance(self, x: np.ndarray, about: np.ndarray, most: float = math.inf) -> np.ndarray:
        """(n,) distance from x (n, 3) to the nearest point; infinite where it is more than `most`."""
        return self._tree.query(x, distance_upper_bound=most, workers=cpu_threads())[0]


def first_of_each(numbers: np.ndarray, count: int) -> np.ndarray:
    """Index of the first of each of the numbers (n,), 0 to count - 1, in the order of the numbers."""
    first = np.full(count, -1)
    first[numbers[::-1]] = np.arange(len(numbers))[::-1]  # of several values at one place the last stays
    return first[first >= 0]


def distance_to(mask: np.ndarray, radius: int) -> np.ndarray:
    """Euclidean distance in voxels from each voxel centre to the nearest one of `mask`, at most `radius`; float32."""
    # the smaller the numbers, the more of them pass at once; a sum of two is the largest
    kind = np.uint16 if 2 * radius * radius < 2**16 else np.uint32
    squared = np.where(mask, kind(0), kind(radius * radius))
    farther = np.empty_like(squared)
    for axis in range(3):  # exact and separable: along one axis after the other (Saito and Toriwaki 1994)
        rows = np.moveaxis(squared, axis, 0)
        nearest, room = rows.copy(order="K"), np.moveaxis(farther, axis, 0)
        for step in range(1, min(radius, len(rows) - 1) + 1):
            np.add(rows, kind(step * step), out=room)
            np.minimum(nearest[step:], room[:-step], out=nearest[step:])
            np.minimum(nearest[:-step], room[step:], out=nearest[:-step])
        squared = np.moveaxis(nearest, 0, axis)
    return np.sqrt(np.ascontiguousarray(squared).astype(np.float32))


#: Closing radii tried, in lengths of the cage's edges: the first gives the tightest cage.
CLOSINGS = (0.45, 0.7, 1.0, 1.5, 2.2, 3.3, 5.0)

#: Share of the way from `need` to the closing radius at which the surface to decimate lies.
_START = 0.4

#: Voxels off the object where the smoothed distance has a surface, whatever the object: smoothing over one voxel lifts
#: the distance to a sheet, a line and a point to 0.8, 1.3 and 1.6 at the object itself.
_MIN_LEVEL = 1.8

#: Rounds of spreading, tried in this order, as many may tangle a thin surface; shares of the way from there to drawn
#: close; and the rounds tried where nothing else holds: the surface given holds the object by construction.
_ROUNDS, _DRAWN, _LAST_ROUNDS = (25, 10, 4), (1.0, 0.75, 0.5, 0.25, 0.0), (0,)

#: What is wrong with a cage that is neither spread evenly nor drawn: it holds, but a wider closing may be tighter.
_LOOSE = "it could not be drawn close"

#: Vertices of the surface that a progressive hull begins with, for each that it leaves, and whether the last rounds are
#: tried: all closings are tried with the first, then, where none of them holds, with the next.
_ATTEMPTS = ((6, False), (9, False), (4, False), (6, True))


def shell_cage(points, spacing, slack, margin, vertex_count, symmetry=None, progress=False) -> ClosedMesh:
    """Try ever wider closings until a cage comes out that holds; slack: how far the object may lie off its points."""
    size = np.ptp(points, axis=0).max()
    need = slack + margin
    shell = ObjectShell(points, spacing, need + max(0.06 * size, 2.0 * spacing), need)
    edge = edge_length(shell, max(need, _MIN_LEVEL * spacing), vertex_count)
    reasons = []
    for fine, last in _ATTEMPTS:
        found = []
        for closing in CLOSINGS:
            coarse = max(spacing, closing * edge / 16.0)  # wide closings need no fine voxels
            room = max(closing * edge, 2.0 * coarse, (_MIN_LEVEL * coarse - need) / _START)
            shell = ObjectShell(points, coarse, need + room, need)
            step = 2 if edge > 8.0 * coarse else 1
            start = decimated(*shell.surface(need + _START * (shell.reach - need), step), fine * vertex_count)
            cage, reason = sound(
                shell, *progressive_hull(*start, vertex_count, progress), need, vertex_count, last=last
            )
            found += [cage] if cage else []
            if not reason:
                break
            reasons.append(reason)
        if found:
            return min(found, key=lambda cage: cage.volume)
    # no closing is wider than a box, which holds as it is
    cage, reason = sound(shell, *split_box(points, 1.5 * shell.reach, vertex_count), need, vertex_count, last=True)
    if cage is None:
        raise InputError(f"{reason}; before: {', '.join(dict.fromkeys(reasons))}")
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
