"""The map of an edit continued beyond the walls of its posed cage, to where its crumbs go."""

# Mean value coordinates are defined on both sides of a closed cage (Ju, Schaefer and Warren, "Mean value coordinates
# for closed triangular meshes", SIGGRAPH 2005), are linear on its faces, and reproduce affine maps. With q the point of
# the posed cage nearest to x, phi the edit's map on its lattice and g the map that is linear on the faces,
#
#     psi(x) = sum_j w_j(x) v_j + phi(q) - g(q),        faded as phi is (mesh/walls).
#
# The difference at q is zero but for the lattice's error where phi takes the cage's faces to each other (harmonic, mean
# value), and closes the jump where it does not (Green). So psi goes on from phi without a jump and is exact for poses
# that phi reproduces.

import warp as wp

from ..coordinates.mean_value import mean_value_position
from ..lattice.cage_map import CageMap, map_position
from ..lattice.nodes import CELL_DIAGONAL
from ..mesh.containment import triangle_distance_squared
from ..mesh.triangle import nearest_barycentric
from ..mesh.walls import Walls, faded_position

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Most steps of the search for a place that the map leads to a given point.
MOST_STEPS = wp.constant(12)


@wp.struct
class WallMap:
    """Both cages of a posed edit, and its map on the lattice."""

    posed: wp.array(dtype=wp.vec3)  # (v,) vertices of the posed cage
    rest: wp.array(dtype=wp.vec3)  # (v,) of the rest cage
    faces: wp.array(dtype=wp.vec3i)
    posed_fans: wp.array(dtype=wp.vec4)  # see mesh/fans
    rest_fans: wp.array(dtype=wp.vec4)
    posed_size: float  # longest side
    rest_size: float
    plain: CageMap  # the map before it fades
    walls: Walls  # it fades towards them


@wp.func(inline=False)  # the closed form is long, and slow enough that a call does not matter
def cage_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """coordinates/mean_value.mean_value_position."""
    return mean_value_position(x, vertices, faces, fans, targets, size)


@wp.func(inline=False)
def wall_offset(walls: WallMap, x: wp.vec3):
    """phi(q) - g(q) at the point q of the posed cage nearest to x."""
    nearest = float(1.0e30)
    chosen = int(0)
    for f in range(walls.faces.shape[0]):
        face = walls.faces[f]
        squared = triangle_distance_squared(x, walls.posed[face[0]], walls.posed[face[1]], walls.posed[face[2]])
        if squared < nearest:
            nearest = squared
            chosen = f
    face = walls.faces[chosen]
    share = nearest_barycentric(
        wp.vec3d(walls.posed[face[0]] - x), wp.vec3d(walls.posed[face[1]] - x), wp.vec3d(walls.posed[face[2]] - x)
    )
    q = wp.vec3(0.0, 0.0, 0.0)
    flat = wp.vec3(0.0, 0.0, 0.0)
    for corner in range(3):
        q += wp.float32(share[corner]) * walls.posed[face[corner]]
        flat += wp.float32(share[corner]) * walls.rest[face[corner]]
    offset = map_position(walls.plain, q) - flat
    if not wp.isfinite(wp.length_sq(offset)):  # a face without area
        return wp.vec3(0.0, 0.0, 0.0)
    return offset


@wp.func
def continued_position(walls: WallMap, x: wp.vec3):
    """psi(x): where a point outside the posed cage comes from."""
    mapped = cage_position(x, walls.posed, walls.faces, walls.posed_fans, walls.rest, walls.posed_size)
    return faded_position(walls.walls, x, mapped + wall_offset(walls, x))


@wp.func
def forward_position(walls: WallMap, y: wp.vec3):
    """F(y), nearly the inverse of psi: the mean value map from the rest cage to the posed one."""
    return cage_position(y, walls.rest, walls.faces, walls.rest_fans, walls.posed, walls.rest_size)


@wp.kernel
def map_forwards(first: int, walls: WallMap, points: wp.array(dtype=wp.vec3), places: wp.array(dtype=wp.vec3)):
    """F at points (n,)."""
    n = first + wp.tid()
    places[n] = forward_position(walls, points[n])


@wp.kernel
def find_places(
    first: int,
    walls: WallMap,
    points: wp.array(dtype=wp.vec3),
    enough: float,
    offsets: wp.array(dtype=wp.vec3),
    errors: wp.array(dtype=float),
):
    """How far from F(y) the place x is that psi leads to points y (n,) beside the rest cage, and how far from y psi
    leads at last, world units; the search ends where that is less than `enough`."""
    # x <- x + F(y) - F(psi(x)), from x = F(y) on; the best of all x is kept
    n = first + wp.tid()
    y = points[n]
    goal = forward_position(walls, y)
    x = goal
    best = goal
    error = float(1.0e30)
    step = int(0)
    while step < MOST_STEPS and error > enough:
        reached = continued_position(walls, x)
        off = wp.length(reached - y)
        if off < error:
            error = off
            best = x
        if error > enough:
            x += goal - forward_position(walls, reached)
        step += 1
    offsets[n] = best - goal
    errors[n] = error


@wp.kernel
def carry_nodes(
    first: int,
    walls: WallMap,
    lower: wp.vec3,
    spacing: float,
    distance: wp.array3d(dtype=float),
    marks: wp.array3d(dtype=wp.uint8),
    positions: wp.array3d(dtype=wp.vec3),
):
    """psi at the nodes of a lattice at corners of marked cells; those in the rings of the map (lattice/nodes) keep what
    they have. Node (0, 0, 0) is at `lower`. One item per node."""
    n = first + wp.tid()
    k = n % distance.shape[2]
    j = (n // distance.shape[2]) % distance.shape[1]
    i = n // (distance.shape[2] * distance.shape[1])
    if distance[i, j, k] / spacing < CELL_DIAGONAL:
        return
    found = bool(False)
    for c in range(8):
        a = i - (c >> 2)
        b = j - ((c >> 1) & 1)
        d = k - (c & 1)
        if a >= 0 and b >= 0 and d >= 0 and a < marks.shape[0] and b < marks.shape[1] and d < marks.shape[2]:
            found = found or marks[a, b, d] != wp.uint8(0)
    if found:
        positions[i, j, k] = continued_position(walls, lower + spacing * wp.vec3(float(i), float(j), float(k)))
