"""The march through a voxel field that one edit deforms: that of deform/march, written for speed.

The same samples and the same sums ("Deforming Radiance Fields with Cages", ECCV 2022, Eq. 4 and 5), for the common case
of one edit on a lattice: flat arrays whose numbers are read many at once, one table of cells, and the map's derivative
where matter is. Where the map compresses, a sample is cut into sub-samples as in deform/march.
Needs: core/entries, deform/edits, deform/flat_edits, deform/laid_shades, deform/map_nodes, deform/march,
deform/matter_rows, deform/ray_parts, field/grid, field/samples, lattice/cage_map, view/rays.
"""

from typing import Any

import warp as wp

from ..core.entries import byte_entry, near_reciprocal, near_root
from ..field.grid import VoxelGrid, grid_position
from ..field.samples import exit_of_cell, grid_span, safe_inverse
from ..lattice.cage_map import side_position
from ..view.rays import box_span
from .edits import CELL_FOLDED, CELL_INSIDE, CELL_OUTSIDE, CELL_STAYS, CELL_STEEP, CUT_LENGTH
from .flat_edits import LOOK_SKIP, FlatEdit, rest_distance
from .laid_shades import CARRIED_LAYER, PLAIN_LAYER
from .map_nodes import node_blend, node_slope, side_slope
from .march import FAINT, FOLD_MIN_WEIGHT, MAX_SUB_SAMPLES, DeformedRadiance, MarchOptions
from .matter_rows import empty_at, least_pending, matter_at, matter_colour
from .ray_parts import BEGUN, RayState

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Where no cell is steep, a ray takes at least this way for a canonical length of 1.
SURE_WAY = wp.constant(1.0 / float(CUT_LENGTH))


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


@wp.struct
class EditLine:
    """What a march knows of a ray: in lattice cells, so many per unit of distance, and where boxes are on it."""

    start: wp.vec3
    rate: wp.vec3
    inverse: wp.vec3  # of the rate
    box: wp.vec2  # distances between which it is in the lattice
    span: wp.vec2  # and in the field's grid


@wp.struct
class MarchedRay:
    """How far a march has come along a ray, and what it saw. Samples are counted in floats: no conversions."""

    seen: DeformedRadiance
    pending: float
    k: float  # the sample
    j: float  # the part of it that is done, where it is cut
    share: float  # of the sample that a sub-sample stands for; 1 for one that is not cut


@wp.struct
class LatticePlace:
    """Where a sample is in an edit's lattice, and what its cell is known for."""

    in_box: bool
    n: int  # node below it
    f: wp.vec3  # place in the cell above that, 0 to 1
    flags: int


@wp.struct
class MappedPlace:
    """Where a sample is in canonical space."""

    position: wp.vec3
    mapped: bool  # whether the map has led there
    entry: int  # of the table of sides


# Registers are short. What a branch sets is a variable of the whole kernel to Warp, and kept from round to round: so
# functions below return early, or set numbers of a struct. What a launch knows is a number of its structs rather than
# worked out before the loop, and exact roots and quotients are calls, around which more is kept.


