"""Draw the splats of each tile over each other, a tile at a time: what a CPU does best."""

# The equation is that of splats/composite. Each splat is drawn over the pixels of the tile that its ellipse covers,
# eight of a row at once, so that a splat of a few pixels costs no more than these.

import warp as wp

from ..core.native import native_source
from .tiles import TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func_native(native_source(__file__, "composite_tiles.h"))
def draw_tile(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    tiles: TileGrid,
    tile: int,
    background: wp.vec3,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """Draw a tile of 16x16 pixels, on the CPU alone. Arrays without gaps. Alphas are those of splats/project."""
    ...


@wp.kernel
def composite_tiles(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    background: wp.vec3,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """One item per tile. Outputs (h * w,), row by row; depth: expected distance along the ray, world units, inf where
    almost nothing is seen."""
    # view: (3 n,) of splats/project. members: splats of all tiles, tile by tile from front to back. starts: (tiles +
    # 1,) where each begins.
    tile = first + wp.tid()
    draw_tile(view, members, starts[tile], starts[tile + 1], tiles, tile, background, stop, rgb, alpha, depth)
