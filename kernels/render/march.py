"""The march through a voxel field that one edit deforms: that of render/march_exact, written for speed."""

import functools
from typing import Any

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import byte_entry, cell_byte, near_exp, near_reciprocal, near_root
from ..edits.nodes import cell_place_slope, node_blend_slope, node_distance, side_slope
from ..edits.structs import (
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    CUT_LENGTH,
    LOOK_SKIP,
    EditData,
    entry_of_sides,
    rest_distance,
)
from ..field.densities import row_density
from ..field.grid import (
    SAMPLE_PLACE,
    VoxelGrid,
    cell_below,
    exit_of_cell,
    first_sample,
    grid_position,
    grid_span,
    safe_inverse,
)
from ..field.harmonics import sh_basis
from ..field.march import PENDING_WEIGHT
from ..field.rows import RowTable, row_color
from ..lattice.cage_map import side_position
from ..view.rays import box_span, joined_span
from .rays import (
    BEGUN,
    FAINT,
    FOLD_MIN_WEIGHT,
    MAX_SUB_SAMPLES,
    DeformedRadiance,
    MarchOptions,
    RayState,
    forward_only_radiance,
)
from .volume import CARRIED_LAYER, PLAIN_LAYER, ShadedVolume, shaded_value

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3))


@wp.func
def is_cell(grid: VoxelGrid, i: int, j: int, k: int):
    """Whether there is a cell above node (i, j, k)."""
    low = i >= 0 and j >= 0 and k >= 0
    return low and i < grid.skip.shape[0] and j < grid.skip.shape[1] and k < grid.skip.shape[2]


@wp.func
def empty_at(grid: VoxelGrid, g: wp.vec3):
    """Distance in cells from node coordinates g to the nearest that holds anything, 0 there; 1 outside the grid."""
    i, j, k = cell_below(g)
    if not is_cell(grid, i, j, k):
        return int(1)
    return cell_byte(grid.skip, i, j, k)


@wp.func
def matter_at(table: RowTable, grid: VoxelGrid, g: wp.vec3, layer: int, step: float):
    """Color, where the table holds it, and optical depth of a step at node coordinates g; 0 where there is nothing.
    layer: of render/volume."""
    i, j, k = cell_below(g)
    if not is_cell(grid, i, j, k):
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    offset = g - wp.vec3(float(i), float(j), float(k))
    if cell_byte(grid.skip, i, j, k) > 0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    sigma = row_density(table.laid, table.unit, grid.density, table.columns, i, j, k, offset)
    return wp.vec4(0.0, 0.0, 0.0, sigma * step)


@wp.func
def matter_at(table: ShadedVolume, grid: VoxelGrid, g: wp.vec3, layer: int, step: float):  # noqa: F811 (a Warp overload)
    low = g[0] >= 0.0 and g[1] >= 0.0 and g[2] >= 0.0
    if not (low and g[0] < table.cells[0] and g[1] < table.cells[1] and g[2] < table.cells[2]):
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    return shaded_value(table, g, layer)


@wp.func
def matter_color(table: RowTable, grid: VoxelGrid, g: wp.vec3, slope: wp.vec3, direction: wp.vec3):
    """Colour before the clamp at zero, at node coordinates g, seen along `slope`, or `direction` where that is zero;
    both of any length."""
    length = wp.length(slope)
    along = wp.where(length > 1.0e-6, slope / length, wp.normalize(direction))
    i, j, k = cell_below(g)
    offset = g - wp.vec3(float(i), float(j), float(k))
    return row_color(grid.sh, table.packed, table.columns, i, j, k, offset, sh_basis(along))


@wp.func
def sample_after(k: float):
    """The next sample; from 2^24 on the next float32, so that a march through a cage far away ends."""
    return k + wp.max(1.0, 6.0e-8 * k)


@wp.struct
class EditLine:
    """A ray in fine cells per unit of distance, and the distances of boxes on it."""

    start: wp.vec3
    rate: wp.vec3
    inverse: wp.vec3  # of the rate
    box: wp.vec2  # distances between which it is in the lattice
    span: wp.vec2  # and in the field's grid


