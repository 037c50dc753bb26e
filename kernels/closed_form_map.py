"""Mean value and Green maps at the listed nodes of a lattice.

Points and cage vertices are in node units (see crossings) relative to `centre`, in the middle of the lattice; `size`
is the cage's size in them.
Siblings: mean_value, green, node_levels.
"""

import warp as wp

from .green import green_position
from .mean_value import mean_value_position
from .node_levels import NodeLevels, node_place

wp.set_module_options({"enable_backward": False})


@wp.kernel
def map_nodes_mean_value(
    first: int,
    begin: int,
    centre: wp.vec3,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
):
    """values[node] = sum_j w_j targets_j at the nodes listed from `begin` on, inside or outside the cage."""
    node = levels.nodes[begin + first + wp.tid()]
    p = node_place(levels, 0, node)
    x = wp.vec3(float(p[0]), float(p[1]), float(p[2])) - centre
    values[node] = mean_value_position(x, vertices, faces, targets, size)


@wp.kernel
def map_nodes_green(
    first: int,
    begin: int,
    centre: wp.vec3,
    levels: NodeLevels,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
    values: wp.array(dtype=wp.vec3),
):
    """values[node] = sum_i phi_i targets_i + sum_f psi_f target_normals_f at inside nodes listed from `begin` on."""
    node = levels.nodes[begin + first + wp.tid()]
    p = node_place(levels, 0, node)
    x = wp.vec3(float(p[0]), float(p[1]), float(p[2])) - centre
    values[node] = green_position(x, vertices, faces, targets, target_normals, size)
