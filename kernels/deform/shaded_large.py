"""The views of deform/shaded_single for pictures of many pixels ("Deforming Radiance Fields with Cages", ECCV 2022,
Eq. 4 and 5): a GPU that has rays enough takes less time with more of them in flight, of fewer registers each.

Needs: deform/flat_edits, deform/laid_shades, deform/march, deform/march_pixels, deform/march_single, deform/pictures,
field/grid, view/rays.
"""

import warp as wp

from ..field.grid import VoxelGrid
from ..view.rays import PinholeCamera
from .flat_edits import FlatEdit
from .laid_shades import LaidShades
from .march import MarchOptions
from .march_pixels import march_pixel
from .march_single import NoSides
from .pictures import Picture

# small blocks: the rays of one block end at very different times
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})


@wp.kernel(cuda_max_registers=72)
def render_large_shaded_edit(
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
    march_pixel(first + wp.tid(), NoSides(), grid, table, edit, camera, background, options, picture)
