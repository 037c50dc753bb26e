"""Gradient of a frame of a posed field by the positions of its map's nodes, by its camera, and by the field."""

# L depends on a ray's C = sum_k w_k c_k + T B, its opacity 1 - T and its depth. With optical depths o_k, w_k = T_k (1 -
# exp(-o_k)), and v_k what a weight of 1 at sample k adds to L: dL/do_k = T_{k+1} v_k - sum_{j>k} w_j v_j - T v_B
# (Max 1995; Plenoxels 2022, section 3.2). A sample x in the posed cage reads density and colour at the trilinear p(x) =
# sum_c a_c P_c of eight nodes, seen along s / |s|, s = dp/dt = sum_c a'_c P_c (Eq. 4), with o = sigma dt |s|: so
# dL/dP_c = a_c dL/dp + a'_c dL/ds. Samples are those of the frame, held at their distances from the camera: what enters
# or leaves the cage, ends a march or is cut into parts jumps, and counts for nothing.

import warp as wp

from ..core.atomics import GROUPS_END, add_to_cell, lane_groups, vec24
from ..core.gradients import forward
from ..edits.nodes import node_slope
from ..edits.structs import EditData
from ..field.columns import eight_rows
from ..field.grid import VoxelGrid, blended_color, eight_weights
from ..field.harmonics import sh_basis, vec16
from ..field.rows import RowTable
from ..fitting.cameras import CAMERA_NUMBERS, camera_slope
from ..fitting.loss import ROW_GRADIENT
from ..fitting.slopes import sh_basis_slope
from ..lattice.cage_map import corner_share
from ..render.march import LatticePlace, edit_line, lattice_place, ray_sample, sample_distance
from ..render.rays import MarchOptions
from .frame_samples import (
    FrameRays,
    RayEnd,
    RaySamples,
    SamplePlace,
    cell_of_sample,
    corner_gradient,
    density_at,
    frame_ray,
    kept_count,
    kept_place,
    optical_length,
    packed_end,
    ray_end,
    slope_by_color,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})


@wp.struct
class FrameSlopes:
    """What a gradient is added to; arrays without entries are left out."""

    nodes: wp.array(dtype=wp.vec3)  # (nodes,) by their positions, world units
    density: wp.array(dtype=wp.float32)  # (rows,)
    harmonics: wp.array2d(dtype=wp.float32)  # (rows, 24 or 27)
    rays: wp.array2d(dtype=wp.float32)  # (views * h * w, 7) by the camera (fitting/cameras), of each ray alone


vec10 = wp.types.vector(length=10, dtype=wp.float32)


def color_adjoint_code(width: int, parts: tuple[int, ...]) -> str:
    """C++ of `color_adjoint` for rows of a width, whose parts have so many numbers each."""
    # all loops are of known lengths, so that a GPU keeps their numbers in registers
    starts = [sum(parts[:part]) for part in range(3)]
    sums = (
        EIGHT_SUMS
        if width == 24
        else "\n".join(
            f"            for (int b = 0; b < {count}; ++b) dots[{part}] += products[{start} + b];"
            for part, (start, count) in enumerate(zip(starts, parts, strict=True))
        )
    )
    spread = "\n".join(
        f"        for (int b = 0; b < {count}; ++b) spread[{start} + b] = basis.c[b];"
        for start, count in zip(starts, parts, strict=True)
    )
    colors = "\n".join(
        f"        for (int b = 0; b < {count}; ++b) a[{part}] += basis.c[b] * blend[{start} + b];"
        for part, (start, count) in enumerate(zip(starts, parts, strict=True))
    )
    turned = "\n".join(
        f"""        for (int b = 0; b < {count}; ++b)
        {{
            const float number = by_part[{part}] * blend[{start} + b];
            x += number * basis_x.c[b];
            y += number * basis_y.c[b];
            z += number * basis_z.c[b];
        }}"""
        for part, (start, count) in enumerate(zip(starts, parts, strict=True))
    )
    return f"""
        float blend[{width}], moved[3][3] = {{}};  // rows in their weights; their parts by the place in the cell
        float spread[{width}];  // basis of each number
{spread}
        for (int n = 0; n < {width}; ++n)
            blend[n] = 0.0f;
{UNROLL}
        for (int corner = 0; corner < 8; ++corner)
        {{
            const bool is_held = rows.c[corner] >= 0;
#if !defined(__CUDA_ARCH__)  // where a row that is not weighs nothing: no branches between loads
            if (!is_held)
                continue;
#endif
            float products[{width}], dots[3] = {{}};
            {READ_ROW.format(width=width)}
            const float weight = is_held ? weights.c[corner] : 0.0f, held = is_held ? 1.0f : 0.0f;
            for (int n = 0; n < {width}; ++n)
                blend[n] += weight * row[n];
            for (int n = 0; n < {width}; ++n)
                products[n] = spread[n] * row[n];
{sums}
            const bool p = corner & 4, q = corner & 2, r = corner & 1;
            const float u = p ? offset.c[0] : 1.0f - offset.c[0], v = q ? offset.c[1] : 1.0f - offset.c[1];
            const float w = r ? offset.c[2] : 1.0f - offset.c[2];
            const float gradient[3] = {{p ? v * w : -v * w, q ? u * w : -u * w, r ? u * v : -u * v}};
            for (int part = 0; part < 3; ++part)
                for (int axis = 0; axis < 3; ++axis)
                    moved[part][axis] += held * gradient[axis] * dots[part];
        }}
        float a[3] = {{}};
{colors}
        const bool luminous = {width} == 24;
        const float colors[3] = {{luminous ? a[0] + a[1] - 0.5f * a[2] : a[0], luminous ? a[0] + a[2] : a[1],
            luminous ? a[0] - a[1] - 0.5f * a[2] : a[2]}};
        result.c[6] = 0.0f;
        for (int channel = 0; channel < 3; ++channel)
        {{
            const float color = colors[channel] + 0.5f, passed = color > 0.0f ? by_color.c[channel] : 0.0f;
            result.c[6] += passed * color;
            result.c[7 + channel] = passed;
        }}
        const float red = result.c[7], green = result.c[8], blue = result.c[9];
        const float by_part[3] = {{luminous ? red + green + blue : red, luminous ? red - blue : green,
            luminous ? green - 0.5f * (red + blue) : blue}};
        for (int axis = 0; axis < 3; ++axis)
            result.c[axis] = by_part[0] * moved[0][axis] + by_part[1] * moved[1][axis] + by_part[2] * moved[2][axis];
        float x = 0.0f, y = 0.0f, z = 0.0f;
{turned}
        result.c[3] = x;
        result.c[4] = y;
        result.c[5] = z;
"""


