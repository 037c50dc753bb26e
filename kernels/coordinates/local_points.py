"""Points of any layout and precision in a local frame, local = (world - centre) / size, and back in world units."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Farthest along an axis, in sizes of the cage: mean value weights keep four digits as far outside.
FARTHEST = wp.constant(1.0e3)


@wp.kernel
def localise_points(
    first: int,
    points: wp.array2d(dtype=Any),
    center: wp.vec3d,
    size: wp.float64,
    local: wp.array(dtype=wp.vec3),
    bad: wp.array(dtype=int),
):
    """local (n,) = (points - centre) / size of points (n, 3); bad[0] becomes 1 where one is not finite, bad[1] where
    one is FARTHEST away."""
    n = first + wp.tid()
    world = wp.vec3d(wp.float64(points[n, 0]), wp.float64(points[n, 1]), wp.float64(points[n, 2]))
    x = wp.vec3((world - center) / size)  # in float64: keeps the digits of points far from the origin
    if not wp.isfinite(x):
        bad[0] = 1
    if wp.max(wp.abs(x)) >= FARTHEST:
        bad[1] = 1
    local[n] = x


#: Numbers that points on a device may be of: all are compiled at once, as a later one would compile the others anew.
NUMBERS = (wp.float32, wp.float64, wp.float16, wp.int32, wp.int64)
for number in NUMBERS:
    wp.overload(localise_points, {"points": wp.array2d(dtype=number)})


@wp.kernel
def find_not_finite(first: int, values: wp.array(dtype=Any), bad: wp.array(dtype=int)):
    """bad[0] becomes 1 where a value is not finite."""
    if not wp.isfinite(values[first + wp.tid()]):
        bad[0] = 1


#: Weights, points, and rows of weights with gradients.
for value in (wp.float32, wp.vec3, wp.vec4):
    wp.overload(find_not_finite, {"values": wp.array(dtype=value)})


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
