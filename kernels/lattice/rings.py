"""Values at the outside nodes of cells that the cage cuts, continued from inside, and the affine part of the map."""

# Trilinear look-up needs all eight corners of a cell. Ring 0 (see nodes.py) is continued along grid edges through the
# true crossing, its boundary value g: with u_in at the inside node, a fraction theta of a cell away, u_back behind it,
#   g + (g - u_in) (1 - theta) / theta  where theta >= 1/2,    else  g + (g - u_back) (1 - theta) / (1 + theta),
# averaged; other rings take the mean of 2 u_1 - u_2 along the lattice's 26 directions, ring 1 from inside nodes alone
# where it can, else from what lies towards the nearest part of the cage. All is linear in the values, exact for linear
# functions. Too thin a cage (no second value) takes the neighbours' mean or its nearest point's value.

import warp as wp

from ..core.lanes import lane_count, lane_place, octet_count, sum_of_lanes, sum_of_octet
from .cut_rows import CutRows, barycentric, crossing_value, nearest_face
from .nodes import OUTSIDE, RING, NodeLevels, node_place, ring_section

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})


@wp.func
def node_step(levels: NodeLevels, direction: int):
    """From a node of level 0 to its neighbour in direction 2 * axis + forward."""
    shape = levels.shapes[0]
    step = int(1)
    if direction < 2:
        step = shape[1] * shape[2]
    elif direction < 4:
        step = shape[2]
    return wp.where(direction % 2 == 1, step, -step)


@wp.func
def is_open_link(levels: NodeLevels, rows: CutRows, node: int, direction: int):
    """Whether the link from an inside node does not cross the cage."""
    code = levels.codes[node]
    return code < 0 or ((rows.links[code] >> direction) & 1) == 1


@wp.func
def is_steady(rows: CutRows, row: int, direction: int):
    """Whether the value beyond the crossing in a direction follows without much amplification.
    It does not where the cage is crossed again right behind the node."""
    back = direction ^ 1
    theta = rows.fractions[row, direction]
    return theta >= 0.5 or (rows.links[row] >> back) & 1 == 1 or theta + rows.fractions[row, back] >= 0.5


@wp.func
def value_beyond(
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    vertex_values: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    node: int,
    direction: int,
):
    """Value at the outside neighbour of cut inside node `node` in a direction, continued through the crossing."""
    row = levels.codes[node]
    back = direction ^ 1
    theta = rows.fractions[row, direction]
    g = crossing_value(rows, faces, vertex_values, row, direction)
    if theta >= 0.5:
        return g + (g - values[node]) * ((1.0 - theta) / theta)
    if (rows.links[row] >> back) & 1 == 1:
        return g + (g - values[node + node_step(levels, back)]) * ((1.0 - theta) / (1.0 + theta))
    g_back = crossing_value(rows, faces, vertex_values, row, back)  # the cage is crossed again behind the node
    return g + (g - g_back) * ((1.0 - theta) / wp.max(theta + rows.fractions[row, back], 0.5))


@wp.struct
class Extrapolation:
    linear: wp.vec3  # sum of 2 u_1 - u_2 over the directions that know both
    linear_count: float
    nearby: wp.vec3  # sum of u_1 over those that know it
    nearby_count: float


@wp.func
def is_known(code: int, rings: int):
    """Whether a node of this code is inside or in one of the first `rings` rings."""
    return code > OUTSIDE or (code <= RING and code > RING - rings)


@wp.func
def direction_step(levels: NodeLevels, direction: int):
    """From a node of level 0 to the next one along direction 0 .. 26 of the lattice; 0 for the middle one."""
    shape = levels.shapes[0]
    return ((direction / 9 - 1) * shape[1] + (direction / 3) % 3 - 1) * shape[2] + direction % 3 - 1


