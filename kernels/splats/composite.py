"""Draw the splats of each tile over each other, from front to back."""

import warp as wp

from ..core.gradients import forward
from ..core.variants import native_source
from .tiles import TILE_SIDE, TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 256})

#: A pixel has a depth where it is at least this opaque.
DEPTH_MIN_ALPHA = wp.constant(1.0e-3)

vec5 = wp.types.vector(length=5, dtype=wp.float32)


@forward.func_native(native_source(__file__, "cpp/composite.h"))
def drawn_pixel(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    x: float,
    y: float,
    inside: int,
    with_depth: int,
    stop: float,
) -> vec5:
    """Red, green, blue and depth, weighted, and what is left of the light, of a pixel with its center at x, y.
    All lanes of a warp, which has 8x4 pixels, row by row; blocks of up to 256 threads."""
    ...


@wp.func
def pixel_of_tiles(tiles: TileGrid, n: int):
    """The tile, the column and the row of the pixel of thread n, of which 32 are 8x4 pixels, and its place in arrays
    of all pictures, or -1 beside them."""
    tile = n // (TILE_SIDE * TILE_SIDE)
    of_view = tiles.columns * tiles.rows
    view = tile // of_view
    own = tile - view * of_view
    block = (n // 32) % (TILE_SIDE * TILE_SIDE // 32)
    lane = n % 32
    across = TILE_SIDE // 8
    column = (own % tiles.columns) * TILE_SIDE + (block % across) * 8 + lane % 8
    row = (tiles.first_row + own // tiles.columns) * TILE_SIDE + (block // across) * 4 + lane // 8
    at = int(-1)
    if column < tiles.width and row < tiles.height:
        at = (view * tiles.height + row) * tiles.width + column
    return tile, column, row, at


@wp.kernel
def composite_pixels(
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
    """One thread per pixel of the tiles, 32 of them 8x4 pixels. Outputs (views * h * w,); depth: expected distance
    along the ray, world units, inf where almost nothing is seen, or (0,)."""
    # view: (3 n,) of splats/project. members: splats of tiles, front to back; starts: (tiles + 1,) of each tile.
    tile, column, row, at = pixel_of_tiles(tiles, first + wp.tid())
    inside = 0
    if at >= 0:
        inside = 1
    with_depth = wp.min(depth.shape[0], 1)
    x = float(column) + 0.5
    y = float(row) + 0.5
    seen = drawn_pixel(view, members, starts[tile], starts[tile + 1], x, y, inside, with_depth, stop)
    if inside == 1:
        left = seen[4]
        opacity = 1.0 - left
        rgb[at] = wp.vec3(seen[0], seen[1], seen[2]) + left * background
        alpha[at] = opacity
        if with_depth == 1:
            depth[at] = wp.where(opacity > DEPTH_MIN_ALPHA, seen[3] / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)


#: Sums of a splat.
SUMS = wp.constant(9)


@forward.func_native(native_source(__file__, "cpp/composite_slopes.h"))
def add_pixel_slopes(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    x: float,
    y: float,
    inside: int,
    stop: float,
    color: wp.vec3,
    slope: wp.vec3,
    sums: wp.array(dtype=wp.float32),
):
    """Add the sums of a pixel with its center at x, y: its color, with what is behind the splats, and the slope by it.
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
    """One thread per pixel of the tiles, as splats/composite, whose inputs and picture these are. slopes:
    (views * h * w,) of the loss by the picture. sums: (SUMS views n,) are added to."""
    tile, column, row, at = pixel_of_tiles(tiles, first + wp.tid())
    inside = 0
    color = wp.vec3()
    slope = wp.vec3()
    if at >= 0:
        inside = 1
        color = rgb[at]
        slope = slopes[at]
    add_pixel_slopes(
        view,
        members,
        starts[tile],
        starts[tile + 1],
        float(column) + 0.5,
        float(row) + 0.5,
        inside,
        stop,
        color,
        slope,
        sums,
    )


@forward.func_native(f"#define WITH_DEPTHS\n{native_source(__file__, 'cpp/composite_slopes.h')}#undef WITH_DEPTHS\n")
def add_pixel_depth_slopes(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    x: float,
    y: float,
    inside: int,
    stop: float,
    color: wp.vec3,
    slope: wp.vec3,
    other: wp.vec3,
    sums: wp.array(dtype=wp.float32),
    depth_sums: wp.array(dtype=wp.float32),
):
    """`add_pixel_slopes` of a pixel whose opacity and depth count too; other: of gradients/splat_pose."""
    ...


@wp.kernel
def add_depth_slopes(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    others: wp.array(dtype=wp.vec3),
    sums: wp.array(dtype=wp.float32),
    depth_sums: wp.array(dtype=wp.float32),
):
    """`add_slopes` of a loss by colors, opacities and depths; others: (views * h * w,) of gradients/splat_pose.
    depth_sums: (3 views n,) are added to: slopes by a splat's distance, and by its lean along columns and rows."""
    tile, column, row, at = pixel_of_tiles(tiles, first + wp.tid())
    inside = 0
    color = wp.vec3()
    slope = wp.vec3()
    other = wp.vec3()
    if at >= 0:
        inside = 1
        color = rgb[at]
        slope = slopes[at]
        other = others[at]
    add_pixel_depth_slopes(
        view,
        members,
        starts[tile],
        starts[tile + 1],
        float(column) + 0.5,
        float(row) + 0.5,
        inside,
        stop,
        color,
        slope,
        other,
        sums,
        depth_sums,
    )
