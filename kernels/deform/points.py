"""Arbitrary points and directions of a deformed scene in canonical space, for renderers other than ours."""

# "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 4 and 5, with edits looked up on lattices; see deform/edits.

from typing import Any

import warp as wp

from .edits import CLEARED, MAPPED, LatticeEdit, canonical_direction, canonical_point, canonical_step

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class CanonicalRay:
    """Where a point is in canonical space, and how it is seen there."""

    point: wp.vec3
    direction: wp.vec3
    region: int
    outside: int


@wp.func
def canonical_ray(edits: Any, x: wp.vec3, direction: wp.vec3, dt: float):
    """Point, direction and region of a point x seen along `direction` of any length; dt in world units."""
    # a cleared point keeps x and its direction; one whose map leaves the rest cage is empty too, hence cleared
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