#: C++ before a loop that a GPU is to unroll.
UNROLL = """#if defined(__CUDA_ARCH__)
        #pragma unroll
#endif"""

#: C++ that adds up the `products` of parts of 16, 4 and 4 numbers, side by side, as a CPU can.
EIGHT_SUMS = """            float eight[8];
            for (int lane = 0; lane < 8; ++lane)
                eight[lane] = products[lane] + products[8 + lane];
            dots[0] = ((eight[0] + eight[4]) + (eight[1] + eight[5])) + ((eight[2] + eight[6]) + (eight[3] + eight[7]));
            dots[1] = (products[16] + products[17]) + (products[18] + products[19]);
            dots[2] = (products[20] + products[21]) + (products[22] + products[23]);"""

#: C++ that reads the `row` of a corner, or the first one where it has none.
READ_ROW = """const float* from = sh.data + (size_t)(is_held ? rows.c[corner] : 0) * {width};
#if defined(__CUDA_ARCH__)
            float row[{width}];
            if ({width} % 4 == 0 && ((size_t)sh.data & 15) == 0)
                #pragma unroll
                for (int n = 0; n < {width} / 4; ++n)
                {{
                    const float4 four = reinterpret_cast<const float4*>(from)[n];
                    row[4 * n] = four.x;
                    row[4 * n + 1] = four.y;
                    row[4 * n + 2] = four.z;
                    row[4 * n + 3] = four.w;
                }}
            else
                for (int n = 0; n < {width}; ++n)
                    row[n] = from[n];
#else
            const float* row = from;
#endif"""


# parts of 16, 4 and 4 numbers are luminance, orange and green; of 9 each red, green and blue
@forward.func_native(
    """
    wp::vec_t<10, wp::float32> result;
    if (sh.shape[1] == 24)
    {
"""
    + color_adjoint_code(24, (16, 4, 4))
    + """
    }
    else
    {
"""
    + color_adjoint_code(27, (9, 9, 9))
    + """
    }
    return result;
"""
)
def color_adjoint(
    sh: wp.array2d(dtype=wp.float32),
    rows: eight_rows,
    weights: eight_weights,
    offset: wp.vec3,
    basis: vec16,
    basis_x: vec16,
    basis_y: vec16,
    basis_z: vec16,
    by_color: wp.vec3,
) -> vec10:
    """Derivatives of dot(by_color, colour) of a blend of the eight rows of a cell by the place in it (3) and by the
    direction (3); that number; and by_color without channels that the clamp at zero holds (3)."""
    ...


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
    found: SamplePlace,
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
    changes = vec24()
    for corner in range(8):
        gradient = corner_gradient(corner, found.f)
        change = corner_share(corner, found.f) * by_position + wp.dot(gradient, rate) * by_slope
        for axis in range(3):
            changes[3 * corner + axis] = change[axis]
        if slopes.rays.shape[0] > 0:
            value = edit.nodes[node_of_corner(edit, at.n, corner)]
            if found.side >= 0:
                value = edit.sides[found.side, corner]
            position = wp.vec3(value[0], value[1], value[2])
            moved += wp.dot(position, by_position) * gradient
            turned += wp.dot(position, by_slope) * gradient
    if slopes.nodes.shape[0] > 0:
        add_to_cell(slopes.nodes, at.n, edit.node_counts, changes)
    if slopes.rays.shape[0] > 0:
        moved += map_curvature(edit, edit.fine_width * at.fine, rate, by_slope)
    by_ray.origin += edit.inverse_spacing * moved
    by_ray.direction += edit.inverse_spacing * (t * moved + turned)
    return by_ray


