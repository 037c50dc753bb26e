"""Points and views of a deformed scene without a lattice: mean value or Green coordinates evaluated at every sample.

The "precise" mode of "Deforming Radiance Fields with Cages" (ECCV 2022), section 5.3. The same functions as in
deformed_points and deformed_render on ClosedFormEdit; a module of its own, so that it is compiled only when it is used.
Siblings: cage_edits, deformed_march, deformed_points, deformed_render, grid, rays.
"""

import warp as wp

from .cage_edits import ClosedFormEdit
from .deformed_march import MarchOptions, march_deformed
from .deformed_points import canonical_ray
from .deformed_render import Picture, fill_pixel
from .grid import VoxelGrid
from .rays import PinholeCamera, pixel_direction, tile_pixel

wp.set_module_options({"enable_backward": False})


@wp.kernel
def map_points_precisely(
    first: int,
    edits: wp.array(dtype=ClosedFormEdit),
    origin: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    dt: float,
    canonical_points: wp.array(dtype=wp.vec3),
    canonical_directions: wp.array(dtype=wp.vec3),
    region: wp.array(dtype=wp.int32),
    outside: wp.array(dtype=wp.uint8),
):
    """As deformed_points.map_points."""
    n = first + wp.tid()
    ray = canonical_ray(edits, points[n] - origin, directions[n], dt)
    canonical_points[n] = ray.point + origin
    canonical_directions[n] = ray.direction
    region[n] = ray.region
    outside[n] = wp.uint8(ray.outside)


@wp.kernel
def render_precisely(
    first: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=ClosedFormEdit),
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """As deformed_render.render_edits."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        seen = march_deformed(edits, grid, camera.centre, pixel_direction(camera, column, row), options)
        fill_pixel(picture, row * camera.width + column, seen, background)
