"""Tiles of the training images that see anything of a field."""

# A module of its own: on CUDA, fitting/loss is not compiled, as fitting/loss_warps takes its place.

import warp as wp

from ..field.grid import VoxelGrid, empty_distance, grid_ray, sample_beyond, sample_distance, sample_place
from ..view.rays import PinholeCamera, pixel_direction

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def mark_active_tiles(
    first: int,
    grid: VoxelGrid,
    cameras: wp.array(dtype=PinholeCamera),
    tile_size: int,
    step: float,
    active: wp.array(dtype=wp.int32),
):
    """active: (tiles,) 1 where any pixel of a tile looks through a cell that holds values: the others have no gradient.
    One item per tile. step: world units from one look at the grid to the next."""
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
            ray = grid_ray(grid, camera.center, pixel_direction(camera, column, row), step)
            k = ray.first
            while sample_distance(ray, k) < ray.far and found == 0:
                g = sample_place(ray, k)
                empty = empty_distance(grid, g)
                if empty > 0:
                    k = sample_beyond(ray, k, g, empty)
                else:
                    found = int(1)
    active[tile] = found
