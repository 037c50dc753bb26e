"""Views of a voxel field that one edit deforms: the march of deform/march, written for speed.

The same samples and the same sums ("Deforming Radiance Fields with Cages", ECCV 2022, Eq. 4 and 5), for the common case
of one edit on a lattice. What differs is the order of the work, for a GPU that runs many rays at once and has few
registers for each: the map is looked up at one place of the program. A sample that holds matter waits for the sample
after it, whose canonical point completes its finite difference (Eq. 4); where that is no difference of one map, the
march turns back for one. Where the map compresses, a sample is cut into sub-samples as in deform/march.
Needs: deform/edits, deform/march, deform/render, field/grid, field/harmonics, field/samples, lattice/cage_map,
view/rays.
"""

import warp as wp

from ..field.grid import VoxelGrid, cell_colour, cell_density, cell_sample, empty_distance, grid_position
from ..field.harmonics import sh_basis
from ..field.samples import grid_span, sample_index_after
from ..lattice.cage_map import CageMap, map_distance, side_position
from ..view.rays import PinholeCamera, box_span, pixel_direction, tile_pixel
from .edits import (
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    CUT_LENGTH,
    LONG_STEP,
    SHORT_DIFFERENCE,
)
from .march import FAINT, FOLD_MIN_WEIGHT, MAX_SUB_SAMPLES, DeformedRadiance, MarchOptions
from .render import Picture, fill_pixel

# small blocks: the rays of one block end at very different times
wp.set_module_options({"enable_backward": False, "block_dim": 64})

#: `look` holds the flags of a cell that must be looked at, or this and the distance to the nearest such cell.
LOOK_SKIP = wp.constant(32)

#: Where the next look-up is: at the next sample, or beside one that waits for its difference, or whose length is asked.
AT_SAMPLE = wp.constant(0)
AHEAD = wp.constant(1)  # at the next sample, for the one that waits
BEHIND = wp.constant(2)
SHORT_AHEAD = wp.constant(3)
SHORT_BEHIND = wp.constant(4)
LENGTH_AHEAD = wp.constant(5)
LENGTH_BEHIND = wp.constant(6)


@wp.struct
class SingleEdit:
    """A LatticeEdit with flat arrays: node (i, j, k), and the cell above it, is at (i * ny + j) * nz + k."""

    lower: wp.vec3  # position of node (0, 0, 0)
    inverse_spacing: float
    node_counts: wp.vec3i
    positions: wp.array(dtype=wp.vec3)
    distance: wp.array(dtype=float)
    look: wp.array(dtype=wp.uint8)
    has_sides: int  # 1: there are cells at narrow gaps of the cage with corner values for each side (see CageMap)
    side_index: wp.array(dtype=int)
    sides: wp.array2d(dtype=wp.vec4)
    rest: CageMap
    tolerance: float
    slack: float
    keeps_source: int
    removes: int