@wp.func
def edit_line(edit: FlatEdit, grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
    """A ray as a march through an edit knows it."""
    line = EditLine()
    line.start = (origin - edit.lower) * edit.inverse_spacing
    line.rate = direction * edit.inverse_spacing
    line.inverse = safe_inverse(line.rate)
    corner = wp.vec3(float(edit.node_counts[0] - 1), float(edit.node_counts[1] - 1), float(edit.node_counts[2] - 1))
    line.box = box_span(line.start, line.rate, wp.vec3(0.0, 0.0, 0.0), corner)
    line.span = grid_span(grid, origin, direction)
    return line


@wp.func
def line_span(line: EditLine):
    """Distances between which a ray can meet anything; none if the first is not below the second."""
    meets_box = line.box[0] < line.box[1]
    meets_grid = line.span[0] < line.span[1]
    near = wp.min(wp.where(meets_box, line.box[0], 1.0e30), wp.where(meets_grid, line.span[0], 1.0e30))
    far = wp.max(wp.where(meets_box, line.box[1], -1.0), wp.where(meets_grid, line.span[1], -1.0))
    return wp.vec2(near, far)


@wp.func
def ray_distance(ray: MarchedRay, step: float):
    """Distance of a ray's sample from the camera."""
    return (ray.k + ray.j + 0.5 * ray.share) * step


@wp.func
def at_sample(ray: MarchedRay, k: float):
    """A ray that goes on with the whole of sample k."""
    ray.k = k
    ray.j = float(0.0)
    ray.share = float(1.0)
    return ray


@wp.func
def first_sample(t: float, inverse_step: float):
    """The first sample at or beyond a distance."""
    return wp.ceil(t * inverse_step - 0.5)


@wp.func
def lattice_place(edit: FlatEdit, line: EditLine, place: wp.vec3, t: float):
    """Where a sample is in the lattice: its place in cells is `place`, its distance t. Flags are 0 outside."""
    at = LatticePlace()
    at.in_box = t >= line.box[0] and t < line.box[1]
    at.f = place
    if at.in_box:
        ci = wp.clamp(int(place[0]), 0, edit.last_cell[0])
        cj = wp.clamp(int(place[1]), 0, edit.last_cell[1])
        ck = wp.clamp(int(place[2]), 0, edit.last_cell[2])
        at.n = (ci * edit.node_counts[1] + cj) * edit.node_counts[2] + ck
        at.f = place - wp.vec3(float(ci), float(cj), float(ck))
        at.flags = byte_entry(edit.look, at.n)
    return at


@wp.func
def mapped_place(sides: Any, edit: FlatEdit, at: LatticePlace, place: wp.vec3):
    """Where a sample is in canonical space (Eq. 4): where the map leads it inside the posed cage, else where it is."""
    result = MappedPlace()
    result.position = edit.lower + edit.spacing * place
    if not at.in_box or edit.removes == 1 or (at.flags & CELL_OUTSIDE) != 0:
        return result
    nz = edit.node_counts[2]
    node = node_blend(edit.nodes, at.n, edit.node_counts[1] * nz, nz, at.f)
    if (at.flags & CELL_INSIDE) == 0 and node[3] > edit.tolerance:
        return result
    result.mapped = True
    result.entry = side_entry(sides, edit, at.n)
    result.position = map_position(sides, edit, result.entry, at.f, wp.vec3(node[0], node[1], node[2]))
    return result


@wp.func
def room_in_cage(edit: FlatEdit, position: wp.vec3, is_asked: bool):
    """Distance along a ray over which no sample leaves the rest cage: half of that in canonical space, of which a ray
    takes at most CUT_LENGTH times its own where it is not steep. Negative beyond the slack; endless if not asked."""
    if not is_asked:
        return 1.0e30
    return 0.5 * (edit.slack - rest_distance(edit, position))


@wp.func
def slope_at(sides: Any, edit: FlatEdit, at: LatticePlace, entry: int, line: EditLine, is_asked: bool):
    """Derivative of the canonical position along a ray (Eq. 5), by its distance; its rate in lattice cells where nobody
    asks."""
    if not is_asked:
        return line.rate
    return map_slope(sides, edit, at.n, entry, at.f, line.rate)


@wp.func
def exit_of_lattice_cell(f: wp.vec3, inverse: wp.vec3, reach: int):
    """field/samples.exit_of_cell without numbers that are the same for a whole ray, which a march would keep."""
    half = float(reach) - 0.5
    x = half * wp.abs(inverse[0]) - (f[0] - 0.5) * inverse[0]
    y = half * wp.abs(inverse[1]) - (f[1] - 0.5) * inverse[1]
    z = half * wp.abs(inverse[2]) - (f[2] - 0.5) * inverse[2]
    return wp.min(x, wp.min(y, z))


@wp.func
def beyond_grid(line: EditLine, t: float):
    """Where a sample outside the grid and the lattice may meet something again."""
    if t < line.span[0]:
        return line.span[0]
    return wp.max(line.box[1], line.span[1])


@wp.func
def up_to_box(line: EditLine, t: float, leave: float):
    """A jump from t that does not lead into the lattice."""
    if t < line.box[0] and line.box[0] < line.box[1]:
        return wp.min(leave, line.box[0])
    return leave


@wp.func
def leave_empty(edit: FlatEdit, grid: VoxelGrid, line: EditLine, at: LatticePlace, g: wp.vec3, t: float, room: float):
    """Distance up to which a ray certainly meets nothing after a sample that holds nothing."""
    if at.in_box:
        if (at.flags & (CELL_INSIDE | CELL_STEEP)) != CELL_INSIDE:
            return t
        hollow = float(empty_at(grid, g) - 1) * (wp.min(grid.voxel_size) * SURE_WAY)
        return t + wp.min(wp.min(exit_of_lattice_cell(at.f, line.inverse, 1), hollow), room)
    if t < line.span[0] or not (t < line.span[1]):
        return up_to_box(line, t, beyond_grid(line, t))
    offset = g - wp.vec3(wp.floor(g[0]), wp.floor(g[1]), wp.floor(g[2]))
    inverse = wp.cw_mul(line.inverse, edit.inverse_spacing * grid.voxel_size)
    return up_to_box(line, t, t + exit_of_cell(offset, inverse, empty_at(grid, g)))


@wp.func
def take_sample(
    sides: Any, edit: FlatEdit, grid: VoxelGrid, table: Any, options: MarchOptions, line: EditLine, ray: MarchedRay
):
    """Gather what a ray's sample holds, and go on to the next one to look at."""
    step = options.step
    t = ray_distance(ray, step)
    place = line.start + t * line.rate
    at = lattice_place(edit, line, place, t)
    if at.flags >= LOOK_SKIP:
        leave = t + exit_of_lattice_cell(at.f, line.inverse, at.flags - LOOK_SKIP)
        leave = wp.max(wp.min(leave, line.box[1]), t + 0.5 * step)
        return at_sample(ray, wp.max(sample_after(ray.k), first_sample(leave, options.inverse_step)))
    point = mapped_place(sides, edit, at, place)
    g = grid_position(grid, point.position)
    matter = matter_at(table, grid, g, wp.where(point.mapped, CARRIED_LAYER, PLAIN_LAYER), step)
    is_matter = matter[3] > 0.0
    clears = is_matter and not point.mapped and edit.keeps_source == 0
    asks_room = clears or (point.mapped and (at.flags & CELL_STAYS) == 0)
    room = room_in_cage(edit, point.position, asks_room)
    leaves = point.mapped and room < 0.0
    asks_length = point.mapped and ray.share == 1.0 and (at.flags & CELL_STEEP) != 0
    asks_slope = asks_length or (point.mapped and is_matter and not leaves)
    slope = slope_at(sides, edit, at, point.entry, line, asks_slope)
    stretch = near_root(wp.dot(slope, slope))
    if asks_length and stretch > CUT_LENGTH:
        ray.share = near_reciprocal(wp.min(wp.ceil(stretch - 1.0e-3), float(MAX_SUB_SAMPLES)))
        return ray
    next_k = sample_after(ray.k)
    if leaves:
        ray.seen.outside += 1.0
    elif is_matter:
        depth = matter[3] * ray.share * wp.where(point.mapped and options.arc_opacity == 1, stretch, 1.0)
        kept = wp.exp(-depth)
        if clears and 2.0 * room >= edit.slack:
            if ray.seen.cleared_transmittance > FAINT:
                ray.seen.reveal += ray.seen.transmittance * ray.seen.cleared_transmittance * (1.0 - kept)
                ray.seen.cleared_transmittance *= kept
        else:
            weight = ray.seen.transmittance * (1.0 - kept)
            ray.pending += weight
            if ray.pending > least_pending(table):
                colour = matter_colour(table, grid, matter, g, slope, line.rate)
                ray.seen.colour += ray.pending * wp.max(colour, wp.vec3(0.0, 0.0, 0.0))
                ray.pending = float(0.0)
            ray.seen.depth += weight * t
            ray.seen.transmittance *= kept
            if (at.flags & CELL_FOLDED) != 0 and point.mapped and weight > FOLD_MIN_WEIGHT:
                ray.seen.fold += weight
    else:
        next_k = wp.max(next_k, first_sample(leave_empty(edit, grid, line, at, g, t, room), options.inverse_step))
    ray.j += ray.share
    if ray.j > 1.0 - 0.5 * ray.share:
        return at_sample(ray, next_k)
    return ray


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
    line = edit_line(edit, grid, origin, direction)
    near_far = line_span(line)
    far = wp.min(near_far[1], end)
    ray = MarchedRay()
    ray.seen = state.seen
    ray.pending = state.pending
    ray = at_sample(ray, first_sample(wp.max(near_far[0], state.reached), options.inverse_step))
    while ray_distance(ray, options.step) < far and ray.seen.transmittance > options.stop:
        ray = take_sample(sides, edit, grid, table, options, line, ray)
    after = RayState()
    after.seen = ray.seen
    after.pending = ray.pending
    after.reached = wp.max(far, BEGUN)  # beyond `far` there is nothing up to `end`
    return after
