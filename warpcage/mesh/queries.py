"""Which points lie inside a mesh, and which faces of a mesh pass through each other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import PointsLike, as_given, as_host_points, is_device_array, points_device, points_in_turn
from ..core.devices import launch
from ..core.modules import Kernel
from .faces import column_cross
from .mesh import ClosedMesh
from .surface import CELLS
from .validity import require_usable

#: Points this close to a mesh, as a share of its size, count as inside.
SURFACE_TOLERANCE = 1e-5


@overload
def inside_mesh(
    points: np.ndarray, mesh: ClosedMesh, *, tolerance: float = ..., device: wp.DeviceLike = ...
) -> np.ndarray: ...


@overload
def inside_mesh(
    points: PointsLike, mesh: ClosedMesh, *, tolerance: float = ..., device: wp.DeviceLike = ...
) -> Any: ...


@points_in_turn
def inside_mesh(
    points: PointsLike, mesh: ClosedMesh, *, tolerance: float = SURFACE_TOLERANCE, device: wp.DeviceLike = None
) -> Any:
    """Whether points (n, 3), world units, are inside a usable mesh or on its surface: (n,) bool, of the points' kind.
    tolerance: points this close to the surface are inside, as a share of the mesh's size."""
    # Winding number above 1/2: cavities are outside, places that a tangled pose covers twice are inside.
    require_usable(mesh)
    host, place = as_host_points(points), points_device(points, device)
    inside = _inside(host, mesh.surface, tolerance, place)
    if not is_device_array(points):
        return inside
    return as_given(wp.array(inside, dtype=wp.bool, device=place), points)


def _inside(points: np.ndarray, mesh: ClosedMesh, tolerance: float, device: wp.Device) -> np.ndarray:
    from ..kernels.mesh.containment import measure_distance, measure_winding_number  # as in mesh.py

    # float32 relative to the mesh's middle, so that a mesh far from the origin keeps its digits, and to its size, so
    # that products of lengths stay in range
    center, size = mesh.bounds.mean(axis=0), mesh.size
    inside = np.zeros(len(points), dtype=bool)
    reach = tolerance * size
    near = np.flatnonzero(((points >= mesh.bounds[0] - reach) & (points <= mesh.bounds[1] + reach)).all(axis=1))
    vertices = wp.array(((mesh.vertices - center) / size).astype(np.float32), dtype=wp.vec3, device=device)
    faces = wp.array(mesh.faces, dtype=wp.vec3i, device=device)

    def measure(kernel: Kernel, rows: np.ndarray) -> np.ndarray:
        local = wp.array(((points[rows] - center) / size).astype(np.float32), dtype=wp.vec3, device=device)
        values = wp.empty(len(rows), dtype=wp.float32, device=device)  # pyright: ignore[reportArgumentType]
        launch(kernel, len(rows), [local, vertices, faces], [values], device=device, work=len(mesh.faces))
        return values.numpy()

    if len(near):
        inside[near] = measure(measure_winding_number, near) > 0.5
    outside = near[~inside[near]]
    if len(outside):
        inside[outside] = measure(measure_distance, outside) <= tolerance
    return inside


def crossing_faces(mesh: ClosedMesh) -> np.ndarray:
    """Pairs (k, 2) of faces of a mesh that cross or overlap, as `intersecting_faces`; a polygon that folds over itself
    is a pair with itself."""
    surface = mesh.surface
    pairs = intersecting_faces(surface.vertices, surface.faces)
    if mesh.polygon_faces is None:
        return pairs
    return np.unique(np.sort(mesh.polygon_faces.refined(CELLS).owner[pairs], axis=1), axis=0)


#: Overlaps and crossings below this share of the mesh's size are touching, not intersecting.
TOUCHING = 1e-9

#: Boxes smaller than 2 to this power of the mesh's size share a grid.
FINEST_LEVEL = -19

#: Pairs of boxes that are looked at together.
CANDIDATES = 1 << 20

#: Least number of pairs of faces that are tested together: a call costs as much as a few hundred of them.
PAIRS = 1 << 12


