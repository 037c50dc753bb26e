"""How much of an edit is left near the walls of a cage that do not move: nothing on them, all of it beyond a band."""

# The band is `width` across. Over it the share rises from 0 to 1 as s(t) = t^3 (6 t^2 - 15 t + 10), t = distance /
# width, whose first and second derivatives are 0 at both ends (Perlin, "Improving Noise", SIGGRAPH 2002). Walls are
# sets of faces that meet without an edge; the share is the product over the walls. The distance to a flat convex wall
# has a continuous derivative off the wall, and so has the product, also where two walls meet.

import warp as wp

from .containment import triangle_distance_squared

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


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
    return share


@wp.func
def faded_position(walls: Walls, x: wp.vec3, mapped: wp.vec3):
    """Where a map that leads x to `mapped` leads it once it fades to the identity towards the walls."""
    if walls.width > 0.0:
        return x + walls_share(walls, x) * (mapped - x)
    return mapped
