"""Views of a voxel field that one edit deforms, on a CPU: render/march for the rays of a tile, sixteen side by side."""

import warp as wp

from ..core.gradients import forward
from ..core.variants import native_source
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
from ..field.grid import VoxelGrid, grid_span
from ..field.march import PENDING_WEIGHT
from ..field.occupancy import MatterCells
from ..field.rows import RowTable
from ..view.rays import TILE_SIZE, PinholeCamera, box_span, pixel_direction, tile_pixel
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

CONSTANTS = "".join(  #: of the march, by their names in C++
    f"const {kind} {name} = {value}{'f' if kind == 'float' else ''};\n"
    for kind, name, value in (
        ("int", "cell_inside", CELL_INSIDE),
        ("int", "cell_outside", CELL_OUTSIDE),
        ("int", "cell_stays", CELL_STAYS),
        ("int", "cell_folded", CELL_FOLDED),
        ("int", "cell_steep", CELL_STEEP),
        ("int", "look_skip", LOOK_SKIP),
        ("int", "most_parts", MAX_SUB_SAMPLES),
        ("float", "cut_length", float(CUT_LENGTH)),
        ("float", "faint", float(FAINT)),
        ("float", "fold_weight", float(FOLD_MIN_WEIGHT)),
    )
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
                    near = float(1.0e30)
                    far = float(-1.0)
                    if box[0] < box[1]:
                        near = box[0]
                        far = box[1]
                    if span[0] < span[1]:
                        near = wp.min(near, span[0])
                        far = wp.max(far, span[1])
                    for axis in range(3):
                        rays[r, axis] = rate[axis]
                    rays[r, 3] = box[0]
                    rays[r, 4] = box[1]
                    rays[r, 5] = span[0]
                    rays[r, 6] = span[1]
                    rays[r, 7] = wp.min(far, end)
                    rays[r, 8] = wp.ceil(wp.max(near, ray.reached) / options.step - 0.5)
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
