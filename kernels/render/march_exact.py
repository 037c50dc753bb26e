"""Emission-absorption ray marching of a deformed sparse voxel grid."""

from typing import Any

import warp as wp

from ..core.gradients import forward_only_in
from ..edits.structs import CELL_STEEP, CLEARED, CUT_LENGTH, MAPPED, ExactEdit, lattice_lower, lattice_upper
from ..edits.trace import CanonicalPoint, canonical_direction, canonical_point, canonical_step, has_inverted_cells
from ..field.grid import (
    SAMPLE_PLACE,
    VoxelGrid,
    cell_density,
    cell_sample,
    empty_distance,
    exit_distance,
    grid_position,
    grid_span,
    sample_index_after,
    steps_to_sample,
    stored_color,
)
from ..field.harmonics import sh_basis
from ..view.rays import box_span, joined_span
from .rays import FAINT, FOLD_MIN_WEIGHT, MAX_SUB_SAMPLES, DeformedRadiance, MarchOptions, forward_only_radiance

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3), (wp.vec2, wp.vec3))


@wp.func
def empty_reach_of_cells(
    skip: wp.array3d(dtype=wp.uint8), lower: wp.vec3, inverse_spacing: float, x: wp.vec3, direction: wp.vec3
):
    """Distance along a ray from x, in the box of a lattice, over which nothing can be seen; 0 where x may hold
    something."""
    g = (x - lower) * inverse_spacing
    i = wp.clamp(int(wp.floor(g[0])), 0, skip.shape[0] - 1)
    j = wp.clamp(int(wp.floor(g[1])), 0, skip.shape[1] - 1)
    k = wp.clamp(int(wp.floor(g[2])), 0, skip.shape[2] - 1)
    reach = int(skip[i, j, k])
    if reach == 0:
        return 0.0
    return exit_distance(g, direction * inverse_spacing, reach)


@wp.func
def empty_reach(edit: ExactEdit, x: wp.vec3, direction: wp.vec3):
    """empty_reach_of_cells of an edit's table."""
    table = edit.deformed_cells
    return empty_reach_of_cells(table.skip, table.lower, 1.0 / table.spacing, x, direction)


@wp.func
def empty_reach_of_grid(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, t: float):
    """Distance along a ray from t on over which the canonical grid is empty; 0 where it may hold something."""
    span = grid_span(grid, origin, direction)
    reach = float(1.0e30)
    if span[0] < span[1] and t < span[1]:
        reach = span[0] - t
        if t >= span[0]:
            g = grid_position(grid, origin + t * direction)
            empty = empty_distance(grid, g)
            reach = float(0.0)
            if empty > 0:
                reach = exit_distance(g, wp.cw_mul(direction, grid.inverse_voxel_size), empty)
    return reach


@wp.func
def empty_until(edits: Any, grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, t: float):
    """Distance along a ray from t on up to which the deformed scene is certainly empty; t where it may hold matter."""
    # The last edit whose box holds the point decides, as its `skip` counts what is beneath; else the grid does.
    x = origin + t * direction
    limit = float(1.0e30)
    reach = float(-1.0)
    e = int(edits.shape[0]) - 1
    while e >= 0 and reach < 0.0:
        edit = edits[e]
        span = box_span(origin, direction, lattice_lower(edit), lattice_upper(edit))
        if span[0] < span[1] and t < span[1]:
            if t >= span[0]:
                reach = empty_reach(edit, x, direction)
                limit = wp.min(limit, span[1])
            else:
                limit = wp.min(limit, span[0])
        e -= 1
    if reach < 0.0:
        reach = empty_reach_of_grid(grid, origin, direction, t)
    if reach <= 0.0:
        return forward_only(t, origin)
    return forward_only(wp.max(t, wp.min(t + reach, limit)), origin)


@wp.func
def scene_span(edits: Any, grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
    """Distances (near, far) between which a ray can meet anything: the grid and the boxes of all edits."""
    span = grid_span(grid, origin, direction)
    for e in range(edits.shape[0]):
        edit = edits[e]
        span = joined_span(span, box_span(origin, direction, lattice_lower(edit), lattice_upper(edit)))
    return forward_only(span, origin)


@wp.func
def march_deformed(edits: Any, grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, options: MarchOptions):
    """Gather radiance along a ray through the deformed scene."""
    seen = DeformedRadiance()
    seen.transmittance = float(1.0)
    seen.cleared_transmittance = float(1.0)
    step = options.step
    span = scene_span(edits, grid, origin, direction)
    k = sample_index_after(span[0], step)
    ahead = CanonicalPoint()
    ahead_index = int(-1)  # the sample that `ahead` belongs to
    while steps_to_sample(float(k)) * step < span[1] and seen.transmittance > options.stop:
        t = steps_to_sample(float(k)) * step
        leave = empty_until(edits, grid, origin, direction, t)
        if leave > t:
            k = wp.max(k + 1, sample_index_after(leave, step))
            continue
        x = origin + t * direction
        here = ahead
        if ahead_index != k:
            here = canonical_point(edits, x)
        delta = step * direction
        has_delta = here.region != MAPPED
        count = int(1)
        if here.region == MAPPED and (here.flags & CELL_STEEP) != 0:
            ahead = canonical_point(edits, x + delta)
            ahead_index = k + 1
            delta = canonical_step(edits, x, direction, step, here, ahead)
            has_delta = bool(True)
            arc = wp.length(delta)
            if arc > CUT_LENGTH * step:
                count = wp.min(int(wp.ceil(arc / step - 1.0e-3)), MAX_SUB_SAMPLES)
        share = 1.0 / float(count)
        for j in range(count):
            t_sub = t + (steps_to_sample(float(j)) * share - SAMPLE_PLACE) * step
            x_sub = origin + t_sub * direction
            point = here
            if count > 1:
                point = canonical_point(edits, x_sub)
            if point.vacant == 1:
                seen.outside += float(point.outside)
            elif point.region != CLEARED or seen.cleared_transmittance > FAINT:
                g = grid_position(grid, point.position)
                sigma = float(0.0)
                if empty_distance(grid, g) == 0:
                    cell = cell_sample(grid, g)
                    sigma = cell_density(grid, cell)
                if sigma > 0.0:
                    if not has_delta:  # only now, as most samples hold nothing
                        ahead = canonical_point(edits, x + delta)
                        ahead_index = k + 1
                        delta = canonical_step(edits, x, direction, step, here, ahead)
                        has_delta = bool(True)
                    length = share * step
                    along = direction
                    if point.region == MAPPED:
                        along = canonical_direction(delta, step, direction)
                        if options.arc_opacity == 1:
                            length = share * wp.length(delta)
                    kept = wp.exp(-sigma * length)
                    if point.region == CLEARED:
                        seen.reveal += seen.transmittance * seen.cleared_transmittance * (1.0 - kept)
                        seen.cleared_transmittance *= kept
                    else:
                        weight = seen.transmittance * (1.0 - kept)
                        color = wp.max(stored_color(grid, cell, sh_basis(along)), wp.vec3(0.0, 0.0, 0.0))
                        seen.color += weight * color
                        seen.depth += weight * t_sub
                        seen.transmittance *= kept
                        if point.region == MAPPED and weight > FOLD_MIN_WEIGHT:
                            if has_inverted_cells(edits, x_sub, point):
                                seen.fold += weight
        k += 1
    return forward_only_radiance(seen, origin)
