"""Slopes of a loss by what splats/project says of each splat, from those by the pixels of a picture."""

# The picture is drawn once more, front to back, as in splats/composite. With T the light that is left before a splat, g
# the slope by the pixel's colour C, P what the splats up to this one have added to C . g, and l = c . g of its colour,
#
#   dL/dalpha = T l - (C . g - P) / (1 - alpha),
#
# as what lies behind is the rest of the picture: nothing need be kept of the pixels but their colour. An alpha that is
# held at 0.999 has no slope. With q = dL/dpower = dL/dalpha alpha ln 2, power = strength - w^2 - s^2, w = l_0 dx + l_1
# dy and s = l_2 dy, nine sums over the pixels are all that the slopes of a splat are made of:
#
#   q    q w    q s    q w dx    q w dy    q s dy    T alpha g (3)
#
# For CUDA; on the CPU it is splats/composite_slopes_tiles. A warp has 8x4 pixels to itself, sums what its lanes have,
# by halves that lanes exchange, and adds nine numbers a splat.

import warp as wp

from ..core.native import native_source
from .tiles import TILE_SIDE, TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 256})

#: Sums of a splat.
SUMS = wp.constant(9)


@wp.func_native(native_source(__file__, "composite_slopes.h"))
def add_pixel_slopes(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    x: float,
    y: float,
    inside: int,
    stop: float,
    colour: wp.vec3,
    slope: wp.vec3,
    sums: wp.array(dtype=wp.float32),
):
    """Add the sums of a pixel with its centre at x, y: its colour, with what is behind the splats, and the slope by it.
    All lanes of a warp, which has 8x4 pixels, row by row; blocks of up to 256 threads."""
    ...


@wp.kernel
def add_slopes(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    sums: wp.array(dtype=wp.float32),
):
    """One thread per pixel of the tiles, as splats/composite, whose inputs and picture these are. slopes: (h * w,) of
    the loss by the picture. sums: (SUMS n,) are added to."""
    n = first + wp.tid()
    tile = n // (TILE_SIDE * TILE_SIDE)
    block = (n // 32) % (TILE_SIDE * TILE_SIDE // 32)
    lane = n % 32
    across = TILE_SIDE // 8
    column = (tile % tiles.columns) * TILE_SIDE + (block % across) * 8 + lane % 8
    row = (tiles.first_row + tile // tiles.columns) * TILE_SIDE + (block // across) * 4 + lane // 8
    inside = 0
    colour = wp.vec3()
    slope = wp.vec3()
    if column < tiles.width and row < tiles.height:
        inside = 1
        colour = rgb[row * tiles.width + column]
        slope = slopes[row * tiles.width + column]
    add_pixel_slopes(
        view,
        members,
        starts[tile],
        starts[tile + 1],
        float(column) + 0.5,
        float(row) + 0.5,
        inside,
        stop,
        colour,
        slope,
        sums,
    )
