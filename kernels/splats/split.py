"""Which splats a pose bends so much that their pieces are drawn instead."""

import warp as wp

from ..mesh.triangle import Walls, walls_share
from .pose import CarriedSplats

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Step of the difference of the share, in widths of the band.
DIFFERENCE = wp.constant(2.0e-3)


@wp.kernel
def fade_carried(
    first: int, members: wp.array(dtype=int), centers: wp.array(dtype=wp.vec3), walls: Walls, carried: CarriedSplats
):
    """Splats members (m,), carried from centres (n,) at rest by one edit."""
    m = first + wp.tid()
    n = members[m]
    x = centers[n]
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


@wp.kernel
def measure_bends(
    first: int,
    whole: wp.array(dtype=int),
    pieces: wp.array2d(dtype=int),
    offsets: wp.array2d(dtype=wp.vec3),
    at_wall: wp.array(dtype=wp.uint8),
    nodes: wp.array(dtype=int),
    rest: wp.array(dtype=wp.vec3),
    tolerance: float,
    carried: CarriedSplats,
    split: wp.array(dtype=wp.uint8),
):
    """split[nodes[m]] becomes 1 where splat whole[m] (m,) is bent by more than the tolerance, world units. pieces (m,
    3): its pieces, -1 for one that does not go along; offsets (m, 3) to them at rest."""
    m = first + wp.tid()
    n = whole[m]
    bend = float(0.0)
    if at_wall[m] != wp.uint8(0):  # goes along in part, and is split once it moves
        bend = wp.length(carried.positions[n] - rest[n])
    jacobian = carried.jacobians[n]
    for k in range(3):
        piece = pieces[m, k]
        if piece >= 0:
            expected = carried.positions[n] + jacobian * offsets[m, k]
            bend = wp.max(bend, wp.length(carried.positions[piece] - expected))
    if bend > tolerance:
        split[nodes[m]] = wp.uint8(1)


@wp.kernel
def hide_splats(
    first: int,
    nodes: wp.array(dtype=int),
    parents: wp.array(dtype=int),
    split: wp.array(dtype=wp.uint8),
    hidden: wp.array(dtype=wp.uint8),
):
    """hidden (n,): 1 for splats that are split, and for pieces of splats that are not. nodes (n,); parents (nodes,):
    the node that each is a piece of, or -1."""
    n = first + wp.tid()
    node = nodes[n]
    is_hidden = split[node]
    above = parents[node]
    while above >= 0:
        if split[above] == wp.uint8(0):
            is_hidden = wp.uint8(1)
        above = parents[above]
    hidden[n] = is_hidden