@forward.func_native(
    ROW_GRADIENT
    + """
    float own[36] = {};  // numbers of a row, slope by density, weights of the corners
    const int width = grad_sh.shape[1];
    for (int n = 0; n < (luminous ? 24 : 27); ++n)
        own[n] = gradient[n];
    own[27] = by_density;
    for (int corner = 0; corner < 8; ++corner)
        own[28 + corner] = weights.c[corner];
#if defined(__CUDA_ARCH__)
    const int key = cell;
"""
    + lane_groups(36)
    + """
        for (int corner = 0; corner < 8; ++corner)
        {
            const int row = __shfl_sync(active, rows.c[corner], leader);
            if (row < 0)
                continue;
            for (int n = rank; n <= width; n += size)
            {
                float total = 0.0f;
                for (unsigned left = group; left; left &= left - 1u)
                {
                    const float* numbers = kept + (__ffs(left) - 1) * stride;
                    total += numbers[28 + corner] * numbers[n < width ? n : 27];
                }
                atomicAdd(n < width ? grad_sh.data + (size_t)row * width + n : grad_density.data + row, total);
            }
        }
"""
    + GROUPS_END
    + """
#else
    for (int corner = 0; corner < 8; ++corner)
        if (rows.c[corner] >= 0)
        {
            float* sums = grad_sh.data + (size_t)rows.c[corner] * width;
            if (luminous)
                for (int n = 0; n < 24; ++n)
                    sums[n] += weights.c[corner] * own[n];
            else
                for (int n = 0; n < 27; ++n)
                    sums[n] += weights.c[corner] * own[n];
            grad_density.data[rows.c[corner]] += weights.c[corner] * by_density;
        }
#endif
"""
)
def add_to_rows(
    grad_density: wp.array(dtype=wp.float32),
    grad_sh: wp.array2d(dtype=wp.float32),
    cell: int,
    rows: eight_rows,
    weights: eight_weights,
    basis: vec16,
    change: wp.vec3,
    by_density: float,
):
    """Add the gradient by the density and the numbers of eight rows, those of a cell. change: by red, green, blue."""
    ...


@wp.func
def shown_value(color: wp.vec3, t: float, by_color: wp.vec3, by_depth: float):
    """What a weight of 1 of a sample adds to the loss."""
    return wp.dot(by_color, wp.max(color, wp.vec3())) + t * by_depth


@wp.func
def seen_along(found: SamplePlace, direction: wp.vec3):
    """Unit direction along which a sample is seen in canonical space."""
    if found.stretch > 1.0e-6:
        return found.place.slope / found.stretch
    return direction


@wp.kernel
def weigh_samples(
    first: int,
    grid: VoxelGrid,
    table: RowTable,
    edit: EditData,
    rays: FrameRays,
    options: MarchOptions,
    back: int,
    samples: RaySamples,
):
    """Note what a weight of 1 of each kept sample adds to the loss. One item per slot of the table and ray."""
    item = first + wp.tid()
    place = item % samples.counts.shape[0]
    slot = item // samples.counts.shape[0]
    if slot >= kept_count(samples, place, back):
        return
    kept = samples.kept[slot, place]
    ray = frame_ray(rays, place)
    line = edit_line(edit, grid, ray.origin, ray.direction)
    t = sample_distance(ray_sample(kept[0], 0.0, kept[1]), options.step)
    found = kept_place(edit, grid, ray.direction, lattice_place(edit, grid, line, t), kept[1])
    if found.in_cell == 0:
        return
    cell = cell_of_sample(table.columns, found.g)
    color = blended_color(grid.sh, cell.rows, cell.weights, sh_basis(seen_along(found, ray.direction)))
    kept[3] = shown_value(color, t, slope_by_color(rays.loss, ray.pixel), ray_end(samples, place).by_depth)
    samples.kept[slot, place] = kept


@wp.func
def optical_slope(end: RayEnd, value: float):
    """Derivative by the optical depth of the sample before `end`."""
    return end.light * value - end.later


