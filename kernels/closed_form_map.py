"""Mean value and Green maps at the listed nodes of a lattice.

Cage vertices are in node units (see crossings) relative to the middle of the lattice, so that float32 keeps most
digits where the cage is; `size` is the cage's size in them.
Siblings: mean_value, green, node_levels.
"""

import warp as wp

from .green import green_position
from .mean_value import mean_value_position
from .node_levels import RINGS, NodeLevels, centred_place

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.kernel
def map_nodes_mean_value(
    first: int,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
):
    """values[node] = sum_j w_j targets_j at inside nodes, then at those of the rings. One item a node; one level."""
    n = first + wp.tid()
    if n >= levels.starts[2]:
        n += levels.starts[3] - levels.starts[2]
    if n >= levels.starts[3 + RINGS]:
        return
    node = levels.nodes[n]
    values[node] = mean_value_position(centred_place(levels, node), vertices, faces, targets, size)


@wp.kernel
def map_nodes_green(
    first: int,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
):
    """values[node] = sum_i phi_i targets_i + sum_f psi_f target_normals_f at inside nodes. One item a node; one
    level."""
    n = first + wp.tid()
    if n >= levels.starts[2]:
        return
    node = levels.nodes[n]
    values[node] = green_position(centred_place(levels, node), vertices, faces, targets, target_normals, size)
