"""Where the views of deformed scenes go."""

import warp as wp

from ..field.march import visible_depth
from ..view.tile_order import TileOrder
from .march import DeformedRadiance

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Picture:
    """Where a view goes, (h * w,) each; the masks are those of DeformedRadiance."""

    rgb: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)
    reveal: wp.array(dtype=wp.float32)
    fold: wp.array(dtype=wp.float32)
    outside: wp.array(dtype=wp.float32)
    begins: wp.array(dtype=wp.float32)  # (tiles,) distance before which the rays of a tile meet nothing; or none
    order: TileOrder  # in which marches of one edit or of a part of the scene follow its tiles


@wp.func
def fill_pixel(picture: Picture, pixel: int, seen: DeformedRadiance, background: wp.vec3):
    """Write what a march saw to a pixel."""
    picture.rgb[pixel] = seen.colour + seen.transmittance * background
    opacity = 1.0 - seen.transmittance
    picture.alpha[pixel] = opacity
    picture.depth[pixel] = visible_depth(seen.depth, opacity)
    picture.reveal[pixel] = seen.reveal
    picture.fold[pixel] = seen.fold
    picture.outside[pixel] = seen.outside
