"""Gradient of a frame of a posed field by the positions of its map's nodes, by its camera, and by the field."""

# L depends on a ray's C = sum_k w_k c_k + T B, its opacity 1 - T and its depth. With optical depths o_k, w_k = T_k (1 -
# exp(-o_k)), and v_k what a weight of 1 at sample k adds to L: dL/do_k = T_{k+1} v_k - sum_{j>k} w_j v_j - T v_B
# (Max 1995; Plenoxels 2022, section 3.2). A sample x in the posed cage reads density and colour at the trilinear p(x) =
# sum_c a_c P_c of eight nodes, seen along s / |s|, s = dp/dt = sum_c a'_c P_c (Eq. 4), with o = sigma dt |s|: so
# dL/dP_c = a_c dL/dp + a'_c dL/ds. Samples are those of the frame, held at their distances from the camera: what enters
# or leaves the cage, ends a march or is cut into parts jumps, and counts for nothing.

import warp as wp

from ..core.gradients import forward, forward_only_in
from ..edits.nodes import node_slope
from ..edits.structs import CELL_OUTSIDE, CELL_STEEP, CUT_LENGTH, EditData, entry_of_sides
from ..field.columns import Columns, cell_rows, eight_rows
from ..field.grid import VoxelGrid, cell_below, eight_weights, first_sample, grid_position
from ..field.harmonics import sh_basis, vec16
from ..field.march import DEPTH_MIN_ALPHA
from ..fitting.cameras import CAMERA_NUMBERS, camera_slope
from ..fitting.loss import add_color_gradient
from ..fitting.slopes import sh_basis_slope
from ..lattice.cage_map import corner_share, nearest_side
from ..render.march import (
    EditLine,
    LatticePlace,
    MappedPlace,
    distance_to_rest,
    edit_line,
    empty_at,
    is_empty,
    lattice_place,
    next_sample,
    node_place,
    ray_sample,
    sample_distance,
)
from ..render.rays import MAX_SUB_SAMPLES, MarchOptions
from ..view.rays import PinholeCamera, joined_span, pixel_direction, tile_pixel

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})

forward_only = forward_only_in(__name__, (float, wp.vec3))

#: Samples of a ray that are kept on its way; of one with more, the backward pass looks for runs of as many again.
MAX_KEPT = wp.constant(48)

kept_numbers = wp.types.vector(length=48, dtype=wp.float32)


@wp.struct
class FrameLoss:
    """Derivatives of a loss by the arrays of frames, (views * h * w,) each; none where it does not depend on them."""

    rgb: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)


@wp.struct
class FrameSlopes:
    """What a gradient is added to; arrays without entries are left out."""

    nodes: wp.array(dtype=wp.vec3)  # (nodes,) by their positions, world units
    density: wp.array(dtype=wp.float32)  # (rows,)
    harmonics: wp.array2d(dtype=wp.float32)  # (rows, 24 or 27)
    rays: wp.array2d(dtype=wp.float32)  # (views * h * w, 7) by the camera (fitting/cameras), of each ray alone


vec15 = wp.types.vector(length=15, dtype=wp.float32)