#: A LatticePlace outside the lattice, and one that is also outside the field's grid.
NO_LATTICE = wp.constant(-1)

NOWHERE = wp.constant(-2)


@wp.struct
class LatticePlace:
    """Where a sample is in an edit's lattice, and the entry of its fine cell."""

    n: int  # node below it; NO_LATTICE or NOWHERE
    fine: wp.vec3  # in fine cells
    look: int  # of its fine cell; outside the lattice the distance of its cell in the field's grid


@wp.struct
class RaySample:
    """A sample of a ray, or a part of one that is cut. Counted in floats: no conversions."""

    k: float  # the sample
    j: float  # how much of it is done
    share: float  # of it that this part stands for, 1 for one that is not cut; below 0: not known before


@wp.struct
class MarchedRay:
    """How far a march has followed a ray, and what it gathered."""

    seen: DeformedRadiance
    pending: float
    sample: RaySample


@wp.struct
class MappedPlace:
    """Where a sample is in canonical space."""

    position: wp.vec3
    mapped: int  # 1: the map has led there. Not a bool, which Warp keeps in a byte
    slope: wp.vec3  # derivative along the ray (Eq. 5) times fine cells along a cell; the ray's direction if not mapped


@wp.func
def polynomial_place(edit: EditData, at: LatticePlace, f: wp.vec3, rate: wp.vec3, place: MappedPlace):
    """Where a sample at a place f, 0 to 1, in its lattice cell is in canonical space: `place` where the posed cage does
    not hold it."""
    there = cell_place_slope(edit.polynomials, at.n, f, rate)
    if (at.look & CELL_INSIDE) == 0:
        nz = edit.node_counts[2]
        if node_distance(edit.nodes, at.n, edit.node_counts[1] * nz, nz, f) > edit.tolerance:
            return place
    place.mapped = int(1)
    place.position = wp.vec3(there[0], there[1], there[2])
    place.slope = wp.vec3(there[3], there[4], there[5])
    return place


@wp.func
def node_place(edit: EditData, at: LatticePlace, f: wp.vec3, rate: wp.vec3, place: MappedPlace):
    """The same of an edit without polynomials."""
    nz = edit.node_counts[2]
    node = node_blend_slope(edit.nodes, at.n, edit.node_counts[1] * nz, nz, f, rate)
    if (at.look & CELL_INSIDE) == 0 and node[3] > edit.tolerance:
        return place
    place.mapped = int(1)
    place.position = wp.vec3(node[0], node[1], node[2])
    place.slope = wp.vec3(node[4], node[5], node[6])
    return place


# Registers are short. Warp keeps a variable that a branch sets for the whole kernel, from round to round: so functions
# below return early, or set members of a struct. What a launch knows is a member of its structs rather than computed
# before the loop, and exact roots and quotients are calls, around which more registers are kept.


