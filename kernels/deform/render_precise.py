"""Pictures of a deformed scene without a lattice: mean value or Green coordinates evaluated at every sample.

The "precise" mode of "Deforming Radiance Fields with Cages" (ECCV 2022), section 5.3. The same functions as in
deform/render on ClosedFormEdit; a module of its own, so that it is compiled only when it is used.

Positions are exact everywhere. Lattices only save work whose result is known (see deform/settled_cells).
Needs: deform/edits, deform/march, deform/pictures, field/grid, view/rays.
"""

import warp as wp

from ..field.grid import VoxelGrid
from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .edits import ClosedFormEdit
from .march import MarchOptions, march_deformed
from .pictures import Picture, fill_pixel

# small blocks: the rays of one block end at very different times
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})


@wp.kernel
def render_precisely(
    first: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=ClosedFormEdit),
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """As deform/render.render_edits."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        seen = march_deformed(edits, grid, camera.centre, pixel_direction(camera, column, row), options)
        fill_pixel(picture, row * camera.width + column, seen, background)
