"""The paper's cage: the surface of coarse voxels along the object's principal axes, smoothed and pushed off it.
Xian, Lin and Gao 2009, "Automatic generation of coarse bounding cages from dense meshes"; not manifold: filled."""

from __future__ import annotations

import itertools

import numpy as np

from ...core.reports import Progress
from ...errors import InputError
from ...mesh.mesh import ClosedMesh
from .decimate import Sizing, progressive_hull
from .distance import ObjectShell, ObjectVoxels, bounds_of
from .fit import row_sums
from .mirror import Mirror
from .shell import STRAYS, best_cage, sound

#: Sizes of voxels tried, as shares of the longest side; and closing radii, in voxels.
_SIZES = np.geomspace(0.9, 0.012, 140)
_SHIFTS = tuple(itertools.product((0, 1), repeat=3))[1:]
_CLOSINGS = (0.3, 0.6, 1.0, 1.6, 2.5)

#: Variances of the points along two axes that differ by less, as a share of the largest, are equal.
_EQUAL_SPREAD = 1e-3

#: Voxels by which the grid is aside of the points' bounds: places on a round share of them lie on no voxel's face.
_ASIDE = 1e-6


def voxel_cage(
    voxels: ObjectVoxels,
    vertex_count: int,
    plane: tuple[int, float] | None = None,
    progress: bool | Progress = False,
    sizing: Sizing = None,
) -> ClosedMesh:
    """A cage of about `vertex_count` vertices around an object. plane: of symmetry, of the object too, (axis,
    place)."""
    import scipy.ndimage

    points, spacing, need = voxels.points, voxels.spacing, voxels.need
    axis, middle = plane or (None, 0.0)
    frame = np.eye(3) if axis is not None else principal_frame(points)  # with a mirror plane the world's
    side, reasons = None, []
    for last in (False, True):
        found = []
        for closing in _CLOSINGS:
            room = min(0.0 if side is None else closing * side, 40.0 * spacing)
            shell = ObjectShell(voxels, need + room) if room > 2.0 * spacing else voxels.narrow_shell
            solid = shell.closed <= need + 0.5 * spacing
            # what lies within its skin marks nothing that is not filled
            solid &= ~np.asarray(scipy.ndimage.binary_erosion(solid, np.ones((3, 3, 3), bool)), bool)
            solid = np.argwhere(solid) * spacing + shell.lower
            side, marks, lower = _searched(np.matmul(solid, frame), vertex_count, axis, spacing)
            nodes, faces = outer_surface(marks, axis)
            vertices = np.matmul(lower + nodes * side, frame.T)
            if len(vertices) > 1.1 * vertex_count and axis is None:
                vertices, faces = progressive_hull(vertices, faces, vertex_count, progress, sizing)
            mirror = None if axis is None else Mirror(axis, middle, _partners(nodes, marks.shape, axis))
            vertices = _smoothed_improved(vertices, ClosedMesh(vertices, faces).edges)
            # a mirrored count is even in its pairs and has no decimation to help it
            count = len(vertices) if axis is not None else vertex_count
            cage, reason = sound(shell, vertices, faces, need, count, mirror, last, sizing)
            found += [cage] if cage else []
            if not reason or reason == STRAYS:  # of which wider closings have more
                break
            reasons.append(reason)
        if found:
            return best_cage(voxels, found, sizing)
    raise InputError(reasons[-1])


def principal_frame(points: np.ndarray) -> np.ndarray:
    """(3, 3) right-handed, columns the axes of the points' covariance, each as near as may be to a world axis."""
    centered = points - points.mean(axis=0)
    spreads, axes = np.linalg.eigh(np.matmul(centered.T, centered))
    # equal spreads leave their axes open, as those of a ball or a square plate do: they are turned towards the world's
    group = np.cumsum(np.diff(spreads, prepend=spreads[0]) > _EQUAL_SPREAD * spreads[-1])
    choices = []
    for order in itertools.permutations(range(3)):
        frame = np.zeros((3, 3))
        for k in np.unique(group):
            span, columns = axes[:, group == k], [j for j in range(3) if group[order[j]] == k]
            u, _, v = np.linalg.svd(span.T[:, columns])  # u v is the turn of the span nearest to those world axes
            frame[:, columns] = np.matmul(span, np.matmul(u, v))
        choices.append(frame)
    # rounded: of orders as near as each other the first is taken, not one by last digits
    frame = choices[int(np.argmax([round(float(np.abs(np.diagonal(choice)).sum()), 6) for choice in choices]))]
    frame = frame * np.where(np.diagonal(frame) < -1e-6, -1.0, 1.0)
    return frame if np.linalg.det(frame) > 0.0 else frame * [1.0, 1.0, -1.0]


def _searched(solid, vertex_count, axis, least):
    """Side, marks (nx, ny, nz) and lower corner of the voxels whose outer surface has the count nearest to that asked
    for; where none is within a tenth, the coarsest that has more. solid: (s, 3) points in the frame."""
    low, high = bounds_of(solid)
    above, near, close = None, None, []
    for side in (high - low).max() * _SIZES:
        if side < 2.0 * least:
            break
        marks, lower = _marked(solid, side, low, high, axis)
        count = np.count_nonzero(_mixed_corners(marks))
        if near is None or abs(count - vertex_count) < near[0]:
            near = abs(count - vertex_count), side, marks, lower
        if count >= vertex_count and above is None:
            above = side, marks, lower
        if 0.6 * vertex_count < count < 1.6 * vertex_count:
            close.append(side)
        if count > 2 * vertex_count:
            break
    assert near is not None  # the coarsest size is many times the least
    # the same sizes with the grid half a voxel aside give other counts
    for side, shift in itertools.product(close, _SHIFTS):
        if near[0] <= 0.1 * vertex_count:
            break
        marks, lower = _marked(solid, side, low, high, axis, shift)
        count = np.count_nonzero(_mixed_corners(marks))
        if abs(count - vertex_count) < near[0]:
            near = abs(count - vertex_count), side, marks, lower
    return near[1:] if above is None or axis is not None or near[0] <= 0.1 * vertex_count else above


