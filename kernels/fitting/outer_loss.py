"""Gradients of the photometric loss and of the total variation by the values of an outer grid, and their steps."""

# C = F + T_F (inner), inner = ... + T B: the front F, the light T_F that passes it and the back B are marches through
# field/outer, before and after the inner grid's. A sample of weight w_k = T_k alpha_k gets dL/dc_k = w_k g and
# dL/dsigma_k = d_k (T_{k+1} c_k . g - sum_{j>k} w_j c_j . g - r), r what the end of its march adds: T_F dL/dT_F in
# front, T sky . g behind. Opaque voxels hide the sky, which would learn nothing and show as it began in new views: it
# also follows B, by a loss by_sky / 2 * T_F T |sky - B|^2 of the sky alone, T the light that passes the box.

import warp as wp

from ..core.gradients import forward, forward_only_in
from ..core.lanes import from_octet_lane, grid_place, octet_place, octet_sum_before
from ..field.background import layer_value, surface_sample
from ..field.columns import node_row
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
from ..field.march import picture_mark, record_row
from ..field.outer import (
    FAR_AWAY,
    OUTER_STOP,
    OuterGrid,
    any_goes_on,
    front_end,
    march_outer,
    outer_path,
    outer_piece,
    outer_step,
    shown_color,
    sky_color,
    turn_after,
    turn_before_all,
)
from ..view.rays import PinholeCamera, pixel_direction, strided_pixel
from .loss import TrainingRays, batch_pixel, in_picture
from .rmsprop import rmsprop_update

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3))


@wp.kernel(launch_bounds=(256, 3))  # at most 80 registers: three blocks at a time wait for less
def gather_outer(
    first: int, outer: OuterGrid, rays: TrainingRays, front: wp.array(dtype=wp.vec4), behind: wp.array(dtype=wp.vec3)
):
    """What is before the box, (rays,) colour and the light that passes, and behind it, (rays,) colour with the sky.
    An octet of lanes (core/lanes) per ray, as many items as fill whole warps."""
    n, lane, lanes = octet_place(first + wp.tid())
    pixel = batch_pixel(rays, n)
    is_ray = n < behind.shape[0] and in_picture(rays, pixel)
    camera = rays.cameras[pixel[0]]
    direction = pixel_direction(camera, pixel[2], pixel[1])
    between = front_end(outer, camera.center, direction)
    # octets of a warp march together: those with no way left march none of it
    seen = march_outer(outer, camera.center, direction, 0.0, wp.where(is_ray, between, 0.0), lane, lanes)
    is_lit = is_ray and seen[3] > OUTER_STOP
    far = wp.where(is_lit, FAR_AWAY, between)
    beyond = march_outer(outer, camera.center, direction, between, far, lane, lanes)
    if lane == 0 and is_ray:
        color = wp.vec3(beyond[0], beyond[1], beyond[2])
        if is_lit and beyond[3] > OUTER_STOP:
            color += beyond[3] * sky_color(outer, direction)
        front[n] = seen
        behind[n] = color


@forward.func_native("""
    float* numbers = reinterpret_cast<float*>(values.data + row);
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<float4*>(numbers), make_float4(value.c[0], value.c[1], value.c[2], value.c[3]));
#else
    for (int channel = 0; channel < 4; ++channel)
#if defined(__CUDA_ARCH__)
        atomicAdd(numbers + channel, value.c[channel]);
#else
        numbers[channel] += value.c[channel];
#endif
#endif
""")
def add_to_row(values: wp.array(dtype=wp.vec4), row: wp.int32, value: wp.vec4):
    """Atomic on CUDA, there in one piece where it can be; plain on a CPU, as wp.atomic_add is."""
    ...


@wp.func
def add_outer_gradient(
    outer: OuterGrid,
    origin: wp.vec3,
    direction: wp.vec3,
    begin: float,
    end: float,
    grad_color: wp.vec3,
    total: float,
    lane: int,
    lanes: int,
    grad_values: wp.array(dtype=wp.vec4),
):
    """Adjoint of march_outer, all lanes of a warp at once; returns the light that is left.
    total: color . its gradient, and light that is left times its own gradient."""
    later = float(total)
    light = float(1.0)
    path = outer_path(outer, origin, direction, begin, end)
    turn = turn_after(path, turn_before_all())
    while any_goes_on(turn.region >= 0, lanes):
        piece = outer_piece(outer, origin, direction, turn)
        k = int(0)
        while any_goes_on(k < piece.count and light > OUTER_STOP, lanes):
            step = outer_step(outer, piece, k, light, lane, lanes)
            weight = step.before * (1.0 - step.kept)
            change = wp.dot(shown_color(step.sample.value), grad_color)
            share = float(0.0)
            if step.has_matter > 0:
                share = weight * change
            later_own = later - octet_sum_before(share, lane) - share
            if step.has_matter > 0:
                by_density = piece.length * (step.before * step.kept * change - later_own)
                gradient = wp.vec4(0.0, 0.0, 0.0, by_density)
                for channel in range(3):
                    if step.sample.value[channel] >= 0.0:
                        gradient[channel] = weight * grad_color[channel]
                for corner in range(8):
                    if step.sample.rows[corner] >= 0:
                        add_to_row(grad_values, step.sample.rows[corner], step.sample.weights[corner] * gradient)
            later = from_octet_lane(later_own, lanes - 1)
            light = step.light
            k = step.following
        turn = turn_after(path, turn)
    return forward_only(light, origin)


