"""The photometric gradient of fitting/loss, for CUDA: one warp per ray, one lane per coefficient.

The sums are those of accumulate_photometric_gradient there, which documents them. The densities of 32 successive
samples are looked up at once, one per lane. Then the samples that hold matter are taken one by one: 24 neighbouring
lanes read the 24 coefficients of a voxel and add their gradients, so that a voxel's row is one run of memory instead of
24 scattered numbers. (Lanes for coefficients: Plenoxels 2022, in its CUDA code.)
Needs: core/lanes, field/grid, field/harmonics, field/samples, fitting/loss, fitting/rmsprop.
"""

import warp as wp

from ..core.lanes import ballot, from_lane, index_from_lane, lowest_bit, without_lowest_bit
from ..field.grid import CellSample, VoxelGrid, cell_density, cell_sample, empty_distance
from ..field.harmonics import DIFFERENCE_BASIS, LUMINANCE_BASIS, luminance_colour, sh_basis
from ..field.samples import grid_ray, sample_beyond, sample_distance, sample_place
from .loss import TrainingRays, background_behind, batch_pixel, in_picture, subray_direction, training_colour
from .rmsprop import COEFFICIENTS, GRADIENT_ROW, gradient_place

wp.set_module_options({"enable_backward": False, "block_dim": 128})
LANES = wp.constant(32)

#: Where a filled cell is at most this many cells away, the densities of the next samples are asked at once.
NEAR = wp.constant(4)

#: Sample at which a march has nothing to do.
BEYOND = wp.constant(1 << 28)


@wp.func
def sum_before(value: float, lane: int):
    """Sum of the values of the lanes before this one."""
    total = float(value)
    for i in range(5):
        other = from_lane(total, wp.max(lane - (1 << i), 0))
        if lane >= (1 << i):
            total += other
    return total - value


@wp.func
def part_sums(value: float, lane: int):
    """Sums over the lanes of luminance (0 to 15), orange (16 to 19) and green (20 to 23), in each lane."""
    total = value + from_lane(value, lane ^ 1)
    total += from_lane(total, lane ^ 2)
    luminance = total + from_lane(total, lane ^ 4)
    luminance += from_lane(luminance, lane ^ 8)
    return wp.vec3(from_lane(luminance, 0), from_lane(total, 16), from_lane(total, 20))


@wp.func
def over_channels(value: float):
    """Sum of what the first three lanes hold: red, green and blue."""
    return from_lane(value, 0) + from_lane(value, 1) + from_lane(value, 2)


@wp.func
def channels(value: float):
    """What the first three lanes hold."""
    return wp.vec3(from_lane(value, 0), from_lane(value, 1), from_lane(value, 2))


@wp.func
def corner_weight(f: wp.vec3, corner: int):
    """Trilinear weight of a corner of a cell. f: place within it."""
    wx = wp.where((corner >> 2) == 1, f[0], 1.0 - f[0])
    wy = wp.where(((corner >> 1) & 1) == 1, f[1], 1.0 - f[1])
    wz = wp.where((corner & 1) == 1, f[2], 1.0 - f[2])
    return wx * wy * wz


@wp.func
def pick(v: wp.vec3, channel: int):
    return wp.where(channel == 0, v[0], wp.where(channel == 1, v[1], v[2]))


@wp.func
def part_gradient(change: wp.vec3, lane: int):
    """Gradient by the part of a colour that a lane's coefficient belongs to. change: by red, green and blue."""
    if lane < LUMINANCE_BASIS:
        return change[0] + change[1] + change[2]
    if lane < LUMINANCE_BASIS + DIFFERENCE_BASIS:
        return change[0] - change[2]
    return change[1] - 0.5 * (change[0] + change[2])


