"""Draw the splats of each tile over each other, a tile at a time: what a CPU does best."""

import warp as wp

from ..core.gradients import forward
from ..core.variants import native_source
from .tiles import TileGrid

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@forward.func_native(native_source(__file__, "cpp/composite_slopes_cpu.h"))
def sum_tile_slopes(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    tiles: TileGrid,
    tile: int,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    entry_sums: wp.array(dtype=wp.float32),
):
    """The sums of the entries of a tile, on the CPU alone. Arrays without gaps."""
    ...


@wp.kernel
def sum_slopes_of_tiles(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    entry_sums: wp.array(dtype=wp.float32),
):
    """One item per tile; inputs and picture of splats/composite_cpu. sources: (entries,) place of each sorted entry
    among those written. slopes: (views * h * w,) of the loss by the picture. entry_sums: (9 entries,), by place."""
    tile = first + wp.tid()
    sum_tile_slopes(view, members, sources, starts[tile], starts[tile + 1], tiles, tile, stop, rgb, slopes, entry_sums)


@forward.func_native(
    f"#define WITH_DEPTHS\n{native_source(__file__, 'cpp/composite_slopes_cpu.h')}#undef WITH_DEPTHS\n"
)
def sum_tile_depth_slopes(
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    begin: int,
    end: int,
    tiles: TileGrid,
    tile: int,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    others: wp.array(dtype=wp.vec3),
    entry_sums: wp.array(dtype=wp.float32),
    entry_depths: wp.array(dtype=wp.float32),
):
    """`sum_tile_slopes` of pixels whose opacities and depths count too."""
    ...


@wp.kernel
def sum_depth_slopes_of_tiles(
    first: int,
    view: wp.array(dtype=wp.vec4),
    members: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tiles: TileGrid,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    others: wp.array(dtype=wp.vec3),
    entry_sums: wp.array(dtype=wp.float32),
    entry_depths: wp.array(dtype=wp.float32),
):
    """`sum_slopes_of_tiles` of a loss by colors, opacities and depths: others, as for splats/composite
    `add_depth_slopes`; entry_depths: (3 entries,), by place."""
    tile = first + wp.tid()
    begin = starts[tile]
    end = starts[tile + 1]
    sum_tile_depth_slopes(
        view, members, sources, begin, end, tiles, tile, stop, rgb, slopes, others, entry_sums, entry_depths
    )


@wp.kernel
def sum_slopes_of_splats(
    first: int,
    order: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int64),
    width: int,
    entry_sums: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
):
    """order: (n,) splats as they wrote their entries. ends: (n,) where the entries of each end. entry_sums:
    (width entries,), sums: (width n,)."""
    i = first + wp.tid()
    begin = int(0)
    if i > 0:
        begin = int(ends[i - 1])
    end = int(ends[i])
    n = order[i]
    for k in range(width):
        total = float(0.0)
        for e in range(begin, end):
            total += entry_sums[width * e + k]
        sums[width * n + k] = total


@forward.func_native(native_source(__file__, "cpp/composite_cpu.h"))
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
    """One item per tile. Outputs (views * h * w,), row by row; depth: expected distance along the ray, world units, inf
    where almost nothing is seen, or (0,)."""
    # view: (3 n,) of splats/project. members: splats of tiles, front to back; starts: (tiles + 1,) of each tile.
    tile = first + wp.tid()
    draw_tile(view, members, starts[tile], starts[tile + 1], tiles, tile, background, stop, rgb, alpha, depth)
