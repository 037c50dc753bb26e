"""Points between world units and the local frame of a cage: local = (world - centre) / size."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Farthest along an axis, in sizes of the cage: mean value weights keep four digits as far outside.
FARTHEST = wp.constant(1.0e3)


@wp.kernel
def localise_points(
    first: int,
    points: wp.array(dtype=wp.vec3),
    center: wp.vec3d,
    size: wp.float64,
    local: wp.array(dtype=wp.vec3),
    bad: wp.array(dtype=int),
):
    """local (n,) = (points - centre) / size; bad (1,) becomes 1 where a point is not finite or FARTHEST away."""
    n = first + wp.tid()
    x = wp.vec3((wp.vec3d(points[n]) - center) / size)  # in float64: keeps the digits of points far from the origin
    if not wp.isfinite(x) or wp.max(wp.abs(x)) >= FARTHEST:
        bad[0] = 1
    local[n] = x


@wp.kernel
def restore_points(
    first: int, local: wp.array(dtype=wp.vec3), center: wp.vec3d, size: wp.float64, points: wp.array(dtype=wp.vec3)
):
    """points (n,) = local * size + centre."""
    n = first + wp.tid()
    points[n] = wp.vec3(wp.vec3d(local[n]) * size + center)


@wp.kernel
def scale_rows(first: int, factor: float, weights: wp.array2d(dtype=wp.float32)):
    """weights (n, k) times factor."""
    n = first + wp.tid()
    for j in range(weights.shape[1]):
        weights[n, j] = weights[n, j] * factor
