"""The lattice map of an edit, faded to the identity towards walls of its cage that do not move."""

# phi' = x + s(x) (phi(x) - x) with the share s of mesh/walls: on such a wall phi' and its derivative are those of the
# scene outside, which no cage maps. The map phi is that of "Deforming Radiance Fields with Cages" (ECCV 2022), section
# 4.1; phi' is taken at the nodes of its lattice, and at the corners that cells at narrow gaps hold for each side.

import warp as wp

from ..lattice.cage_map import CageMap
from ..mesh.walls import Walls, faded_position

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Corners of cells with a point in the cage are no farther from it than this, in cells.
FAR_CELLS = wp.constant(2.0)


@wp.func
def node_position(cage_map: CageMap, i: int, j: int, k: int):
    """Position of a node, relative to the map's origin."""
    return cage_map.lower + cage_map.spacing * wp.vec3(float(i), float(j), float(k))


@wp.kernel
def fade_nodes(first: int, cage_map: CageMap, walls: Walls, positions: wp.array3d(dtype=wp.vec3)):
    """The faded map at each node, but for those that no look-up in the cage takes in."""
    n = first + wp.tid()
    k = n % positions.shape[2]
    j = (n // positions.shape[2]) % positions.shape[1]
    i = n // (positions.shape[2] * positions.shape[1])
    mapped = cage_map.positions[i, j, k]
    if cage_map.distance[i, j, k] < FAR_CELLS * cage_map.spacing:
        mapped = faded_position(walls, node_position(cage_map, i, j, k), mapped)
    positions[i, j, k] = mapped


@wp.kernel
def fade_sides(first: int, cage_map: CageMap, walls: Walls, sides: wp.array2d(dtype=wp.vec4)):
    """The faded map at the corners of the cell above each node, for each side that the cell has."""
    n = first + wp.tid()
    entry = cage_map.side_index[n]
    if entry == 0:
        return
    shape = cage_map.positions.shape
    k = n % shape[2]
    j = (n // shape[2]) % shape[1]
    i = n // (shape[2] * shape[1])
    for side in range(entry % 8):
        row = entry / 8 + side
        for corner in range(8):
            x = node_position(cage_map, i + (corner >> 2), j + ((corner >> 1) & 1), k + (corner & 1))
            old = cage_map.sides[row, corner]
            new = faded_position(walls, x, wp.vec3(old[0], old[1], old[2]))
            sides[row, corner] = wp.vec4(new[0], new[1], new[2], old[3])
