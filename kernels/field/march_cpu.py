"""Views of a sparse voxel grid on a CPU: the march of field/march for the rays of a tile, sixteen side by side."""

import warp as wp

from ..core.gradients import forward
from ..core.variants import native_constants, native_source
from ..view.rays import TILE_SIZE, PinholeCamera, pixel_direction, tile_pixel
from .grid import SAMPLE_PLACE, VoxelGrid, grid_ray
from .march import PENDING_WEIGHT, pending_color, visible_depth
from .occupancy import MatterCells
from .rows import RowTable

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

tile_floats = wp.types.vector(length=32, dtype=wp.float32)

tile_directions = wp.types.matrix(shape=(32, 3), dtype=wp.float32)

tile_radiance = wp.types.matrix(shape=(32, 6), dtype=wp.float32)


@forward.func_native(native_constants(sample_place=SAMPLE_PLACE) + native_source(__file__, "cpp/march_cpu.h"))
def march_tile(
    grid: VoxelGrid,
    table: RowTable,
    cells: MatterCells,
    start: wp.vec3,
    directions: tile_directions,
    firsts: tile_floats,
    ends: tile_floats,
    step: float,
    stop: float,
    least: float,
) -> tile_radiance:
    """Colour, transmittance, depth and what is pending of field/march.march for each ray of a tile.
    start: node coordinates of the rays' origin. firsts, ends: the first sample, and where the ray leaves the grid."""
    ...


@wp.kernel
def render_tiles(
    first: int,
    grid: VoxelGrid,
    table: RowTable,
    cells: MatterCells,
    camera: PinholeCamera,
    background: wp.vec3,
    step: float,
    stop: float,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """As field/march.render_image, on a CPU alone: one item per tile."""
    tile = first + wp.tid()
    start = wp.vec3(0.0, 0.0, 0.0)
    directions = tile_directions()
    firsts = tile_floats()
    ends = tile_floats()
    for r in range(TILE_SIZE):
        column, row = tile_pixel(tile * TILE_SIZE + r, camera.width)
        ends[r] = -1.0
        if column < camera.width and row < camera.height:
            direction = pixel_direction(camera, column, row)
            ray = grid_ray(grid, camera.center, direction, step)
            start = ray.start
            directions[r] = direction
            firsts[r] = float(ray.first)
            ends[r] = ray.far
    seen = march_tile(grid, table, cells, start, directions, firsts, ends, step, stop, PENDING_WEIGHT)
    for r in range(TILE_SIZE):
        column, row = tile_pixel(tile * TILE_SIZE + r, camera.width)
        if column < camera.width and row < camera.height:
            n = row * camera.width + column
            color = wp.vec3(seen[r, 0], seen[r, 1], seen[r, 2])
            transmittance = seen[r, 3]
            color += pending_color(color, transmittance, seen[r, 5])
            rgb[n] = color + transmittance * background
            alpha[n] = 1.0 - transmittance
            depth[n] = visible_depth(seen[r, 4], 1.0 - transmittance)
