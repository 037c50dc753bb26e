"""The backward pass from points and directions in canonical space to those of the deformed scene, and to the map."""

# p = phi(x) and u = s / |s|, s the difference that edits/trace.canonical_step takes along the unit direction d: so a
# slope g by u is (g - (g u) u) / |s| by s, and goes on to both ends of the difference. phi is a map on a lattice, whose
# slope is that of central differences over a cell, as for adjoint/points.

import warp as wp

from ..lattice.cage_map import CageMap, corner_share, map_slope
from .structs import MAPPED, LatticeEdit
from .trace import LONG_STEP, SHORT_DIFFERENCE, CanonicalPoint, canonical_point, same_map

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def difference_ends(edits: wp.array(dtype=LatticeEdit), x: wp.vec3, along: wp.vec3, dt: float, here: CanonicalPoint):
    """(a, b, factor) of the difference factor (phi(x + b d) - phi(x + a d)) that edits/trace.canonical_step takes; a
    factor of 0: none."""
    ahead = canonical_point(edits, x + dt * along)
    if same_map(here, ahead):
        length = wp.length(ahead.position - here.position)
        if length <= LONG_STEP * dt:
            return wp.vec3(0.0, dt, 1.0)
        near = canonical_point(edits, x + SHORT_DIFFERENCE * dt * along)
        if same_map(here, near):
            if length * SHORT_DIFFERENCE > 2.0 * wp.length(near.position - here.position):
                return wp.vec3(0.0, SHORT_DIFFERENCE * dt, 1.0 / SHORT_DIFFERENCE)
            return wp.vec3(0.0, dt, 1.0)
    behind = canonical_point(edits, x - dt * along)
    if same_map(here, behind):
        return wp.vec3(-dt, 0.0, 1.0)
    for side in range(2):
        short = wp.where(side == 0, SHORT_DIFFERENCE, -SHORT_DIFFERENCE)
        near = canonical_point(edits, x + short * dt * along)
        if same_map(here, near):
            return wp.vec3(0.0, short * dt, 1.0 / short)
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def propagated(cage_map: CageMap, x: wp.vec3, slope: wp.vec3, by_nodes: wp.array3d(dtype=wp.vec3)):
    """The slope by a point, of one by its canonical position, which is added to the nodes of its cell."""
    if by_nodes.shape[0] > 0:
        g = (x - cage_map.lower) * cage_map.inverse_spacing
        i = wp.clamp(int(wp.floor(g[0])), 0, cage_map.positions.shape[0] - 2)
        j = wp.clamp(int(wp.floor(g[1])), 0, cage_map.positions.shape[1] - 2)
        k = wp.clamp(int(wp.floor(g[2])), 0, cage_map.positions.shape[2] - 2)
        offset = g - wp.vec3(float(i), float(j), float(k))
        for corner in range(8):
            share = corner_share(corner, offset)
            wp.atomic_add(by_nodes, i + (corner >> 2), j + ((corner >> 1) & 1), k + (corner & 1), share * slope)
    return wp.transpose(map_slope(cage_map, x)) * slope


@wp.kernel
def propagate_canonical_points(
    first: int,
    edits: wp.array(dtype=LatticeEdit),
    origin: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    dt: float,
    region: wp.array(dtype=wp.int32),
    by_canonical_points: wp.array(dtype=wp.vec3),
    by_canonical_directions: wp.array(dtype=wp.vec3),
    by_points: wp.array(dtype=wp.vec3),
    by_directions: wp.array(dtype=wp.vec3),
    by_nodes: wp.array3d(dtype=wp.vec3),
):
    """From slopes (n,) by what edits/trace.map_points returned for one edit, those by its points and directions, and,
    added up where there are any, by positions of nodes. region: as it returned it."""
    # points share nodes: atomics on CUDA, one thread on a CPU
    n = first + wp.tid()
    by_point = by_canonical_points[n]
    by_direction = by_canonical_directions[n]
    if region[n] == MAPPED:
        edit = edits[0]
        x = points[n] - origin
        length = wp.length(directions[n])
        along = directions[n] / length
        here = canonical_point(edits, x)
        ends = difference_ends(edits, x, along, dt, here)
        tail = x + ends[0] * along
        head = x + ends[1] * along
        step = ends[2] * (canonical_point(edits, head).position - canonical_point(edits, tail).position)
        by_point = propagated(edit.deformed, x, by_point, by_nodes)
        if wp.length(step) > 1.0e-6 * dt:
            seen = wp.normalize(step)
            by_step = ends[2] / wp.length(step) * (by_direction - wp.dot(seen, by_direction) * seen)
            by_head = propagated(edit.deformed, head, by_step, by_nodes)
            by_tail = propagated(edit.deformed, tail, -by_step, by_nodes)
            by_point += by_head + by_tail
            by_direction = ends[1] * by_head + ends[0] * by_tail
        by_direction = (by_direction - wp.dot(along, by_direction) * along) / length
    by_points[n] = by_point
    by_directions[n] = by_direction