@forward.func_native("""
    const int width = sh.shape[1];
    const bool luminous = width == 24;
    // parts of 16, 4 and 4 numbers are luminance, orange and green; of 9 each red, green and blue
    const int most[3] = {luminous ? 16 : 9, luminous ? 4 : 9, luminous ? 4 : 9};
    float spread[27], blend[27], dots[8][3];  // basis of each number; their blend; sums of each corner's parts
    for (int b = 0; b < 16; ++b)
        if (luminous)
        {
            spread[b] = basis.c[b];
            if (b < 4)
                spread[16 + b] = spread[20 + b] = basis.c[b];
        }
        else if (b < 9)
            spread[b] = spread[9 + b] = spread[18 + b] = basis.c[b];
    for (int n = 0; n < 27; ++n)
        blend[n] = 0.0f;
    for (int corner = 0; corner < 8; ++corner)
    {
        dots[corner][0] = dots[corner][1] = dots[corner][2] = 0.0f;
        if (rows.c[corner] < 0)
            continue;
        const float* row = sh.data + (size_t)rows.c[corner] * width;
        const float weight = weights.c[corner];
        float held[27], parts[27];
#if defined(__CUDA_ARCH__)
        if (luminous && ((size_t)row & 15) == 0)  // a quarter of the loads, which bound it
            for (int n = 0; n < 6; ++n)
            {
                const float4 four = ((const float4*)row)[n];
                held[4 * n] = four.x;
                held[4 * n + 1] = four.y;
                held[4 * n + 2] = four.z;
                held[4 * n + 3] = four.w;
            }
        else
#endif
            for (int n = 0; n < 24; ++n)
                held[n] = row[n];
        for (int n = 24; n < 27; ++n)
            held[n] = luminous ? 0.0f : row[n];
        for (int n = 0; n < 27; ++n)
        {
            blend[n] += weight * held[n];
            parts[n] = luminous && n > 23 ? 0.0f : spread[n] * held[n];
        }
        if (luminous)
        {
            float eight[8];
            for (int lane = 0; lane < 8; ++lane)
                eight[lane] = parts[lane] + parts[8 + lane];
            dots[corner][0] = ((eight[0] + eight[4]) + (eight[1] + eight[5])) +
                ((eight[2] + eight[6]) + (eight[3] + eight[7]));
            dots[corner][1] = (parts[16] + parts[17]) + (parts[18] + parts[19]);
            dots[corner][2] = (parts[20] + parts[21]) + (parts[22] + parts[23]);
        }
        else
            for (int part = 0; part < 3; ++part)
                for (int b = 0; b < 9; ++b)
                    dots[corner][part] += parts[9 * part + b];
    }
    float a[3] = {0.0f, 0.0f, 0.0f};
    for (int corner = 0; corner < 8; ++corner)
        for (int part = 0; part < 3; ++part)
            a[part] += weights.c[corner] * dots[corner][part];
    const float colors[3] = {luminous ? a[0] + a[1] - 0.5f * a[2] : a[0], luminous ? a[0] + a[2] : a[1],
        luminous ? a[0] - a[1] - 0.5f * a[2] : a[2]};
    wp::vec_t<15, wp::float32> result;
    result.c[11] = 0.0f;
    for (int channel = 0; channel < 3; ++channel)
    {
        const float color = colors[channel] + 0.5f, passed = color > 0.0f ? by_color.c[channel] : 0.0f;
        result.c[11] += passed * color;
        result.c[12 + channel] = passed;
    }
    const float red = result.c[12], green = result.c[13], blue = result.c[14];
    const float by_part[3] = {luminous ? red + green + blue : red, luminous ? red - blue : green,
        luminous ? green - 0.5f * (red + blue) : blue};
    for (int corner = 0; corner < 8; ++corner)
        result.c[corner] = by_part[0] * dots[corner][0] + by_part[1] * dots[corner][1] + by_part[2] * dots[corner][2];
    float x = 0.0f, y = 0.0f, z = 0.0f;
    for (int part = 0, n = 0; part < 3; ++part)
        for (int b = 0; b < most[part]; ++b, ++n)
        {
            const float turned = by_part[part] * blend[n];
            x += turned * basis_x.c[b];
            y += turned * basis_y.c[b];
            z += turned * basis_z.c[b];
        }
    result.c[8] = x;
    result.c[9] = y;
    result.c[10] = z;
    return result;
""")
def color_adjoint(
    sh: wp.array2d(dtype=wp.float32),
    rows: eight_rows,
    weights: eight_weights,
    basis: vec16,
    basis_x: vec16,
    basis_y: vec16,
    basis_z: vec16,
    by_color: wp.vec3,
) -> vec15:
    """Derivatives of dot(by_color, colour) of a blend of eight rows by its eight weights and by the direction (3); that
    number; and by_color without channels that the clamp at zero holds (3)."""
    ...


@wp.struct
class FoundSample:
    """A sample that holds matter, or is to be cut into `parts` that may."""

    f: wp.vec3  # place in its lattice cell, 0 to 1
    side: int  # row of the edit's table of sides that has its position, -1: the nodes have it
    place: MappedPlace  # its slope: canonical length per length along the ray
    stretch: float  # of that slope
    parts: int
    offset: wp.vec3  # place in its cell of the field's grid, 0 to 1
    rows: eight_rows
    weights: eight_weights
    sigma: float  # 0: nothing is drawn there


@wp.func
def trilinear_shares(offset: wp.vec3):
    """Weights of the eight corners of a cell at a place in it, 0 to 1."""
    shares = eight_weights()
    for corner in range(8):
        shares[corner] = corner_share(corner, offset)
    return shares


