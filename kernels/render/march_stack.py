"""The march through a voxel field that several edits on lattices deform, each acting on what those before it left."""

import functools
from typing import Any

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import byte_entry, cell_byte
from ..edits.nodes import node_blend, node_slope, side_slope
from ..edits.structs import (
    CELL_ALONE,
    CELL_CARRIES,
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    CUT_LENGTH,
    LATTICE_BORDER,
    LOOK_SKIP,
    EditData,
    cell_exit,
    in_fragments,
    rest_distance,
)
from ..field.densities import row_density
from ..field.grid import (
    SAMPLE_PLACE,
    VoxelGrid,
    cell_below,
    empty_distance,
    exit_of_cell,
    grid_position,
    grid_span,
    safe_inverse,
    sample_index_after,
    steps_to_sample,
)
from ..field.harmonics import sh_basis
from ..field.march import PENDING_WEIGHT, pending_color
from ..field.rows import RowTable, row_color
from ..lattice.cage_map import side_position
from ..view.rays import box_span, joined_span
from .rays import FAINT, FOLD_MIN_WEIGHT, MAX_SUB_SAMPLES, DeformedRadiance, MarchOptions, forward_only_radiance

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3), (wp.vec3, wp.vec3), (wp.vec2, wp.vec3))


@wp.struct
class LatticePlace:
    """A place on the lattice of an edit."""

    cell: int  # the cell's index, -1 beside the lattice
    offset: wp.vec3  # in the cell, 0 to 1
    nodes: wp.vec2i  # from a node to the next of axes 0 and 1


@wp.func
def lattice_place(edit: EditData, x: wp.vec3):
    """Where a point is."""
    result = LatticePlace()
    g = (x - edit.lower) * edit.inverse_spacing
    i, j, k = cell_below(g)
    result.cell = -1
    if i >= 0 and j >= 0 and k >= 0:
        if i < edit.node_counts[0] - 1 and j < edit.node_counts[1] - 1 and k < edit.node_counts[2] - 1:
            result.nodes = wp.vec2i(edit.node_counts[1] * edit.node_counts[2], edit.node_counts[2])
            result.cell = i * result.nodes[0] + j * result.nodes[1] + k
            result.offset = g - wp.vec3(float(i), float(j), float(k))
    return result


@wp.struct
class TracedPoint:
    """A point under all edits, as edits/trace.CanonicalPoint."""

    position: wp.vec3
    path: int  # bit e is set where edit e mapped the point
    cleared: int
    vacant: int
    outside: int
    flags: int
    offset: wp.vec3  # in the cell of the last edit looked up before one mapped the point, or of that one
    room: float  # around the point, in which that edit's cell maps all or nothing, and nothing out of the rest cage


@wp.func
def rest_span(edit: EditData, origin: wp.vec3, direction: wp.vec3):
    """Distances (near, far) at which a ray is in the box around an edit's rest cage."""
    rest = edit.rest
    counts = wp.vec3i(rest.distance.shape[0], rest.distance.shape[1], rest.distance.shape[2])
    low = wp.vec3(LATTICE_BORDER, LATTICE_BORDER, LATTICE_BORDER)
    high = wp.vec3(float(counts[0] - 1), float(counts[1] - 1), float(counts[2] - 1)) - low
    start = (origin - rest.lower) * rest.inverse_spacing
    return box_span(start, direction * rest.inverse_spacing, low, high)


@wp.struct
class RayPart:
    """A stretch of a ray that begins at a sample, in which it enters and leaves no box of an edit."""

    holder: int  # the last edit whose posed box holds it, -1 for none
    candidates: int  # bit e: the posed or the rest box of edit e holds it, or edit e has fragments
    end: float


@wp.func
def may_jump(part: RayPart, point: TracedPoint):
    """Whether the last edit whose box holds a stretch of a ray decides alone where the points around one are seen."""
    if point.path == 0:
        return part.candidates == 1 << part.holder
    return point.path == 1 << part.holder and (point.flags & (CELL_ALONE + CELL_STEEP)) == CELL_ALONE


