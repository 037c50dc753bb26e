"""Views of a sparse voxel grid whose voxels were shaded for the camera: the march of field/render, with fewer reads.

The same samples and sums as field/render.
Needs: core/entries, field/grid, field/render, field/samples, field/shades, view/rays.
"""

import warp as wp

from ..core.entries import cell_byte
from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .grid import VoxelGrid
from .render import Radiance, visible_depth
from .samples import exit_of_cell, grid_ray, safe_inverse
from .shades import ShadedGrid, shade_at

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})


@wp.func
def march_shades(grid: VoxelGrid, shaded: ShadedGrid, origin: wp.vec3, direction: wp.vec3, step: float, stop: float):
    """Gather radiance along a ray until its transmittance falls below `stop`."""
    result = Radiance()
    result.transmittance = float(1.0)
    ray = grid_ray(grid, origin, direction, step)
    inverse_slope = safe_inverse(ray.slope)
    inverse_step = 1.0 / step
    tops = wp.vec3i(grid.skip.shape[0] - 1, grid.skip.shape[1] - 1, grid.skip.shape[2] - 1)
    k = float(ray.first)  # a whole number: no conversions in the loop, where each step waits for the one before
    t = (k + 0.5) * step
    while t < ray.far and result.transmittance > stop:
        g = ray.start + t * ray.slope
        ci = wp.clamp(int(g[0]), 0, tops[0])
        cj = wp.clamp(int(g[1]), 0, tops[1])
        ck = wp.clamp(int(g[2]), 0, tops[2])
        empty = cell_byte(grid.skip, ci, cj, ck)
        offset = g - wp.vec3(float(ci), float(cj), float(ck))
        if empty > 0:
            leave = t + exit_of_cell(offset, inverse_slope, empty)
            after = wp.ceil(leave * inverse_step - 0.5)
            k = wp.where(after > k + 1.0, after, k + 1.0)
        else:
            shade = shade_at(shaded, ci, cj, ck, offset)
            if shade[3] > 0.0:
                kept = wp.exp(-shade[3])
                weight = result.transmittance * (1.0 - kept)
                colour = wp.vec3(shade[0] + 0.5, shade[1] + 0.5, shade[2] + 0.5)
                result.colour += weight * wp.max(colour, wp.vec3(0.0, 0.0, 0.0))
                result.depth += weight * t
                result.transmittance *= kept
            k += 1.0
        t = (k + 0.5) * step
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
    depth[n] = visible_depth(seen.depth, opacity)
