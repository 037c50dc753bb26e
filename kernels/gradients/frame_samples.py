"""Samples of the rays of frames of a posed field that hold matter, kept for the gradient of a loss."""

# The march of a frame (render/march) without colours. A table keeps the last run of each ray's samples; of rays with
# more, runs before are found again from where they began, the last ones first, as what lies behind counts for those
# before. A ray is an item of the marches, and each of its samples one of what comes after them: few rays are long.

import warp as wp

from ..core.gradients import forward_only_in
from ..edits.structs import CELL_OUTSIDE, CELL_STEEP, CUT_LENGTH, EditData, entry_of_sides
from ..field.columns import Columns, cell_rows, eight_rows
from ..field.densities import row_density
from ..field.grid import VoxelGrid, cell_below, eight_weights, first_sample, grid_position
from ..field.march import DEPTH_MIN_ALPHA
from ..field.rows import RowTable
from ..lattice.cage_map import corner_share, nearest_side
from ..render.march import (
    LatticePlace,
    MappedPlace,
    current_place,
    distance_to_rest,
    edit_line,
    empty_at,
    is_empty,
    lattice_place,
    next_sample,
    node_place,
    polynomial_place,
    ray_sample,
    sample_distance,
)
from ..render.rays import MAX_SUB_SAMPLES, MarchOptions
from ..view.rays import PinholeCamera, joined_span, pixel_direction, tile_pixel

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})

forward_only = forward_only_in(__name__, (float, wp.vec3), (eight_weights, wp.vec3))


@wp.struct
class FrameLoss:
    """Derivatives of a loss by the arrays of frames, (views * h * w,) each; none where it does not depend on them."""

    rgb: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)


@wp.struct
class FrameRays:
    """Rays of frames of one size, tile by tile, and a loss of the frames."""

    cameras: wp.array(dtype=PinholeCamera)  # (views,)
    view_rays: int  # of each view, of whole tiles
    begin: int  # the first one that a table has samples of
    background: wp.vec3
    loss: FrameLoss


@wp.struct
class FrameRay:
    """One of them."""

    view: int
    pixel: int  # of all frames; -1 beside them
    origin: wp.vec3
    direction: wp.vec3


@wp.func
def frame_ray(rays: FrameRays, place: int):
    """The ray at a place of a table."""
    ray = FrameRay()
    item = rays.begin + place
    ray.view = item // rays.view_rays
    ray.pixel = int(-1)
    camera = rays.cameras[ray.view]
    column, row = tile_pixel(item - ray.view * rays.view_rays, camera.width)
    if column < camera.width and row < camera.height:
        ray.pixel = (ray.view * camera.height + row) * camera.width + column
        ray.origin = camera.center
        ray.direction = pixel_direction(camera, column, row)
    return ray


@wp.func
def slope_by_color(loss: FrameLoss, pixel: int):
    """Derivatives of a loss by the colour of a pixel."""
    if loss.rgb.shape[0] > 0:
        return loss.rgb[pixel]
    return wp.vec3()


@wp.struct
class RaySamples:
    """Samples that hold matter: of each of a batch of rays those of one run."""

    kept: wp.array2d(
        dtype=wp.vec4
    )  # (most of a run, rays) sample, share of one, light that reaches it; the last is free
    counts: wp.array(dtype=int)  # (rays,) of the whole ray
    ends: wp.array(dtype=wp.vec4)  # (rays,) see `RayEnd`
    begins: wp.array2d(dtype=wp.vec4)  # (runs, rays) of each run the sample, how much of it is done, share, light


@wp.struct
class RayEnd:
    """Where the samples of a run end, seen from behind."""

    light: float  # that is left
    by_depth: float  # derivative of the loss by the depth of a weight of 1
    later: float  # what the light that is left adds to the loss
    left_over: float  # light that was left where a march ended in matter, until the last sample takes it


@wp.func
def packed_end(end: RayEnd):
    return wp.vec4(end.light, end.by_depth, end.later, end.left_over)


@wp.func
def ray_end(samples: RaySamples, place: int):
    values = samples.ends[place]
    end = RayEnd()
    end.light = values[0]
    end.by_depth = values[1]
    end.later = values[2]
    end.left_over = values[3]
    return end


@wp.func
def run_before_last(samples: RaySamples, count: int, back: int):
    """The run of a ray that many before its last one; below 0: there is none."""
    size = samples.kept.shape[0]
    return (count + size - 1) // size - 1 - back


@wp.func
def kept_count(samples: RaySamples, place: int, back: int):
    """Samples of that run of a ray."""
    count = samples.counts[place]
    run = run_before_last(samples, count, back)
    if run < 0:
        return int(0)
    return wp.min(count - run * samples.kept.shape[0], samples.kept.shape[0])


