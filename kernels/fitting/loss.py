"""Gradient of the photometric loss by the density and SH numbers of a voxel grid."""

# Mean over pixels and channels of (C - C*)^2, C the mean of a pixel's sub-rays. With g = dL/dC, w_k = T_k alpha_k and
# the background as last sample, dL/dc_k = w_k g, dL/dsigma_k = dt (T_{k+1} c_k . g - sum_{j>k} w_j c_j . g): a second
# march (Plenoxels 2022, section 3.2), as no tape unrolls a loop of unknown length. Rows: 24 numbers (field/harmonics).

import warp as wp

from ..core.gradients import forward
from ..field.grid import (
    VoxelGrid,
    cell_color,
    cell_density,
    cell_sample,
    eight_rows,
    eight_weights,
    empty_distance,
    grid_ray,
    sample_beyond,
    sample_distance,
    sample_place,
)
from ..field.harmonics import sh_basis, vec16
from ..view.rays import PinholeCamera, image_direction
from .batches import Pictures, picture_pixel, shuffled_place

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)

#: Sub-rays of a pixel, at most.
MAX_SUBRAYS = wp.constant(4)


@wp.struct
class TrainingRays:
    """Images cut into square tiles; a batch is a run of tiles in a shuffled order."""

    cameras: wp.array(dtype=PinholeCamera)  # (views,)
    pictures: Pictures  # (views, h, w)
    exposures: wp.array2d(dtype=wp.vec3)  # (views, 2) gain and offset that undo a picture's exposure; empty: none
    height: int  # of a picture, pixels
    width: int
    tiles: wp.array(
        dtype=wp.int32
    )  # flat indices of those that count: (view * tile rows + row) * tile columns + column
    tile_size: int
    order: int  # key of the order in which `tiles` are taken (fitting/batches); below 0: as they are
    first_tile: int  # where this batch begins in that order
    rays_per_side: int  # 1: through the middle of a pixel, 2: four rays, each somewhere in its quarter


