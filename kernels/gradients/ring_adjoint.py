"""The backward pass from the nodes of a map to those that it is evaluated or solved at, and to where links cross."""

# The transpose of what fills a lattice: rings 2, 1 and 0 (../lattice/rings.py), then the nodes that are interpolated
# (../lattice/closed_form.py). `slopes` (nodes,) vec3 are dL / d value of each node, L being what is asked about; each
# step passes on those of its own nodes to the nodes that their values came from. All of that is linear in the values.
# What the values depend on besides are crossings of links with the cage: the value g there, and how far away it is,
# theta. Many ring nodes pass on to one node: atomics on CUDA, one thread on a CPU.

import warp as wp

from ..core.gradients import forward_only_in
from ..lattice.cut_rows import CutRows, crossing_value
from ..lattice.nodes import CUT_SECTION, INTERPOLATED, NodeLevels, node_place, ring_section
from ..lattice.rings import direction_step, distance_slope, is_steady, known_along, node_step
from ..lattice.side_values import correction_of

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.array(dtype=wp.vec3),))


@wp.struct
class CrossingSlopes:
    """Of L, by what cut nodes take from crossings of their links with the cage."""

    values: wp.array2d(dtype=wp.vec3)  # (rows of level 0, 6) by g, the map where the link crosses the cage
    fractions: wp.array2d(dtype=float)  # (rows of level 0, 6) by theta, how far away that is, cells


@wp.func
def known_counts(levels: NodeLevels, node: int, rings: int, towards: wp.vec3):
    """Directions of the lattice that know two values in a row, and those that know one at least."""
    counts = wp.vec2i(0, 0)
    for direction in range(27):
        known = known_along(levels, node, rings, towards, direction)
        counts += wp.vec2i(known / 2, wp.min(known, 1))
    return counts


@wp.func
def propagate_extrapolation(
    levels: NodeLevels, node: int, rings: int, towards: wp.vec3, counts: wp.vec2i, slopes: wp.array(dtype=wp.vec3)
):
    """Transpose of the mean of 2 u_1 - u_2 over the directions that know both, else of u_1."""
    slope = slopes[node] / float(wp.max(wp.where(counts[0] > 0, counts[0], counts[1]), 1))
    direction = int(0)
    while direction < 27:
        known = known_along(levels, node, rings, towards, direction)
        step = direction_step(levels, direction)
        if known == 2 and counts[0] > 0:
            wp.atomic_add(slopes, node + step, 2.0 * slope)
            wp.atomic_add(slopes, node + 2 * step, -slope)
        elif known > 0 and counts[0] == 0:
            wp.atomic_add(slopes, node + step, slope)
        direction += 1
    forward_only(slopes)


@wp.kernel
def propagate_ring(
    first: int, ring: int, levels: NodeLevels, distance: wp.array(dtype=float), slopes: wp.array(dtype=wp.vec3)
):
    """Transpose of extend_outwards for a ring, which chooses as that does; distance (nodes,) signed. A ring node that
    nothing reaches has the value of the cage there, and is held."""
    n = first + wp.tid()
    section = ring_section(levels) + ring
    node = levels.nodes[levels.starts[section] + n]
    if wp.length_sq(slopes[node]) == 0.0:
        return
    anywhere = wp.vec3(0.0, 0.0, 0.0)
    towards = anywhere
    rings = int(0)
    counts = wp.vec2i(0, 0)
    if ring < 2:
        counts = known_counts(levels, node, rings, towards)
    if ring > 0 and counts[0] == 0:
        rings = ring
        towards = -distance_slope(levels, distance, node)
        counts = known_counts(levels, node, rings, towards)
        if counts[0] == 0:
            towards = anywhere
            counts = known_counts(levels, node, rings, towards)
    propagate_extrapolation(levels, node, rings, towards, counts, slopes)