@wp.kernel
def join_cell_tables(
    first: int,
    cells: wp.array3d(dtype=wp.uint8),
    skip: wp.array3d(dtype=wp.uint8),
    node_counts: wp.vec3i,
    look: wp.array(dtype=wp.uint8),
):
    """The two tables of a LatticeEdit's cells as one, so that a sample reads one byte."""
    n = first + wp.tid()
    k = n % cells.shape[2]
    j = (n // cells.shape[2]) % cells.shape[1]
    i = n // (cells.shape[2] * cells.shape[1])
    value = int(cells[i, j, k])
    if skip[i, j, k] > wp.uint8(0):
        value = LOOK_SKIP + int(skip[i, j, k])
    look[(i * node_counts[1] + j) * node_counts[2] + k] = wp.uint8(value)


@wp.func
def flat_distance(edit: SingleEdit, n: int, f: wp.vec3):
    """Trilinear signed distance in the cell above node n."""
    z = edit.node_counts[2]
    x = z * edit.node_counts[1]
    d00 = wp.lerp(edit.distance[n], edit.distance[n + 1], f[2])
    d01 = wp.lerp(edit.distance[n + z], edit.distance[n + z + 1], f[2])
    d10 = wp.lerp(edit.distance[n + x], edit.distance[n + x + 1], f[2])
    d11 = wp.lerp(edit.distance[n + x + z], edit.distance[n + x + z + 1], f[2])
    return wp.lerp(wp.lerp(d00, d01, f[1]), wp.lerp(d10, d11, f[1]), f[0])


@wp.func
def flat_position(edit: SingleEdit, n: int, f: wp.vec3):
    """Trilinear canonical position in the cell above node n."""
    z = edit.node_counts[2]
    x = z * edit.node_counts[1]
    p00 = wp.lerp(edit.positions[n], edit.positions[n + 1], f[2])
    p01 = wp.lerp(edit.positions[n + z], edit.positions[n + z + 1], f[2])
    p10 = wp.lerp(edit.positions[n + x], edit.positions[n + x + 1], f[2])
    p11 = wp.lerp(edit.positions[n + x + z], edit.positions[n + x + z + 1], f[2])
    return wp.lerp(wp.lerp(p00, p01, f[1]), wp.lerp(p10, p11, f[1]), f[0])


@wp.func
def safe_inverse(rate: wp.vec3):
    """1 / rate by component; a large number where the rate is almost zero."""
    result = wp.vec3(1.0e30, 1.0e30, 1.0e30)
    for axis in range(3):
        if wp.abs(rate[axis]) > 1.0e-12:
            result[axis] = 1.0 / rate[axis]
    return result


@wp.func
def cell_exit(g: wp.vec3, inverse_rate: wp.vec3, reach: int):
    """field/samples.exit_distance with the divisions done once per ray."""
    leave = float(1.0e30)
    for axis in range(3):
        cell = wp.floor(g[axis])
        plane = wp.where(inverse_rate[axis] > 0.0, cell + float(reach), cell - float(reach) + 1.0)
        leave = wp.min(leave, (plane - g[axis]) * inverse_rate[axis])
    return leave


@wp.func
def march_edit(edit: SingleEdit, grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, options: MarchOptions):
    """Gather radiance along a ray through the deformed scene."""
    seen = DeformedRadiance()
    seen.transmittance = float(1.0)
    seen.cleared_transmittance = float(1.0)
    step = options.step
    # the ray in lattice cells and in voxels
    lattice_start = (origin - edit.lower) * edit.inverse_spacing
    lattice_rate = direction * edit.inverse_spacing
    tops = wp.vec3i(edit.node_counts[0] - 2, edit.node_counts[1] - 2, edit.node_counts[2] - 2)
    corner = wp.vec3(float(tops[0] + 1), float(tops[1] + 1), float(tops[2] + 1))
    box = box_span(lattice_start, lattice_rate, wp.vec3(0.0, 0.0, 0.0), corner)
    span = grid_span(grid, origin, direction)
    near = float(1.0e30)
    far = float(-1.0)
    if box[0] < box[1]:
        near = box[0]
        far = box[1]
    if span[0] < span[1]:
        near = wp.min(near, span[0])
        far = wp.max(far, span[1])
    lattice_inverse = safe_inverse(lattice_rate)
    grid_inverse = safe_inverse(wp.cw_mul(direction, grid.inverse_voxel_size))
    inverse_step = 1.0 / step
    hollow_rate = wp.min(grid.voxel_size) / CUT_LENGTH

    k = sample_index_after(near, step)
    count = int(0)  # sub-samples of sample k; 0: not known, so one
    j = int(0)
    stage = int(AT_SAMPLE)
    # the sample that waits: its canonical point, distance and what it stands for
    held_position = wp.vec3(0.0, 0.0, 0.0)
    held_t = float(0.0)
    held_dt = float(0.0)
    held_sigma = float(0.0)
    held_mapped = bool(False)
    held_folded = bool(False)
    t = (float(k) + 0.5) * step
    while (t < far or stage != AT_SAMPLE) and seen.transmittance > options.stop:
        at = t
        if stage == BEHIND:
            at = held_t - held_dt
        elif stage == SHORT_AHEAD:
            at = held_t + SHORT_DIFFERENCE * held_dt
        elif stage == SHORT_BEHIND:
            at = held_t - SHORT_DIFFERENCE * held_dt
        elif stage == LENGTH_AHEAD:
            at = held_t + step
        elif stage == LENGTH_BEHIND:
            at = held_t - step

        # the canonical point
        position = origin + at * direction
        mapped = bool(False)
        leaves = bool(False)
        flags = int(0)
        skip = int(0)
        place = lattice_start + at * lattice_rate
        in_box = at >= box[0] and at < box[1]
        if in_box:
            ci = wp.clamp(int(wp.floor(place[0])), 0, tops[0])
            cj = wp.clamp(int(wp.floor(place[1])), 0, tops[1])
            ck = wp.clamp(int(wp.floor(place[2])), 0, tops[2])
            n = (ci * edit.node_counts[1] + cj) * edit.node_counts[2] + ck
            flags = int(edit.look[n])
            if flags >= LOOK_SKIP:
                skip = flags - LOOK_SKIP
                flags = int(0)  # not known
            if (skip == 0 or stage != AT_SAMPLE) and edit.removes == 0:
                f = place - wp.vec3(float(ci), float(cj), float(ck))
                mapped = (flags & CELL_INSIDE) != 0
                if (flags & (CELL_INSIDE | CELL_OUTSIDE)) == 0:
                    mapped = flat_distance(edit, n, f) <= edit.tolerance
                if mapped:
                    sides = int(0)
                    if edit.has_sides == 1:
                        sides = edit.side_index[n]
                    if sides == 0:
                        position = flat_position(edit, n, f)
                    else:
                        position = side_position(edit.sides, sides, f)
                    if (flags & CELL_STAYS) == 0 and skip == 0:
                        leaves = map_distance(edit.rest, position) > edit.slack

        # the sample that waits
        if stage != AT_SAMPLE:
            last_stage = stage
            slope = direction
            known = not held_mapped
            if held_mapped and mapped and at != held_t:  # a part of a step may be nothing far from the camera
                slope = (position - held_position) / (at - held_t)
                known = stage != AHEAD or wp.length_sq(slope) <= LONG_STEP * LONG_STEP
            stretch = wp.length(slope)
            if stage >= LENGTH_AHEAD:
                if known or stage == LENGTH_BEHIND:
                    count = wp.clamp(int(wp.ceil(stretch - 1.0e-3)), 1, MAX_SUB_SAMPLES)
                    if stretch <= CUT_LENGTH:
                        count = int(1)
                    t = held_t + (0.5 / float(count) - 0.5) * step
                    stage = AT_SAMPLE
                else:
                    stage = LENGTH_BEHIND
                continue
            if not known and stage != SHORT_BEHIND:
                # too long a step may lead over a gap between two parts of the cage
                stage = wp.where(stage == AHEAD and mapped, SHORT_AHEAD, stage + 1)
                continue
            length = held_dt
            along = direction
            if held_mapped:
                if options.arc_opacity == 1:
                    length = held_dt * stretch
                if stretch > 1.0e-6:
                    along = slope / stretch
            kept = wp.exp(-held_sigma * length)
            weight = seen.transmittance * (1.0 - kept)
            cell = cell_sample(grid, grid_position(grid, held_position))
            colour = wp.max(cell_colour(grid, cell, sh_basis(along)), wp.vec3(0.0, 0.0, 0.0))
            seen.colour += weight * colour
            seen.depth += weight * held_t
            seen.transmittance *= kept
            if held_folded and weight > FOLD_MIN_WEIGHT:
                seen.fold += weight
            stage = AT_SAMPLE
            if last_stage != AHEAD:
                continue  # this was not a sample

        # the sample itself
        leave = t
        if not in_box:
            g = grid_position(grid, position)
            empty = empty_distance(grid, g)
            if t < span[0] or not (t < span[1]):
                leave = wp.where(t < span[0], span[0], far)
            elif empty > 0:
                leave = t + cell_exit(g, grid_inverse, empty)
            if t < box[0] and box[0] < box[1]:
                leave = wp.min(leave, box[0])
        elif skip > 0:
            leave = wp.min(t + cell_exit(place, lattice_inverse, skip), box[1])
        if leave > t:
            k = wp.max(k + 1, int(wp.ceil(leave * inverse_step - 0.5)))
            count = int(0)
            j = int(0)
            t = (float(k) + 0.5) * step
            continue
        if mapped and count == 0 and (flags & CELL_STEEP) != 0:
            held_mapped = bool(True)
            held_position = position
            held_t = t
            stage = LENGTH_AHEAD
            continue
        parts = wp.max(count, 1)
        next_index = k + 1
        if leaves:
            seen.outside += 1.0
        else:
            g = grid_position(grid, position)
            empty = empty_distance(grid, g)
            if empty == 0:
                sigma = cell_density(grid, cell_sample(grid, g))
                if sigma > 0.0:
                    dt = step / float(parts)
                    cleared = bool(False)
                    if not mapped and edit.keeps_source == 0:
                        cleared = map_distance(edit.rest, position) <= 0.0
                    if cleared:
                        if seen.cleared_transmittance > FAINT:
                            kept = wp.exp(-sigma * dt)
                            seen.reveal += seen.transmittance * seen.cleared_transmittance * (1.0 - kept)
                            seen.cleared_transmittance *= kept
                    else:
                        held_position = position
                        held_t = t
                        held_dt = dt
                        held_sigma = sigma
                        held_mapped = mapped
                        held_folded = (flags & CELL_FOLDED) != 0
                        stage = AHEAD
            elif empty > 1 and (flags & (CELL_INSIDE | CELL_STEEP)) == CELL_INSIDE:
                leave = t + wp.min(cell_exit(place, lattice_inverse, 1), float(empty - 1) * hollow_rate)
                next_index = wp.max(next_index, int(wp.ceil(leave * inverse_step - 0.5)))
        j += 1
        if j >= parts:
            k = next_index
            count = int(0)
            j = int(0)
        parts = wp.max(count, 1)
        t = (float(k) + 0.5 + ((float(j) + 0.5) / float(parts) - 0.5)) * step
    return seen


@wp.kernel(cuda_max_registers=168)  # measured on an H200: fewer spill, more leave too few rays at a time
def render_edit(
    first: int,
    grid: VoxelGrid,
    edit: SingleEdit,
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """One thread per pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        seen = march_edit(edit, grid, camera.centre, pixel_direction(camera, column, row), options)
        fill_pixel(picture, row * camera.width + column, seen, background)