@wp.func
def found_sample(
    edit: EditData,
    grid: VoxelGrid,
    columns: Columns,
    line: EditLine,
    direction: wp.vec3,
    at: LatticePlace,
    share: float,
):
    """What render/march finds at a place that is not known to be empty, with what its derivatives take."""
    found = FoundSample()
    found.side = int(-1)
    found.stretch = float(1.0)
    place = MappedPlace()
    place.position = edit.lower + edit.fine_size * at.fine
    place.slope = direction
    if at.n >= 0 and ((at.look | edit.all_outside) & CELL_OUTSIDE) == 0:
        cells = edit.fine_width * at.fine
        f = cells - wp.vec3(wp.floor(cells[0]), wp.floor(cells[1]), wp.floor(cells[2]))
        rate = edit.inverse_spacing * direction
        place = node_place(edit, at, f, rate, place)
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
    g = grid_position(grid, place.position)
    if empty_at(grid, g) > 0:
        return found
    distance = distance_to_rest(edit, place, at.look)
    if place.mapped == 1 and distance > edit.slack:
        return found  # out of the rest cage
    if place.mapped == 0 and distance <= 0.0:
        return found  # cleared
    i, j, k = cell_below(g)
    rows = cell_rows(columns, i, j, k)
    offset = g - wp.vec3(float(i), float(j), float(k))
    weights = trilinear_shares(offset)
    sigma = float(0.0)
    for corner in range(8):
        if rows[corner] >= 0:
            if columns.order.shape[0] > 0:
                rows[corner] = columns.order[rows[corner]]
            sigma += weights[corner] * grid.density[rows[corner]]
    found.offset = offset
    found.rows = rows
    found.weights = weights
    found.sigma = forward_only(sigma, g)
    return found


@wp.func
def optical_length(found: FoundSample, share: float, options: MarchOptions):
    """Length by which a sample's density counts, world units."""
    return share * options.step * wp.where(found.place.mapped == 1 and options.arc_opacity == 1, found.stretch, 1.0)


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


@wp.func
def slope_at(edit: EditData, cells: wp.vec3, rate: wp.vec3):
    """Derivative of the map at a place in lattice cells, which moves at `rate`."""
    nz = edit.node_counts[2]
    i = wp.clamp(int(wp.floor(cells[0])), 0, edit.node_counts[0] - 2)
    j = wp.clamp(int(wp.floor(cells[1])), 0, edit.node_counts[1] - 2)
    k = wp.clamp(int(wp.floor(cells[2])), 0, nz - 2)
    f = cells - wp.vec3(float(i), float(j), float(k))
    return node_slope(edit.nodes, (i * edit.node_counts[1] + j) * nz + k, edit.node_counts[1] * nz, nz, f, rate)


@wp.func
def map_curvature(edit: EditData, cells: wp.vec3, rate: wp.vec3, by_slope: wp.vec3):
    """Derivatives by the place, in cells, of dot(slope_at, by_slope), over half a cell to each side."""
    # within a cell there is none of a cube's bend: it lies in the jumps between cells
    x = wp.vec3(0.5, 0.0, 0.0)
    y = wp.vec3(0.0, 0.5, 0.0)
    z = wp.vec3(0.0, 0.0, 0.5)
    return wp.vec3(
        wp.dot(slope_at(edit, cells + x, rate) - slope_at(edit, cells - x, rate), by_slope),
        wp.dot(slope_at(edit, cells + y, rate) - slope_at(edit, cells - y, rate), by_slope),
        wp.dot(slope_at(edit, cells + z, rate) - slope_at(edit, cells - z, rate), by_slope),
    )


@wp.func
def node_of_corner(edit: EditData, n: int, corner: int):
    """Number of the node at a corner of the cell above node n."""
    nz = edit.node_counts[2]
    return n + ((corner >> 2) * edit.node_counts[1] + ((corner >> 1) & 1)) * nz + (corner & 1)


@wp.struct
class RaySlopes:
    """Derivatives of a loss by a ray's origin and its unit direction."""

    origin: wp.vec3
    direction: wp.vec3