@wp.func
def light_behind(grad_behind: wp.vec3, grad_pixel: wp.vec3):
    """Light that reaches what is behind the box: the loss's gradient by that colour over the one by the pixel's."""
    return wp.clamp(wp.length(grad_behind) / wp.max(wp.length(grad_pixel), 1.0e-20), 0.0, 1.0)


@wp.kernel(launch_bounds=(256, 3))
def accumulate_outer_gradient(
    first: int,
    outer: OuterGrid,
    rays: TrainingRays,
    front: wp.array(dtype=wp.vec4),
    behind: wp.array(dtype=wp.vec3),
    grad_front: wp.array(dtype=wp.vec4),
    grad_behind: wp.array(dtype=wp.vec3),
    by_front: float,
    by_sky: float,
    grad_values: wp.array(dtype=wp.vec4),
    grad_sky: wp.array2d(dtype=wp.vec4),
):
    """Adds the gradient by the values of the grid (rows,) and of the sky (1, nodes). Items as of gather_outer. front,
    behind: (rays,) of gather_outer. What it adds to is shared: on the CPU each thread needs its own."""
    # Of the loss, of by_front * opacity of the front, and of the loss of the sky alone by by_sky (above).
    n, lane, lanes = octet_place(first + wp.tid())
    pixel = batch_pixel(rays, n)
    is_ray = n < behind.shape[0] and in_picture(rays, pixel)
    n = wp.where(is_ray, n, 0)
    camera = rays.cameras[pixel[0]]
    origin = camera.center
    direction = pixel_direction(camera, pixel[2], pixel[1])
    between = front_end(outer, origin, direction)
    seen = front[n]
    change = grad_front[n] - wp.vec4(0.0, 0.0, 0.0, by_front)
    by_color = wp.vec3(change[0], change[1], change[2])
    front_far = wp.where(is_ray and seen[3] < 1.0, between, 0.0)
    add_outer_gradient(
        outer, origin, direction, 0.0, front_far, by_color, wp.dot(seen, change), lane, lanes, grad_values
    )
    grad_color = grad_behind[n]
    shows_behind = is_ray and seen[3] > OUTER_STOP and wp.length_sq(grad_color) > 0.0
    behind_far = wp.where(shows_behind, FAR_AWAY, between)
    by_behind = wp.dot(behind[n], grad_color)
    light = add_outer_gradient(
        outer, origin, direction, between, behind_far, grad_color, by_behind, lane, lanes, grad_values
    )
    if shows_behind and lane == 0:
        place = surface_sample(outer.sky.side, direction)
        value = layer_value(outer.sky, 0, place)
        to_pixel = wp.vec3(grad_front[n][0], grad_front[n][1], grad_front[n][2])
        follows = by_sky * light_behind(grad_color, to_pixel)
        gradient = wp.vec4()
        for channel in range(3):
            gradient[channel] = follows * (value[channel] - behind[n][channel])
            if light > OUTER_STOP and value[channel] >= 0.0:
                gradient[channel] += light * grad_color[channel]
        for corner in range(4):
            wp.atomic_add(grad_sky, 0, place.nodes[corner], place.weights[corner] * gradient)


@wp.func
def light_through(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, step: float):
    """Light that passes the inner grid."""
    ray = grid_ray(grid, origin, direction, step)
    depth = float(0.0)
    k = ray.first
    while sample_distance(ray, k) < ray.far and depth < 7.0:
        g = sample_place(ray, k)
        empty = empty_distance(grid, g)
        if empty > 0:
            k = sample_beyond(ray, k, g, empty)
        else:
            depth += step * wp.max(cell_density(grid, cell_sample(grid, g)), 0.0)
            k += 1
    return forward_only(wp.exp(-depth), origin)


@wp.func
def record_outer_ray(
    outer: OuterGrid,
    origin: wp.vec3,
    direction: wp.vec3,
    begin: float,
    end: float,
    first_light: float,
    mark: wp.uint32,
    weights: wp.array(dtype=wp.float32),
    shown: wp.array(dtype=wp.uint32),
):
    """Largest rendering weights along a ray. Returns the light that is left."""
    light = float(first_light)
    path = outer_path(outer, origin, direction, begin, end)
    turn = turn_after(path, turn_before_all())
    while turn.region >= 0:
        piece = outer_piece(outer, origin, direction, turn)
        k = int(0)
        while k < piece.count and light > OUTER_STOP:
            step = outer_step(outer, piece, k, light, 0, 1)
            if step.has_matter > 0:
                weight = step.before * (1.0 - step.kept)
                for corner in range(8):
                    row = step.sample.rows[corner]
                    if row >= 0:
                        record_row(weights, shown, row, weight, mark)
            light = step.light
            k = step.following
        turn = turn_after(path, turn)
    return forward_only(light, origin)


