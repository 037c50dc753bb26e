"""Arbitrary points and directions of a deformed scene in canonical space, without a lattice."""

import warp as wp

from .structs import ExactEdit
from .trace import canonical_ray

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def map_points_precisely(
    first: int,
    edits: wp.array(dtype=ExactEdit),
    origin: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    dt: float,
    canonical_points: wp.array(dtype=wp.vec3),
    canonical_directions: wp.array(dtype=wp.vec3),
    region: wp.array(dtype=wp.int32),
    outside: wp.array(dtype=wp.uint8),
):
    """As edits/trace.map_points."""
    n = first + wp.tid()
    ray = canonical_ray(edits, points[n] - origin, directions[n], dt)
    canonical_points[n] = ray.point + origin
    canonical_directions[n] = ray.direction
    region[n] = ray.region
    outside[n] = wp.uint8(ray.outside)
