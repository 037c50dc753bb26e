"""Emission-absorption ray marching of a sparse voxel grid: its views, by rows or by voxels shaded for the camera."""

from typing import Any

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import cell_byte
from ..core.variants import declared_once, variant_module
from ..view.rays import PinholeCamera, pixel_direction, strided_pixel, tile_pixel
from .colors import ShadedGrid, color_at
from .densities import row_density
from .grid import (
    VoxelGrid,
    cell_density,
    cell_sample,
    empty_distance,
    exit_of_cell,
    first_sample,
    grid_ray,
    safe_inverse,
    sample_beyond,
    sample_distance,
    sample_place,
    steps_to_sample,
)
from .harmonics import sh_basis
from .rows import RowTable, row_color

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

forward_only = forward_only_in(__name__, (float, wp.vec3), (wp.vec3, wp.vec3))

#: A pixel has a depth where it is at least this opaque.
DEPTH_MIN_ALPHA = wp.constant(1.0e-3)

#: Samples that together weigh no more than this take the colour of the next one: half of what an 8-bit image shows.
PENDING_WEIGHT = wp.constant(1.0 / 512.0)


@wp.struct
class Radiance:
    """What a march gathered along a ray."""

    color: wp.vec3  # sum of w_k c_k, without background
    transmittance: float  # what is left for the background
    depth: float  # sum of w_k t_k


@wp.func
def pending_color(color: wp.vec3, transmittance: float, pending: float):
    """Colour of the samples whose rows were not read: the mean colour of the others, or grey without any."""
    looked_up = 1.0 - transmittance - pending
    if looked_up > 0.5 * PENDING_WEIGHT:
        return (pending / looked_up) * color
    return wp.vec3(0.5 * pending, 0.5 * pending, 0.5 * pending)


@wp.func
def visible_depth(depth: float, opacity: float):
    """Expected distance along the ray, inf where almost nothing is seen. depth: sum of w_k t_k."""
    return wp.where(opacity > DEPTH_MIN_ALPHA, depth / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)


@declared_once
def image_kernel(shaded: bool) -> Any:
    """The kernel that renders a view, by a RowTable or by a ShadedGrid."""
    table_type = ShadedGrid if shaded else RowTable
    variant = "shaded" if shaded else "rows"

    @wp.func
    def march(grid: VoxelGrid, table: table_type, origin: wp.vec3, direction: wp.vec3, step: float, stop: float):
        """Gather radiance along a ray until its transmittance falls below `stop`."""
        result = Radiance()
        result.transmittance = float(1.0)
        if wp.static(not shaded):
            basis = sh_basis(direction)
        ray = grid_ray(grid, origin, direction, step)
        inverse_slope = safe_inverse(ray.slope)
        inverse_step = 1.0 / step
        tops = wp.vec3i(grid.skip.shape[0] - 1, grid.skip.shape[1] - 1, grid.skip.shape[2] - 1)
        if wp.static(not shaded):
            pending = float(0.0)  # weight of samples whose colour is not looked up yet
        k = float(ray.first)  # a whole number: no conversions in the loop, where each step waits for the one before
        t = steps_to_sample(k) * step
        while t < ray.far and result.transmittance > stop:
            g = ray.start + t * ray.slope
            ci = wp.clamp(int(g[0]), 0, tops[0])
            cj = wp.clamp(int(g[1]), 0, tops[1])
            ck = wp.clamp(int(g[2]), 0, tops[2])
            empty = cell_byte(grid.skip, ci, cj, ck)
            offset = g - wp.vec3(float(ci), float(cj), float(ck))
            if empty > 0:
                leave = t + exit_of_cell(offset, inverse_slope, empty)
                after = first_sample(leave * inverse_step)
                k = wp.where(after > k + 1.0, after, k + 1.0)
            else:
                if wp.static(shaded):
                    shade = color_at(table, ci, cj, ck, offset)
                    if shade[3] > 0.0:
                        kept = wp.exp(-shade[3])
                        weight = result.transmittance * (1.0 - kept)
                        color = wp.vec3(shade[0] + 0.5, shade[1] + 0.5, shade[2] + 0.5)
                        result.color += weight * wp.max(color, wp.vec3(0.0, 0.0, 0.0))
                        result.depth += weight * t
                        result.transmittance *= kept
                else:
                    sigma = row_density(table.laid, table.unit, grid.density, table.columns, ci, cj, ck, offset)
                    if sigma > 0.0:
                        kept = wp.exp(-sigma * step)
                        weight = result.transmittance * (1.0 - kept)
                        pending += weight
                        if pending > PENDING_WEIGHT:
                            color = row_color(grid.sh, table.packed, table.columns, ci, cj, ck, offset, basis)
                            result.color += pending * wp.max(color, wp.vec3(0.0, 0.0, 0.0))
                            pending = float(0.0)
                        result.depth += weight * t
                        result.transmittance *= kept
                k += 1.0
            t = steps_to_sample(k) * step
        if wp.static(not shaded):
            result.color += pending_color(result.color, result.transmittance, pending)
        result.color = forward_only(result.color, origin)
        result.transmittance = forward_only(result.transmittance, origin)
        result.depth = forward_only(result.depth, origin)
        return result

    @wp.kernel(name=f"render_{variant}", module=variant_module(__name__, variant, block_dim=64 if shaded else 128))
    def render(
        first: int,
        grid: VoxelGrid,
        table: table_type,
        camera: PinholeCamera,
        background: wp.vec3,
        step: float,
        stop: float,
        rgb: wp.array(dtype=wp.vec3),
        alpha: wp.array(dtype=wp.float32),
        depth: wp.array(dtype=wp.float32),
    ):
        """One thread per pixel, in the order of view/rays.tile_pixel; outputs (h * w,) row by row."""
        column, row = tile_pixel(first + wp.tid(), camera.width)
        if column >= camera.width or row >= camera.height:
            return
        n = row * camera.width + column
        seen = march(grid, table, camera.center, pixel_direction(camera, column, row), step, stop)
        opacity = 1.0 - seen.transmittance
        rgb[n] = seen.color + seen.transmittance * background
        alpha[n] = opacity
        depth[n] = visible_depth(seen.depth, opacity)

    return render


