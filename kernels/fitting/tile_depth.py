"""A loss of depths that differ between neighbouring pixels of a tile: flat things that show no texture are sheets."""

# weight * sum over neighbours a, b of (q_a - q_b)^2 exp(-|C*_a - C*_b| / EDGE), C* what the pictures show, q = sum_k
# w_k s_k + T_end the mean over a whole ray, front, box and back, of contracted distances s = t / (t + middle), 1 at
# infinity (Niemeyer et al., "RegNeRF", CVPR 2022, Eq. 6, of pixels that pictures have). With dL/dq it is one channel of
# colour more for the adjoints of fitting/loss and fitting/outer_loss.

import warp as wp

from ..field.grid import (
    VoxelGrid,
    cell_density,
    cell_sample,
    empty_distance,
    grid_ray,
    sample_beyond,
    sample_distance,
    sample_place,
)
from ..field.outer import (
    FAR_AWAY,
    OUTER_STOP,
    OuterGrid,
    front_end,
    outer_path,
    outer_piece,
    outer_place,
    outer_step,
    turn_after,
    turn_before_all,
)
from ..view.rays import pixel_direction
from .loss import TrainingRays, batch_pixel, contracted_distance, in_picture, training_color
from .outer_loss import outer_distance

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Difference of colours over which a loss of depths falls to 1 / e.
EDGE = wp.constant(0.1)


@wp.func
def box_depth(grid: VoxelGrid, rays: TrainingRays, origin: wp.vec3, direction: wp.vec3, step: float, stop: float):
    """Sum of weights times contracted distances in the box, and the light that is left."""
    ray = grid_ray(grid, origin, direction, step)
    depth = float(0.0)
    light = float(1.0)
    k = ray.first
    while sample_distance(ray, k) < ray.far and light > stop:
        g = sample_place(ray, k)
        empty = empty_distance(grid, g)
        if empty > 0:
            k = sample_beyond(ray, k, g, empty)
        else:
            kept = wp.exp(-step * wp.max(cell_density(grid, cell_sample(grid, g)), 0.0))
            depth += light * (1.0 - kept) * contracted_distance(rays, sample_distance(ray, k))
            light *= kept
            k += 1
    return wp.vec2(depth, light)


@wp.func
def outer_depth(outer: OuterGrid, rays: TrainingRays, origin: wp.vec3, direction: wp.vec3, begin: float, end: float):
    """As box_depth, of an outer grid between two distances."""
    depth = float(0.0)
    light = float(1.0)
    path = outer_path(outer, origin, direction, begin, end)
    turn = turn_after(path, turn_before_all())
    while turn.region >= 0:
        piece = outer_piece(outer, origin, direction, turn)
        k = int(0)
        while k < piece.count and light > OUTER_STOP:
            sample = outer_step(outer, piece, k, light, 0, 1)
            if sample.has_matter > 0:
                distance = outer_distance(outer, origin, direction, outer_place(outer, piece, k))
                depth += sample.before * (1.0 - sample.kept) * contracted_distance(rays, distance)
            light = sample.light
            k = sample.following
        turn = turn_after(path, turn)
    return wp.vec2(depth, light)


@wp.kernel
def gather_depths(
    first: int,
    outer: OuterGrid,
    grid: VoxelGrid,
    rays: TrainingRays,
    step: float,
    stop: float,
    depths: wp.array(dtype=wp.vec4),
):
    """Per ray (rays,), through the middle of its pixel: the part of its depth that is before the box, all of it, the
    depth that is seen behind the box, and the light that reaches there."""
    n = first + wp.tid()
    depths[n] = wp.vec4()
    pixel = batch_pixel(rays, n)
    if not in_picture(rays, pixel):
        return
    camera = rays.cameras[pixel[0]]
    direction = pixel_direction(camera, pixel[2], pixel[1])
    between = front_end(outer, camera.center, direction)
    front = wp.vec2(0.0, 1.0)
    if between > 0.0:
        front = outer_depth(outer, rays, camera.center, direction, 0.0, between)
    behind = float(0.0)
    if front[1] > OUTER_STOP:
        back = outer_depth(outer, rays, camera.center, direction, between, FAR_AWAY)
        behind = back[0] + back[1]
    inner = box_depth(grid, rays, camera.center, direction, step, stop)
    whole = front[0] + front[1] * (inner[0] + inner[1] * behind)
    depths[n] = wp.vec4(front[0], whole, behind, front[1] * inner[1])


@wp.kernel
def slope_depths(
    first: int, rays: TrainingRays, depths: wp.array(dtype=wp.vec4), weight: float, slopes: wp.array(dtype=wp.float32)
):
    """Gradient of the loss by the depth of each ray (rays,); depths: (rays,) of gather_depths."""
    n = first + wp.tid()
    slopes[n] = 0.0
    size = rays.tile_size
    pixel = batch_pixel(rays, n)
    if not in_picture(rays, pixel):
        return
    black = wp.vec3()
    color = training_color(rays, pixel, black)
    slope = float(0.0)
    for side in range(4):
        down = wp.where(side < 2, 2 * side - 1, 0)
        right = wp.where(side < 2, 0, 2 * side - 5)
        row = (n % (size * size)) // size + down
        column = n % size + right
        other = wp.vec3i(pixel[0], pixel[1] + down, pixel[2] + right)
        if row >= 0 and row < size and column >= 0 and column < size and in_picture(rays, other):
            edge = wp.exp(-wp.length(color - training_color(rays, other, black)) / EDGE)
            slope += 2.0 * weight * edge * (depths[n][1] - depths[n + down * size + right][1])
    slopes[n] = slope