@wp.func
def propagate_beyond(
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    corrections: wp.array(dtype=wp.vec3),
    scale: float,
    node: int,
    direction: int,
    slope: wp.vec3,
    slopes: wp.array(dtype=wp.vec3),
    by_crossings: CrossingSlopes,
):
    """Transpose of value_beyond: g + (g - u) ratio, with the ratio's slope by theta."""
    row = levels.codes[node]
    back = direction ^ 1
    theta = rows.fractions[row, direction]
    g = crossing_value(rows, faces, targets, row, direction)
    ratio = (1.0 - theta) / theta
    by_theta = -1.0 / (theta * theta)
    behind = node
    is_inside = True
    if theta < 0.5:
        is_inside = (rows.links[row] >> back) & 1 == 1
        behind = node + node_step(levels, back)
        ratio = (1.0 - theta) / (1.0 + theta)
        by_theta = -2.0 / ((1.0 + theta) * (1.0 + theta))
    if is_inside:
        u = positions[behind] - scale * correction_of(corrections, levels.codes[behind])
        wp.atomic_add(slopes, behind, -ratio * slope)
        wp.atomic_add(by_crossings.fractions, row, direction, by_theta * wp.dot(slope, g - u))
    else:  # the cage is crossed again behind the node
        apart = theta + rows.fractions[row, back]
        ratio = (1.0 - theta) / wp.max(apart, 0.5)
        along = wp.dot(slope, g - crossing_value(rows, faces, targets, row, back))
        wp.atomic_add(by_crossings.values, row, back, -ratio * slope)
        by_theta = -1.0 / wp.max(apart, 0.5)
        if apart > 0.5:
            by_theta -= ratio / apart
            wp.atomic_add(by_crossings.fractions, row, back, -ratio / apart * along)
        wp.atomic_add(by_crossings.fractions, row, direction, by_theta * along)
    wp.atomic_add(by_crossings.values, row, direction, (1.0 + ratio) * slope)


@wp.kernel
def propagate_through_cage(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    corrections: wp.array(dtype=wp.vec3),
    scale: float,
    slopes: wp.array(dtype=wp.vec3),
    by_crossings: CrossingSlopes,
):
    """Transpose of extend_through_cage: ring 0. targets (v,): the map at the cage's vertices; positions (nodes,): the
    map, with scale * corrections (rows of level 0,) where there are any."""
    n = first + wp.tid()
    node = levels.nodes[levels.starts[ring_section(levels)] + n]
    if wp.length_sq(slopes[node]) == 0.0:
        return
    steady = int(0)
    other = int(0)
    for direction in range(6):
        row = levels.codes[node + node_step(levels, direction)]
        if row >= 0:
            is_one = is_steady(rows, row, direction ^ 1)
            steady += wp.where(is_one, 1, 0)
            other += wp.where(is_one, 0, 1)
    anywhere = wp.vec3(0.0, 0.0, 0.0)
    counts = wp.vec2i(0, 0)
    if steady == 0:  # beside a tip of the cage
        counts = known_counts(levels, node, 0, anywhere)
    if counts[0] > 0:
        propagate_extrapolation(levels, node, 0, anywhere, counts, slopes)
        return
    slope = slopes[node] / float(wp.max(wp.where(steady > 0, steady, other), 1))
    direction = int(0)
    while direction < 6:
        inside = node + node_step(levels, direction)
        row = levels.codes[inside]
        if row >= 0:
            if steady == 0 or is_steady(rows, row, direction ^ 1):
                propagate_beyond(
                    levels,
                    rows,
                    faces,
                    targets,
                    positions,
                    corrections,
                    scale,
                    inside,
                    direction ^ 1,
                    slope,
                    slopes,
                    by_crossings,
                )
        direction += 1


@wp.func
def interpolation_axis(p: wp.vec3i):
    """The axis that an interpolated node at this place is interpolated along: the last one that it is odd on."""
    return wp.where((p[2] & 1) == 1, 2, wp.where((p[1] & 1) == 1, 1, 0))


@wp.kernel
def propagate_interpolation(first: int, axis: int, levels: NodeLevels, slopes: wp.array(dtype=wp.vec3)):
    """Transpose of interpolate_nodes along an axis, the last one first: inside nodes even along it gather from the
    interpolated ones beside them. One item per inside node."""
    n = first + wp.tid()
    if n >= levels.starts[CUT_SECTION]:
        return
    node = levels.nodes[n]
    p = node_place(levels, 0, node)
    shape = levels.shapes[0]
    step = wp.where(axis == 2, 1, wp.where(axis == 1, shape[2], shape[1] * shape[2]))
    if (wp.where(axis == 2, p[2], wp.where(axis == 1, p[1], p[0])) & 1) == 1:
        return
    total = slopes[node]
    for k in range(6):
        offset = 2 * k - 5
        q = p
        q[axis] = p[axis] + offset
        beside = node + offset * step
        is_there = q[axis] >= 0 and q[axis] < shape[axis]
        if is_there and interpolation_axis(q) == axis:
            if levels.codes[beside] == INTERPOLATED:
                share = wp.where(k == 2 or k == 3, 150.0, wp.where(k == 1 or k == 4, -25.0, 3.0))
                total += share / 256.0 * slopes[beside]
    slopes[node] = total
