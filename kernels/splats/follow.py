"""Splats that an earlier edit has moved, through the edits after it; forward maps on lattices."""

# "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 5, for matter: each edit acts on the scene that the ones
# before it left. Where a splat is then is known with each pose only, so that it is carried through the forward map of
# the edit, which is looked up on a lattice over the cage at rest; derivatives are central differences over half a cell
# to each side. Such a splat goes, stays and gives way as its centre does.

import warp as wp

from ..lattice.cage_map import CageMap, map_distance, map_position
from ..mesh.containment import winding_number
from .pose import CarriedSplats

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: What becomes of a splat that an edit may meet: it goes or stays; goes or is gone (a copy that moves); stays, whatever
#: is taken from there (a copy that is left).
GOES_OR_STAYS = wp.constant(0)
GOES = wp.constant(1)
STAYS = wp.constant(2)


@wp.func
def map_slope(cage_map: CageMap, x: wp.vec3):
    """Jacobian of a map on a lattice, by central differences over half a cell to each side."""
    h = 0.5 * cage_map.spacing
    inverse = cage_map.inverse_spacing
    dx = map_position(cage_map, x + wp.vec3(h, 0.0, 0.0)) - map_position(cage_map, x - wp.vec3(h, 0.0, 0.0))
    dy = map_position(cage_map, x + wp.vec3(0.0, h, 0.0)) - map_position(cage_map, x - wp.vec3(0.0, h, 0.0))
    dz = map_position(cage_map, x + wp.vec3(0.0, 0.0, h)) - map_position(cage_map, x - wp.vec3(0.0, 0.0, h))
    return inverse * wp.matrix_from_cols(dx, dy, dz)


@wp.func
def lies_in_cage(
    x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i), lower: wp.vec3, upper: wp.vec3
):
    """Whether a point is in a cage, of vertices (v,) and faces (f,), in the box from lower to upper."""
    for axis in range(3):
        if x[axis] < lower[axis] or x[axis] > upper[axis]:
            return False
    return winding_number(x, vertices, faces) > 0.5


@wp.kernel
def follow_map(
    first: int,
    members: wp.array(dtype=int),
    ways: wp.array(dtype=wp.uint8),
    forward: CageMap,
    tolerance: float,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    lower: wp.vec3,
    upper: wp.vec3,
    carried: CarriedSplats,
):
    """Splats members (m,), ways (m,), through an edit. forward: from the cage at rest, where its distances are of, to
    the posed one, of vertices (v,) and faces (f,) in the box lower to upper."""
    m = first + wp.tid()
    n = members[m]
    way = int(ways[m])
    x = carried.positions[n]
    if way != STAYS and map_distance(forward, x) <= tolerance:
        carried.jacobians[n] = map_slope(forward, x) * carried.jacobians[n]
        carried.positions[n] = map_position(forward, x)
    elif way == GOES or lies_in_cage(x, vertices, faces, lower, upper):
        carried.shares[n] = 0.0


@wp.kernel
def clear_inside(
    first: int,
    members: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    lower: wp.vec3,
    upper: wp.vec3,
    carried: CarriedSplats,
):
    """Clear of splats members (m,), which an earlier edit moved, what lies in a cage whose content is removed."""
    m = first + wp.tid()
    n = members[m]
    if lies_in_cage(carried.positions[n], vertices, faces, lower, upper):
        carried.shares[n] = 0.0
