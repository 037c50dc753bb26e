"""Views of a voxel field that several edits on lattices deform, each acting on the scene that the ones before it left.

"Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1 (the map on a lattice) and Eq. 5. A ray is cut where it
enters and leaves the boxes of the edits: in between one edit, the last whose box holds the ray, knows what may be
skipped, and later ones need not be asked for their maps.
Needs: core/entries, deform/crumbs, deform/edits, deform/flat_edits, deform/map_nodes, deform/march, deform/pictures,
field/densities, field/grid, field/harmonics, field/render, field/rows, field/samples, lattice/cage_map, view/rays.
"""

import warp as wp

from ..core.entries import byte_entry
from ..field.densities import row_density
from ..field.grid import VoxelGrid, empty_distance, grid_position
from ..field.harmonics import sh_basis
from ..field.render import PENDING_WEIGHT, pending_colour
from ..field.rows import RowTable, row_colour
from ..field.samples import grid_span, safe_inverse, sample_index_after
from ..lattice.cage_map import side_position
from ..view.rays import PinholeCamera, box_span, pixel_direction, tile_pixel
from .crumbs import in_crumbs
from .edits import CELL_CARRIES, CELL_FOLDED, CELL_INSIDE, CELL_OUTSIDE, CELL_STAYS, CELL_STEEP, CUT_LENGTH
from .flat_edits import LOOK_SKIP, FlatEdit, cell_exit, rest_distance
from .map_nodes import node_blend, node_slope, side_slope
from .march import FAINT, FOLD_MIN_WEIGHT, MAX_SUB_SAMPLES, DeformedRadiance, MarchOptions
from .pictures import Picture, fill_pixel

# small blocks: the rays of one block end at very different times
wp.set_module_options({"enable_backward": False, "block_dim": 64})


@wp.struct
class LatticePlace:
    """A place on the lattice of an edit."""

    cell: int  # the cell's index, -1 beside the lattice
    offset: wp.vec3  # in the cell, 0 to 1
    nodes: wp.vec2i  # from a node to the next of axes 0 and 1


@wp.func
def lattice_place(edit: FlatEdit, x: wp.vec3):
    """Where a point is."""
    result = LatticePlace()
    g = (x - edit.lower) * edit.inverse_spacing
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    result.cell = -1
    if i >= 0 and j >= 0 and k >= 0:
        if i < edit.node_counts[0] - 1 and j < edit.node_counts[1] - 1 and k < edit.node_counts[2] - 1:
            result.nodes = wp.vec2i(edit.node_counts[1] * edit.node_counts[2], edit.node_counts[2])
            result.cell = i * result.nodes[0] + j * result.nodes[1] + k
            result.offset = g - wp.vec3(float(i), float(j), float(k))
    return result


@wp.struct
class TracedPoint:
    """What all edits say of a point: deform/edits.CanonicalPoint."""

    position: wp.vec3
    path: int  # bit e is set where edit e mapped the point
    cleared: int
    vacant: int
    outside: int
    flags: int


@wp.func
def flat_trace(edits: wp.array(dtype=FlatEdit), last: int, x: wp.vec3):
    """Trace a point to canonical space as deform/edits.traced_point does; edits after `last` do not hold it."""
    result = TracedPoint()
    position = x
    e = int(edits.shape[0]) - 1
    while e >= 0 and result.vacant == 0:
        edit = edits[e]
        mapped = bool(False)
        if edit.removes == 0 and (e <= last or result.path != 0):
            place = lattice_place(edit, position)
            if place.cell >= 0:
                flags = byte_entry(edit.look, place.cell)
                if flags >= LOOK_SKIP:
                    flags = int(0)  # not known
                case = flags & CELL_CARRIES
                if case != CELL_OUTSIDE:
                    node = node_blend(edit.nodes, place.cell, place.nodes[0], place.nodes[1], place.offset)
                    source = wp.vec3(node[0], node[1], node[2])
                    if edit.has_sides == 1:
                        sides = edit.side_index[place.cell]
                        if sides != 0:
                            source = side_position(edit.sides, sides, place.offset)
                    is_crumb = bool(False)
                    if (flags & CELL_STAYS) == 0:
                        is_crumb = in_crumbs(edit.crumbs, source)
                    mapped = case == CELL_INSIDE or node[3] <= edit.tolerance or (case == CELL_CARRIES and is_crumb)
                    if mapped:
                        position = source
                        if result.path != 0:
                            flags = flags | CELL_STEEP  # each may be gentle, but not both together
                        result.path = result.path | (1 << e)
                        result.flags = result.flags | flags
                        if (flags & CELL_STAYS) == 0 and not is_crumb:
                            if rest_distance(edit, position) > edit.slack:
                                result.vacant = 1
                                result.outside = 1 - result.cleared
        if not mapped and edit.keeps_source == 0:
            if rest_distance(edit, position) <= 0.0 or in_crumbs(edit.crumbs, position):
                result.vacant = result.cleared  # what is cleared cannot be cleared again
                result.cleared = 1
        e -= 1
    result.position = position
    return result


@wp.func
def traced_slope(edits: wp.array(dtype=FlatEdit), x: wp.vec3, direction: wp.vec3, path: int):
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
            sides = int(0)
            if edit.has_sides == 1:
                sides = edit.side_index[place.cell]
            if sides == 0:
                slope = node_slope(edit.nodes, place.cell, place.nodes[0], place.nodes[1], place.offset, rate)
                node = node_blend(edit.nodes, place.cell, place.nodes[0], place.nodes[1], place.offset)
                position = wp.vec3(node[0], node[1], node[2])
            else:
                slope = side_slope(edit.sides, sides, place.offset, rate)
                position = side_position(edit.sides, sides, place.offset)
            rest_of_path = rest_of_path - (1 << e)
        e -= 1
    return slope