@wp.func
def add_place_slopes(
    edit: EditData,
    at: LatticePlace,
    found: FoundSample,
    direction: wp.vec3,
    t: float,
    by_position: wp.vec3,
    by_slope: wp.vec3,
    slopes: FrameSlopes,
    by_ray: RaySlopes,
):
    """Add the derivatives by a sample's canonical position and by that along the ray to its cell's nodes.
    Returns by_ray with those by the ray added."""
    if found.place.mapped == 0:
        by_ray.origin += by_position
        by_ray.direction += t * by_position + by_slope
        return by_ray
    rate = edit.inverse_spacing * direction
    moved = wp.vec3()
    turned = wp.vec3()
    for corner in range(8):
        gradient = corner_gradient(corner, found.f)
        node = node_of_corner(edit, at.n, corner)
        if slopes.nodes.shape[0] > 0:
            share = corner_share(corner, found.f)
            wp.atomic_add(slopes.nodes, node, share * by_position + wp.dot(gradient, rate) * by_slope)
        if slopes.rays.shape[0] > 0:
            value = edit.nodes[node]
            if found.side >= 0:
                value = edit.sides[found.side, corner]
            position = wp.vec3(value[0], value[1], value[2])
            moved += wp.dot(position, by_position) * gradient
            turned += wp.dot(position, by_slope) * gradient
    if slopes.rays.shape[0] > 0:
        moved += map_curvature(edit, edit.fine_width * at.fine, rate, by_slope)
    by_ray.origin += edit.inverse_spacing * moved
    by_ray.direction += edit.inverse_spacing * (t * moved + turned)
    return by_ray


