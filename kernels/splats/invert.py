"""Splats put where the map of the voxels finds them: the backward map of a posed cage, inverted."""

# Voxels look each point x of the posed scene up in the cage at rest, psi(x) = sum_j w'_j(x) v_j with the coordinates w'
# of the posed cage ("Deforming Radiance Fields with Cages", ECCV 2022, section 3.2). For a splat at c this is solved
# the other way, psi(x) = c, by Newton's method from where the forward map takes it, on the lattice of the posed cage,
# so that splats and voxels under one cage coincide. J is the inverse of psi's.

import warp as wp

from ..lattice.cage_map import CageMap, map_distance, map_position
from .follow import map_slope
from .pose import CarriedSplats

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Steps at most, and the longest step, in cells.
STEPS = wp.constant(24)
LONGEST = wp.constant(2.0)


@wp.kernel
def invert_map(
    first: int,
    members: wp.array(dtype=int),
    targets: wp.array(dtype=wp.vec3),
    backward: CageMap,
    tolerance: float,
    close: float,
    carried: CarriedSplats,
    missed: wp.array(dtype=wp.uint8),
):
    """Splats members (m,) to the places that `backward` takes to targets (m,), their places at rest. missed (m,): 1
    where there is no such place near, and the splat stays where the forward map took it."""
    # tolerance: how far outside of the posed cage a place may be; close: how near to its target it must be taken; world
    # units.
    m = first + wp.tid()
    n = members[m]
    target = targets[m]
    x = carried.positions[n]
    reach = backward.spacing
    found = int(0)
    off = wp.length(map_position(backward, x) - target)
    step = int(0)
    while step < STEPS and off > 0.01 * close:
        slope = map_slope(backward, x)
        det = wp.determinant(slope)
        if wp.abs(det) < 1.0e-9:
            break
        move = wp.inverse(slope) * (target - map_position(backward, x))
        length = wp.length(move)
        if length > LONGEST * reach:
            move = move * (LONGEST * reach / length)
        # a shorter step where the whole one does not come nearer
        share = float(1.0)
        better = float(0.0)
        for _ in range(6):
            trial = wp.length(map_position(backward, x + share * move) - target)
            if trial < off:
                better = share
                off = trial
                break
            share *= 0.5
        if better == 0.0:
            break
        x += better * move
        step += 1
    if off <= close and map_distance(backward, x) <= tolerance:
        slope = map_slope(backward, x)
        if wp.abs(wp.determinant(slope)) > 1.0e-9:
            found = 1
            carried.positions[n] = x
            carried.jacobians[n] = wp.inverse(slope)
    missed[m] = wp.uint8(1 - found)
