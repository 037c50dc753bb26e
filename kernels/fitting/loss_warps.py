"""The photometric gradient of fitting/loss, for CUDA: one warp per ray, one lane per coefficient."""

# The sums are those of accumulate_photometric_gradient. The densities of 32 successive samples are looked up at once,
# then samples with matter are taken one by one: 24 neighbouring lanes read the 24 coefficients of a voxel as one run of
# memory (lanes for coefficients: Plenoxels 2022, in its CUDA code). What a sample weighs and shows is kept for the
# adjoint, which reads none of it again; a sub-ray for which no room is left marches twice.

import warp as wp

from ..core.lanes import ballot, from_lane, lowest_bit, sum_before, without_lowest_bit
from ..core.shared import WARP_NUMBERS, bits_as_float, bits_as_int, four_kept, keep_four, keep_one, one_kept, warp_meets
from ..field.grid import (
    CellSample,
    VoxelGrid,
    cell_density,
    cell_sample,
    empty_distance,
    grid_ray,
    sample_beyond,
    sample_distance,
    sample_place,
)
from ..field.harmonics import DIFFERENCE_BASIS, LUMINANCE_BASIS, luminance_color, sh_basis
from .loss import TrainingRays, background_behind, batch_pixel, in_picture, subray_direction, training_color
from .rmsprop import COEFFICIENTS, GRADIENT_ROW, gradient_place

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})
LANES = wp.constant(32)

#: Where a filled cell is at most this many cells away, the densities of the next samples are asked at once.
NEAR = wp.constant(4)

#: Sample at which a march has nothing to do.
BEYOND = wp.constant(1 << 28)