@wp.func
def known_along(levels: NodeLevels, node: int, rings: int, towards: wp.vec3, direction: int):
    """How many values in a row are known along a direction of the lattice, 0 to 2, of inside nodes and the first
    `rings` rings; none where it leads away from `towards`, where that is not zero."""
    step = direction_step(levels, direction)
    ahead = wp.vec3(float(direction / 9 - 1), float((direction / 3) % 3 - 1), float(direction % 3 - 1))
    leads = wp.dot(ahead, towards) > 0.0 or wp.dot(towards, towards) == 0.0
    code = levels.codes[node + step]  # without branches around the codes, so that they are read at once
    far_code = levels.codes[wp.clamp(node + 2 * step, 0, levels.codes.shape[0] - 1)]
    known = int(0)
    if step != 0 and leads and is_known(code, rings):
        known = wp.where(is_known(far_code, rings), 2, 1)
    return known


@wp.func
def with_direction(
    sums: Extrapolation,
    levels: NodeLevels,
    values: wp.array(dtype=wp.vec3),
    node: int,
    rings: int,
    towards: wp.vec3,
    direction: int,
):
    """The sums with what a direction of the lattice adds at a node; see `known_along`."""
    result = sums
    known = known_along(levels, node, rings, towards, direction)
    if known > 0:
        step = direction_step(levels, direction)
        value = values[node + step]
        result.nearby += value
        result.nearby_count += 1.0
        if known > 1:
            result.linear += 2.0 * value - values[node + 2 * step]
            result.linear_count += 1.0
    return result


@wp.func
def lattice_extrapolation(levels: NodeLevels, values: wp.array(dtype=wp.vec3), node: int, rings: int):
    """What the 26 directions of the lattice contribute at a node."""
    result = Extrapolation()
    for direction in range(27):
        result = with_direction(result, levels, values, node, rings, wp.vec3(0.0, 0.0, 0.0), direction)
    return result


@wp.func
def shared_extrapolation(
    levels: NodeLevels, values: wp.array(dtype=wp.vec3), node: int, rings: int, towards: wp.vec3, lane: int
):
    """The same, of the directions that lead `towards` a side, shared by a group of lanes. All lanes."""
    own = Extrapolation()
    for direction in range(lane, 27, lane_count()):
        own = with_direction(own, levels, values, node, rings, towards, direction)
    result = Extrapolation()
    result.linear_count = sum_of_lanes(own.linear_count)
    result.nearby_count = sum_of_lanes(own.nearby_count)
    for axis in range(3):
        result.linear[axis] = sum_of_lanes(own.linear[axis])
        result.nearby[axis] = sum_of_lanes(own.nearby[axis])
    return result


@wp.kernel
def extend_through_cage(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    vertex_values: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
):
    """Values of ring 0, of a map that takes vertex_values (v,) at the cage's vertices and is linear on its faces. One
    octet of lanes per node, one lane per direction; as many items as fill whole warps."""
    item = first + wp.tid()
    lane = item % octet_count()
    n = item / octet_count()
    section = ring_section(levels)
    is_node = n < levels.starts[section + 1] - levels.starts[section]
    node = int(0)
    if is_node:
        node = levels.nodes[levels.starts[section] + n]
    steady = wp.vec3(0.0, 0.0, 0.0)
    steady_count = float(0.0)
    other = wp.vec3(0.0, 0.0, 0.0)
    other_count = float(0.0)
    for direction in range(lane, wp.where(is_node, 6, 0), octet_count()):
        inside = node + node_step(levels, direction)
        row = levels.codes[inside]
        if row >= 0:
            value = value_beyond(levels, rows, faces, vertex_values, values, inside, direction ^ 1)
            if is_steady(rows, row, direction ^ 1):
                steady += value
                steady_count += 1.0
            else:
                other += value
                other_count += 1.0
    steady_count = sum_of_octet(steady_count)
    other_count = sum_of_octet(other_count)
    for axis in range(3):
        steady[axis] = sum_of_octet(steady[axis])
        other[axis] = sum_of_octet(other[axis])
    if is_node and lane == 0:
        if steady_count > 0.0:
            values[node] = steady / steady_count
        else:  # beside a tip of the cage
            found = lattice_extrapolation(levels, values, node, 0)
            if found.linear_count > 0.0:
                values[node] = found.linear / found.linear_count
            else:
                values[node] = other / wp.max(other_count, 1.0)


