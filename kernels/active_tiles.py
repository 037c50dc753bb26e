"""Tiles of the training images that see anything of a field.

A module of its own, as the gradients of field_loss are not compiled where field_loss_warps stands in for them.
Siblings: grid, rays, volume_render.
"""

import warp as wp

from .grid import VoxelGrid, empty_distance, grid_position
from .rays import PinholeCamera, pixel_direction
from .volume_render import exit_distance, grid_span, sample_index_after

wp.set_module_options({"enable_backward": False})


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
