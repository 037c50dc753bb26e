"""The march through a voxel field that one edit deforms: that of deform/march, written for speed.

The same samples and the same sums ("Deforming Radiance Fields with Cages", ECCV 2022, Eq. 4 and 5), for the common case
of one edit on a lattice: flat arrays whose numbers are read many at once, one table of cells, and the map's derivative
where matter is. Where the map compresses, a sample is cut into sub-samples as in deform/march.
Needs: core/entries, deform/edits, deform/flat_edits, deform/laid_shades, deform/map_nodes, deform/march,
deform/matter_rows, deform/ray_parts, field/grid, field/samples, lattice/cage_map, view/rays.
"""

from typing import Any

import warp as wp

from ..core.entries import byte_entry, cell_byte
from ..field.grid import VoxelGrid, grid_position
from ..field.samples import exit_of_cell, grid_span, safe_inverse
from ..lattice.cage_map import side_position
from ..view.rays import box_span
from .edits import CELL_FOLDED, CELL_INSIDE, CELL_OUTSIDE, CELL_STAYS, CELL_STEEP, CUT_LENGTH
from .flat_edits import LOOK_SKIP, FlatEdit, rest_distance
from .laid_shades import CARRIED_LAYER, PLAIN_LAYER
from .map_nodes import node_blend, node_slope, side_slope
from .march import FAINT, FOLD_MIN_WEIGHT, MAX_SUB_SAMPLES, DeformedRadiance, MarchOptions
from .matter_rows import early_matter, late_matter, least_pending, matter_colour
from .ray_parts import BEGUN, RayState

wp.set_module_options({"enable_backward": False})


@wp.struct
class NoSides:
    """Says that no cell has corner values for each side of a narrow gap."""

    unused: int


@wp.struct
class WithSides:
    """Says that some have. Their functions are calls, around which a GPU keeps more registers, so that the march for
    edits without them is compiled by itself."""

    unused: int


@wp.func
def side_entry(sides: NoSides, edit: FlatEdit, n: int):
    """Entry of the table of sides for the cell above node n, 0 for none."""
    return 0


@wp.func
def side_entry(sides: WithSides, edit: FlatEdit, n: int):  # noqa: F811 (a Warp overload)
    return edit.side_index[n]


@wp.func
def map_position(sides: NoSides, edit: FlatEdit, entry: int, f: wp.vec3, position: wp.vec3):
    """Canonical position at a place in a cell whose corners alone say `position`."""
    return position


@wp.func
def map_position(sides: WithSides, edit: FlatEdit, entry: int, f: wp.vec3, position: wp.vec3):  # noqa: F811
    if entry != 0:
        return side_position(edit.sides, entry, f)
    return position


@wp.func
def map_slope(sides: NoSides, edit: FlatEdit, n: int, entry: int, f: wp.vec3, rate: wp.vec3):
    """Derivative of the canonical position at a place in the cell above node n, which moves at `rate`."""
    nz = edit.node_counts[2]
    return node_slope(edit.nodes, n, edit.node_counts[1] * nz, nz, f, rate)


@wp.func
def map_slope(sides: WithSides, edit: FlatEdit, n: int, entry: int, f: wp.vec3, rate: wp.vec3):  # noqa: F811
    if entry != 0:
        return side_slope(edit.sides, entry, f, rate)
    nz = edit.node_counts[2]
    return node_slope(edit.nodes, n, edit.node_counts[1] * nz, nz, f, rate)


@wp.func
def sample_after(k: float):
    """The next sample; from 2^24 on the next one that float32 has, so that a march through a cage far away ends."""
    return k + wp.max(1.0, 6.0e-8 * k)


