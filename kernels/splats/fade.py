"""The map of an edit on splats, faded to the identity towards walls of its cage that do not move."""

# phi'(x) = x + s(x) (phi(x) - x) with the share s of mesh/walls, J' = 1 + s (J - 1) + (phi - x) grad(s)^T. On such a
# wall phi' and its Jacobian are those of the scene outside.

import warp as wp

from ..mesh.walls import Walls, walls_share
from .pose import CarriedSplats

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Step of the difference of the share, in widths of the band.
DIFFERENCE = wp.constant(2.0e-3)


@wp.kernel
def fade_carried(
    first: int, members: wp.array(dtype=int), centres: wp.array(dtype=wp.vec3), walls: Walls, carried: CarriedSplats
):
    """Splats members (m,), carried from centres (n,) at rest by one edit."""
    m = first + wp.tid()
    n = members[m]
    x = centres[n]
    h = DIFFERENCE * walls.width
    share = walls_share(walls, x)
    slope = wp.vec3(
        walls_share(walls, x + wp.vec3(h, 0.0, 0.0)) - walls_share(walls, x - wp.vec3(h, 0.0, 0.0)),
        walls_share(walls, x + wp.vec3(0.0, h, 0.0)) - walls_share(walls, x - wp.vec3(0.0, h, 0.0)),
        walls_share(walls, x + wp.vec3(0.0, 0.0, h)) - walls_share(walls, x - wp.vec3(0.0, 0.0, h)),
    ) * (0.5 / h)
    moved = carried.positions[n] - x
    one = wp.identity(n=3, dtype=float)
    carried.jacobians[n] = one + share * (carried.jacobians[n] - one) + wp.outer(moved, slope)
    carried.positions[n] = x + share * moved