#: What a warp keeps (core/shared). For each lane CELL_FOURS times four numbers: weights and rows of the eight
#: corners of its sample's cell, and four more. From HEADS on, eight numbers for each sub-ray: its colour, where its
#: samples begin, their number or -1, where it first comes near to anything. From SAMPLES on, seven for each sample that
#: holds matter: its index, transmittance before it, weight, colour, (none).
CELL_FOURS = wp.constant(5)
HEADS = wp.constant(32 * 4 * 5)
HEAD = wp.constant(8)
SAMPLES = wp.constant(32 * 4 * 5 + 4 * 8)
SAMPLE = wp.constant(7)  # odd, so that lanes read from different banks
MAX_SAMPLES = wp.constant((WARP_NUMBERS - 32 * 4 * 5 - 4 * 8) // 7)


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
def keep_cell(own: CellSample, lane: int):
    """Leave the cell of a lane's sample for the others."""
    place = CELL_FOURS * lane
    keep_four(place, wp.vec4(own.weights[0], own.weights[1], own.weights[2], own.weights[3]))
    keep_four(place + 1, wp.vec4(own.weights[4], own.weights[5], own.weights[6], own.weights[7]))
    for half in range(2):
        rows = wp.vec4()
        for c in range(4):
            rows[c] = bits_as_float(own.rows[4 * half + c])
        keep_four(place + 2 + half, rows)


@wp.func
def add_corner_gradients(
    gradients: wp.array(dtype=wp.float32), j: int, lane: int, stride: int, first_place: int, gradient: float
):
    """Add a gradient by this lane's number of a row to the eight rows of lane j's cell."""
    if lane < GRADIENT_ROW:
        for half in range(2):
            weights = four_kept(CELL_FOURS * j + half)
            rows = four_kept(CELL_FOURS * j + 2 + half)
            for c in range(4):
                row = bits_as_int(rows[c])
                if row >= 0:
                    wp.atomic_add(gradients, row * stride + first_place, weights[c] * gradient)


@wp.func
def touch_rows(touched: wp.array(dtype=wp.uint8), own: CellSample):
    """Mark the rows of this lane's cell."""
    for c in range(8):
        if own.rows[c] >= 0:
            touched[own.rows[c]] = wp.uint8(1)


@wp.func
def pick(v: wp.vec3, channel: int):
    return wp.where(channel == 0, v[0], wp.where(channel == 1, v[1], v[2]))


@wp.func
def part_gradients(change: wp.vec3):
    """Gradients by luminance, orange and green of a colour. change: by red, green and blue."""
    return change[0] + change[1] + change[2], change[0] - change[2], change[1] - 0.5 * (change[0] + change[2])


@wp.kernel(launch_bounds=(128, 8))  # few registers: many rays in flight hide the latency of their loads
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
    front: wp.array(dtype=wp.vec4),
    gradients: wp.array(dtype=wp.float32),
    touched: wp.array(dtype=wp.uint8),
    squared_error: wp.array(dtype=wp.float32),
    grad_background: wp.array(dtype=wp.vec3),
    grad_front: wp.array(dtype=wp.vec4),
):
    """As accumulate_photometric_gradient of fitting/loss, with 32 items per pixel, in blocks of at most 128.
    gradients: (25 rows,) of fitting/rmsprop. touched: (rows,) set to 1 where there is a gradient."""
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
            if front.shape[0] > 0:
                grad_front[n] = wp.vec4()
        return
    channel = lane % 3  # of colours that a lane keeps: registers are what is short
    number = wp.min(lane, COEFFICIENTS - 1)
    part = wp.where(lane < LUMINANCE_BASIS, 0, wp.min((lane - LUMINANCE_BASIS) // DIFFERENCE_BASIS + 1, 3))
    first_place = gradient_place(0, lane, touched.shape[0])
    stride = wp.where(lane < COEFFICIENTS, COEFFICIENTS, 1)
    all_behind = background_behind(background, random_background, seed, n)
    if has_background:
        all_behind = own_background[n]
    behind = pick(all_behind, channel)
    target = pick(training_color(rays, pixel, all_behind), channel)
    if front.shape[0] > 0:
        target -= pick(wp.vec3(front[n][0], front[n][1], front[n][2]), channel)

    subray_count = rays.rays_per_side * rays.rays_per_side
    mean_color = float(0.0)  # of this lane's channel
    left_over = float(0.0)  # transmittance, summed over the sub-rays
    grad_color = float(0.0)
    kept = int(0)  # samples of all sub-rays
    march = int(0)
    while march < 2 * subray_count:  # forward for each sub-ray, then the adjoint for each
        subray = march % subray_count
        head = HEADS + HEAD * subray
        camera = rays.cameras[pixel[0]]  # not kept from march to march: registers are what is short
        direction = subray_direction(rays, camera, pixel, subray, seed, n)
        all_basis = sh_basis(direction)
        basis = float(1.0)  # for the lane of the density's gradient
        own_basis = wp.where(lane < LUMINANCE_BASIS, lane, lane % DIFFERENCE_BASIS)
        for b in range(16):
            if lane < COEFFICIENTS and own_basis == b:
                basis = all_basis[b]
        ray = grid_ray(grid, camera.center, direction, step)
        k = ray.first
        start = int(BEYOND)
        first_kept = kept
        later = float(0.0)  # the part of C . dL/dC that comes from behind the current sample
        if march >= subray_count:
            later = over_channels(one_kept(head + channel) * grad_color)
            first_kept = bits_as_int(one_kept(head + 3))
            count = bits_as_int(one_kept(head + 4))
            k = bits_as_int(one_kept(head + 5))
            all_gradients = channels(grad_color)
            if count >= 0:
                k = BEYOND
            done = int(0)
            while done < count:  # 32 samples at a time, one a lane
                present = done + lane < count
                place = SAMPLES + SAMPLE * (first_kept + wp.min(done + lane, count - 1))
                left = one_kept(place + 1)
                weight = one_kept(place + 2)
                radiance = wp.vec3(one_kept(place + 3), one_kept(place + 4), one_kept(place + 5))
                own = cell_sample(grid, sample_place(ray, bits_as_int(one_kept(place))))
                change = wp.dot(radiance, all_gradients)
                share = wp.where(present, weight * change, 0.0)
                later_own = later - sum_before(share, lane) - share
                passed = wp.vec3()
                for c in range(3):
                    if radiance[c] > 0.0:  # the clamp max(0, .) passes no gradient
                        passed[c] = weight * all_gradients[c]
                luminance, orange, green = part_gradients(passed)
                warp_meets()
                keep_cell(own, lane)
                slope = step * ((left - weight) * change - later_own)
                keep_four(CELL_FOURS * lane + 4, wp.vec4(luminance, orange, green, slope))
                later = from_lane(later_own, LANES - 1)
                if present:
                    touch_rows(touched, own)
                warp_meets()
                for j in range(wp.min(count - done, LANES)):
                    gradient = basis * one_kept(4 * (CELL_FOURS * j + 4) + part)
                    add_corner_gradients(gradients, j, lane, stride, first_place, gradient)
                done += LANES
        color = float(0.0)
        transmittance = float(1.0)
        while sample_distance(ray, k) < ray.far and transmittance > stop:
            g = sample_place(ray, k)
            empty = empty_distance(grid, g)
            if empty > NEAR:
                k = sample_beyond(ray, k, g, empty)
            else:
                start = wp.min(start, k)
                # density of 32 samples, one a lane, which leaves its cell for the others
                own_g = sample_place(ray, k + lane)
                depth = float(0.0)
                warp_meets()
                if sample_distance(ray, k + lane) < ray.far and empty_distance(grid, own_g) == 0:
                    own = cell_sample(grid, own_g)
                    depth = wp.max(cell_density(grid, own), 0.0) * step
                    keep_cell(own, lane)
                before = transmittance * wp.exp(-sum_before(depth, lane))
                alpha = 1.0 - wp.exp(-depth)
                matter = ballot(wp.where(depth > 0.0 and before > stop, 1, 0))
                transmittance = from_lane(before * (1.0 - alpha), LANES - 1)
                warp_meets()
                while matter != 0:
                    j = lowest_bit(matter)
                    matter = without_lowest_bit(matter)
                    left = from_lane(before, j)
                    weight = left * from_lane(alpha, j)
                    value = float(0.0)
                    for half in range(2):  # no branches: all eight loads are on their way together
                        weights = four_kept(CELL_FOURS * j + half)
                        rows = four_kept(CELL_FOURS * j + 2 + half)
                        for c in range(4):
                            row = bits_as_int(rows[c])
                            value += wp.where(row >= 0, weights[c], 0.0) * grid.sh[wp.max(row, 0), number]
                    sums = part_sums(basis * value, lane)
                    raw = 0.5 + pick(luminance_color(sums), channel)
                    radiance_own = wp.max(raw, 0.0)
                    if march < subray_count:
                        color += weight * radiance_own
                        if kept < MAX_SAMPLES:
                            keeping = radiance_own
                            slot = 3 + lane
                            if lane == 3:
                                keeping = bits_as_float(k + j)
                                slot = 0
                            if lane == 4:
                                keeping = left
                                slot = 1
                            if lane == 5:
                                keeping = weight
                                slot = 2
                            if lane < 6:
                                keep_one(SAMPLES + SAMPLE * kept + slot, keeping)
                        kept += 1
                    else:
                        change_all = over_channels(radiance_own * grad_color)
                        later -= weight * change_all
                        passed_all = part_gradients(channels(wp.where(raw > 0.0, weight * grad_color, 0.0)))
                        gradient_own = basis * pick(wp.vec3(passed_all[0], passed_all[1], passed_all[2]), part)
                        if lane == COEFFICIENTS:
                            gradient_own = step * ((left - weight) * change_all - later)
                        add_corner_gradients(gradients, j, lane, stride, first_place, gradient_own)
                        if lane < 8:
                            marked = bits_as_int(one_kept(4 * (CELL_FOURS * j + 2) + lane))
                            if marked >= 0:
                                touched[marked] = wp.uint8(1)
                k += LANES
        if march < subray_count:
            color += transmittance * behind
            mean_color += color / float(subray_count)
            left_over += transmittance
            count_kept = kept - first_kept
            if kept > MAX_SAMPLES:  # no room: the adjoint marches again
                kept = first_kept
                count_kept = -1
            if lane < 3:
                keep_one(head + lane, color)
            if lane == 3:
                keep_one(head + 3, bits_as_float(first_kept))
            if lane == 4:
                keep_one(head + 4, bits_as_float(count_kept))
            if lane == 5:
                keep_one(head + 5, bits_as_float(start))
            warp_meets()
        if march == subray_count - 1:
            passed_front = float(1.0)
            if front.shape[0] > 0:
                passed_front = front[n][3]
            error = passed_front * mean_color - target
            grad_color = 2.0 * scale * error
            total = over_channels(error * error)
            change_of_light = over_channels(grad_color * mean_color)
            all_errors = channels(grad_color)
            grad_color *= passed_front / float(subray_count)
            if lane == 0:
                squared_error[n] = total
                if has_background:
                    grad_background[n] = left_over * passed_front / float(subray_count) * all_errors
                if front.shape[0] > 0:
                    grad_front[n] = wp.vec4(all_errors[0], all_errors[1], all_errors[2], change_of_light)
        march += 1