@functools.cache
def make_trace(is_simple: bool) -> Any:
    """Functions that follow a point through the edits: its position, and the derivative of that.
    Simple edits have no fragments and no sides of narrow gaps: a march without them keeps fewer registers."""

    @wp.func
    def side_entry(edit: EditData, cell: int):
        """Entry of an edit's table of sides for a cell of its lattice, 0 for none."""
        entry = int(0)
        if wp.static(not is_simple):
            if edit.has_sides == 1:
                entry = edit.side_index[cell]
        return entry

    @wp.func
    def mapped_position(edit: EditData, entry: int, offset: wp.vec3, node: wp.vec4):
        """Where a place in a cell is mapped to; node: the value that its corners alone give."""
        position = wp.vec3(node[0], node[1], node[2])
        if wp.static(not is_simple):
            if entry != 0:
                position = side_position(edit.sides, entry, offset)
        return position

    @wp.func
    def mapped_slope(edit: EditData, entry: int, place: LatticePlace, rate: wp.vec3):
        """Derivative of mapped_position where the place moves at `rate`, cells."""
        if wp.static(not is_simple):
            if entry != 0:
                return side_slope(edit.sides, entry, place.offset, rate)
        return node_slope(edit.nodes, place.cell, place.nodes[0], place.nodes[1], place.offset, rate)

    @wp.func
    def is_in_fragments(edit: EditData, x: wp.vec3):
        """Whether fragments of an edit are at a point of the scene at rest."""
        if wp.static(is_simple):
            return False
        else:
            return in_fragments(edit.fragments, x)

    @wp.func
    def trace_stack(edits: wp.array(dtype=EditData), candidates: int, x: wp.vec3):
        """Trace a point to canonical space as edits/trace.traced_point does. candidates: bit e is set where edit e may
        have it in its posed or its rest cage; the edits before one that maps it are looked up in any case."""
        result = TracedPoint()
        result.room = float(1.0e30)
        position = x
        e = int(edits.shape[0]) - 1
        while e >= 0 and result.vacant == 0:
            if result.path != 0 or (candidates & (1 << e)) != 0:
                edit = edits[e]
                mapped = bool(False)
                alone = bool(False)
                if edit.removes == 0:
                    place = lattice_place(edit, position)
                    if place.cell >= 0:
                        if result.path == 0:
                            result.offset = place.offset
                        flags = byte_entry(edit.look, place.cell)
                        if flags >= LOOK_SKIP:
                            flags = int(0)  # not known
                        case = flags & CELL_CARRIES
                        if case != CELL_OUTSIDE:
                            node = node_blend(edit.nodes, place.cell, place.nodes[0], place.nodes[1], place.offset)
                            source = mapped_position(edit, side_entry(edit, place.cell), place.offset, node)
                            is_fragment = bool(False)
                            if (flags & CELL_STAYS) == 0:
                                is_fragment = is_in_fragments(edit, source)
                            if result.path == 0 and case != CELL_INSIDE:
                                # the trilinear distance changes by less than twice the way
                                result.room = wp.where(case == CELL_CARRIES, 0.0, 0.5 * wp.abs(node[3]))
                            mapped = (
                                case == CELL_INSIDE
                                or node[3] <= edit.tolerance
                                or (case == CELL_CARRIES and is_fragment)
                            )
                            if mapped:
                                position = source
                                alone = (flags & CELL_ALONE) != 0
                                if result.path != 0:
                                    flags = flags | CELL_STEEP  # each may be gentle, but not both together
                                result.path = result.path | (1 << e)
                                result.flags = result.flags | flags
                                if (flags & CELL_STAYS) == 0 and not is_fragment:
                                    staying = 0.5 * (edit.slack - rest_distance(edit, position))
                                    result.room = wp.min(result.room, staying)
                                    if staying < 0.0:
                                        result.vacant = 1
                                        result.outside = 1 - result.cleared
                if not mapped and edit.keeps_source == 0:
                    if rest_distance(edit, position) <= 0.0 or is_in_fragments(edit, position):
                        result.vacant = result.cleared  # what is cleared cannot be cleared again
                        result.cleared = 1
                if alone:
                    e = 0  # the edits before this one have nothing there
            e -= 1
        result.position = forward_only(position, x)
        result.offset = forward_only(result.offset, x)
        result.room = forward_only(result.room, x)
        return result

    @wp.func
    def traced_slope(edits: wp.array(dtype=EditData), x: wp.vec3, direction: wp.vec3, path: int):
        """Derivative of the canonical position along a direction, by the edits of a path."""
        position = x
        slope = direction
        rest_of_path = path
        e = int(edits.shape[0]) - 1
        while rest_of_path != 0 and e >= 0:
            if (path & (1 << e)) != 0:
                edit = edits[e]
                place = lattice_place(edit, position)
                rate = slope * edit.inverse_spacing
                entry = side_entry(edit, place.cell)
                slope = mapped_slope(edit, entry, place, rate)
                rest_of_path = rest_of_path - (1 << e)
                if rest_of_path != 0:  # another edit is at the place that this one maps to
                    node = node_blend(edit.nodes, place.cell, place.nodes[0], place.nodes[1], place.offset)
                    position = mapped_position(edit, entry, place.offset, node)
            e -= 1
        return forward_only(slope, x)

    return trace_stack, traced_slope


