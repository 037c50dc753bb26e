"""Views of a voxel field that edits deform which cannot meet each other, of one edit whose map has no narrow gaps, of
voxels that were shaded for the camera ("Deforming Radiance Fields with Cages", ECCV 2022, Eq. 4 and 5); see
deform/march_single, deform/ray_parts and deform/laid_shades.

Needs: deform/flat_edits, deform/laid_shades, deform/march, deform/march_single, deform/pictures, deform/ray_parts,
field/grid, view/rays.
"""

import warp as wp

from ..field.grid import VoxelGrid
from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .flat_edits import FlatEdit
from .laid_shades import LaidShades
from .march import MarchOptions
from .march_single import NoSides, march_edit
from .pictures import Picture, fill_pixel
from .ray_parts import ScenePart, finished, leave_ray, part_end, ray_start, ray_state

# small blocks: the rays of one block end at very different times
wp.set_module_options({"enable_backward": False, "block_dim": 64})


@wp.kernel(cuda_max_registers=128)
def render_shaded_part(
    first: int,
    grid: VoxelGrid,
    table: LaidShades,
    edit: FlatEdit,
    part: ScenePart,
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """One thread per pixel, tile by tile; a launch for each edit, front to back."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        pixel = row * camera.width + column
        direction = pixel_direction(camera, column, row)
        end = part_end(part, camera.centre, direction)
        if end > 0.0:
            ray = ray_state(part, pixel)
            if ray.seen.transmittance > options.stop:
                ray = march_edit(NoSides(), edit, grid, table, camera.centre, direction, options, ray, end)
                if part.is_last == 0:
                    leave_ray(part, pixel, ray)
            if part.is_last == 1:
                fill_pixel(picture, pixel, finished(ray), background)
        elif part.is_first == 1:
            leave_ray(part, pixel, ray_start())
