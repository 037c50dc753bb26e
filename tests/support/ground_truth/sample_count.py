"""Number of samples that a march takes along the rays of cameras: the work of a step of a fit."""

import warp as wp

from warpcage.kernels.field.grid import (
    VoxelGrid,
    cell_density,
    cell_sample,
    empty_distance,
    grid_ray,
    sample_beyond,
    sample_distance,
    sample_place,
)
from warpcage.kernels.view.rays import PinholeCamera, pixel_direction, strided_pixel

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def count_samples(
    first: int,
    grid: VoxelGrid,
    cameras: wp.array(dtype=PinholeCamera),
    pixel_stride: int,
    step: float,
    stop: float,
    marched_count: wp.array(dtype=wp.int32),
    matter_count: wp.array(dtype=wp.int32),
):
    """Samples of each ray (rays,), one item each: marched in cells that hold values until less than `stop` of the light
    is left, and with density. Rays of every pixel_stride-th row and column of every camera, all of one size."""
    n = first + wp.tid()
    pixel = strided_pixel(n, cameras[0].width, cameras[0].height, pixel_stride)
    camera = cameras[pixel[0]]
    direction = pixel_direction(camera, pixel[2], pixel[1])
    ray = grid_ray(grid, camera.center, direction, step)
    k = ray.first
    transmittance = float(1.0)
    marched = int(0)
    matter = int(0)
    while sample_distance(ray, k) < ray.far and transmittance > stop:
        g = sample_place(ray, k)
        empty = empty_distance(grid, g)
        if empty > 0:
            k = sample_beyond(ray, k, g, empty)
        else:
            marched += 1
            sigma = cell_density(grid, cell_sample(grid, g))
            if sigma > 0.0:
                matter += 1
                transmittance *= wp.exp(-sigma * step)
            k += 1
    marched_count[n] = marched
    matter_count[n] = matter
