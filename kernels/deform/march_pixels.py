"""The ray of a pixel through a scene that edits deform, whatever a march reads of the field, and whether maps have
narrow gaps ("Deforming Radiance Fields with Cages", ECCV 2022, Eq. 4 and 5).

Needs: deform/flat_edits, deform/march, deform/march_single, deform/pictures, deform/ray_parts, field/grid, view/rays,
view/tile_order.
"""

from typing import Any

import warp as wp

from ..field.grid import VoxelGrid
from ..view.rays import TILE_SIZE, PinholeCamera, pixel_direction, tile_pixel
from ..view.tile_order import clock_ticks, note_ticks, ordered_item
from .flat_edits import FlatEdit
from .march import MarchOptions
from .march_single import march_edit
from .pictures import Picture, fill_pixel
from .ray_parts import RAY_END, RayState, ScenePart, finished, leave_ray, part_end, ray_start, ray_state

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def begun_ray(state: RayState, picture: Picture, item: int):
    """A ray of an item that has passed what holds nothing for all rays of its tile."""
    if picture.begins.shape[0] > 0:
        state.reached = wp.max(state.reached, picture.begins[item // TILE_SIZE])
    return state


@wp.func
def march_pixel(
    item: int,
    sides: Any,
    grid: VoxelGrid,
    table: Any,
    edit: FlatEdit,
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """Fill the pixel of an item, tile by tile in the picture's order. sides: NoSides or WithSides; table: RowTable or
    LaidShades."""
    begin = clock_ticks()
    place = ordered_item(picture.order, item)
    column, row = tile_pixel(place, camera.width)
    if column < camera.width and row < camera.height:
        direction = pixel_direction(camera, column, row)
        start = begun_ray(ray_start(), picture, place)
        ray = march_edit(sides, edit, grid, table, camera.centre, direction, options, start, RAY_END)
        fill_pixel(picture, row * camera.width + column, finished(ray), background)
        note_ticks(picture.order, place, begin)


@wp.func
def march_part_pixel(
    item: int,
    sides: Any,
    grid: VoxelGrid,
    table: Any,
    edit: FlatEdit,
    part: ScenePart,
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """The same through a part of the scene, from where the parts before it have left the ray; the last one fills."""
    begin = clock_ticks()
    place = ordered_item(picture.order, item)
    column, row = tile_pixel(place, camera.width)
    if column < camera.width and row < camera.height:
        pixel = row * camera.width + column
        direction = pixel_direction(camera, column, row)
        end = part_end(part, camera.centre, direction)
        if end > 0.0:
            ray = ray_state(part, pixel)
            if ray.seen.transmittance > options.stop:
                ray = begun_ray(ray, picture, place)
                ray = march_edit(sides, edit, grid, table, camera.centre, direction, options, ray, end)
                if part.is_last == 0:
                    leave_ray(part, pixel, ray)
            if part.is_last == 1:
                fill_pixel(picture, pixel, finished(ray), background)
        elif part.is_first == 1:
            leave_ray(part, pixel, ray_start())
        note_ticks(picture.order, place, begin)
