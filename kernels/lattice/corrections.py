"""Corrections of a mean value map next to the cage, so that trilinear look-up errs less there."""

# Second derivatives of mean value maps have one sign next to the cage, most of all where it faces itself over a gap: in
# the middle of a cell trilinear interpolation errs by an eighth of the sum of the second differences. Half of that as
# an error of the other sign at the nodes halves the largest one, so cut inside nodes (see nodes.py) move by
#   - (d_0 + d_1 + d_2) / 16,    d_a = 2 ((u_+ - u_0) / theta_+ + (u_- - u_0) / theta_-) / (theta_+ + theta_-)
# with the neighbours, or the values where links cross the cage, a fraction theta of a cell away. Ring nodes are
# continued along grid edges (see rings.py), which miss edges of the cage between them: each moves by MISFIT_SHARE of
# the map's error at the nearest point of the cage. All is linear in the values, zero for linear functions.

import warp as wp

from ..mesh.containment import closest_point_on_triangle
from .cage_map import corner_share
from .cut_rows import CutRows, barycentric, crossing_value
from .distance import BLOCK, block_count, nearest_face
from .nodes import CUT_SECTION, OUTSIDE, RING_SECTION, NodeLevels, node_place
from .rings import is_known, is_open_link, node_step

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

#: Of the misfit at a point, how much a ring node takes: other outside corners of the cell move as well, and have about
#: as much weight there as all inside ones.
MISFIT_SHARE = wp.constant(1.25)

#: Crossings nearer than this share of a cell make differences of the node's own value unsteady.
NEAREST_CROSSING = wp.constant(0.25)


@wp.func
def second_difference(
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    vertex_values: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    node: int,
    axis: int,
):
    """Second derivative of the map along an axis at a cut node, a cell being 1; zero where too little is known."""
    row = levels.codes[node]
    step = node_step(levels, 2 * axis + 1)
    here = values[node]
    open_count = int(0)
    nearest = float(1.0)
    steepness = wp.vec3(0.0, 0.0, 0.0)
    span = float(0.0)
    cut = int(0)
    for side in range(2):
        direction = 2 * axis + side
        theta = rows.fractions[row, direction]
        value = here
        if (rows.links[row] >> direction) & 1 == 1:
            value = values[node + wp.where(side == 1, step, -step)]
            open_count += 1
        else:
            value = crossing_value(rows, faces, vertex_values, row, direction)
            cut = direction
        steepness += (value - here) / theta
        span += theta
        nearest = wp.min(nearest, theta)
    if nearest >= NEAREST_CROSSING:
        return 2.0 * steepness / span
    back = cut ^ 1
    behind = node + node_step(levels, back)
    if open_count == 1 and is_open_link(levels, rows, behind, back):
        theta = rows.fractions[row, cut]
        g = crossing_value(rows, faces, vertex_values, row, cut)
        u_1 = values[behind]
        u_2 = values[behind + node_step(levels, back)]
        return 2.0 * ((g - u_1) / (theta + 1.0) - (u_1 - u_2)) / (theta + 2.0)
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def is_between(levels: NodeLevels, node: int):
    """Whether an outside node lies between two inside ones on a grid line."""
    found = bool(False)
    for axis in range(3):
        step = node_step(levels, 2 * axis + 1)
        found = found or (levels.codes[node - step] > OUTSIDE and levels.codes[node + step] > OUTSIDE)
    return found


@wp.func
def misfit(
    levels: NodeLevels,
    counts: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
    vertex_values: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    node: int,
):
    """What trilinear look-up misses of the map's value at the point of the cage nearest to a node of rings 0 and 1;
    zero where its cell has other outside corners than those."""
    p = node_place(levels, 0, node)
    shape = levels.shapes[0]
    block = ((p[0] / BLOCK) * block_count(shape[1]) + p[1] / BLOCK) * block_count(shape[2]) + p[2] / BLOCK
    node_at = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    _apart, f = nearest_face(node_at, block, counts, near, vertices, faces, boxes)
    if f < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    face = faces[f]
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    x = closest_point_on_triangle(node_at, a, b, c)
    weight = barycentric(x, a, b, c)
    result = (
        weight[0] * vertex_values[face[0]] + weight[1] * vertex_values[face[1]] + weight[2] * vertex_values[face[2]]
    )
    i = int(wp.floor(x[0]))
    j = int(wp.floor(x[1]))
    k = int(wp.floor(x[2]))
    base = (i * shape[1] + j) * shape[2] + k
    for corner in range(8):
        at = base + ((corner >> 2) * shape[1] + ((corner >> 1) & 1)) * shape[2] + (corner & 1)
        if not is_known(levels.codes[at], 2):
            return wp.vec3(0.0, 0.0, 0.0)
    offset = x - wp.vec3(float(i), float(j), float(k))
    for corner in range(8):
        at = base + ((corner >> 2) * shape[1] + ((corner >> 1) & 1)) * shape[2] + (corner & 1)
        result -= corner_share(corner, offset) * values[at]
    return result


@wp.kernel
def measure_corrections(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    counts: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
    vertex_values: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    corrections: wp.array(dtype=wp.vec3),
):
    """corrections (cut nodes and rings 0 and 1,): what is to be added to the values (nodes,) of a map that is linear on
    the cage's faces and takes vertex_values (v,) there. One item per node; one level. vertices (v,): node units."""
    n = first + wp.tid()
    if n >= levels.starts[RING_SECTION + 2] - levels.starts[CUT_SECTION]:
        return
    node = levels.nodes[levels.starts[CUT_SECTION] + n]
    correction = wp.vec3(0.0, 0.0, 0.0)
    if levels.codes[node] >= 0:
        for axis in range(3):
            correction -= second_difference(levels, rows, faces, vertex_values, values, node, axis) / 16.0
    elif not is_between(levels, node):
        correction = MISFIT_SHARE * misfit(levels, counts, near, vertices, faces, boxes, vertex_values, values, node)
    corrections[n] = correction


@wp.kernel
def correct_values(
    first: int, levels: NodeLevels, corrections: wp.array(dtype=wp.vec3), values: wp.array(dtype=wp.vec3)
):
    """Add the corrections to the values of cut nodes and rings 0 and 1. One item per node; one level."""
    n = first + wp.tid()
    if n >= levels.starts[RING_SECTION + 2] - levels.starts[CUT_SECTION]:
        return
    node = levels.nodes[levels.starts[CUT_SECTION] + n]
    values[node] = values[node] + corrections[n]
