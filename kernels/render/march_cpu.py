"""Views of a voxel field that one edit deforms, on a CPU: render/march for the rays of a tile, sixteen side by side."""

import warp as wp

from ..core.gradients import forward
from ..core.variants import native_constants, native_source
from ..edits.structs import (
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    CUT_LENGTH,
    LOOK_SKIP,
    EditData,
)
from ..field.grid import SAMPLE_PLACE, VoxelGrid, first_sample, grid_span
from ..field.march import PENDING_WEIGHT
from ..field.occupancy import MatterCells
from ..field.rows import RowTable
from ..view.rays import TILE_SIZE, PinholeCamera, box_span, joined_span, pixel_direction, tile_pixel
from .rays import (
    BEGUN,
    FAINT,
    FOLD_MIN_WEIGHT,
    MAX_SUB_SAMPLES,
    DeformedRadiance,
    MarchOptions,
    Picture,
    ScenePart,
    fill_pixel,
    finished,
    part_end,
    ray_start,
    ray_state,
    store_ray,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

tile_rays = wp.types.matrix(shape=(32, 10), dtype=wp.float32)

tile_radiance = wp.types.matrix(shape=(32, 10), dtype=wp.float32)

CONSTANTS = native_constants(
    sample_place=SAMPLE_PLACE,
    cell_inside=CELL_INSIDE,
    cell_outside=CELL_OUTSIDE,
    cell_stays=CELL_STAYS,
    cell_folded=CELL_FOLDED,
    cell_steep=CELL_STEEP,
    look_skip=LOOK_SKIP,
    most_parts=MAX_SUB_SAMPLES,
    cut_length=CUT_LENGTH,
    faint=FAINT,
    fold_weight=FOLD_MIN_WEIGHT,
)


@forward.func_native(CONSTANTS + native_source(__file__, "march_cpu.h"))
def march_tile(
    edit: EditData,
    grid: VoxelGrid,
    table: RowTable,
    cells: MatterCells,
    start: wp.vec3,
    rays: tile_rays,
    before: tile_radiance,
    options: MarchOptions,
    least: float,
) -> tile_radiance:
    """What render/march.march_edit gathers along each ray of a tile, beside what was gathered before, as
    DeformedRadiance has it, and what is pending. start: the rays' origin in lattice cells."""
    # rays: cells per distance (3), spans in the lattice's box (2) and the grid (2), end, first sample, one more.
    ...


@wp.kernel
def render_edit_tiles(
    first: int,
    grid: VoxelGrid,
    table: RowTable,
    cells: MatterCells,
    edit: EditData,
    part: ScenePart,
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """As the kernels of render/views, render_sides, render_part and render_part_sides, on a CPU alone: one item
    per tile. A single edit's part is the first and the last."""
    tile = first + wp.tid()
    start = (camera.center - edit.lower) * edit.inverse_spacing
    counts = edit.node_counts
    corner = wp.vec3(float(counts[0] - 1), float(counts[1] - 1), float(counts[2] - 1))
    rays = tile_rays()
    values = tile_radiance()
    for r in range(TILE_SIZE):
        column, row = tile_pixel(tile * TILE_SIZE + r, camera.width)
        rays[r, 7] = -1.0
        if column < camera.width and row < camera.height:
            direction = pixel_direction(camera, column, row)
            end = part_end(part, camera.center, direction)
            rays[r, 9] = end
            if end > 0.0:
                ray = ray_state(part, row * camera.width + column)
                seen = ray.seen
                for axis in range(3):
                    values[r, axis] = seen.color[axis]
                values[r, 3] = seen.transmittance
                values[r, 4] = seen.depth
                values[r, 5] = seen.cleared_transmittance
                values[r, 6] = seen.reveal
                values[r, 7] = seen.fold
                values[r, 8] = seen.outside
                values[r, 9] = ray.pending
                if seen.transmittance > options.stop:
                    rate = direction * edit.inverse_spacing
                    box = box_span(start, rate, wp.vec3(0.0, 0.0, 0.0), corner)
                    span = grid_span(grid, camera.center, direction)
                    near_far = joined_span(box, span)
                    for axis in range(3):
                        rays[r, axis] = rate[axis]
                    rays[r, 3] = box[0]
                    rays[r, 4] = box[1]
                    rays[r, 5] = span[0]
                    rays[r, 6] = span[1]
                    rays[r, 7] = wp.min(near_far[1], end)
                    rays[r, 8] = first_sample(wp.max(near_far[0], ray.reached) / options.step)
    values = march_tile(edit, grid, table, cells, start, rays, values, options, PENDING_WEIGHT)
    for r in range(TILE_SIZE):
        column, row = tile_pixel(tile * TILE_SIZE + r, camera.width)
        if column < camera.width and row < camera.height:
            pixel = row * camera.width + column
            end = rays[r, 9]
            ray = ray_start()
            if end > 0.0:
                seen = DeformedRadiance()
                seen.color = wp.vec3(values[r, 0], values[r, 1], values[r, 2])
                seen.transmittance = values[r, 3]
                seen.depth = values[r, 4]
                seen.cleared_transmittance = values[r, 5]
                seen.reveal = values[r, 6]
                seen.fold = values[r, 7]
                seen.outside = values[r, 8]
                ray.seen = seen
                ray.pending = values[r, 9]
                ray.reached = wp.max(rays[r, 7], BEGUN)
            if part.is_last == 1:
                fill_pixel(picture, pixel, finished(ray), background)
            elif end > 0.0 or part.is_first == 1:
                store_ray(part, pixel, ray)