@functools.cache
def make_spans(is_simple: bool) -> Any:
    """Functions that find where a ray meets anything, and where it enters and leaves boxes of edits."""

    @wp.func
    def has_fragments(edit: EditData):
        """Whether fragments go with an edit."""
        if wp.static(is_simple):
            return False
        else:
            return edit.fragments.marks.shape[0] > 0

    @wp.func
    def posed_span(edit: EditData, origin: wp.vec3, direction: wp.vec3):
        """Distances (near, far) at which a ray is in the box around an edit's posed cage, or around its lattice where
        that carries fragments."""
        border = float(LATTICE_BORDER)
        if has_fragments(edit):
            border = float(0.0)
        low = wp.vec3(border, border, border)
        counts = edit.node_counts
        high = wp.vec3(float(counts[0] - 1), float(counts[1] - 1), float(counts[2] - 1)) - low
        start = (origin - edit.lower) * edit.inverse_spacing
        return box_span(start, direction * edit.inverse_spacing, low, high)

    @wp.func
    def scene_span(edits: wp.array(dtype=EditData), grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
        """Distances (near, far) between which a ray can meet anything: the grid and the boxes of all edits."""
        span = grid_span(grid, origin, direction)
        for e in range(edits.shape[0]):
            span = joined_span(span, posed_span(edits[e], origin, direction))
        return forward_only(span, origin)

    @wp.func
    def ray_part(edits: wp.array(dtype=EditData), origin: wp.vec3, direction: wp.vec3, t: float):
        """The stretch from distance t on."""
        part = RayPart()
        part.holder = -1
        part.end = float(1.0e30)
        for e in range(edits.shape[0]):
            edit = edits[e]
            for box in range(2):
                span = posed_span(edit, origin, direction)
                if box == 1:
                    span = rest_span(edit, origin, direction)
                if (box == 0 or edit.keeps_source == 0) and span[0] < span[1] and t < span[1]:
                    if t >= span[0]:
                        part.candidates = part.candidates | (1 << e)
                        part.end = wp.min(part.end, span[1])
                        if box == 0:
                            part.holder = e
                    else:
                        part.end = wp.min(part.end, span[0])
            if has_fragments(edit):
                part.candidates = part.candidates | (1 << e)
        part.end = forward_only(part.end, origin)
        return part

    return scene_span, ray_part


@functools.cache
def make_stack_march(is_simple: bool) -> Any:
    """The march through several edits, each of which acts on the scene that the ones before it left."""
    trace_stack, traced_slope = make_trace(is_simple)
    scene_span, ray_part = make_spans(is_simple)

    @wp.func
    def march_stack(
        edits: wp.array(dtype=EditData),
        grid: VoxelGrid,
        table: RowTable,
        origin: wp.vec3,
        direction: wp.vec3,
        options: MarchOptions,
    ):
        """Gather radiance along a ray through the deformed scene."""
        seen = DeformedRadiance()
        seen.transmittance = float(1.0)
        seen.cleared_transmittance = float(1.0)
        step = options.step
        span = scene_span(edits, grid, origin, direction)
        box = grid_span(grid, origin, direction)
        inverse = safe_inverse(direction)
        grid_inverse = wp.cw_mul(inverse, grid.voxel_size)
        cells = wp.vec3i(grid.skip.shape[0], grid.skip.shape[1], grid.skip.shape[2])
        part = RayPart()
        part.end = float(-1.0)
        k = sample_index_after(span[0], step)
        count = int(0)  # sub-samples of sample k; 0: not known, so one
        j = int(0)
        t = steps_to_sample(float(k)) * step
        pending = float(0.0)  # weight of samples whose colour is not looked up yet
        while t < span[1] and seen.transmittance > options.stop:
            if t >= part.end:
                part = ray_part(edits, origin, direction, t)
            x = origin + t * direction
            leave = t
            if part.holder >= 0:
                edit = edits[part.holder]
                g = (x - edit.lower) * edit.inverse_spacing
                ci = wp.clamp(int(g[0]), 0, edit.node_counts[0] - 2)
                cj = wp.clamp(int(g[1]), 0, edit.node_counts[1] - 2)
                ck = wp.clamp(int(g[2]), 0, edit.node_counts[2] - 2)
                look = byte_entry(edit.look, (ci * edit.node_counts[1] + cj) * edit.node_counts[2] + ck)
                if look >= LOOK_SKIP:
                    leave = t + cell_exit(g, inverse / edit.inverse_spacing, look - LOOK_SKIP)
                    leave = wp.max(wp.min(leave, part.end), t + 0.5 * step)
            else:
                if t < box[0] or not (t < box[1]):
                    leave = wp.where(t < box[0], box[0], span[1])
                else:
                    g = grid_position(grid, x)
                    empty = empty_distance(grid, g)
                    if empty > 0:
                        leave = t + cell_exit(g, grid_inverse, empty)
                leave = wp.min(leave, part.end)
            if leave > t:
                k = wp.max(k + 1, sample_index_after(leave, step))
                count = int(0)
                j = int(0)
                t = steps_to_sample(float(k)) * step
                continue
            point = trace_stack(edits, part.candidates, x)
            # each function of the map stands once in this loop: registers are short
            g = grid_position(grid, point.position)
            gi, gj, gk = cell_below(g)
            offset = g - wp.vec3(float(gi), float(gj), float(gk))
            empty = int(1)
            sigma = float(0.0)
            if point.vacant == 0 and (point.cleared == 0 or seen.cleared_transmittance > FAINT):
                if gi >= 0 and gj >= 0 and gk >= 0 and gi < cells[0] and gj < cells[1] and gk < cells[2]:
                    empty = cell_byte(grid.skip, gi, gj, gk)
            if empty == 0:
                sigma = row_density(table.laid, table.unit, grid.density, table.columns, gi, gj, gk, offset)
            mapped = point.path != 0 and point.cleared == 0
            asks_length = mapped and count == 0 and (point.flags & CELL_STEEP) != 0
            slope = direction
            if mapped and (asks_length or sigma > 0.0):
                slope = traced_slope(edits, x, direction, point.path)
            stretch = wp.length(slope)
            if asks_length:
                count = int(1)
                if stretch > CUT_LENGTH:
                    count = wp.clamp(int(wp.ceil(stretch - 1.0e-3)), 1, MAX_SUB_SAMPLES)
                    t = (float(k) + SAMPLE_PLACE / float(count)) * step
                    continue
            parts = wp.max(count, 1)
            next_index = k + 1
            if point.vacant == 1:
                seen.outside += float(point.outside)
            elif sigma > 0.0:
                depth = sigma * step / float(parts)
                if mapped and options.arc_opacity == 1:
                    depth = depth * stretch
                kept = wp.exp(-depth)
                if point.cleared == 1:
                    seen.reveal += seen.transmittance * seen.cleared_transmittance * (1.0 - kept)
                    seen.cleared_transmittance *= kept
                else:
                    weight = seen.transmittance * (1.0 - kept)
                    pending += weight
                    if pending > PENDING_WEIGHT:
                        along = wp.where(stretch > 1.0e-6, slope / stretch, direction)
                        color = row_color(grid.sh, table.packed, table.columns, gi, gj, gk, offset, sh_basis(along))
                        seen.color += pending * wp.max(color, wp.vec3(0.0, 0.0, 0.0))
                        pending = float(0.0)
                    seen.depth += weight * t
                    seen.transmittance *= kept
                    if (point.flags & CELL_FOLDED) != 0 and weight > FOLD_MIN_WEIGHT:
                        seen.fold += weight
            elif empty > 1 and part.holder >= 0 and may_jump(part, point):
                # over what is left of the lattice cell, all of which is seen where nothing is near
                inverse_rate = inverse / edits[part.holder].inverse_spacing
                hollow = float(empty - 1) * wp.min(grid.voxel_size) / CUT_LENGTH
                leave = t + wp.min(wp.min(exit_of_cell(point.offset, inverse_rate, 1), hollow), point.room)
                next_index = wp.max(next_index, sample_index_after(wp.min(leave, part.end), step))
            j += 1
            if j >= parts:
                k = next_index
                count = int(0)
                j = int(0)
            parts = wp.max(count, 1)
            t = (steps_to_sample(float(k)) + (steps_to_sample(float(j)) / float(parts) - SAMPLE_PLACE)) * step
        seen.color += pending_color(seen.color, seen.transmittance, pending)
        return forward_only_radiance(seen, origin)

    return march_stack