@wp.func
def edit_line(edit: EditData, grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
    """A ray in a march through one edit."""
    line = EditLine()
    line.start = (origin - edit.lower) * edit.inverse_fine_size
    line.rate = direction * edit.inverse_fine_size
    line.inverse = safe_inverse(line.rate)
    corner = wp.vec3(float(edit.last_fine[0] + 1), float(edit.last_fine[1] + 1), float(edit.last_fine[2] + 1))
    line.box = box_span(line.start, line.rate, wp.vec3(0.0, 0.0, 0.0), corner)
    line.span = grid_span(grid, origin, direction)
    return line


@wp.func
def sample_distance(sample: RaySample, step: float):
    """Distance of a sample from the camera."""
    return (sample.k + sample.j + SAMPLE_PLACE * wp.abs(sample.share)) * step


@wp.func
def ray_sample(k: float, j: float, share: float):
    """A part of sample k."""
    sample = RaySample()
    sample.k = k
    sample.j = j
    sample.share = share
    return sample


@wp.func
def lattice_place(edit: EditData, grid: VoxelGrid, line: EditLine, t: float):
    """Where the ray is in the lattice at a distance."""
    at = LatticePlace()
    at.fine = line.start + t * line.rate
    if t >= line.box[0] and t < line.box[1]:
        i = wp.clamp(int(at.fine[0]), 0, edit.last_fine[0])
        j = wp.clamp(int(at.fine[1]), 0, edit.last_fine[1])
        k = wp.clamp(int(at.fine[2]), 0, edit.last_fine[2])
        bits = edit.fine_bits
        at.n = ((i >> bits) * edit.node_counts[1] + (j >> bits)) * edit.node_counts[2] + (k >> bits)
        rest = (1 << bits) - 1
        within = ((((i & rest) << bits) + (j & rest)) << bits) + (k & rest)
        at.look = byte_entry(edit.fine_look, (at.n << (3 * bits)) + within)
    elif t >= line.span[0] and t < line.span[1]:
        at.n = int(NO_LATTICE)
        at.look = empty_at(grid, grid_position(grid, edit.lower + edit.fine_size * at.fine))
    else:
        at.n = int(NOWHERE)
        at.look = int(1)
    return at


@wp.func
def current_place(edit: EditData, grid: VoxelGrid, line: EditLine, sample: RaySample, foreseen: LatticePlace, t: float):
    """Where a sample at distance t is in the lattice."""
    if sample.share > 0.0:
        return foreseen
    return lattice_place(edit, grid, line, t)


@wp.func
def is_empty(at: LatticePlace):
    """Whether nothing is there."""
    return at.look >= wp.where(at.n >= 0, int(LOOK_SKIP), 1)


@wp.func
def distance_to_rest(edit: EditData, place: MappedPlace, look: int):
    """Signed distance of a sample to the rest cage; any number of that sign where its fine cell decides, or where it is
    not used."""
    if (look & CELL_STAYS) != 0 and (place.mapped == 1 or (look & CELL_OUTSIDE) != 0):
        return float(-1.0e30)
    if place.mapped == 0 and edit.keeps_source == 1:
        return float(1.0e30)
    return rest_distance(edit, place.position)


@wp.func
def color_layer(edit: EditData, mapped: int, distance: float):
    """The layer of colours that a sample reads: matter that moves with a pose is in one of them only."""
    if mapped == 1 or distance <= edit.carried_below:
        return CARRIED_LAYER
    return PLAIN_LAYER


@wp.func
def exit_of_fine_cell(fine: wp.vec3, inverse: wp.vec3, reach: int):
    """field/grid.exit_of_cell without numbers that are the same for a whole ray, which a march would keep."""
    g = fine - wp.vec3(wp.floor(fine[0]), wp.floor(fine[1]), wp.floor(fine[2]))
    half = float(reach) - 0.5
    x = half * wp.abs(inverse[0]) - (g[0] - 0.5) * inverse[0]
    y = half * wp.abs(inverse[1]) - (g[1] - 0.5) * inverse[1]
    z = half * wp.abs(inverse[2]) - (g[2] - 0.5) * inverse[2]
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
def leave_empty(edit: EditData, grid: VoxelGrid, line: EditLine, at: LatticePlace, t: float):
    """Distance up to which a ray certainly meets nothing from an empty place on."""
    if at.n >= 0:
        return wp.min(t + exit_of_fine_cell(at.fine, line.inverse, at.look - LOOK_SKIP), line.box[1])
    if at.n == NOWHERE:
        return up_to_box(line, t, beyond_grid(line, t))
    g = grid_position(grid, edit.lower + edit.fine_size * at.fine)
    offset = g - wp.vec3(wp.floor(g[0]), wp.floor(g[1]), wp.floor(g[2]))
    inverse = wp.cw_mul(line.inverse, edit.inverse_fine_size * grid.voxel_size)
    return up_to_box(line, t, t + exit_of_cell(offset, inverse, at.look))


@wp.func
def next_sample(
    edit: EditData,
    grid: VoxelGrid,
    options: MarchOptions,
    line: EditLine,
    sample: RaySample,
    at: LatticePlace,
    t: float,
):
    """The sample to look at after one at distance t, or the next part of it if it is cut."""
    if sample.share < 1.0:  # other parts of a sample in an empty place may hold something
        done = sample.j + sample.share
        if done <= 1.0 - 0.5 * sample.share:
            return ray_sample(sample.k, done, sample.share)
    elif is_empty(at):
        leave = leave_empty(edit, grid, line, at, t)
        return ray_sample(wp.max(sample_after(sample.k), first_sample(leave * options.inverse_step)), 0.0, 1.0)
    return ray_sample(sample_after(sample.k), 0.0, 1.0)


@wp.struct
class FoundMatter:
    """What a sample holds."""

    mapped: int  # of MappedPlace
    slope: wp.vec3  # of that MappedPlace
    distance: float  # to the rest cage
    g: wp.vec3  # node coordinates in the field's grid
    matter: wp.vec4  # colour, if it comes with the rest, and optical depth of a step


@wp.func
def with_color(table: RowTable, grid: VoxelGrid, line: EditLine, found: FoundMatter, ray: MarchedRay, weight: float):
    """A ray with the colour of a sample; light samples are looked up together with the next one."""
    ray.pending += weight
    if ray.pending > PENDING_WEIGHT:
        color = matter_color(table, grid, found.g, found.slope, line.rate)
        ray.seen.color += ray.pending * wp.max(color, wp.vec3(0.0, 0.0, 0.0))
        ray.pending = float(0.0)
    return ray


@wp.func
def with_color(  # noqa: F811 (a Warp overload)
    table: ShadedVolume, grid: VoxelGrid, line: EditLine, found: FoundMatter, ray: MarchedRay, weight: float
):
    color = wp.vec3(found.matter[0] + 0.5, found.matter[1] + 0.5, found.matter[2] + 0.5)
    ray.seen.color += weight * wp.max(color, wp.vec3(0.0, 0.0, 0.0))
    return ray


@wp.func
def gather_matter(
    edit: EditData,
    grid: VoxelGrid,
    table: Any,
    options: MarchOptions,
    line: EditLine,
    ray: MarchedRay,
    after: RaySample,
    at: LatticePlace,
    found: FoundMatter,
    t: float,
):
    """A ray with what its sample holds, at the one after it; at the parts of this one if it is to be cut."""
    share = ray.sample.share
    k = ray.sample.k
    ray.sample = after
    if is_empty(at):
        return ray
    stretch = edit.fine_width * near_root(wp.dot(found.slope, found.slope))
    if found.mapped == 1 and share == 1.0 and (at.look & CELL_STEEP) != 0 and stretch > CUT_LENGTH:
        part = near_reciprocal(wp.min(wp.ceil(stretch - 1.0e-3), float(MAX_SUB_SAMPLES)))
        ray.sample = ray_sample(k, 0.0, -part)
        return ray
    if found.mapped == 1 and found.distance > edit.slack:
        ray.seen.outside += 1.0
    elif found.matter[3] > 0.0:
        length = wp.where(found.mapped == 1 and options.arc_opacity == 1, stretch, 1.0)
        kept = near_exp(-(found.matter[3] * share * length))
        if found.mapped == 0 and found.distance <= 0.0:
            if ray.seen.cleared_transmittance > FAINT:
                ray.seen.reveal += ray.seen.transmittance * ray.seen.cleared_transmittance * (1.0 - kept)
                ray.seen.cleared_transmittance *= kept
        else:
            weight = ray.seen.transmittance * (1.0 - kept)
            ray = with_color(table, grid, line, found, ray, weight)
            ray.seen.depth += weight * t
            ray.seen.transmittance *= kept
            if (at.look & CELL_FOLDED) != 0 and found.mapped == 1 and weight > FOLD_MIN_WEIGHT:
                ray.seen.fold += weight
    return ray


@functools.cache
def make_edit_march(has_sides: bool) -> Any:
    """The march through one edit. has_sides: cells may have corner values for each side of a narrow gap, or no
    polynomials. Around calls for these a GPU keeps more registers: edits without have a march of their own."""

    @wp.func
    def cell_place(edit: EditData, at: LatticePlace, f: wp.vec3, rate: wp.vec3, place: MappedPlace):
        """The same, whatever the edit's cells have."""
        if wp.static(has_sides):
            if edit.by_nodes == 1:
                place = node_place(edit, at, f, rate, place)
            else:
                place = polynomial_place(edit, at, f, rate, place)
            entry = entry_of_sides(edit, at.n)
            if entry != 0 and place.mapped == 1:
                place.position = side_position(edit.sides, entry, f)
                place.slope = side_slope(edit.sides, entry, f, rate)
        else:
            place = polynomial_place(edit, at, f, rate, place)
        return place

    @wp.func
    def mapped_place(edit: EditData, at: LatticePlace, line: EditLine):
        """Where a sample is in canonical space (Eq. 4): mapped inside the posed cage, else where it is."""
        result = MappedPlace()
        result.position = edit.lower + edit.fine_size * at.fine
        result.slope = line.rate
        if at.n < 0:
            return result
        if ((at.look | edit.all_outside) & CELL_OUTSIDE) != 0:
            return result
        # the cage reaches no cell at the lattice's border, where rounding may lead to the one beyond
        place = edit.fine_width * at.fine
        f = place - wp.vec3(wp.floor(place[0]), wp.floor(place[1]), wp.floor(place[2]))
        return cell_place(edit, at, f, line.rate, result)

    @wp.func
    def found_matter(edit: EditData, grid: VoxelGrid, table: Any, line: EditLine, at: LatticePlace, step: float):
        """What a sample holds."""
        found = FoundMatter()
        if is_empty(at):
            return found
        point = mapped_place(edit, at, line)
        found.mapped = point.mapped
        found.slope = point.slope
        found.distance = distance_to_rest(edit, point, at.look)
        found.g = grid_position(grid, point.position)
        found.matter = matter_at(table, grid, found.g, color_layer(edit, point.mapped, found.distance), step)
        return found

    @wp.func
    def march_edit(
        edit: EditData,
        grid: VoxelGrid,
        table: Any,
        origin: wp.vec3,
        direction: wp.vec3,
        options: MarchOptions,
        state: RayState,
        end: float,
    ):
        """Gather radiance along a ray through the deformed scene, from where `state` has reached up to `end`."""
        line = edit_line(edit, grid, origin, direction)
        near_far = joined_span(line.box, line.span)
        far = wp.min(near_far[1], end)
        ray = MarchedRay()
        ray.seen = state.seen
        ray.pending = state.pending
        ray.sample = ray_sample(first_sample(wp.max(near_far[0], state.reached) * options.inverse_step), 0.0, 1.0)
        t = sample_distance(ray.sample, options.step)
        foreseen = lattice_place(edit, grid, line, t)
        while t < far and ray.seen.transmittance > options.stop:
            at = current_place(edit, grid, line, ray.sample, foreseen, t)
            ray.sample.share = wp.abs(ray.sample.share)
            after = next_sample(edit, grid, options, line, ray.sample, at, t)
            found = found_matter(edit, grid, table, line, at, options.step)
            # a GPU waits for what it reads: so the next place is read before this matter
            foreseen = lattice_place(edit, grid, line, sample_distance(after, options.step))
            ray = gather_matter(edit, grid, table, options, line, ray, after, at, found, t)
            t = sample_distance(ray.sample, options.step)
        result = RayState()
        result.seen = forward_only_radiance(ray.seen, origin)
        result.pending = forward_only(ray.pending, origin)
        result.reached = wp.max(far, BEGUN)  # beyond `far` there is nothing up to `end`
        return result

    return march_edit