def intersecting_faces(vertices: ArrayLike, faces: ArrayLike) -> np.ndarray:
    """Pairs (k, 2) of faces that cross or overlap, the lower one first, in ascending order."""
    # Neighbours intersect when they fold onto each other. Pairs whose bounding boxes overlap are tested: edges against
    # triangles (Moeller and Trumbore 1997) and, in one plane, by separating axes.
    faces = np.asarray(faces, dtype=np.int64)
    places = np.asarray(vertices, dtype=np.float64)
    places = places - places[faces.reshape(-1)].mean(axis=0)
    size = np.ptp(places[faces.reshape(-1)], axis=0).max()
    if size == 0.0:
        return np.zeros((0, 2), dtype=np.int64)
    corners = places[faces] / size
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)
    found = [np.zeros((0, 2), dtype=np.int64)]
    for pairs in _together(overlapping_boxes(corners)):
        found.append(pairs[_crossing(pairs, faces, corners, normals, lengths[:, 0])])
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _together(parts: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """The same pairs in fewer, larger parts: at least PAIRS in each but the last."""
    held: list[np.ndarray] = []
    for part in parts:
        held.append(part)
        if sum(map(len, held)) >= PAIRS:
            yield np.concatenate(held)
            held = []
    if held:
        yield np.concatenate(held)


def _crossing(
    pairs: np.ndarray, faces: np.ndarray, corners: np.ndarray, normals: np.ndarray, lengths: np.ndarray
) -> np.ndarray:
    """Which of the pairs (p, 2) of faces (f, 3) with corners (f, 3, 3) cross or overlap; normals and their lengths."""
    one, two = pairs.T
    columns = np.ascontiguousarray(faces.T)
    first, second = np.take(columns, one, axis=1), np.take(columns, two, axis=1)
    same = [[first[i] == second[j] for j in range(3)] for i in range(3)]
    # an edge that begins or ends at a corner of the triangle touches it there and nowhere else
    free = np.empty((2, len(pairs), 3), dtype=bool)
    of_one, of_two = ([x | y | z for x, y, z in rows] for rows in (same, zip(*same, strict=True)))
    for side, common in enumerate((of_one, of_two)):
        for k in range(3):
            free[side, :, k] = ~(common[k] | common[(k + 1) % 3])
    alike = of_one[0] & of_one[1] & of_one[2]
    # the edges of each against the triangle of the other, all at once
    a, b = np.concatenate([one, two]), np.concatenate([two, one])
    row, k = np.nonzero(free.reshape(-1, 3))
    crossed = _segments_cross(corners[a[row], k], corners[a[row], (k + 1) % 3], corners[b[row]])
    crossing = np.zeros(2 * len(pairs), dtype=bool)
    crossing[row[crossed]] = True
    crossing = crossing[: len(pairs)] | crossing[len(pairs) :]
    flat = np.flatnonzero(~alike & (lengths[one] > 0.0) & (lengths[two] > 0.0))
    for k in range(3):
        offsets = corners[two[flat], k] - corners[one[flat], 0]
        flat = flat[np.abs(np.einsum("pi,pi->p", offsets, normals[one[flat]])) < 1e-7]
    crossing[flat] |= _overlap_in_plane(corners[one[flat]], corners[two[flat]], normals[one[flat]])
    return crossing | alike


def overlapping_boxes(corners: np.ndarray) -> Iterator[np.ndarray]:
    """Pairs (p, 2), i < j, of triangles (f, 3, 3) of a mesh of size 1 whose bounding boxes overlap, some at a time."""
    # Boxes are sorted by size into levels with grids of their own, whose cells no box of the level exceeds, by lower
    # corners. A box of the same level or a smaller one meets those in the cells that it touches and the ones before: at
    # most 3 x 3 x 3, of which three follow each other in the order of cells.
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    columns = [(np.ascontiguousarray(low[:, axis]), np.ascontiguousarray(high[:, axis])) for axis in range(3)]
    origin = low.min(axis=0)
    extents = (high - low).max(axis=1)
    levels = np.maximum(np.ceil(np.log2(np.maximum(extents, 2.0**FINEST_LEVEL))), FINEST_LEVEL).astype(np.int64)
    for level in np.unique(levels):
        held = np.flatnonzero(levels == level)
        asking = np.flatnonzero(levels <= level)
        side = 2.0**level
        first, last = (np.floor((ends[asking] - origin) / side).astype(np.int64) for ends in (low, high))
        step = int(last[:, 1:].max(initial=0)) + 4  # room for the cells before the first and after the last
        cells = np.floor((low[held] - origin) / side).astype(np.int64) + 1
        keys = (cells[:, 0] * step + cells[:, 1]) * step + cells[:, 2]
        order = np.argsort(keys, kind="stable")
        keys, held = keys[order], held[order]
        for x in range(3):
            for y in range(3):
                touched = np.flatnonzero((first[:, 0] + x <= last[:, 0] + 1) & (first[:, 1] + y <= last[:, 1] + 1))
                row = ((first[touched, 0] + x) * step + first[touched, 1] + y) * step
                begin = np.searchsorted(keys, row + first[touched, 2])
                end = np.searchsorted(keys, row + last[touched, 2] + 1, side="right")
                yield from meeting_boxes(asking[touched], held, begin, end, columns, levels)


def meeting_boxes(
    asking: np.ndarray,
    held: np.ndarray,
    begin: np.ndarray,
    end: np.ndarray,
    columns: list[tuple[np.ndarray, np.ndarray]],
    levels: np.ndarray,
) -> Iterator[np.ndarray]:
    """Pairs (p, 2), i < j, of boxes: each that asks, and what it overlaps of the held ones from `begin` to `end`.
    columns: lowest and highest places of all boxes along each axis."""
    total = np.cumsum(end - begin)
    start = 0
    while start < len(asking):
        # as many as make no more candidates than are looked at together, but at least one box's
        passed = total[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(total, passed + CANDIDATES, side="right")))
        counts = end[start:stop] - begin[start:stop]
        one = np.repeat(asking[start:stop], counts)
        within = np.arange(len(one)) - np.repeat(np.cumsum(counts) - counts, counts)
        two = held[np.repeat(begin[start:stop], counts) + within]
        meet = (levels[one] < levels[two]) | (one < two)  # of one level both boxes ask: one answer is enough
        one, two = one[meet], two[meet]
        for low, high in columns:
            meet = (low[one] <= high[two]) & (low[two] <= high[one])
            one, two = one[meet], two[meet]
        if len(one):
            yield np.stack([np.minimum(one, two), np.maximum(one, two)], axis=1)
        start = stop


