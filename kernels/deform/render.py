"""Views of a voxel field that several edits on lattices deform ("Deforming Radiance Fields with Cages", ECCV 2022,
Eq. 4 and 5); see deform/march_several.

Needs: deform/flat_edits, deform/march, deform/march_several, deform/pictures, field/grid, field/rows, view/rays.
"""

import warp as wp

from ..field.grid import VoxelGrid
from ..field.rows import RowTable
from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .flat_edits import FlatEdit
from .march import MarchOptions
from .march_several import AnyEdits, march_edits
from .pictures import Picture, fill_pixel

# small blocks: the rays of one block end at very different times
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})


@wp.kernel(cuda_max_registers=128)
def render_edits(
    first: int,
    grid: VoxelGrid,
    table: RowTable,
    edits: wp.array(dtype=FlatEdit),
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """One thread per pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        direction = pixel_direction(camera, column, row)
        seen = march_edits(AnyEdits(), edits, grid, table, camera.centre, direction, options)
        fill_pixel(picture, row * camera.width + column, seen, background)
