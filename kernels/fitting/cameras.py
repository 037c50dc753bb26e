"""Derivatives of the colours of rays by their camera's numbers, by which a fit refines cameras."""

# Forward-mode derivatives of the march (Max 1995; BARF, Lin et al. 2021; NeRF--, Wang et al. 2021). With
# x_k = o + t_k d, optical depth s_k = sigma_k dt and A_k = sum_{j<k} ds_j, a ray's C = sum_k w_k c_k + T B changes by
# dC = sum_k [c_k (T_{k+1} ds_k - w_k A_k) + w_k dc_k] + T (dB - B A_end): one march for a camera's seven numbers.
# They are small turns about its axes (x right, y down, z forward; d' = w x d), shifts along them in units of `reach`,
# and the logarithm of its focal length (a ray turns as the point (x / f, y / f, 1) does).

import warp as wp

from ..field.grid import (
    VoxelGrid,
    cell_density,
    cell_sample,
    empty_distance,
    grid_ray,
    sample_beyond,
    sample_distance,
    sample_place,
)
from ..field.harmonics import sh_basis
from ..view.rays import PinholeCamera
from .batches import picture_pixel
from .loss import TrainingRays, background_behind, batch_pixel, in_picture, subray_direction, training_color
from .slopes import blended_color_slopes, cell_slopes, density_slope, sh_basis_slope

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Numbers by which a camera changes: turns, shifts, and the logarithm of its focal length.
CAMERA_NUMBERS = wp.constant(7)

#: Colours that a ray leaves for the sums: what it missed its pixel by, its seven derivatives, what it saw of the
#: picture's matter, that of the pixel, and the pixel's opacity in each channel.
RECORD = wp.constant(11)
MISSED = wp.constant(0)
FIRST_SLOPE = wp.constant(1)
PREDICTED = wp.constant(8)
PICTURED = wp.constant(9)
OPACITY = wp.constant(10)

#: Sums of a camera: the upper triangle of J^T J, J^T e, five for each channel of its exposure, and e^T e.
NORMAL_SUMS = wp.constant(28)
EXPOSURE_SUMS = wp.constant(15)
CAMERA_SUMS = wp.constant(51)


@wp.kernel
def draw_tiles(
    first: int,
    tiles: wp.array(dtype=wp.int32),
    view_tiles: wp.array(dtype=wp.int32),
    tiles_per_view: int,
    count: int,
    seed: int,
    drawn: wp.array(dtype=wp.int32),
):
    """drawn: (views * count,) tiles of each view, of those that count; its first one where none does. tiles:
    (n,) flat indices of those that count, rising; view_tiles: (views + 1,) where each view's begin. One item each."""
    n = first + wp.tid()
    view = n // count
    begin = view_tiles[view]
    there = view_tiles[view + 1] - begin
    tile = view * tiles_per_view
    if there > 0:
        random = wp.rand_init(seed + 2, n)
        tile = tiles[begin + wp.min(int(wp.randf(random) * float(there)), there - 1)]
    drawn[n] = tile


@wp.func
def camera_slope(camera: PinholeCamera, direction: wp.vec3, number: int, reach: float):
    """How the origin and the unit direction of a ray change by one of its camera's numbers."""
    origin_change = wp.vec3()
    direction_change = wp.vec3()
    if number < 6:
        axis = number % 3
        along = wp.vec3(camera.rotation[0, axis], camera.rotation[1, axis], camera.rotation[2, axis])
        if number < 3:
            direction_change = wp.cross(along, direction)
        else:
            origin_change = reach * along
    else:
        local = wp.transpose(camera.rotation) * direction
        flat = wp.vec3(-local[0], -local[1], 0.0)
        direction_change = camera.rotation * (flat - wp.dot(flat, local) * local)
    return origin_change, direction_change


