"""Gradient of the photometric and total-variation losses by the density and SH coefficients of a voxel grid.

Photometric: mean over rays and channels of (C - C*)^2. With g = dL/dC, w_k = T_k alpha_k and the background as the
last sample, dL/dc_k = w_k g and dL/dsigma_k = dt (T_{k+1} c_k . g - sum_{j>k} w_j c_j . g): the hand-written adjoint of
volume_render.march as a second march (Plenoxels 2022, section 3.2; a tape cannot unroll a loop of unknown length).
Total variation: per cell and channel sqrt(dx^2 + dy^2 + dz^2 + eps) of forward differences (Plenoxels 2022, Eq. 3).
Siblings: grid, rays, spherical_harmonics, volume_render.
"""

import warp as wp

from .grid import VoxelGrid, cell_colour, cell_density, cell_sample, empty_distance, grid_position
from .rays import PinholeCamera, pixel_direction
from .spherical_harmonics import sh_basis, vec9
from .volume_render import exit_distance, grid_span, march, sample_index_after

wp.set_module_options({"enable_backward": False})


@wp.struct
class TrainingRays:
    """Images cut into square tiles; a batch is a run of tiles in a shuffled order."""

    cameras: wp.array(dtype=PinholeCamera)  # (views,)
    pixels: wp.array3d(dtype=wp.vec4h)  # (views, h, w) premultiplied rgb and alpha
    tiles: wp.array(dtype=wp.int32)  # shuffled flat tile indices: (view * tile rows + tile row) * tile columns + column
    tile_size: int
    first_tile: int  # where this batch begins in `tiles`