@wp.func
def batch_pixel(rays: TrainingRays, n: int):
    """(view, row, column) of the n-th ray of a batch; the far tiles' pixels may lie beyond the image."""
    size = rays.tile_size
    columns = (rays.width + size - 1) // size
    rows = (rays.height + size - 1) // size
    count = rays.tiles.shape[0]
    place = (rays.first_tile + n // (size * size)) % count
    if rays.order >= 0:
        place = shuffled_place(place, count, rays.order)
    tile = rays.tiles[place]
    within = n % (size * size)
    view = tile // (rows * columns)
    row = (tile // columns) % rows * size + within // size
    column = tile % columns * size + within % size
    return wp.vec3i(view, row, column)


@wp.func
def in_picture(rays: TrainingRays, pixel: wp.vec3i):
    return pixel[1] < rays.height and pixel[2] < rays.width


@wp.func
def evenly_exposed(rays: TrainingRays, view: int, rgba: wp.vec4):
    """A pixel's premultiplied colour without its picture's exposure: gain c + alpha offset."""
    color = wp.vec3(rgba[0], rgba[1], rgba[2])
    if rays.exposures.shape[0] > 0:
        color = wp.cw_mul(rays.exposures[view, 0], color) + rgba[3] * rays.exposures[view, 1]
    return color


@wp.func
def training_color(rays: TrainingRays, pixel: wp.vec3i, behind: wp.vec3):
    """What a pixel of the pictures shows in front of a background."""
    rgba = picture_pixel(rays.pictures, pixel[0], pixel[1], pixel[2])
    return evenly_exposed(rays, pixel[0], rgba) + (1.0 - rgba[3]) * behind


@wp.func
def subray_direction(rays: TrainingRays, camera: PinholeCamera, pixel: wp.vec3i, subray: int, seed: int, n: int):
    """Direction of a sub-ray of the n-th pixel of a batch: through the middle, or anywhere in its part of the pixel."""
    side = rays.rays_per_side
    right = float(0.5)
    down = float(0.5)
    if side > 1:
        random = wp.rand_init(seed, MAX_SUBRAYS * n + subray)
        right = (float(subray % side) + wp.randf(random)) / float(side)
        down = (float(subray // side) + wp.randf(random)) / float(side)
    return image_direction(camera, float(pixel[2]) + right, float(pixel[1]) + down)


@wp.func
def background_behind(background: wp.vec3, random_background: int, seed: int, n: int):
    """The given background, or a colour drawn for each pixel."""
    if random_background == 1:
        random = wp.rand_init(seed + 1, n)
        return wp.vec3(wp.randf(random), wp.randf(random), wp.randf(random))
    return background


#: C++ that makes the `gradient` of the numbers of a row from `change`, that by red, green and blue, and the `basis`.
ROW_GRADIENT = """
    float gradient[27];
    const bool luminous = grad_sh.shape[1] == 24;
    if (luminous)
    {
        // luminance, orange and green: what red, green and blue are made of
        const float parts[3] = {
            change.c[0] + change.c[1] + change.c[2],
            change.c[0] - change.c[2],
            change.c[1] - 0.5f * (change.c[0] + change.c[2]),
        };
        for (int b = 0; b < 16; ++b)
            gradient[b] = parts[0] * basis.c[b];
        for (int b = 0; b < 4; ++b)
        {
            gradient[16 + b] = parts[1] * basis.c[b];
            gradient[20 + b] = parts[2] * basis.c[b];
        }
    }
    else
        for (int channel = 0; channel < 3; ++channel)
            for (int b = 0; b < 9; ++b)
                gradient[9 * channel + b] = change.c[channel] * basis.c[b];
"""


@forward.func_native(
    ROW_GRADIENT
    + """
#if defined(__CUDA_ARCH__)
    #define ADD(n) atomicAdd(sums + n, weights.c[corner] * gradient[n])
#else
    #define ADD(n) sums[n] += weights.c[corner] * gradient[n]
#endif
    for (int corner = 0; corner < 8; ++corner)
        if (rows.c[corner] >= 0)
        {
            float* sums = grad_sh.data + (size_t)rows.c[corner] * (grad_sh.strides[0] / sizeof(float));
            if (luminous)
                for (int n = 0; n < 24; ++n)
                    ADD(n);
            else
                for (int n = 0; n < 27; ++n)
                    ADD(n);
        }
    #undef ADD
"""
)
def add_color_gradient(
    grad_sh: wp.array2d(dtype=wp.float32), rows: eight_rows, weights: eight_weights, basis: vec16, change: wp.vec3
):
    """Add the gradient by the numbers of eight rows; on a CPU to what one thread alone adds to. change: by red, green
    and blue."""
    ...


@wp.kernel
def accumulate_photometric_gradient(
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
    grad_density: wp.array(dtype=wp.float32),
    grad_sh: wp.array2d(dtype=wp.float32),
    squared_error: wp.array(dtype=wp.float32),
    grad_background: wp.array(dtype=wp.vec3),
    grad_front: wp.array(dtype=wp.vec4),
):
    """Adds scale * d(sum over channels of (C - C*)^2) for each pixel of a batch; squared_error: (pixels,) that sum.
    One item per pixel. Rows are shared: for CPU threads that have gradients (rows,), (rows, 24) of their own."""
    # random_background: 1 puts a random colour behind image and render alike: opacity is supervised too.
    # own_background: (pixels,) instead of `background`; front: (pixels,) colour before the grid and light that passes
    # it; each with its gradient, empty where there is none. stop: transmittance at which a march ends.
    n = first + wp.tid()
    squared_error[n] = 0.0
    has_background = own_background.shape[0] > 0
    has_front = front.shape[0] > 0
    if has_background:
        grad_background[n] = wp.vec3()
    if has_front:
        grad_front[n] = wp.vec4()
    pixel = batch_pixel(rays, n)
    if not in_picture(rays, pixel):
        return
    camera = rays.cameras[pixel[0]]
    behind = background_behind(background, random_background, seed, n)
    if has_background:
        behind = own_background[n]
    target = training_color(rays, pixel, behind)
    passed_front = float(1.0)
    if has_front:
        target -= wp.vec3(front[n][0], front[n][1], front[n][2])
        passed_front = front[n][3]

    subray_count = rays.rays_per_side * rays.rays_per_side
    colors = mat43()
    left = float(0.0)  # transmittance, summed over the sub-rays
    grad_color = wp.vec3()
    march = int(0)
    while march < 2 * subray_count:  # forward for each sub-ray, then the adjoint for each
        subray = march % subray_count
        direction = subray_direction(rays, camera, pixel, subray, seed, n)
        basis = sh_basis(direction)
        ray = grid_ray(grid, camera.center, direction, step)
        later = wp.dot(colors[subray], grad_color)  # the part of C . dL/dC that comes from behind the current sample
        color = wp.vec3()
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
                    weight = transmittance * (1.0 - wp.exp(-sigma * step))
                    transmittance *= wp.exp(-sigma * step)
                    raw = cell_color(grid, cell, basis)
                    radiance = wp.max(raw, wp.vec3(0.0, 0.0, 0.0))
                    if march < subray_count:
                        color += weight * radiance
                    else:
                        change = wp.dot(radiance, grad_color)
                        later -= weight * change
                        grad_sigma = step * (transmittance * change - later)
                        for c in range(8):
                            if cell.rows[c] >= 0:
                                wp.atomic_add(grad_density, cell.rows[c], cell.weights[c] * grad_sigma)
                        passed = wp.vec3()
                        for channel in range(3):
                            if raw[channel] > 0.0:  # the clamp max(0, .) passes no gradient
                                passed[channel] = weight * grad_color[channel]
                        add_color_gradient(grad_sh, cell.rows, cell.weights, basis, passed)
                k += 1
        if march < subray_count:
            colors[subray] = color + transmittance * behind
            left += transmittance
        if march == subray_count - 1:
            seen = (colors[0] + colors[1] + colors[2] + colors[3]) / float(subray_count)
            error = passed_front * seen - target
            squared_error[n] = wp.dot(error, error)
            grad_seen = 2.0 * scale * error
            grad_color = passed_front / float(subray_count) * grad_seen
            if has_front:
                grad_front[n] = wp.vec4(grad_seen[0], grad_seen[1], grad_seen[2], wp.dot(grad_seen, seen))
            if has_background:
                grad_background[n] = left * grad_color
        march += 1
