"""Weights of all cage vertices at the inside nodes of a lattice, and the maps that they give."""

# weights (m, v): row n belongs to entry begin + n of the node list (see nodes.py). A map with values r_j at the cage's
# vertices is sum_j w_j r_j at each node (Joshi et al. 2007, section 3).

import warp as wp

from .cage_map import CageMap, map_position
from .nodes import NodeLevels, centred_place

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def place_nodes(first: int, begin: int, levels: NodeLevels, points: wp.array(dtype=wp.vec3)):
    """points (m,): places of entries of the node list from `begin` on; node units from the middle of the lattice."""
    n = first + wp.tid()
    points[n] = centred_place(levels, levels.nodes[begin + n])


@wp.kernel
def select_vertices(first: int, column: int, values: wp.array(dtype=wp.vec3)):
    """values (v,): channel c is 1 at vertex column + c and 0 at the others."""
    vertex = first + wp.tid()
    selected = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        if vertex == column + c:
            selected[c] = 1.0
    values[vertex] = selected


@wp.kernel
def store_weights(
    first: int,
    begin: int,
    column: int,
    levels: NodeLevels,
    values: wp.array(dtype=wp.vec3),
    weights: wp.array2d(dtype=float),
):
    """Columns column .. column + 2 of weights (m, v) from the values of the nodes listed from `begin` on."""
    n = first + wp.tid()
    value = values[levels.nodes[begin + n]]
    for c in range(3):
        if column + c < weights.shape[1]:
            weights[n, column + c] = value[c]


@wp.kernel
def apply_weights(
    first: int,
    begin: int,
    levels: NodeLevels,
    weights: wp.array2d(dtype=float),
    targets: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
):
    """Add sum_j weights[n, j] targets[j] to the value of each node listed from `begin` on."""
    n = first + wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for j in range(targets.shape[0]):
        total += weights[n, j] * targets[j]
    node = levels.nodes[begin + n]
    values[node] = values[node] + total


@wp.kernel
def sample_weights(
    first: int, column: int, cage_map: CageMap, points: wp.array(dtype=wp.vec3), weights: wp.array2d(dtype=float)
):
    """Columns column .. column + 2 of weights (n, v) by look-up at points (n,). cage_map: has the weights of three
    vertices where others have positions."""
    n = first + wp.tid()
    value = map_position(cage_map, points[n])
    for c in range(3):
        if column + c < weights.shape[1]:
            weights[n, column + c] = value[c]