@wp.func
def batch_pixel(rays: TrainingRays, n: int):
    """(view, row, column) of the n-th ray of a batch; the far tiles' pixels may lie beyond the image."""
    size = rays.tile_size
    columns = (rays.pixels.shape[2] + size - 1) // size
    rows = (rays.pixels.shape[1] + size - 1) // size
    tile = rays.tiles[(rays.first_tile + n // (size * size)) % rays.tiles.shape[0]]
    within = n % (size * size)
    view = tile // (rows * columns)
    row = (tile // columns) % rows * size + within // size
    column = tile % columns * size + within % size
    return wp.vec3i(view, row, column)


# small blocks of few registers: a batch is hardly more threads than a large GPU holds at once
@wp.kernel(launch_bounds=(64, 8))
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
    grad_density: wp.array(dtype=wp.float32),
    grad_sh: wp.array2d(dtype=vec9),
    squared_error: wp.array(dtype=wp.float32),
):
    """Adds scale * d(sum over channels of (C - C*)^2) for each ray of a batch; squared_error: (rays,) that sum itself.

    random_background: a colour drawn for each ray goes behind both the image's alpha and the render, so that opacity is
    supervised too; 0 takes `background` for all. Gradient rows are shared: on the CPU each thread needs its own.
    Launch in blocks of at most 64 threads.
    """
    n = first + wp.tid()
    squared_error[n] = 0.0
    pixel = batch_pixel(rays, n)
    if pixel[1] >= rays.pixels.shape[1] or pixel[2] >= rays.pixels.shape[2]:
        return
    camera = rays.cameras[pixel[0]]
    origin = camera.centre
    direction = pixel_direction(camera, pixel[2], pixel[1])
    behind = background
    if random_background == 1:
        random = wp.rand_init(seed, n)
        behind = wp.vec3(wp.randf(random), wp.randf(random), wp.randf(random))

    seen = march(grid, origin, direction, step, stop)
    rgba = rays.pixels[pixel[0], pixel[1], pixel[2]]
    target = wp.vec3(float(rgba[0]), float(rgba[1]), float(rgba[2])) + (1.0 - float(rgba[3])) * behind
    error = seen.colour + seen.transmittance * behind - target
    squared_error[n] = wp.dot(error, error)
    grad_colour = 2.0 * scale * error

    # second march: `later` is the part of C . g that comes from behind the current sample
    later = wp.dot(seen.colour + seen.transmittance * behind, grad_colour)
    transmittance = float(1.0)
    basis = sh_basis(direction)
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
                transmittance *= wp.exp(-sigma * step)
                raw = cell_colour(grid, cell, basis)
                radiance = wp.dot(wp.max(raw, wp.vec3(0.0, 0.0, 0.0)), grad_colour)
                later -= weight * radiance
                grad_sigma = step * (transmittance * radiance - later)
                for c in range(8):
                    if cell.rows[c] >= 0:
                        wp.atomic_add(grad_density, cell.rows[c], cell.weights[c] * grad_sigma)
                for channel in range(3):
                    if raw[channel] > 0.0:  # the clamp max(0, .) passes no gradient
                        grad_cell = weight * grad_colour[channel] * basis
                        for c in range(8):
                            if cell.rows[c] >= 0:
                                wp.atomic_add(grad_sh, cell.rows[c], channel, cell.weights[c] * grad_cell)
            k += 1


@wp.func
def neighbour_row(grid: VoxelGrid, node: wp.vec3i, axis: int):
    """Row of the next node along an axis, or -1."""
    i = node[0] + wp.where(axis == 0, 1, 0)
    j = node[1] + wp.where(axis == 1, 1, 0)
    k = node[2] + wp.where(axis == 2, 1, 0)
    if i < grid.links.shape[0] and j < grid.links.shape[1] and k < grid.links.shape[2]:
        return grid.links[i, j, k]
    return int(-1)


@wp.func
def variation_slope(dx: float, dy: float, dz: float, scale: float):
    """scale / sqrt(dx^2 + dy^2 + dz^2 + eps): the factor of each difference in the variation's gradient."""
    return scale / wp.sqrt(dx * dx + dy * dy + dz * dz + 1.0e-9)


@wp.func
def add_density_variation(
    grid: VoxelGrid, rows: wp.vec4i, unit: float, scale: float, grad_density: wp.array(dtype=wp.float32)
):
    """rows: the cell's own and its next along x, y, z (-1: none)."""
    difference = wp.vec3()
    for axis in range(3):
        if rows[axis + 1] >= 0:
            difference[axis] = (grid.density[rows[axis + 1]] - grid.density[rows[0]]) / unit
    slope = variation_slope(difference[0], difference[1], difference[2], scale / unit)
    wp.atomic_add(grad_density, rows[0], -slope * (difference[0] + difference[1] + difference[2]))
    for axis in range(3):
        if rows[axis + 1] >= 0:
            wp.atomic_add(grad_density, rows[axis + 1], slope * difference[axis])


@wp.kernel
def accumulate_variation_gradient(
    first: int,
    grid: VoxelGrid,
    nodes: wp.array(dtype=wp.vec3i),
    first_row: int,
    density_unit: float,
    scale_density: float,
    scale_sh: float,
    grad_density: wp.array(dtype=wp.float32),
    grad_sh: wp.array2d(dtype=vec9),
):
    """Adds the gradient of scale_density * TV(density / density_unit) + scale_sh * TV(sh) over a run of rows.

    Three items a row, one a channel. nodes: (rows,) grid indices of each row. A difference to a node without a row
    counts as zero. Rows are shared with neighbours: on the CPU each thread needs gradient arrays of its own.
    """
    n = first + wp.tid()
    channel = n % 3
    row = (first_row + n // 3) % nodes.shape[0]
    node = nodes[row]
    rows = wp.vec4i(row, neighbour_row(grid, node, 0), neighbour_row(grid, node, 1), neighbour_row(grid, node, 2))
    if channel == 0:
        add_density_variation(grid, rows, density_unit, scale_density, grad_density)
    sh = grid.sh[row, channel]
    dx = vec9()
    dy = vec9()
    dz = vec9()
    if rows[1] >= 0:
        dx = grid.sh[rows[1], channel] - sh
    if rows[2] >= 0:
        dy = grid.sh[rows[2], channel] - sh
    if rows[3] >= 0:
        dz = grid.sh[rows[3], channel] - sh
    for b in range(9):
        slope = variation_slope(dx[b], dy[b], dz[b], scale_sh)
        dx[b] = dx[b] * slope
        dy[b] = dy[b] * slope
        dz[b] = dz[b] * slope
    wp.atomic_add(grad_sh, row, channel, -(dx + dy + dz))
    if rows[1] >= 0:
        wp.atomic_add(grad_sh, rows[1], channel, dx)
    if rows[2] >= 0:
        wp.atomic_add(grad_sh, rows[2], channel, dy)
    if rows[3] >= 0:
        wp.atomic_add(grad_sh, rows[3], channel, dz)


@wp.kernel
def mark_active_tiles(
    first: int,
    grid: VoxelGrid,
    cameras: wp.array(dtype=PinholeCamera),
    tile_size: int,
    step: float,
    active: wp.array(dtype=wp.int32),
):
    """1 where any pixel of a tile looks through a cell that holds values: the others have no gradient."""
    tile = first + wp.tid()
    width = cameras[0].width
    height = cameras[0].height
    columns = (width + tile_size - 1) // tile_size
    rows = (height + tile_size - 1) // tile_size
    camera = cameras[tile // (rows * columns)]
    found = int(0)
    for n in range(tile_size * tile_size):
        row = (tile // columns) % rows * tile_size + n // tile_size
        column = tile % columns * tile_size + n % tile_size
        if found == 0 and row < height and column < width:
            direction = pixel_direction(camera, column, row)
            g0 = grid_position(grid, camera.centre)
            dg = wp.cw_mul(direction, grid.inverse_voxel_size)
            span = grid_span(grid, camera.centre, direction)
            k = sample_index_after(span[0], step)
            while (float(k) + 0.5) * step < span[1] and found == 0:
                t = (float(k) + 0.5) * step
                empty = empty_distance(grid, g0 + t * dg)
                if empty > 0:
                    k = wp.max(k + 1, sample_index_after(t + exit_distance(g0 + t * dg, dg, empty), step))
                else:
                    found = int(1)
    active[tile] = found
