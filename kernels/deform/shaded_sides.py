"""Views of a voxel field that one edit deforms whose map has corner values for each side of narrow gaps, of voxels that
were shaded for the camera ("Deforming Radiance Fields with Cages", ECCV 2022, Eq. 4 and 5); see deform/march_single and
deform/laid_shades.

Needs: deform/flat_edits, deform/laid_shades, deform/march, deform/march_single, deform/pictures, deform/ray_parts,
field/grid, view/rays.
"""

import warp as wp

from ..field.grid import VoxelGrid
from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .flat_edits import FlatEdit
from .laid_shades import LaidShades
from .march import MarchOptions
from .march_single import WithSides, march_edit
from .pictures import Picture, fill_pixel
from .ray_parts import RAY_END, finished, ray_start

# small blocks: the rays of one block end at very different times
wp.set_module_options({"enable_backward": False, "block_dim": 64})


@wp.kernel(cuda_max_registers=128)
def render_shaded_edit_with_sides(
    first: int,
    grid: VoxelGrid,
    table: LaidShades,
    edit: FlatEdit,
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """One thread per pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        direction = pixel_direction(camera, column, row)
        start = ray_start()
        ray = march_edit(WithSides(), edit, grid, table, camera.centre, direction, options, start, RAY_END)
        fill_pixel(picture, row * camera.width + column, finished(ray), background)