@wp.func
def march_edit(
    sides: Any,
    edit: FlatEdit,
    grid: VoxelGrid,
    table: Any,
    origin: wp.vec3,
    direction: wp.vec3,
    options: MarchOptions,
    state: RayState,
    end: float,
):
    """Gather radiance along a ray through the deformed scene from where `state` has reached up to a distance `end`."""
    seen = DeformedRadiance()
    seen.colour = state.seen.colour
    seen.transmittance = state.seen.transmittance
    seen.depth = state.seen.depth
    seen.cleared_transmittance = state.seen.cleared_transmittance
    seen.reveal = state.seen.reveal
    seen.fold = state.seen.fold
    seen.outside = state.seen.outside
    pending = float(state.pending)
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
    spacing = 1.0 / edit.inverse_spacing
    nz = edit.node_counts[2]
    nyz = edit.node_counts[1] * nz
    cells = wp.vec3i(grid.skip.shape[0], grid.skip.shape[1], grid.skip.shape[2])

    far = wp.min(far, end)
    inverse_step = 1.0 / step
    # whole numbers, for a loop without conversions
    k = wp.ceil(wp.max(near, state.reached) * inverse_step - 0.5)
    j = float(0.0)
    share = float(1.0)  # of sample k that a sub-sample stands for
    is_cut = bool(False)  # whether that is known, where it is asked for
    t = (k + 0.5) * step
    while t < far and seen.transmittance > options.stop:
        place = lattice_start + t * lattice_rate
        in_box = t >= box[0] and t < box[1]
        flags = int(0)
        n = int(0)
        f = wp.vec3(0.0, 0.0, 0.0)
        if in_box:
            ci = wp.clamp(int(place[0]), 0, tops[0])
            cj = wp.clamp(int(place[1]), 0, tops[1])
            ck = wp.clamp(int(place[2]), 0, tops[2])
            n = ci * nyz + cj * nz + ck
            f = place - wp.vec3(float(ci), float(cj), float(ck))
            flags = byte_entry(edit.look, n)
            if flags >= LOOK_SKIP:
                leave = t + exit_of_cell(f, lattice_inverse, flags - LOOK_SKIP)
                leave = wp.max(wp.min(leave, box[1]), t + 0.5 * step)
                k = wp.max(sample_after(k), wp.ceil(leave * inverse_step - 0.5))
                j = float(0.0)
                share = float(1.0)
                is_cut = bool(False)
                t = (k + 0.5) * step
                continue
        # the canonical point
        position = edit.lower + spacing * place  # from few numbers that a ray keeps: registers are short
        mapped = bool(False)
        entry = int(0)
        if in_box and edit.removes == 0 and (flags & CELL_OUTSIDE) == 0:
            node = node_blend(edit.nodes, n, nyz, nz, f)
            mapped = (flags & CELL_INSIDE) != 0 or node[3] <= edit.tolerance
            if mapped:
                entry = side_entry(sides, edit, n)
                position = map_position(sides, edit, entry, f, wp.vec3(node[0], node[1], node[2]))
        g = grid_position(grid, position)
        gi = int(wp.floor(g[0]))
        gj = int(wp.floor(g[1]))
        gk = int(wp.floor(g[2]))
        offset = g - wp.vec3(float(gi), float(gj), float(gk))
        empty = int(1)
        matter = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if gi >= 0 and gj >= 0 and gk >= 0 and gi < cells[0] and gj < cells[1] and gk < cells[2]:
            empty = cell_byte(grid.skip, gi, gj, gk)
            layer = wp.where(mapped, CARRIED_LAYER, PLAIN_LAYER)
            matter = early_matter(table, gi, gj, gk, offset, g, layer)
        next_index = sample_after(k)
        if empty > 0:
            matter = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if not in_box:
                leave = t
                if t < span[0] or not (t < span[1]):
                    leave = wp.where(t < span[0], span[0], wp.max(box[1], span[1]))
                else:
                    inverse = wp.cw_mul(lattice_inverse, edit.inverse_spacing * grid.voxel_size)
                    leave = t + exit_of_cell(offset, inverse, empty)
                if t < box[0] and box[0] < box[1]:
                    leave = wp.min(leave, box[0])
                next_index = wp.max(next_index, wp.ceil(leave * inverse_step - 0.5))
        else:
            matter = late_matter(table, grid, matter, step, gi, gj, gk, offset)
        # each function of the map stands once in this loop: registers are short
        clears = not mapped and edit.keeps_source == 0 and empty == 0
        room = float(1.0e30)  # on the ray, in which no sample leaves the rest cage
        if clears or (mapped and (flags & CELL_STAYS) == 0):
            room = 0.5 * (edit.slack - rest_distance(edit, position))
        leaves = mapped and room < 0.0
        asks_length = mapped and not is_cut and (flags & CELL_STEEP) != 0
        slope = spacing * lattice_rate
        stretch = float(1.0)
        if mapped and (asks_length or (matter[3] > 0.0 and not leaves)):
            slope = map_slope(sides, edit, n, entry, f, lattice_rate)
            stretch = wp.length(slope)
        if asks_length:
            is_cut = bool(True)
            if stretch > CUT_LENGTH:
                share = 1.0 / wp.clamp(wp.ceil(stretch - 1.0e-3), 1.0, float(MAX_SUB_SAMPLES))
                t = (k + 0.5 * share) * step
                continue
        if leaves:
            seen.outside += 1.0
        elif matter[3] > 0.0:
            depth = matter[3] * share
            if mapped and options.arc_opacity == 1:
                depth = depth * stretch
            kept = wp.exp(-depth)
            if clears and room >= 0.5 * edit.slack:
                if seen.cleared_transmittance > FAINT:
                    seen.reveal += seen.transmittance * seen.cleared_transmittance * (1.0 - kept)
                    seen.cleared_transmittance *= kept
            else:
                weight = seen.transmittance * (1.0 - kept)
                pending += weight
                if pending > least_pending(table):
                    colour = matter_colour(table, grid, matter, gi, gj, gk, offset, slope, spacing * lattice_rate)
                    seen.colour += pending * wp.max(colour, wp.vec3(0.0, 0.0, 0.0))
                    pending = float(0.0)
                seen.depth += weight * t
                seen.transmittance *= kept
                if mapped and (flags & CELL_FOLDED) != 0 and weight > FOLD_MIN_WEIGHT:
                    seen.fold += weight
        elif empty > 1 and (flags & (CELL_INSIDE | CELL_STEEP)) == CELL_INSIDE:
            hollow = float(empty - 1) * wp.min(grid.voxel_size) / CUT_LENGTH
            leave = t + wp.min(wp.min(exit_of_cell(f, lattice_inverse, 1), hollow), room)
            next_index = wp.max(next_index, wp.ceil(leave * inverse_step - 0.5))
        j += share
        if j > 1.0 - 0.5 * share:
            k = next_index
            j = float(0.0)
            share = float(1.0)
            is_cut = bool(False)
        t = (k + j + 0.5 * share) * step
    after = RayState()
    after.seen = seen
    after.pending = pending
    after.reached = wp.max(far, BEGUN)  # beyond `far` there is nothing up to `end`
    return after