# few registers: many rays in flight hide the latency of their loads
@wp.kernel(launch_bounds=(128, 8))
def accumulate_photometric_gradient_by_warps(
    first: int,
    grid: VoxelGrid,
    rays: TrainingRays,
    background: wp.vec3,
    random_background: int,
    seed: int,
    step: float,
    stop: float,
    scale: float,
    own_background: wp.array(dtype=wp.vec3),
    gradients: wp.array(dtype=wp.float32),
    touched: wp.array(dtype=wp.uint8),
    squared_error: wp.array(dtype=wp.float32),
    grad_background: wp.array(dtype=wp.vec3),
):
    """As accumulate_photometric_gradient of fitting/loss, with 32 items per pixel, in blocks of at most 128.

    gradients: (25 rows,) of fitting/rmsprop. touched: (rows,)
    set to 1 where there is a gradient.
    """
    item = first + wp.tid()
    n = item // LANES
    lane = item % LANES
    has_background = own_background.shape[0] > 0
    pixel = batch_pixel(rays, n)
    if not in_picture(rays, pixel):
        if lane == 0:
            squared_error[n] = 0.0
            if has_background:
                grad_background[n] = wp.vec3()
        return
    channel = lane % 3  # of colours that a lane keeps: registers are what is short
    number = wp.min(lane, COEFFICIENTS - 1)
    first_place = gradient_place(0, lane, touched.shape[0])
    stride = wp.where(lane < COEFFICIENTS, COEFFICIENTS, 1)
    all_behind = background_behind(background, random_background, seed, n)
    if has_background:
        all_behind = own_background[n]
    behind = pick(all_behind, channel)
    target = pick(training_colour(rays, pixel, all_behind), channel)

    # of this lane's channel
    subray_count = rays.rays_per_side * rays.rays_per_side
    colours = wp.vec4()
    starts = wp.vec4i(BEYOND, BEYOND, BEYOND, BEYOND)  # where a sub-ray first comes near to anything
    left_over = float(0.0)  # transmittance, summed over the sub-rays
    grad_colour = float(0.0)
    march = int(0)
    while march < 2 * subray_count:  # forward for each sub-ray, then the adjoint for each
        subray = march % subray_count
        camera = rays.cameras[pixel[0]]  # not kept from march to march: registers are what is short
        direction = subray_direction(rays, camera, pixel, subray, seed, n)
        all_basis = sh_basis(direction)
        basis = float(0.0)
        own_basis = wp.where(lane < LUMINANCE_BASIS, lane, lane % DIFFERENCE_BASIS)
        for b in range(16):
            if lane < COEFFICIENTS and own_basis == b:
                basis = all_basis[b]
        ray = grid_ray(grid, camera.centre, direction, step)
        # the part of C . dL/dC that comes from behind the current sample
        later = over_channels(colours[subray] * grad_colour)
        colour = float(0.0)
        transmittance = float(1.0)
        k = wp.where(march < subray_count, ray.first, starts[subray])
        while sample_distance(ray, k) < ray.far and transmittance > stop:
            g = sample_place(ray, k)
            empty = empty_distance(grid, g)
            if empty > NEAR:
                k = sample_beyond(ray, k, g, empty)
            else:
                if march < subray_count:
                    starts[subray] = wp.min(starts[subray], k)
                # density of 32 samples, one a lane, which keeps the rows of its cell for the others
                own_g = sample_place(ray, k + lane)
                depth = float(0.0)
                own = CellSample()
                if sample_distance(ray, k + lane) < ray.far and empty_distance(grid, own_g) == 0:
                    own = cell_sample(grid, own_g)
                    depth = wp.max(cell_density(grid, own), 0.0) * step
                before = transmittance * wp.exp(-sum_before(depth, lane))
                alpha = 1.0 - wp.exp(-depth)
                matter = ballot(wp.where(depth > 0.0 and before > stop, 1, 0))
                transmittance = from_lane(before * (1.0 - alpha), LANES - 1)
                while matter != 0:
                    j = lowest_bit(matter)
                    matter = without_lowest_bit(matter)
                    g_j = sample_place(ray, k + j)
                    f = g_j - wp.vec3(wp.floor(g_j[0]), wp.floor(g_j[1]), wp.floor(g_j[2]))
                    left = from_lane(before, j)
                    weight = left * from_lane(alpha, j)
                    value = float(0.0)
                    for c in range(8):  # no branches: all eight loads are on their way together
                        row = index_from_lane(own.rows[c], j)
                        there = wp.where(row >= 0, corner_weight(f, c), 0.0)
                        value += there * grid.sh[wp.max(row, 0), number]
                    sums = part_sums(basis * value, lane)
                    raw = 0.5 + pick(luminance_colour(sums), channel)
                    radiance = wp.max(raw, 0.0)
                    if march < subray_count:
                        colour += weight * radiance
                    else:
                        change = over_channels(radiance * grad_colour)
                        later -= weight * change
                        passed = channels(wp.where(raw > 0.0, grad_colour, 0.0))
                        gradient = weight * basis * part_gradient(passed, lane)
                        if lane == COEFFICIENTS:
                            gradient = step * ((left - weight) * change - later)
                        marked = int(-1)
                        for c in range(8):
                            row = index_from_lane(own.rows[c], j)
                            if lane == c:
                                marked = row
                            if row >= 0 and lane < GRADIENT_ROW:
                                wp.atomic_add(gradients, row * stride + first_place, corner_weight(f, c) * gradient)
                        if marked >= 0:
                            touched[marked] = wp.uint8(1)
                k += LANES
        if march < subray_count:
            colours[subray] = colour + transmittance * behind
            left_over += transmittance
        if march == subray_count - 1:
            error = (colours[0] + colours[1] + colours[2] + colours[3]) / float(subray_count) - target
            grad_colour = 2.0 * scale / float(subray_count) * error
            total = over_channels(error * error)
            all_gradients = channels(grad_colour)
            if lane == 0:
                squared_error[n] = total
                if has_background:
                    grad_background[n] = left_over * all_gradients
        march += 1