def _marked(solid, side, low, high, axis, shift=(0, 0, 0)):
    """Voxels (with an empty rim) that hold points, holes and contacts filled, and the corner of node (0, 0, 0).
    A `shift` of 1 adds a voxel along an axis, so that the grid lies half a voxel aside."""
    count = np.maximum(np.ceil((high - low) / side - 1e-9).astype(int), 1) + shift
    if axis is not None:
        count[axis] += count[axis] % 2  # the mirror plane lies between voxels
    lower = 0.5 * (low + high) - 0.5 * count * side
    cell = np.clip(np.floor((solid - lower) / side + _ASIDE).astype(int), 0, count - 1)
    marks = np.zeros(count + 2, dtype=bool)
    marks[tuple((cell + 1).T)] = True
    if axis is not None:
        marks |= np.flip(marks, axis)
    return made_manifold(marks), lower - side


def made_manifold(marks) -> np.ndarray:
    """Holes filled, and the two by two by two blocks whose voxels, set or not, do not hold together over faces."""
    import skimage.measure

    while True:
        outside = np.asarray(skimage.measure.label(~marks, connectivity=1))
        marks = outside != outside[0, 0, 0]
        wrong = np.argwhere(_TANGLED[_corner_codes(marks)])
        if not len(wrong):
            return marks
        for corner in itertools.product((0, 1), repeat=3):  # the rim stays empty
            marks[tuple(np.clip(wrong + corner, 1, np.array(marks.shape) - 2).T)] = True


def _corner_codes(marks) -> np.ndarray:
    """(nx - 1, ny - 1, nz - 1) eight bits: which of the voxels around each inner corner are set."""
    code = np.zeros(np.array(marks.shape) - 1, dtype=np.uint8)
    for bit, (i, j, k) in enumerate(itertools.product((0, 1), repeat=3)):
        block = marks[i : marks.shape[0] - 1 + i, j : marks.shape[1] - 1 + j, k : marks.shape[2] - 1 + k]
        code |= block.astype(np.uint8) << np.uint8(bit)
    return code


def _mixed_corners(marks) -> np.ndarray:
    code = _corner_codes(marks)
    return (code > 0) & (code < 255)


def _is_tangled(code: int) -> bool:
    for kind in (1, 0):
        left = {cell for bit, cell in enumerate(itertools.product((0, 1), repeat=3)) if (code >> bit & 1) == kind}
        if not left:
            continue
        queue = [left.pop()]
        for cell in queue:
            beside = [other for other in left if sum(abs(a - b) for a, b in zip(cell, other, strict=True)) == 1]
            left.difference_update(beside)
            queue += beside
        if left:
            return True
    return False


_TANGLED = np.array([_is_tangled(code) for code in range(256)])


def outer_surface(marks: np.ndarray, axis: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Corners (v, 3) in voxels and outward triangles (f, 3) of the surface of voxels with an empty rim."""
    squares = []
    for d in range(3):
        ahead = np.diff(marks.astype(np.int8), axis=d)
        u, v = np.eye(3, dtype=int)[(d + 1) % 3], np.eye(3, dtype=int)[(d + 2) % 3]
        for sign in (-1, 1):  # -1: the voxel before is set, the square looks along the axis
            base = np.argwhere(ahead == sign) + np.eye(3, dtype=int)[d]
            ring = [base, base + u, base + u + v, base + v]
            squares.append(np.stack(ring if sign < 0 else ring[::-1], axis=1))
    squares = np.concatenate(squares)
    # cut through the corner first by coordinates, `axis` counted from the middle, so that the halves are cut alike
    key = squares.astype(np.float64)
    if axis is not None:
        key[..., axis] = np.abs(key[..., axis] - 0.5 * marks.shape[axis])
    first = np.argmin(key @ np.array([1e6, 1e3, 1.0]), axis=1)
    squares = np.take_along_axis(squares, ((first[:, None] + np.arange(4)) % 4)[:, :, None], axis=1)
    nodes, number = np.unique(squares.reshape(-1, 3), axis=0, return_inverse=True)
    number = number.reshape(-1, 4)
    return nodes.astype(np.float64), np.concatenate([number[:, [0, 1, 2]], number[:, [0, 2, 3]]])


def _partners(nodes, shape, axis) -> np.ndarray:
    """(v,) the vertex across the mirror plane of each."""
    mirrored = nodes.copy()
    mirrored[:, axis] = shape[axis] - nodes[:, axis]
    order, back = np.lexsort(nodes.T), np.lexsort(mirrored.T)
    partner = np.empty(len(nodes), dtype=np.int64)
    partner[back] = order
    return partner


def _smoothed_improved(vertices, edges, rounds: int = 4, back: float = 0.6) -> np.ndarray:
    """Means of neighbours less their mean move, so as not to shrink (HC, alpha 0; Vollmer, Mencl and Mueller 1999)."""
    count = np.bincount(edges.reshape(-1), minlength=len(vertices))[:, None]

    def mean(values):
        near = values[edges]
        return row_sums([edges[:, 0], edges[:, 1]], [near[:, 1], near[:, 0]], len(values)) / count

    for _ in range(rounds):
        smooth = mean(vertices)
        moved = smooth - vertices
        vertices = smooth - (back * moved + (1.0 - back) * mean(moved))
    return vertices
