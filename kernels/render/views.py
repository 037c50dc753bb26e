"""Views of a voxel field that edits deform, a kernel for each way of marching."""

from typing import Any

import warp as wp

from ..core.variants import declared_once, variant_module
from ..edits.structs import EditData, ExactEdit
from ..field.grid import VoxelGrid
from ..field.rows import RowTable
from ..view.rays import PinholeCamera, pixel_direction, tile_pixel
from ..view.tile_order import clock_ticks, note_ticks, ordered_item
from .march import make_edit_march
from .march_exact import march_deformed
from .march_stack import make_stack_march
from .rays import (
    RAY_END,
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
from .volume import ShadedVolume

#: Register limits, measured on an H200: parts and sides wait less with more.
MAX_REGISTERS = {
    "rows": 96,
    "rows+sides": 128,
    "rows+part": 128,
    "rows+sides+part": 128,
    "shaded": 80,
    "shaded+sides": 96,
    "shaded+part": 96,
    "shaded+sides+part": 96,
    "stack": 128,
    "stack+simple": 128,
    "exact": None,
}


def declaration(variant: str) -> dict[str, Any]:
    """The arguments of wp.kernel for a variant."""
    # small blocks: the rays of one block end at very different times
    module = variant_module(__name__, variant, block_dim=64)
    name = f"view_{variant.replace('+', '_')}"
    return {"name": name, "module": module, "cuda_max_registers": MAX_REGISTERS[variant]}


def view_name(shaded: bool, has_sides: bool, part: bool = False) -> str:
    """The variant's name, such as "shaded+part"."""
    table = "shaded" if shaded else "rows"
    return "+".join([table, *["sides"] * has_sides, *["part"] * part])


@declared_once
def view_kernel(shaded: bool, has_sides: bool) -> Any:
    """The kernel for one edit, by a RowTable or ShadedVolume. has_sides: of make_edit_march."""
    table_type = ShadedVolume if shaded else RowTable
    march = make_edit_march(has_sides)

    @wp.kernel(**declaration(view_name(shaded, has_sides)))
    def render(
        first: int,
        grid: VoxelGrid,
        table: table_type,
        edit: EditData,
        camera: PinholeCamera,
        background: wp.vec3,
        options: MarchOptions,
        picture: Picture,
    ):
        """One thread per pixel, tile by tile in the picture's order."""
        begin = clock_ticks()
        place = ordered_item(picture.order, first + wp.tid())
        column, row = tile_pixel(place, camera.width)
        if column < camera.width and row < camera.height:
            direction = pixel_direction(camera, column, row)
            ray = march(edit, grid, table, camera.center, direction, options, ray_start(), RAY_END)
            fill_pixel(picture, row * camera.width + column, finished(ray), background)
            note_ticks(picture.order, place, begin)

    return render


@declared_once
def part_kernel(shaded: bool, has_sides: bool) -> Any:
    """The kernel for one edit of several that cannot meet each other: the same through a part of the scene."""
    table_type = ShadedVolume if shaded else RowTable
    march = make_edit_march(has_sides)

    @wp.kernel(**declaration(view_name(shaded, has_sides, part=True)))
    def render(
        first: int,
        grid: VoxelGrid,
        table: table_type,
        edit: EditData,
        part: ScenePart,
        camera: PinholeCamera,
        background: wp.vec3,
        options: MarchOptions,
        picture: Picture,
    ):
        """One thread per pixel, tile by tile; a launch for each edit, front to back, of which the last fills pixels."""
        begin = clock_ticks()
        place = ordered_item(picture.order, first + wp.tid())
        column, row = tile_pixel(place, camera.width)
        if column < camera.width and row < camera.height:
            pixel = row * camera.width + column
            direction = pixel_direction(camera, column, row)
            end = part_end(part, camera.center, direction)
            if end > 0.0:
                ray = ray_state(part, pixel)
                if ray.seen.transmittance > options.stop:
                    ray = march(edit, grid, table, camera.center, direction, options, ray, end)
                    if part.is_last == 0:
                        store_ray(part, pixel, ray)
                if part.is_last == 1:
                    fill_pixel(picture, pixel, finished(ray), background)
            elif part.is_first == 1:
                store_ray(part, pixel, ray_start())
            note_ticks(picture.order, place, begin)

    return render


@declared_once
def stack_kernel(is_simple: bool) -> Any:
    """The kernel for several edits that may meet. is_simple: of make_stack_march."""
    march = make_stack_march(is_simple)

    @wp.kernel(**declaration("stack+simple" if is_simple else "stack"))
    def render(
        first: int,
        grid: VoxelGrid,
        table: RowTable,
        edits: wp.array(dtype=EditData),
        camera: PinholeCamera,
        background: wp.vec3,
        options: MarchOptions,
        picture: Picture,
    ):
        """One thread per pixel, tile by tile."""
        column, row = tile_pixel(first + wp.tid(), camera.width)
        if column < camera.width and row < camera.height:
            direction = pixel_direction(camera, column, row)
            seen = march(edits, grid, table, camera.center, direction, options)
            fill_pixel(picture, row * camera.width + column, seen, background)

    return render


@declared_once
def exact_kernel() -> Any:
    """The kernel that evaluates mean value or Green coordinates at every sample.
    Positions are exact everywhere: lattices only save work whose result is known (edits/cell_tables)."""

    @wp.kernel(**declaration("exact"))
    def render(
        first: int,
        grid: VoxelGrid,
        edits: wp.array(dtype=ExactEdit),
        camera: PinholeCamera,
        background: wp.vec3,
        options: MarchOptions,
        picture: Picture,
    ):
        """One thread per pixel, tile by tile."""
        column, row = tile_pixel(first + wp.tid(), camera.width)
        if column < camera.width and row < camera.height:
            seen = march_deformed(edits, grid, camera.center, pixel_direction(camera, column, row), options)
            fill_pixel(picture, row * camera.width + column, seen, background)

    return render


def variants() -> list[Any]:
    """All kernels that factories of this file declare."""
    pairs = [(shaded, has_sides) for shaded in (False, True) for has_sides in (False, True)]
    single = [make(*pair) for make in (view_kernel, part_kernel) for pair in pairs]
    return [*single, stack_kernel(True), stack_kernel(False), exact_kernel()]