@wp.func
def corner_gradient(corner: int, f: wp.vec3):
    """Derivatives of lattice/cage_map.corner_share by the place."""
    i = wp.where((corner & 4) != 0, 1.0, -1.0)
    j = wp.where((corner & 2) != 0, 1.0, -1.0)
    k = wp.where((corner & 1) != 0, 1.0, -1.0)
    x = wp.where(i > 0.0, f[0], 1.0 - f[0])
    y = wp.where(j > 0.0, f[1], 1.0 - f[1])
    z = wp.where(k > 0.0, f[2], 1.0 - f[2])
    return wp.vec3(i * y * z, x * j * z, x * y * k)


@wp.struct
class SamplePlace:
    """Where a sample is; it is to be cut into `parts`, or `filled` where there may be matter."""

    f: wp.vec3  # place in its lattice cell, 0 to 1
    side: int  # row of the edit's table of sides that has its position, -1: the nodes have it
    place: MappedPlace  # its slope: canonical length per length along the ray
    stretch: float  # of that slope
    parts: int
    filled: int
    in_cell: int  # 1: in a cell of the field's grid that holds something
    g: wp.vec3  # node coordinates in the grid


@wp.func
def sample_place(edit: EditData, grid: VoxelGrid, direction: wp.vec3, at: LatticePlace, share: float):
    """Where render/march finds a sample that is not known to be empty, with what its derivatives take."""
    found = SamplePlace()
    found.side = int(-1)
    found.stretch = float(1.0)
    place = MappedPlace()
    place.position = edit.lower + edit.fine_size * at.fine
    place.slope = direction
    if at.n >= 0 and ((at.look | edit.all_outside) & CELL_OUTSIDE) == 0:
        cells = edit.fine_width * at.fine
        f = cells - wp.vec3(wp.floor(cells[0]), wp.floor(cells[1]), wp.floor(cells[2]))
        rate = edit.inverse_spacing * direction
        if edit.by_nodes == 1:
            place = node_place(edit, at, f, rate, place)
        else:
            place = polynomial_place(edit, at, f, rate, place)
        found.f = f
        if place.mapped == 1:
            entry = entry_of_sides(edit, at.n)
            if entry != 0:
                found.side = wp.max(nearest_side(edit.sides, entry, f), entry / 8)
                place.position = wp.vec3()
                place.slope = wp.vec3()
                for corner in range(8):
                    value = edit.sides[found.side, corner]
                    position = wp.vec3(value[0], value[1], value[2])
                    place.position += corner_share(corner, f) * position
                    place.slope += wp.dot(corner_gradient(corner, f), rate) * position
            found.stretch = wp.length(place.slope)
    found.place = place
    if place.mapped == 1 and share == 1.0 and (at.look & CELL_STEEP) != 0 and found.stretch > CUT_LENGTH:
        found.parts = int(wp.min(wp.ceil(found.stretch - 1.0e-3), float(MAX_SUB_SAMPLES)))
        return found
    found.g = grid_position(grid, place.position)
    if empty_at(grid, found.g) > 0:
        return found
    found.in_cell = 1
    distance = distance_to_rest(edit, place, at.look)
    if place.mapped == 1:
        found.filled = wp.where(distance > edit.slack, 0, 1)  # not out of the rest cage
    else:
        found.filled = wp.where(distance <= 0.0, 0, 1)  # not cleared
    return found


@wp.func
def kept_place(edit: EditData, grid: VoxelGrid, direction: wp.vec3, at: LatticePlace, share: float):
    """`sample_place` of a kept sample. Rounding, which is another in each kernel, may take one out of its cell: those
    that are then in none that holds something count for nothing."""
    if is_empty(at):
        return SamplePlace()
    return sample_place(edit, grid, direction, at, share)


@wp.func
def optical_length(found: SamplePlace, share: float, options: MarchOptions):
    """Length by which a sample's density counts, world units."""
    return share * options.step * wp.where(found.place.mapped == 1 and options.arc_opacity == 1, found.stretch, 1.0)


@wp.func
def offset_in_cell(g: wp.vec3):
    return g - wp.vec3(wp.floor(g[0]), wp.floor(g[1]), wp.floor(g[2]))


@wp.func
def density_at(table: RowTable, grid: VoxelGrid, g: wp.vec3):
    """Density before the ReLU at node coordinates in a cell that holds matter."""
    i, j, k = cell_below(g)
    sigma = row_density(table.laid, table.unit, grid.density, table.columns, i, j, k, offset_in_cell(g))
    return forward_only(sigma, g)