@wp.func
def lattice_span(edit: FlatEdit, origin: wp.vec3, direction: wp.vec3):
    """Distances (near, far) at which a ray is in the box of an edit's lattice."""
    counts = edit.node_counts
    corner = wp.vec3(float(counts[0] - 1), float(counts[1] - 1), float(counts[2] - 1))
    start = (origin - edit.lower) * edit.inverse_spacing
    return box_span(start, direction * edit.inverse_spacing, wp.vec3(0.0, 0.0, 0.0), corner)


@wp.func
def scene_span(edits: wp.array(dtype=FlatEdit), grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
    """Distances (near, far) between which a ray can meet anything: the grid and the boxes of all edits."""
    near = float(1.0e30)
    far = float(-1.0)
    span = grid_span(grid, origin, direction)
    if span[0] < span[1]:
        near = span[0]
        far = span[1]
    for e in range(edits.shape[0]):
        span = lattice_span(edits[e], origin, direction)
        if span[0] < span[1]:
            near = wp.min(near, span[0])
            far = wp.max(far, span[1])
    return wp.vec2(near, far)


@wp.func
def march_edits(
    edits: wp.array(dtype=FlatEdit),
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
    holder = int(-1)  # the last edit whose box holds the ray, up to here
    part_end = float(-1.0)
    k = sample_index_after(span[0], step)
    count = int(0)  # sub-samples of sample k; 0: not known, so one
    j = int(0)
    t = (float(k) + 0.5) * step
    pending = float(0.0)  # weight of samples whose colour is not looked up yet
    while t < span[1] and seen.transmittance > options.stop:
        if t >= part_end:
            holder = int(-1)
            part_end = float(1.0e30)
            e = int(edits.shape[0]) - 1
            while e >= 0 and holder < 0:
                inner = lattice_span(edits[e], origin, direction)
                if inner[0] < inner[1] and t < inner[1]:
                    if t >= inner[0]:
                        holder = e
                        part_end = wp.min(part_end, inner[1])
                    else:
                        part_end = wp.min(part_end, inner[0])
                e -= 1
        x = origin + t * direction
        leave = t
        if holder >= 0:
            edit = edits[holder]
            g = (x - edit.lower) * edit.inverse_spacing
            ci = wp.clamp(int(g[0]), 0, edit.node_counts[0] - 2)
            cj = wp.clamp(int(g[1]), 0, edit.node_counts[1] - 2)
            ck = wp.clamp(int(g[2]), 0, edit.node_counts[2] - 2)
            look = byte_entry(edit.look, (ci * edit.node_counts[1] + cj) * edit.node_counts[2] + ck)
            if look >= LOOK_SKIP:
                leave = t + cell_exit(g, inverse / edit.inverse_spacing, look - LOOK_SKIP)
                leave = wp.max(wp.min(leave, part_end), t + 0.5 * step)
        else:
            if t < box[0] or not (t < box[1]):
                leave = wp.where(t < box[0], box[0], span[1])
            else:
                g = grid_position(grid, x)
                empty = empty_distance(grid, g)
                if empty > 0:
                    leave = t + cell_exit(g, grid_inverse, empty)
            leave = wp.min(leave, part_end)
        if leave > t:
            k = wp.max(k + 1, sample_index_after(leave, step))
            count = int(0)
            j = int(0)
            t = (float(k) + 0.5) * step
            continue
        point = flat_trace(edits, holder, x)
        # each function of the map stands once in this loop: registers are short
        g = grid_position(grid, point.position)
        gi = int(wp.floor(g[0]))
        gj = int(wp.floor(g[1]))
        gk = int(wp.floor(g[2]))
        offset = g - wp.vec3(float(gi), float(gj), float(gk))
        sigma = float(0.0)
        if point.vacant == 0 and (point.cleared == 0 or seen.cleared_transmittance > FAINT):
            if empty_distance(grid, g) == 0:
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
                t = (float(k) + 0.5 / float(count)) * step
                continue
        parts = wp.max(count, 1)
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
                    colour = row_colour(grid.sh, table.packed, table.columns, gi, gj, gk, offset, sh_basis(along))
                    seen.colour += pending * wp.max(colour, wp.vec3(0.0, 0.0, 0.0))
                    pending = float(0.0)
                seen.depth += weight * t
                seen.transmittance *= kept
                if (point.flags & CELL_FOLDED) != 0 and weight > FOLD_MIN_WEIGHT:
                    seen.fold += weight
        j += 1
        if j >= parts:
            k += 1
            count = int(0)
            j = int(0)
        parts = wp.max(count, 1)
        t = (float(k) + 0.5 + ((float(j) + 0.5) / float(parts) - 0.5)) * step
    seen.colour += pending_colour(seen.colour, seen.transmittance, pending)
    return seen


@wp.kernel(cuda_max_registers=128)
def render_edits(
    first: int,
    grid: VoxelGrid,
    table: RowTable,
    edits: wp.array(dtype=FlatEdit),
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """One thread per pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        seen = march_edits(edits, grid, table, camera.centre, pixel_direction(camera, column, row), options)
        fill_pixel(picture, row * camera.width + column, seen, background)