@wp.func
def end_before(end: RayEnd, light: float, value: float):
    """The end of a ray before its last sample, which `light` reaches."""
    end.later += (light - end.light) * value
    end.light = light
    return end


@wp.func
def with_left_over(end: RayEnd, value: float):
    """An end whose march ended in matter: sooner or later moves what it leaves back and forth, while the light ends
    there."""
    end.later += end.left_over * value
    end.left_over = 0.0
    return end


@wp.kernel
def sum_samples(first: int, back: int, samples: RaySamples):
    """Change what each kept sample shows to the derivative of the loss by its optical depth. One item per ray."""
    place = first + wp.tid()
    slot = kept_count(samples, place, back) - 1
    if slot < 0:
        return
    end = ray_end(samples, place)
    while slot >= 0:
        kept = samples.kept[slot, place]
        value = kept[3]
        end = with_left_over(end, value)
        kept[3] = optical_slope(end, value)
        samples.kept[slot, place] = kept
        end = end_before(end, kept[2], value)
        slot -= 1
    samples.ends[place] = packed_end(end)


@wp.kernel
def accumulate_frame_gradient(
    first: int,
    groups: int,
    grid: VoxelGrid,
    table: RowTable,
    edit: EditData,
    rays: FrameRays,
    options: MarchOptions,
    back: int,
    samples: RaySamples,
    slopes: FrameSlopes,
):
    """Add the gradient of the loss by the kept samples to `slopes`. One item per group of slots and ray; of one group,
    without `weigh_samples` and `sum_samples`. Nodes and rows are shared: for CPU threads that have their own."""
    item = first + wp.tid()
    place = item % samples.counts.shape[0]
    group = item // samples.counts.shape[0]
    slot = kept_count(samples, place, back) - 1
    if slot < group:
        return
    slot -= (slot - group) % groups
    ray = frame_ray(rays, place)
    line = edit_line(edit, grid, ray.origin, ray.direction)
    by_color = slope_by_color(rays.loss, ray.pixel)
    end = ray_end(samples, place)
    by_ray = RaySlopes()
    while slot >= 0:
        kept = samples.kept[slot, place]
        share = kept[1]
        t = sample_distance(ray_sample(kept[0], 0.0, share), options.step)
        at = lattice_place(edit, grid, line, t)
        found = kept_place(edit, grid, ray.direction, at, share)
        if found.in_cell == 0:
            if groups == 1:
                end = end_before(end, kept[2], 0.0)
            slot -= groups
            continue
        cell = cell_of_sample(table.columns, found.g)
        length = optical_length(found, share, options)
        sigma = density_at(table, grid, found.g)
        weight = kept[2] * (1.0 - wp.exp(-sigma * length))
        along = seen_along(found, ray.direction)
        basis = sh_basis(along)
        held = color_adjoint(
            grid.sh,
            cell.rows,
            cell.weights,
            cell.offset,
            basis,
            sh_basis_slope(along, 0),
            sh_basis_slope(along, 1),
            sh_basis_slope(along, 2),
            by_color,
        )
        by_optical = kept[3]
        if groups == 1:
            value = held[6] + t * end.by_depth
            end = with_left_over(end, value)
            by_optical = optical_slope(end, value)
            end = end_before(end, kept[2], value)
        by_place = weight * wp.vec3(held[0], held[1], held[2])
        for corner in range(8):
            if cell.rows[corner] >= 0:
                density = grid.density[cell.rows[corner]]
                by_place += (by_optical * length * density) * corner_gradient(corner, cell.offset)
        by_slope = wp.vec3()
        if found.stretch > 1.0e-6:
            by_along = weight * wp.vec3(held[3], held[4], held[5])
            by_slope = (by_along - wp.dot(by_along, along) * along) / found.stretch
        if found.place.mapped == 1 and options.arc_opacity == 1:
            by_slope += by_optical * sigma * share * options.step * along
        by_position = wp.cw_mul(by_place, grid.inverse_voxel_size)
        by_ray = add_place_slopes(edit, at, found, ray.direction, t, by_position, by_slope, slopes, by_ray)
        if slopes.density.shape[0] > 0:
            passed = weight * wp.vec3(held[7], held[8], held[9])
            add_to_rows(
                slopes.density,
                slopes.harmonics,
                cell.number,
                cell.rows,
                cell.weights,
                basis,
                passed,
                by_optical * length,
            )
        slot -= groups
    if groups == 1:
        samples.ends[place] = packed_end(end)
    if slopes.rays.shape[0] > 0:
        for number in range(CAMERA_NUMBERS):
            origin_change, direction_change = camera_slope(rays.cameras[ray.view], ray.direction, number, 1.0)
            change = wp.dot(by_ray.origin, origin_change) + wp.dot(by_ray.direction, direction_change)
            wp.atomic_add(slopes.rays, ray.pixel, number, change)


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
