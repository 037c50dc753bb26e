"""Views of a sparse voxel grid whose voxels were shaded for the camera: the march of field/render, with fewer reads.

The same samples and sums as field/render.
Needs: field/grid, field/render, field/samples, field/shades, view/rays.
"""

import warp as wp

from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .grid import VoxelGrid
from .render import DEPTH_MIN_ALPHA, Radiance
from .samples import grid_ray, sample_beyond, sample_distance, sample_place
from .shades import ShadedGrid, shade_at

wp.set_module_options({"enable_backward": False, "block_dim": 64})


@wp.func
def march_shades(grid: VoxelGrid, shaded: ShadedGrid, origin: wp.vec3, direction: wp.vec3, step: float, stop: float):
    """Gather radiance along a ray until its transmittance falls below `stop`."""
    result = Radiance()
    result.transmittance = float(1.0)
    ray = grid_ray(grid, origin, direction, step)
    k = ray.first
    while sample_distance(ray, k) < ray.far and result.transmittance > stop:
        g = sample_place(ray, k)
        ci = wp.clamp(int(wp.floor(g[0])), 0, shaded.columns.node_counts[0] - 2)
        cj = wp.clamp(int(wp.floor(g[1])), 0, shaded.columns.node_counts[1] - 2)
        ck = wp.clamp(int(wp.floor(g[2])), 0, shaded.columns.node_counts[2] - 2)
        empty = int(grid.skip[ci, cj, ck])
        if empty > 0:
            k = sample_beyond(ray, k, g, empty)
        else:
            shade = shade_at(shaded, ci, cj, ck, g - wp.vec3(float(ci), float(cj), float(ck)))
            if shade[3] > 0.0:
                kept = wp.exp(-shade[3])
                weight = result.transmittance * (1.0 - kept)
                result.colour += weight * wp.max(wp.vec3(shade[0], shade[1], shade[2]), wp.vec3(0.0, 0.0, 0.0))
                result.depth += weight * sample_distance(ray, k)
                result.transmittance *= kept
            k += 1
    return result


@wp.kernel
def render_shaded_image(
    first: int,
    grid: VoxelGrid,
    shaded: ShadedGrid,
    camera: PinholeCamera,
    background: wp.vec3,
    step: float,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """As field/render.render_image."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column >= camera.width or row >= camera.height:
        return
    n = row * camera.width + column
    direction = pixel_direction(camera, column, row)
    seen = march_shades(grid, shaded, camera.centre, direction, step, stop)
    opacity = 1.0 - seen.transmittance
    rgb[n] = seen.colour + seen.transmittance * background
    alpha[n] = opacity
    depth[n] = wp.where(opacity > DEPTH_MIN_ALPHA, seen.depth / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)
