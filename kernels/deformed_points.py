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
    CLEARED,
    MAPPED,
    LatticeEdit,
    canonical_direction,
    canonical_point,
    canonical_step,
    difference_determinant,
)
from .cage_map import map_distance

wp.set_module_options({"enable_backward": False})


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
    elif edit.removes == 0:
        lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        upper = -lower
        for c in range(8):
            position = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
            lower = wp.min(lower, position)
            upper = wp.max(upper, position)
        if farthest <= edit.tolerance:
            flags = CELL_INSIDE
        # twice what the distance can change to the corners of the box, as the trilinear one is a little steeper
        if map_distance(edit.rest, 0.5 * (lower + upper)) < -wp.length(upper - lower):
            flags = flags | CELL_STAYS
        h = 0.5 * edit.deformed.spacing
        centre = edit.deformed.lower + h * wp.vec3(float(2 * i + 1), float(2 * j + 1), float(2 * k + 1))
        if difference_determinant(edit, centre, h) <= 0.0:
            flags = flags | CELL_FOLDED
    cells[i, j, k] = wp.uint8(flags)