def _segments_cross(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Whether segments (p, 3) - (p, 3) pass through the inside of triangles (p, 3, 3)."""
    u, v, along = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0], end - start
    normal = _cross(along, v)
    determinant = _dot(u, normal)
    scale = np.sqrt(_dot(u, u)) * np.sqrt(_dot(v, v)) * np.sqrt(_dot(along, along))
    steep = np.abs(determinant) > 1e-9 * scale
    inverse = 1.0 / np.where(steep, determinant, 1.0)
    offset = start - triangle[:, 0]
    b = _dot(offset, normal) * inverse
    crossing = steep & (b > TOUCHING) & (b < 1.0 - TOUCHING)
    left = np.flatnonzero(crossing)  # few: the rest is worked out for them alone
    b, inverse, turned = b[left], inverse[left], _cross(offset[left], u[left])
    c = _dot(along[left], turned) * inverse
    t = _dot(v[left], turned) * inverse
    crossing[left] = (c > TOUCHING) & (b + c < 1.0 - TOUCHING) & (t > TOUCHING) & (t < 1.0 - TOUCHING)
    return crossing


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (p, 3) of rows."""
    return column_cross(a.T, b.T).T


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (p,) of rows."""
    return np.einsum("pi,pi->p", a, b)


def _overlap_in_plane(one: np.ndarray, two: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Whether triangles (p, 3, 3) of one plane overlap in more than a line: no edge separates them."""
    separated = np.zeros(len(one), dtype=bool)
    for a in (one, two):
        for k in range(3):
            axis = np.cross(normal, a[:, (k + 1) % 3] - a[:, k])
            length = np.linalg.norm(axis, axis=1, keepdims=True)
            axis = axis / np.where(length > 0.0, length, 1.0)
            p, q = np.einsum("pki,pi->pk", one, axis), np.einsum("pki,pi->pk", two, axis)
            separated |= (p.max(axis=1) <= q.min(axis=1) + TOUCHING) | (q.max(axis=1) <= p.min(axis=1) + TOUCHING)
    return ~separated