@wp.kernel
def record_outer_weights(
    first: int,
    cameras: wp.array(dtype=PinholeCamera),
    pixel_stride: int,
    counted: wp.array3d(dtype=wp.uint8),
    outer: OuterGrid,
    inner: VoxelGrid,
    step: float,
    weights: wp.array(dtype=wp.float32),
    shown: wp.array(dtype=wp.uint32),
):
    """As record_weights, of an outer grid's rows, behind what the inner grid holds."""
    pixel = strided_pixel(first + wp.tid(), cameras[0].width, cameras[0].height, pixel_stride)
    if counted.shape[0] > 0:
        if counted[pixel[0], pixel[1], pixel[2]] == wp.uint8(0):
            return
    camera = cameras[pixel[0]]
    mark = picture_mark(pixel[0])
    direction = pixel_direction(camera, pixel[2], pixel[1])
    between = front_end(outer, camera.center, direction)
    light = float(1.0)
    if between > 0.0:
        light = record_outer_ray(outer, camera.center, direction, 0.0, between, 1.0, mark, weights, shown)
    light *= light_through(inner, camera.center, direction, step)
    if light > OUTER_STOP:
        record_outer_ray(outer, camera.center, direction, between, FAR_AWAY, light, mark, weights, shown)


@wp.kernel
def accumulate_outer_variation(
    first: int,
    outer: OuterGrid,
    nodes: wp.array(dtype=wp.int32),
    first_row: int,
    scale_color: float,
    scale_density: float,
    views: wp.array(dtype=wp.uint8),
    by_views: wp.array(dtype=wp.vec2),
    grad_values: wp.array(dtype=wp.vec4),
):
    """Adds the gradient of scale_colour * TV(colours) + scale_density * TV(densities). One item per row, from first_row
    on. nodes: (rows,) flat indices. Neighbours share rows: on the CPU each thread needs grad_values of its own."""
    # As in fitting/rmsprop: sqrt(dx^2 + dy^2 + dz^2 + eps) of forward differences, zero to nodes without a row; views,
    # by_views too.
    row = (first_row + first + wp.tid()) % nodes.shape[0]
    side = outer.columns.node_counts[0]
    i, j, k = grid_place(nodes[row], side, side)
    value = outer.values[row]
    rows = wp.vec3i(-1, -1, -1)
    squares = wp.vec4(1.0e-9, 1.0e-9, 1.0e-9, 1.0e-9)
    for axis in range(3):
        other = wp.vec3i(i, j, k)
        other[axis] = other[axis] + 1
        if other[axis] < side:
            rows[axis] = node_row(outer.columns, other[0], other[1], other[2])
            if rows[axis] >= 0:
                difference = outer.values[rows[axis]] - value
                squares += wp.cw_mul(difference, difference)
    slope = wp.vec4(scale_color, scale_color, scale_color, scale_density)
    if views.shape[0] > 0:
        factors = by_views[int(views[row])]
        slope = wp.cw_mul(slope, wp.vec4(factors[1], factors[1], factors[1], factors[0]))
    for channel in range(4):
        slope[channel] = slope[channel] / wp.sqrt(squares[channel])
    total = wp.vec4()
    for axis in range(3):
        if rows[axis] >= 0:
            step = wp.cw_mul(slope, outer.values[rows[axis]] - value)
            total -= step
            add_to_row(grad_values, rows[axis], step)
    add_to_row(grad_values, row, total)


@wp.kernel
def apply_outer_rmsprop(
    first: int,
    rate_color: float,
    rate_density: float,
    beta: float,
    epsilon: float,
    gradients: wp.array(dtype=wp.vec4),
    moments: wp.array(dtype=wp.vec4),
    values: wp.array(dtype=wp.vec4),
):
    """Step of RMSProp where the gradient is not zero, which is cleared. One item per row."""
    row = first + wp.tid()
    gradient = gradients[row]
    if wp.length_sq(gradient) == 0.0:
        return
    value = values[row]
    moment = moments[row]
    for channel in range(4):  # colours stay within [0, 1], as saved: cut at the end they would not be what was fitted
        if gradient[channel] != 0.0:
            rate = wp.where(channel < 3, rate_color, rate_density)
            number, spread = rmsprop_update(value[channel], moment[channel], gradient[channel], rate, beta, epsilon)
            value[channel] = wp.where(channel < 3, wp.clamp(number, 0.0, 1.0), number)
            moment[channel] = spread
    values[row] = value
    moments[row] = moment
    gradients[row] = wp.vec4()
