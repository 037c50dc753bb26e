"""Emission-absorption ray marching of a sparse voxel grid.

C = sum_k T_k (1 - exp(-sigma_k dt)) c_k + T_end background, T_k = exp(-sum_{j<k} sigma_j dt): Max 1995 as used by NeRF
(Mildenhall et al. 2020, Eq. 3) and Plenoxels (2022, Eq. 1).
Needs: field/grid, field/harmonics, field/samples, view/rays.
"""

import warp as wp

from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .grid import VoxelGrid, cell_colour, cell_density, cell_sample, empty_distance
from .harmonics import sh_basis
from .samples import grid_ray, sample_beyond, sample_distance, sample_place

wp.set_module_options({"enable_backward": False, "block_dim": 128})

#: Depth of a pixel is reported where it is at least this opaque.
DEPTH_MIN_ALPHA = wp.constant(1.0e-3)


@wp.struct
class Radiance:
    """What a march gathered along a ray."""

    colour: wp.vec3  # sum of w_k c_k, without background
    transmittance: float  # what is left for the background
    depth: float  # sum of w_k t_k


@wp.func
def march(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, step: float, stop: float):
    """Gather radiance along a ray until its transmittance falls below `stop`."""
    result = Radiance()
    result.transmittance = float(1.0)
    basis = sh_basis(direction)
    ray = grid_ray(grid, origin, direction, step)
    k = ray.first
    while sample_distance(ray, k) < ray.far and result.transmittance > stop:
        g = sample_place(ray, k)
        empty = empty_distance(grid, g)
        if empty > 0:
            k = sample_beyond(ray, k, g, empty)
        else:
            cell = cell_sample(grid, g)
            sigma = cell_density(grid, cell)
            if sigma > 0.0:
                weight = result.transmittance * (1.0 - wp.exp(-sigma * step))
                colour = wp.max(cell_colour(grid, cell, basis), wp.vec3(0.0, 0.0, 0.0))
                result.colour += weight * colour
                result.depth += weight * sample_distance(ray, k)
                result.transmittance *= wp.exp(-sigma * step)
            k += 1
    return result


@wp.kernel
def render_image(
    first: int,
    grid: VoxelGrid,
    camera: PinholeCamera,
    background: wp.vec3,
    step: float,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """One thread a pixel, in the order of rays.tile_pixel; outputs (h * w,) row by row. depth: expected distance along
    the ray, inf where empty."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column >= camera.width or row >= camera.height:
        return
    n = row * camera.width + column
    direction = pixel_direction(camera, column, row)
    seen = march(grid, camera.centre, direction, step, stop)
    opacity = 1.0 - seen.transmittance
    rgb[n] = seen.colour + seen.transmittance * background
    alpha[n] = opacity
    depth[n] = wp.where(opacity > DEPTH_MIN_ALPHA, seen.depth / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)


@wp.kernel
def record_weights(
    first: int,
    grid: VoxelGrid,
    cameras: wp.array(dtype=PinholeCamera),
    pixel_stride: int,
    step: float,
    stop: float,
    weights: wp.array(dtype=wp.float32),
):
    """Largest rendering weight T_k alpha_k that any ray gives to each node's row. Every pixel_stride-th row and column
    of every camera. Rows are shared: on the CPU give each thread its own `weights` and join them by maximum."""
    n = first + wp.tid()
    per_row = (cameras[0].width + pixel_stride - 1) // pixel_stride
    per_view = per_row * ((cameras[0].height + pixel_stride - 1) // pixel_stride)
    camera = cameras[n // per_view]
    column = (n % per_view % per_row) * pixel_stride
    row = (n % per_view // per_row) * pixel_stride
    ray = grid_ray(grid, camera.centre, pixel_direction(camera, column, row), step)
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
                for c in range(8):
                    if cell.rows[c] >= 0:
                        if weights[cell.rows[c]] < weight:
                            wp.atomic_max(weights, cell.rows[c], weight)
                transmittance *= wp.exp(-sigma * step)
            k += 1