def variants() -> list[Any]:
    """All kernels that factories of this file declare."""
    return [image_kernel(shaded) for shaded in (False, True)]


#: A picture shows what has this rendering weight in one of its pixels.
SHOWN_WEIGHT = wp.constant(0.01)


@wp.func
def picture_mark(picture: int):
    """The bit that stands for one of 32 pictures."""
    return wp.uint32(1) << wp.uint32(picture % 32)


@wp.func
def record_row(
    weights: wp.array(dtype=wp.float32), shown: wp.array(dtype=wp.uint32), row: int, weight: float, mark: wp.uint32
):
    """Raise the weight of a row to one that a ray gives it; note that the ray's picture shows it, where `shown` has
    rows."""
    if weights[row] < weight:
        wp.atomic_max(weights, row, weight)
    if weight >= SHOWN_WEIGHT and shown.shape[0] > 0:
        if (shown[row] & mark) == wp.uint32(0):
            wp.atomic_or(shown, row, mark)


@wp.kernel
def record_weights(
    first: int,
    cameras: wp.array(dtype=PinholeCamera),
    pixel_stride: int,
    counted: wp.array3d(dtype=wp.uint8),
    grid: VoxelGrid,
    step: float,
    stop: float,
    weights: wp.array(dtype=wp.float32),
    shown: wp.array(dtype=wp.uint32),
):
    """Largest rendering weight T_k alpha_k that any ray gives to each node's row, and marks of the pictures that show
    it. Every pixel_stride-th row and column of every camera; counted (views, h, w) is 0 where none goes, or empty."""
    # Rays share rows: on the CPU each thread needs outputs of its own, which are joined.
    pixel = strided_pixel(first + wp.tid(), cameras[0].width, cameras[0].height, pixel_stride)
    if counted.shape[0] > 0:
        if counted[pixel[0], pixel[1], pixel[2]] == wp.uint8(0):
            return
    camera = cameras[pixel[0]]
    mark = picture_mark(pixel[0])
    ray = grid_ray(grid, camera.center, pixel_direction(camera, pixel[2], pixel[1]), step)
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
                        record_row(weights, shown, cell.rows[c], weight, mark)
                transmittance *= wp.exp(-sigma * step)
            k += 1
