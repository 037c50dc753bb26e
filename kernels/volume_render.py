"""Emission-absorption ray marching of a sparse voxel grid.

C = sum_k T_k (1 - exp(-sigma_k dt)) c_k + T_end background, T_k = exp(-sum_{j<k} sigma_j dt): Max 1995 as used by NeRF
(Mildenhall et al. 2020, Eq. 3) and Plenoxels (2022, Eq. 1). Sample k of a ray lies at t_k = (k + 1/2) dt from its
origin whatever box it enters, so that two marches over one space sample the same points.
Siblings: grid, rays, spherical_harmonics.
"""

import warp as wp

from .grid import VoxelGrid, cell_colour, cell_density, cell_sample, empty_distance, grid_position
from .rays import PinholeCamera, box_span, pixel_direction, tile_pixel
from .spherical_harmonics import sh_basis

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
def grid_span(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
    """Distances (near, far) at which a ray is among the grid's nodes."""
    cells = wp.vec3(
        float(grid.links.shape[0] - 1), float(grid.links.shape[1] - 1), float(grid.links.shape[2] - 1)
    )
    return box_span(origin, direction, grid.lower, grid.lower + wp.cw_mul(cells, grid.voxel_size))


@wp.func
def exit_distance(g: wp.vec3, dg: wp.vec3, reach: int):
    """How far a ray at node coordinates g, moving by dg a unit, stays in the cells within reach - 1 of its own."""
    leave = float(1.0e30)
    for axis in range(3):
        if wp.abs(dg[axis]) > 1.0e-12:
            cell = wp.floor(g[axis])
            plane = wp.where(dg[axis] > 0.0, cell + float(reach), cell - float(reach) + 1.0)
            leave = wp.min(leave, (plane - g[axis]) / dg[axis])
    return leave


@wp.func
def sample_index_after(t: float, step: float):
    """Index of the first sample at or beyond distance t."""
    return int(wp.ceil(t / step - 0.5))


@wp.func
def march(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, step: float, stop: float):
    """Gather radiance along a ray until its transmittance falls below `stop`."""
    result = Radiance()
    result.transmittance = float(1.0)
    basis = sh_basis(direction)
    g0 = grid_position(grid, origin)
    dg = wp.cw_mul(direction, grid.inverse_voxel_size)
    span = grid_span(grid, origin, direction)
    k = sample_index_after(span[0], step)
    while (float(k) + 0.5) * step < span[1] and result.transmittance > stop:
        t = (float(k) + 0.5) * step
        g = g0 + t * dg
        empty = empty_distance(grid, g)
        if empty > 0:
            k = wp.max(k + 1, sample_index_after(t + exit_distance(g, dg, empty), step))
        else:
            cell = cell_sample(grid, g)
            sigma = cell_density(grid, cell)
            if sigma > 0.0:
                weight = result.transmittance * (1.0 - wp.exp(-sigma * step))
                colour = wp.max(cell_colour(grid, cell, basis), wp.vec3(0.0, 0.0, 0.0))
                result.colour += weight * colour
                result.depth += weight * t
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
    direction = pixel_direction(camera, column, row)
    origin = camera.centre
    transmittance = float(1.0)
    g0 = grid_position(grid, origin)
    dg = wp.cw_mul(direction, grid.inverse_voxel_size)
    span = grid_span(grid, origin, direction)
    k = sample_index_after(span[0], step)
    while (float(k) + 0.5) * step < span[1] and transmittance > stop:
        t = (float(k) + 0.5) * step
        g = g0 + t * dg
        empty = empty_distance(grid, g)
        if empty > 0:
            k = wp.max(k + 1, sample_index_after(t + exit_distance(g, dg, empty), step))
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
