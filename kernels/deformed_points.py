"""Arbitrary points and directions of a deformed scene in canonical space, for renderers other than ours.

"Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 4 and 5, with edits looked up on lattices; see cage_edits.
Siblings: cage_edits, cage_map.
"""

from typing import Any

import warp as wp

from .cage_edits import (
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    CLEARED,
    CUT_LENGTH,
    MAPPED,
    LatticeEdit,
    canonical_direction,
    canonical_point,
    canonical_step,
)
from .cage_map import cell_sides, map_distance

wp.set_module_options({"enable_backward": False})

mat83 = wp.types.matrix(shape=(8, 3), dtype=wp.float32)


@wp.struct
class CanonicalRay:
    point: wp.vec3
    direction: wp.vec3
    region: int
    outside: int


@wp.func
def canonical_ray(edits: Any, x: wp.vec3, direction: wp.vec3, dt: float):
    """Point, direction and region of a point x seen along `direction` of any length; dt in world units.

    A cleared point keeps x and its direction. One whose map leaves the rest cage is empty too, hence cleared.
    """
    result = CanonicalRay()
    result.point = x
    result.direction = direction
    along = wp.normalize(direction)
    here = canonical_point(edits, x)
    result.region = here.region
    if here.vacant == 1:
        result.region = CLEARED
        result.outside = here.outside
    if result.region == MAPPED:
        ahead = canonical_point(edits, x + dt * along)
        result.point = here.position
        result.direction = canonical_direction(canonical_step(edits, x, along, dt, here, ahead), dt, along)
    return result


@wp.kernel
def map_points(
    first: int,
    edits: wp.array(dtype=LatticeEdit),
    origin: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    dt: float,
    canonical_points: wp.array(dtype=wp.vec3),
    canonical_directions: wp.array(dtype=wp.vec3),
    region: wp.array(dtype=wp.int32),
    outside: wp.array(dtype=wp.uint8),
):
    """Canonical points and directions (n,) of points (n,) seen along directions (n,); region: 0 unchanged, 1 cleared,
    2 mapped. `origin` is what the edits' positions are relative to, in the frame of the points."""
    n = first + wp.tid()
    ray = canonical_ray(edits, points[n] - origin, directions[n], dt)
    canonical_points[n] = ray.point + origin
    canonical_directions[n] = ray.direction
    region[n] = ray.region
    outside[n] = wp.uint8(ray.outside)


@wp.func
def corner_edge(corners: mat83, axis: int, side: int):
    """One of the four edges along an axis of a trilinear cell; corner c is at (c & 4, c & 2, c & 1)."""
    low = wp.where(axis == 0, side, wp.where(axis == 1, (side & 1) + 2 * (side & 2), 2 * side))
    return corners[low + (4 >> axis)] - corners[low]


@wp.func
def mean_jacobian(corners: mat83):
    """Jacobian at the middle of a trilinear cell, per cell: its columns are the means of four edges."""
    columns = wp.mat33()
    for axis in range(3):
        mean = wp.vec3()
        for side in range(4):
            mean += 0.25 * corner_edge(corners, axis, side)
        for row in range(3):
            columns[row, axis] = mean[row]
    return columns


@wp.func
def jacobian_spread(corners: mat83, mean: wp.mat33):
    """Bound of how far, in the Frobenius norm, the Jacobian anywhere in a trilinear cell is from its mean."""
    total = float(0.0)
    for axis in range(3):
        column = wp.vec3(mean[0, axis], mean[1, axis], mean[2, axis])
        farthest = float(0.0)
        for side in range(4):
            farthest = wp.max(farthest, wp.length_sq(corner_edge(corners, axis, side) - column))
        total += farthest
    return wp.sqrt(total)


@wp.func
def largest_stretch(jacobian: wp.mat33):
    """Bound of the largest singular value: the root of the largest absolute row sum of J^T J."""
    gram = wp.transpose(jacobian) * jacobian
    largest = float(0.0)
    for row in range(3):
        largest = wp.max(largest, wp.abs(gram[row, 0]) + wp.abs(gram[row, 1]) + wp.abs(gram[row, 2]))
    return wp.sqrt(largest)


@wp.kernel
def mark_edit_cases(first: int, edit: LatticeEdit, cells: wp.array3d(dtype=wp.uint8)):
    """The CELL_... flags of each lattice cell of an edit, so that most samples need neither distance.

    The trilinear distance in a cell lies between its corners'; the trilinear map in the bounding box of its corners'.
    """
    n = first + wp.tid()
    k = n % cells.shape[2]
    j = (n // cells.shape[2]) % cells.shape[1]
    i = n // (cells.shape[2] * cells.shape[1])
    nearest = float(1.0e30)
    farthest = float(-1.0e30)
    for c in range(8):
        distance = edit.deformed.distance[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        nearest = wp.min(nearest, distance)
        farthest = wp.max(farthest, distance)
    flags = int(0)
    if nearest > edit.tolerance:
        flags = CELL_OUTSIDE
    elif edit.removes == 0 and cell_sides(edit.deformed, i, j, k) != 0:
        flags = CELL_STEEP  # at a narrow gap of the cage: nothing is settled for the cell as a whole
    elif edit.removes == 0:
        corners = mat83()
        lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        upper = -lower
        for c in range(8):
            corners[c] = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
            lower = wp.min(lower, corners[c])
            upper = wp.max(upper, corners[c])
        if farthest <= edit.tolerance:
            flags = CELL_INSIDE
        # twice what the distance can change to the corners of the box, as the trilinear one is a little steeper
        if map_distance(edit.rest, 0.5 * (lower + upper)) < -wp.length(upper - lower):
            flags = flags | CELL_STAYS
        jacobian = mean_jacobian(corners) * edit.deformed.inverse_spacing
        if wp.determinant(jacobian) <= 0.0:
            flags = flags | CELL_FOLDED
        spread = jacobian_spread(corners, edit.deformed.spacing * jacobian) * edit.deformed.inverse_spacing
        if largest_stretch(jacobian) + spread > CUT_LENGTH:
            flags = flags | CELL_STEEP
    cells[i, j, k] = wp.uint8(flags)