@wp.func
def distance_slope(levels: NodeLevels, distance: wp.array(dtype=float), node: int):
    """Differences of the signed distance over a node, which point away from the nearest part of the cage."""
    row = levels.shapes[0][2]
    slab = levels.shapes[0][1] * row
    return wp.vec3(
        distance[node + slab] - distance[node - slab],
        distance[node + row] - distance[node - row],
        distance[node + 1] - distance[node - 1],
    )


@wp.func
def value_on_cage(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    vertex_values: wp.array(dtype=wp.vec3),
):
    """Value at the point of the cage nearest to x, of a map that is linear on its faces."""
    face = faces[nearest_face(x, vertices, faces)]
    weight = barycentric(x, vertices[face[0]], vertices[face[1]], vertices[face[2]])
    return weight[0] * vertex_values[face[0]] + weight[1] * vertex_values[face[1]] + weight[2] * vertex_values[face[2]]


@wp.kernel
def extend_outwards(
    first: int,
    ring: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    levels: NodeLevels,
    vertex_values: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    values: wp.array(dtype=wp.vec3),
):
    """Values of a ring from the inside nodes and the rings before it. vertices (v,) in node units; distance (nodes,)
    signed. One group of lanes per node."""
    n, lane, _ = lane_place(first + wp.tid())
    section = ring_section(levels) + ring
    if n >= levels.starts[section + 1] - levels.starts[section]:
        return
    node = levels.nodes[levels.starts[section] + n]
    # nodes of ring 0 that are near may belong to another part of the cage: inside nodes first, which rings 0 and 1 have
    # next to them, then what lies towards the nearest part
    anywhere = wp.vec3(0.0, 0.0, 0.0)
    found = Extrapolation()
    if ring < 2:
        found = shared_extrapolation(levels, values, node, 0, anywhere, lane)
    if ring > 0 and found.linear_count == 0.0:
        found = shared_extrapolation(levels, values, node, ring, -distance_slope(levels, distance, node), lane)
        if found.linear_count == 0.0:
            found = shared_extrapolation(levels, values, node, ring, anywhere, lane)
    if lane == 0:
        if found.linear_count > 0.0:
            values[node] = found.linear / found.linear_count
        elif found.nearby_count > 0.0:
            values[node] = found.nearby / found.nearby_count
        else:
            p = node_place(levels, 0, node)
            x = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
            values[node] = value_on_cage(x, vertices, faces, vertex_values)


@wp.kernel
def add_affine(
    first: int, levels: NodeLevels, scale: float, affine: wp.array(dtype=wp.vec3), values: wp.array(dtype=wp.vec3)
):
    """values becomes scale * values + i a_0 + j a_1 + k a_2 + a_3, a = affine (4,), at every node of level 0."""
    node = first + wp.tid()
    if node >= levels.first_node[1]:
        return
    p = node_place(levels, 0, node)
    values[node] = (
        scale * values[node] + float(p[0]) * affine[0] + float(p[1]) * affine[1] + float(p[2]) * affine[2] + affine[3]
    )


@wp.kernel
def gather_status(
    first: int,
    line_overflow: wp.array(dtype=int),
    list_overflow: wp.array(dtype=int),
    solver: wp.array(dtype=float),
    gap_count: wp.array(dtype=int),
    narrow: wp.array(dtype=int),
    levels: NodeLevels,
    status: wp.array(dtype=float),
):
    """status (5 + sections,): both overflows, the solver's cycles and residual, nodes at gaps, and the length of each
    section. One item per entry."""
    item = first + wp.tid()
    if item >= 5:
        status[item] = float(levels.starts[item - 4] - levels.starts[item - 5])
    elif item == 0:
        status[item] = float(line_overflow[0])
    elif item == 1:
        status[item] = float(list_overflow[0])
    elif item < 4:
        status[item] = solver[item - 2]
    else:
        status[item] = float(gap_count[0] + narrow[0] / 2)
