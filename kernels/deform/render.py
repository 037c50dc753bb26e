"""Views of a deformed voxel field whose edits are looked up on lattices.

"Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1 (the map on a lattice) and Eq. 5. See deformed_march for
the march and cage_edits for the map.
Needs: deform/edits, deform/march, field/grid, field/render, view/rays.
"""

import warp as wp

from ..field.grid import VoxelGrid
from ..field.render import DEPTH_MIN_ALPHA
from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from .edits import LatticeEdit
from .march import DeformedRadiance, MarchOptions, march_deformed

# small blocks: rays of one end at very different times
wp.set_module_options({"enable_backward": False, "block_dim": 64})


@wp.func
def visible_depth(seen: DeformedRadiance):
    """Expected distance along the ray, inf where next to nothing is seen."""
    opacity = 1.0 - seen.transmittance
    return wp.where(opacity > DEPTH_MIN_ALPHA, seen.depth / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)


@wp.struct
class Picture:
    """Where a view goes, (h * w,) each; the masks are those of DeformedRadiance."""

    rgb: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)
    reveal: wp.array(dtype=wp.float32)
    fold: wp.array(dtype=wp.float32)
    outside: wp.array(dtype=wp.float32)


@wp.func
def fill_pixel(picture: Picture, pixel: int, seen: DeformedRadiance, background: wp.vec3):
    """Write what a march saw to a pixel."""
    picture.rgb[pixel] = seen.colour + seen.transmittance * background
    picture.alpha[pixel] = 1.0 - seen.transmittance
    picture.depth[pixel] = visible_depth(seen)
    picture.reveal[pixel] = seen.reveal
    picture.fold[pixel] = seen.fold
    picture.outside[pixel] = seen.outside


@wp.kernel
def render_edits(
    first: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=LatticeEdit),
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """One thread a pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        seen = march_deformed(edits, grid, camera.centre, pixel_direction(camera, column, row), options)
        fill_pixel(picture, row * camera.width + column, seen, background)
