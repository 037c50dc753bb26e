"""The backward pass from points that a map on a lattice moves, to its nodes and to the points."""

import warp as wp

from ..lattice.cage_map import CageMap, corner_share, map_slope

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def propagate_points(
    first: int,
    cage_map: CageMap,
    points: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    by_points: wp.array(dtype=wp.vec3),
    by_nodes: wp.array3d(dtype=wp.vec3),
):
    """From slopes (n,) by the positions of points (n,), those by the points, of the map's central differences over a
    cell, and, added up, those by the positions of nodes. Sides of narrow gaps pass on to the nodes of their cell."""
    # points outside of the lattice are not moved with it. Points share nodes: atomics on CUDA, one thread on a CPU
    n = first + wp.tid()
    x = points[n]
    slope = slopes[n]
    g = (x - cage_map.lower) * cage_map.inverse_spacing
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    shape = cage_map.positions.shape
    if (
        wp.length_sq(slope) > 0.0
        and i >= 0
        and j >= 0
        and k >= 0
        and i < shape[0] - 1
        and j < shape[1] - 1
        and k < shape[2] - 1
    ):
        by_points[n] = wp.transpose(map_slope(cage_map, x)) * slope
        offset = g - wp.vec3(float(i), float(j), float(k))
        for corner in range(8):
            share = corner_share(corner, offset)
            wp.atomic_add(by_nodes, i + (corner >> 2), j + ((corner >> 1) & 1), k + (corner & 1), share * slope)
