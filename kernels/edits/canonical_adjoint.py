"""The backward pass from points and directions in canonical space to those of the deformed scene, and to the map."""

# p = phi(x) and u = s / |s|, s the difference that edits/trace.canonical_step takes along the unit direction d: so a
# slope g by u is (g - (g u) u) / |s| by s, and goes on to both ends of the difference. phi is a map on a lattice, whose
# slope is that of central differences over a cell, as for gradients/points.

import warp as wp

from ..lattice.cage_map import CageMap, corner_share, map_slope
from .structs import MAPPED, LatticeEdit
from .trace import LONG_STEP, SHORT_DIFFERENCE, CanonicalPoint, canonical_point, same_map

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def difference_end(edits: wp.array(dtype=LatticeEdit), x: wp.vec3, along: wp.vec3, dt: float, here: CanonicalPoint):
    """(o, y): the difference that edits/trace.canonical_step takes is dt / o (y - phi(x)), y = phi(x + o d); an o of 0:
    none."""
    ahead = canonical_point(edits, x + dt * along)
    short = SHORT_DIFFERENCE * dt
    if same_map(here, ahead):
        step = ahead.position - here.position
        if wp.length_sq(step) <= LONG_STEP * LONG_STEP * dt * dt:
            return dt, ahead.position
        near = canonical_point(edits, x + short * along)
        if same_map(here, near):
            if wp.length(step) > 2.0 * wp.length((near.position - here.position) / SHORT_DIFFERENCE):
                return short, near.position
            return dt, ahead.position
    behind = canonical_point(edits, x - dt * along)
    if same_map(here, behind):
        return -dt, behind.position
    near = canonical_point(edits, x + short * along)
    if same_map(here, near):
        return short, near.position
    near = canonical_point(edits, x - short * along)
    if same_map(here, near):
        return -short, near.position
    return float(0.0), here.position


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
    # points share nodes: atomics on CUDA, sums of their own for each thread of a CPU
    n = first + wp.tid()
    by_point = by_canonical_points[n]
    by_direction = by_canonical_directions[n]
    if region[n] == MAPPED:
        edit = edits[0]
        x = points[n] - origin
        length = wp.length(directions[n])
        along = directions[n] / length
        here = canonical_point(edits, x)
        offset, there = difference_end(edits, x, along, dt, here)
        by_other = wp.vec3()
        if offset != 0.0:
            step = dt / offset * (there - here.position)
            if wp.length(step) > 1.0e-6 * dt:
                seen = wp.normalize(step)
                by_there = dt / offset / wp.length(step) * (by_direction - wp.dot(seen, by_direction) * seen)
                by_point -= by_there
                by_other = propagated(edit.deformed, x + offset * along, by_there, by_nodes)
                by_direction = offset * by_other
        by_point = by_other + propagated(edit.deformed, x, by_point, by_nodes)
        by_direction = (by_direction - wp.dot(along, by_direction) * along) / length
    by_points[n] = by_point
    by_directions[n] = by_direction
