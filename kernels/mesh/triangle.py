"""Triangles: the nearest point of one, distances, and faces of a cage as walls."""

import warp as wp

from ..core.gradients import forward_only_in
from .containment import triangle_distance_squared

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3))

_ZERO = wp.constant(wp.float64(0.0))

_ONE = wp.constant(wp.float64(1.0))


@wp.func
def nearest_barycentric(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Barycentric coordinates (of a, b, c) of the point nearest to the origin; the triangle must have an area."""
    ab = b - a  # Christer Ericson, "Real-Time Collision Detection" (2005), section 5.1.5
    ac = c - a
    d1 = -wp.dot(ab, a)
    d2 = -wp.dot(ac, a)
    d3 = -wp.dot(ab, b)
    d4 = -wp.dot(ac, b)
    d5 = -wp.dot(ab, c)
    d6 = -wp.dot(ac, c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2

    if d1 <= _ZERO and d2 <= _ZERO:
        return wp.vec3d(_ONE, _ZERO, _ZERO)
    if d3 >= _ZERO and d4 <= d3:
        return wp.vec3d(_ZERO, _ONE, _ZERO)
    if d6 >= _ZERO and d5 <= d6:
        return wp.vec3d(_ZERO, _ZERO, _ONE)
    if vc <= _ZERO and d1 >= _ZERO and d3 <= _ZERO:
        t = d1 / (d1 - d3)
        return wp.vec3d(_ONE - t, t, _ZERO)
    if vb <= _ZERO and d2 >= _ZERO and d6 <= _ZERO:
        t = d2 / (d2 - d6)
        return wp.vec3d(_ONE - t, _ZERO, t)
    if va <= _ZERO and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3d(_ZERO, _ONE - t, t)
    scale = _ONE / (va + vb + vc)
    return wp.vec3d(va * scale, vb * scale, vc * scale)


@wp.struct
class Walls:
    """Faces that do not move, wall after wall; none where `width` is 0. Positions relative to any one origin."""

    corners: wp.array(dtype=wp.vec3)  # (3 faces,)
    starts: wp.array(dtype=int)  # (walls + 1,) where the faces of each wall begin
    boxes: wp.array(dtype=wp.vec3)  # (2 walls,) lower and upper corner of the box of each wall
    lower: wp.vec3  # box of all that is nearer to a wall than the width
    upper: wp.vec3
    width: float  # world units


@wp.func
def box_distance_squared(x: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Squared distance to a box: no more than that to what is in it."""
    return wp.length_sq(wp.max(wp.max(lower - x, x - upper), wp.vec3(0.0, 0.0, 0.0)))


@wp.func(inline=False)
def walls_share(walls: Walls, x: wp.vec3):
    """The share at a point, 0 to 1."""
    for axis in range(3):
        if x[axis] <= walls.lower[axis] or x[axis] >= walls.upper[axis]:
            return float(1.0)
    share = float(1.0)
    for wall in range(walls.starts.shape[0] - 1):
        nearest = walls.width * walls.width
        if box_distance_squared(x, walls.boxes[2 * wall], walls.boxes[2 * wall + 1]) < nearest:
            for face in range(walls.starts[wall], walls.starts[wall + 1]):
                a = walls.corners[3 * face]
                b = walls.corners[3 * face + 1]
                c = walls.corners[3 * face + 2]
                if box_distance_squared(x, wp.min(a, wp.min(b, c)), wp.max(a, wp.max(b, c))) < nearest:
                    nearest = wp.min(nearest, triangle_distance_squared(x, a, b, c))
            t = wp.sqrt(nearest) / walls.width
            share *= t * t * t * (t * (6.0 * t - 15.0) + 10.0)
    return forward_only(share, x)


@wp.func
def faded_position(walls: Walls, x: wp.vec3, mapped: wp.vec3):
    """Where a map that leads x to `mapped` leads it once it fades to the identity towards the walls."""
    if walls.width > 0.0:
        return x + walls_share(walls, x) * (mapped - x)
    return mapped