@wp.kernel
def measure_camera_slopes(
    first: int,
    grid: VoxelGrid,
    rays: TrainingRays,
    background: wp.vec3,
    random_background: int,
    seed: int,
    step: float,
    stop: float,
    reach: float,
    behind: wp.array2d(dtype=wp.vec3),
    front: wp.array2d(dtype=wp.vec4),
    change: float,
    records: wp.array2d(dtype=wp.vec3),
):
    """records: (rays, 11) what a ray misses its pixel by, and how that changes with its camera; zero off the picture.
    One item per ray. reach: world units of a shift by 1. The others: see fitting/loss."""
    # behind, front: (8, rays) of fitting/loss, then each with one of the camera's seven numbers larger by `change`.
    n = first + wp.tid()
    for number in range(RECORD):
        records[n, number] = wp.vec3()
    pixel = batch_pixel(rays, n)
    if not in_picture(rays, pixel):
        return
    camera = rays.cameras[pixel[0]]
    has_behind = behind.shape[0] > 0
    back = background_behind(background, random_background, seed, n)
    if has_behind:
        back = behind[0, n]
    total = wp.vec3()
    own = wp.vec3()  # of the field, without what is behind it
    subray_count = rays.rays_per_side * rays.rays_per_side
    share = 1.0 / float(subray_count)
    subray = int(0)
    while subray < subray_count:
        direction = subray_direction(rays, camera, pixel, subray, seed, n)
        basis = sh_basis(direction)
        basis_x = sh_basis_slope(direction, 0)
        basis_y = sh_basis_slope(direction, 1)
        basis_z = sh_basis_slope(direction, 2)
        ray = grid_ray(grid, camera.center, direction, step)
        color = wp.vec3()
        by_origin = wp.mat33()  # a channel a row
        by_direction = wp.mat33()
        depth_by_origin = wp.vec3()
        depth_by_direction = wp.vec3()
        transmittance = float(1.0)
        k = ray.first
        while sample_distance(ray, k) < ray.far and transmittance > stop:
            g = sample_place(ray, k)
            empty = empty_distance(grid, g)
            if empty > 0:
                k = sample_beyond(ray, k, g, empty)
            else:
                cell = cell_sample(grid, g)
                sigma = cell_density(grid, cell)
                if sigma > 0.0:
                    by_x = cell_slopes(g, 0)
                    by_y = cell_slopes(g, 1)
                    by_z = cell_slopes(g, 2)
                    t = sample_distance(ray, k)
                    left = wp.exp(-sigma * step)
                    weight = transmittance * (1.0 - left)
                    transmittance *= left
                    slope = density_slope(grid, cell.rows, by_x, by_y, by_z)
                    thicker = step * wp.cw_mul(slope, grid.inverse_voxel_size)
                    held = blended_color_slopes(
                        grid.sh, cell.rows, cell.weights, by_x, by_y, by_z, basis, basis_x, basis_y, basis_z
                    )
                    for channel in range(3):
                        value = held[0, channel]
                        if value > 0.0:  # the clamp max(0, .) passes no change
                            by_place = wp.vec3(held[1, channel], held[2, channel], held[3, channel])
                            by_place = weight * wp.cw_mul(by_place, grid.inverse_voxel_size)
                            by_place += value * transmittance * thicker
                            turned = weight * wp.vec3(held[4, channel], held[5, channel], held[6, channel])
                            moved = by_place - value * weight * depth_by_origin
                            turned += t * by_place - value * weight * depth_by_direction
                            color[channel] = color[channel] + weight * value
                            for axis in range(3):
                                by_origin[channel, axis] = by_origin[channel, axis] + moved[axis]
                                by_direction[channel, axis] = by_direction[channel, axis] + turned[axis]
                    depth_by_origin += thicker
                    depth_by_direction += t * thicker
                k += 1
        own += share * color
        total += share * (color + transmittance * back)
        by_origin -= transmittance * wp.outer(back, depth_by_origin)
        by_direction -= transmittance * wp.outer(back, depth_by_direction)
        for number in range(CAMERA_NUMBERS):
            origin_change, direction_change = camera_slope(camera, direction, number, reach)
            slope_of = by_origin * origin_change + by_direction * direction_change
            if has_behind:
                slope_of += transmittance / change * (behind[number + 1, n] - back)
            records[n, FIRST_SLOPE + number] = records[n, FIRST_SLOPE + number] + share * slope_of
        subray += 1
    if front.shape[0] > 0:
        before = front[0, n]
        for number in range(CAMERA_NUMBERS):
            fore = 1.0 / change * (front[number + 1, n] - before)
            records[n, FIRST_SLOPE + number] = (
                wp.vec3(fore[0], fore[1], fore[2]) + fore[3] * total + before[3] * records[n, FIRST_SLOPE + number]
            )
        total = wp.vec3(before[0], before[1], before[2]) + before[3] * total
    rgba = picture_pixel(rays.pictures, pixel[0], pixel[1], pixel[2])
    if random_background == 0 or has_behind:
        own = total - (1.0 - rgba[3]) * back
    records[n, MISSED] = total - training_color(rays, pixel, back)
    records[n, PREDICTED] = own
    records[n, PICTURED] = wp.vec3(rgba[0], rgba[1], rgba[2])
    records[n, OPACITY] = wp.vec3(rgba[3], rgba[3], rgba[3])


@wp.func
def exposure_sum(records: wp.array2d(dtype=wp.vec3), n: int, number: int):
    """A ray's part of one of the fifteen sums for its picture's exposure.
    Of each channel x x, x a, a a, x y, a y: x the field's colour, y the picture's, a the field's opacity."""
    channel = number // 5
    which = number % 5
    x = records[n, PREDICTED][channel]
    y = records[n, PICTURED][channel]
    a = records[n, OPACITY][channel]
    return wp.where(
        which == 0, x * x, wp.where(which == 1, x * a, wp.where(which == 2, a * a, wp.where(which == 3, x * y, a * y)))
    )


@wp.kernel
def sum_camera_slopes(
    first: int, records: wp.array2d(dtype=wp.vec3), run: int, outlier: float, sums: wp.array2d(dtype=wp.float32)
):
    """sums: (runs, 51) over each run of rays, all of one camera. One item per sum. records: (runs * run, 11).
    The upper triangle of J^T J, row after row; J^T e; the fifteen of exposure_sum; e^T e."""
    # Rays count by 1 / (1 + |e|^2 / outlier^2)^2 (Geman and McClure): what a field lacks yet says nothing of cameras.
    item = first + wp.tid()
    place = item // CAMERA_SUMS
    number = item % CAMERA_SUMS
    row = int(0)
    column = number
    while row < CAMERA_NUMBERS and column >= CAMERA_NUMBERS:  # of the triangle
        row += 1
        column = column - CAMERA_NUMBERS + row
    total = float(0.0)
    for n in range(place * run, (place + 1) * run):
        missed = records[n, MISSED]
        certainty = 1.0 / (1.0 + wp.length_sq(missed) / (outlier * outlier))
        value = float(0.0)
        if number < NORMAL_SUMS:
            value = wp.dot(records[n, FIRST_SLOPE + row], records[n, FIRST_SLOPE + column])
        elif number < NORMAL_SUMS + CAMERA_NUMBERS:
            value = wp.dot(records[n, FIRST_SLOPE + number - NORMAL_SUMS], missed)
        elif number < NORMAL_SUMS + CAMERA_NUMBERS + EXPOSURE_SUMS:
            value = exposure_sum(records, n, number - NORMAL_SUMS - CAMERA_NUMBERS)
        else:
            value = wp.length_sq(missed)
        total += certainty * certainty * value
    sums[place, number] = total