@wp.struct
class SampleCell:
    """The cell of the field's grid that a sample is in."""

    offset: wp.vec3  # place in it, 0 to 1
    rows: eight_rows
    weights: eight_weights
    number: int  # different for each cell


@wp.func
def cell_of_sample(columns: Columns, g: wp.vec3):
    """The cell at node coordinates."""
    i, j, k = cell_below(g)
    cell = SampleCell()
    cell.offset = offset_in_cell(g)
    cell.number = (i * columns.node_counts[1] + j) * columns.node_counts[2] + k
    cell.rows = cell_rows(columns, i, j, k)
    for corner in range(8):
        cell.weights[corner] = corner_share(corner, cell.offset)
        if cell.rows[corner] >= 0 and columns.order.shape[0] > 0:
            cell.rows[corner] = columns.order[cell.rows[corner]]
    cell.weights = forward_only(cell.weights, g)
    return cell


@wp.kernel
def keep_samples(
    first: int,
    grid: VoxelGrid,
    table: RowTable,
    edit: EditData,
    rays: FrameRays,
    options: MarchOptions,
    back: int,
    samples: RaySamples,
):
    """Keep the samples of each ray's last run, and count all; of the run `back` before it, from `begins`; back -1: fill
    `begins` alone. One item per ray."""
    place = first + wp.tid()
    run = int(0)
    if back == 0:
        samples.counts[place] = 0
    elif back > 0:
        run = run_before_last(samples, samples.counts[place], back)
        if run < 0:
            return
    ray = frame_ray(rays, place)
    if ray.pixel < 0:
        return
    by_color = slope_by_color(rays.loss, ray.pixel)
    by_alpha = float(0.0)
    end = RayEnd()
    if rays.loss.alpha.shape[0] > 0:
        by_alpha = rays.loss.alpha[ray.pixel]
    if rays.loss.depth.shape[0] > 0:
        end.by_depth = rays.loss.depth[ray.pixel]
    if wp.length_sq(by_color) == 0.0 and by_alpha == 0.0 and end.by_depth == 0.0:
        return
    line = edit_line(edit, grid, ray.origin, ray.direction)
    near_far = joined_span(line.box, line.span)
    sample = ray_sample(first_sample(near_far[0] * options.inverse_step), 0.0, 1.0)
    light = float(1.0)
    depth = float(0.0)
    size = samples.kept.shape[0]
    n = run * size  # of the samples that hold matter
    last = int(1 << 30)
    if back > 0:
        begin = samples.begins[run, place]
        sample = ray_sample(begin[0], begin[1], begin[2])
        light = begin[3]
        last = n + size
    t = sample_distance(sample, options.step)
    foreseen = lattice_place(edit, grid, line, t)
    while t < near_far[1] and light > options.stop and n < last:
        at = current_place(edit, grid, line, sample, foreseen, t)
        sample.share = wp.abs(sample.share)
        after = next_sample(edit, grid, options, line, sample, at, t)
        found = SamplePlace()
        sigma = float(0.0)
        if not is_empty(at):
            found = sample_place(edit, grid, ray.direction, at, sample.share)
            if found.filled == 1:
                sigma = density_at(table, grid, found.g)
        # a GPU waits for what it reads: so the next place is read before this density
        foreseen = lattice_place(edit, grid, line, sample_distance(after, options.step))
        if found.parts > 0:
            after = ray_sample(sample.k, 0.0, -1.0 / float(found.parts))
        if sigma > 0.0:
            if back >= 0:
                samples.kept[n % size, place] = wp.vec4(sample.k + sample.j, sample.share, light, 0.0)
            if back <= 0 and n % size == 0 and n // size < samples.begins.shape[0]:
                samples.begins[n // size, place] = wp.vec4(sample.k, sample.j, sample.share, light)
            passed = wp.exp(-sigma * optical_length(found, sample.share, options))
            depth += light * (1.0 - passed) * t
            light *= passed
            n += 1
        sample = after
        t = sample_distance(sample, options.step)
    if back != 0:
        return
    samples.counts[place] = n
    opacity = 1.0 - light
    if opacity > DEPTH_MIN_ALPHA:
        end.by_depth /= opacity
        by_alpha -= end.by_depth * depth / opacity
    else:
        end.by_depth = 0.0
    end.light = light
    if light <= options.stop:
        end.left_over = light
    else:
        end.later = light * (wp.dot(rays.background, by_color) - by_alpha)
    samples.ends[place] = packed_end(end)


@wp.kernel
def find_largest(first: int, values: wp.array(dtype=int), largest: wp.array(dtype=int)):
    """largest (1,): of values; for one CPU thread."""
    wp.atomic_max(largest, 0, values[first + wp.tid()])