@wp.kernel
def accumulate_frame_gradient(
    first: int,
    grid: VoxelGrid,
    columns: Columns,
    edit: EditData,
    cameras: wp.array(dtype=PinholeCamera),
    view_rays: int,
    background: wp.vec3,
    options: MarchOptions,
    loss: FrameLoss,
    slopes: FrameSlopes,
):
    """Add the gradient of a loss of frames of one edit and size to `slopes`. One item per ray, tile by tile, each view
    `view_rays`. Nodes and rows are shared: for CPU threads that have arrays of their own."""
    item = first + wp.tid()
    view = item // view_rays
    camera = cameras[view]
    column, row = tile_pixel(item - view * view_rays, camera.width)
    if column >= camera.width or row >= camera.height:
        return
    pixel = (view * camera.height + row) * camera.width + column
    by_color = wp.vec3()
    by_alpha = float(0.0)
    by_depth = float(0.0)
    if loss.rgb.shape[0] > 0:
        by_color = loss.rgb[pixel]
    if loss.alpha.shape[0] > 0:
        by_alpha = loss.alpha[pixel]
    if loss.depth.shape[0] > 0:
        by_depth = loss.depth[pixel]
    if wp.length_sq(by_color) == 0.0 and by_alpha == 0.0 and by_depth == 0.0:
        return
    direction = pixel_direction(camera, column, row)
    line = edit_line(edit, grid, camera.center, direction)
    near_far = joined_span(line.box, line.span)
    sample = ray_sample(first_sample(near_far[0] * options.inverse_step), 0.0, 1.0)
    places = kept_numbers()  # of the samples of a run that hold matter: where they are, their share of a sample
    shares = kept_numbers()
    lights = kept_numbers()  # and the light that reaches them
    begin_places = kept_numbers()  # the same of the first ones of runs
    begin_shares = kept_numbers()
    begin_lights = kept_numbers()
    light = float(1.0)
    depth = float(0.0)
    later = float(0.0)  # what the light behind a sample adds to the loss
    left_over = float(0.0)  # of a march that ended in matter
    by_ray = RaySlopes()
    n = int(0)  # of the samples that hold matter
    run = int(-1)  # whose samples are kept; the first march keeps those of the last
    while run != 0:
        t = sample_distance(sample, options.step)
        while t < near_far[1] and light > options.stop and (run < 0 or n < run * MAX_KEPT):
            at = lattice_place(edit, grid, line, t)
            sample.share = wp.abs(sample.share)
            after = next_sample(edit, grid, options, line, sample, at, t)
            if not is_empty(at):
                found = found_sample(edit, grid, columns, line, direction, at, sample.share)
                if found.parts > 0:
                    after = ray_sample(sample.k, 0.0, -1.0 / float(found.parts))
                if found.sigma > 0.0:
                    slot = n % MAX_KEPT
                    places[slot] = sample.k + sample.j
                    shares[slot] = sample.share
                    lights[slot] = light
                    if slot == 0 and n // MAX_KEPT < MAX_KEPT:
                        begin_places[n // MAX_KEPT] = places[slot]
                        begin_shares[n // MAX_KEPT] = shares[slot]
                        begin_lights[n // MAX_KEPT] = light
                    kept = wp.exp(-found.sigma * optical_length(found, sample.share, options))
                    depth += light * (1.0 - kept) * t
                    light *= kept
                    n += 1
            sample = after
            t = sample_distance(sample, options.step)
        if run < 0:
            run = (n + MAX_KEPT - 1) // MAX_KEPT
            opacity = 1.0 - light
            if opacity > DEPTH_MIN_ALPHA:
                by_depth = by_depth / opacity
                by_alpha -= by_depth * depth / opacity
            else:
                by_depth = 0.0
            if light <= options.stop:
                left_over = light
            else:
                later = light * (wp.dot(background, by_color) - by_alpha)
        while n > (run - 1) * MAX_KEPT and run > 0:
            n -= 1
            slot = n % MAX_KEPT
            share = shares[slot]
            t = sample_distance(ray_sample(places[slot], 0.0, share), options.step)
            at = lattice_place(edit, grid, line, t)
            found = found_sample(edit, grid, columns, line, direction, at, share)
            length = optical_length(found, share, options)
            kept = wp.exp(-found.sigma * length)
            weight = lights[slot] * (1.0 - kept)
            along = direction
            if found.stretch > 1.0e-6:
                along = found.place.slope / found.stretch
            basis = sh_basis(along)
            held = color_adjoint(
                grid.sh,
                found.rows,
                found.weights,
                basis,
                sh_basis_slope(along, 0),
                sh_basis_slope(along, 1),
                sh_basis_slope(along, 2),
                by_color,
            )
            value = held[11] + t * by_depth
            # that a march ends sooner or later moves what it leaves back and forth, while the light ends in matter
            later += left_over * value
            left_over = 0.0
            by_optical = lights[slot] * kept * value - later
            later += weight * value
            by_place = wp.vec3()
            for corner in range(8):
                if found.rows[corner] >= 0:
                    by_share = weight * held[corner] + by_optical * length * grid.density[found.rows[corner]]
                    by_place += by_share * corner_gradient(corner, found.offset)
            by_slope = wp.vec3()
            if found.stretch > 1.0e-6:
                by_along = weight * wp.vec3(held[8], held[9], held[10])
                by_slope = (by_along - wp.dot(by_along, along) * along) / found.stretch
            if found.place.mapped == 1 and options.arc_opacity == 1:
                by_slope += by_optical * found.sigma * share * options.step * along
            by_position = wp.cw_mul(by_place, grid.inverse_voxel_size)
            by_ray = add_place_slopes(edit, at, found, direction, t, by_position, by_slope, slopes, by_ray)
            if slopes.density.shape[0] > 0:
                for corner in range(8):
                    if found.rows[corner] >= 0:
                        change = found.weights[corner] * by_optical * length
                        wp.atomic_add(slopes.density, found.rows[corner], change)
                passed = weight * wp.vec3(held[12], held[13], held[14])
                add_color_gradient(slopes.harmonics, found.rows, found.weights, basis, passed)
        run = wp.max(run - 1, 0)
        if run > 0:  # the run before: march again, from the nearest known beginning
            begin = wp.min(run, MAX_KEPT) - 1
            n = begin * MAX_KEPT
            sample = ray_sample(begin_places[begin], 0.0, begin_shares[begin])
            light = begin_lights[begin]
    if slopes.rays.shape[0] > 0:
        for number in range(CAMERA_NUMBERS):
            origin_change, direction_change = camera_slope(camera, direction, number, 1.0)
            change = wp.dot(by_ray.origin, origin_change) + wp.dot(by_ray.direction, direction_change)
            slopes.rays[pixel, number] = change


@wp.kernel
def sum_runs(first: int, values: wp.array2d(dtype=wp.float32), run: int, sums: wp.array2d(dtype=wp.float32)):
    """sums: (runs, n) of each run of rows of values (m, n); one item per sum."""
    item = first + wp.tid()
    place = item // sums.shape[1]
    number = item % sums.shape[1]
    total = float(0.0)
    for n in range(place * run, wp.min((place + 1) * run, values.shape[0])):
        total += values[n, number]
    sums[place, number] = total
