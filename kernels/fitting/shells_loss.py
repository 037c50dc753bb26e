"""Gradients of the photometric loss and of the total variation by the values of nested cubes, and their steps."""

# As outer_loss.py, whose notation this is, through field/shells. A colour is clamped at zero after its slope by the
# direction d is added: dL/dslope = d (sum of the gradients by the channels that are not clamped). What splitting a
# brick may earn is told by the sum of |alpha dL/dalpha| over its samples (Sun et al., "Sparse Voxels Rasterization",
# CVPR 2025, section 3.3).

import warp as wp

from ..field.background import layer_value, surface_sample
from ..field.grid import VoxelGrid
from ..field.outer import FAR_AWAY, OUTER_STOP
from ..field.shells import (
    BRICK_CELLS,
    BRICK_NODES,
    NODES,
    OWNED,
    Shells,
    blend_rows,
    brick_part,
    color_around,
    cube_part,
    front_of_box,
    march_shells,
    node_place,
    seen_color,
    shell_sample,
)
from ..view.rays import PinholeCamera, pixel_direction, strided_pixel
from .loss import TrainingRays, batch_pixel, in_picture
from .outer_loss import light_behind, light_through
from .rmsprop import rmsprop_update

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def gather_shells(
    first: int, shells: Shells, rays: TrainingRays, front: wp.array(dtype=wp.vec4), behind: wp.array(dtype=wp.vec3)
):
    """What is before the box, (rays,) colour and the light that passes, and behind it, (rays,) colour with the sky.
    One item per ray."""
    n = first + wp.tid()
    pixel = batch_pixel(rays, n)
    if in_picture(rays, pixel):
        camera = rays.cameras[pixel[0]]
        direction = pixel_direction(camera, pixel[2], pixel[1])
        between = front_of_box(shells, camera.center, direction)
        seen = wp.vec4(0.0, 0.0, 0.0, 1.0)
        if between > 0.0:
            seen = march_shells(shells, camera.center, direction, 0.0, between)
        front[n] = seen
        behind[n] = wp.vec3()
        if seen[3] > OUTER_STOP:
            behind[n] = color_around(shells, camera.center, direction, between)


@wp.func
def add_shell_gradient(
    shells: Shells,
    origin: wp.vec3,
    direction: wp.vec3,
    begin: float,
    end: float,
    grad_color: wp.vec3,
    total: float,
    grad_values: wp.array(dtype=wp.vec4),
    grad_slopes: wp.array(dtype=wp.vec4),
    earned: wp.array(dtype=wp.float32),
):
    """Adjoint of march_shells; returns the light that is left. total: as of add_outer_gradient."""
    later = float(total)
    light = float(1.0)
    for n in range(2 * shells.cubes):
        part = cube_part(shells, origin, direction, n, begin, end)
        at = float(part.begin)
        while at < part.end and light > OUTER_STOP:
            brick = brick_part(shells, part, at)
            length = brick.step / part.unit
            gain = float(0.0)
            for k in range(brick.count):
                if light > OUTER_STOP:
                    c = brick.start + (at + (float(k) + 0.5) * brick.step) * brick.slope
                    sample = shell_sample(shells, brick.brick, c)
                    if sample.value[3] > 0.0:
                        kept = wp.exp(-sample.value[3] * length)
                        weight = light * (1.0 - kept)
                        light *= kept
                        raw = seen_color(sample, direction)
                        change = wp.dot(wp.max(raw, wp.vec3()), grad_color)
                        later -= weight * change
                        by_light = light * change - later
                        gain += (1.0 - kept) * wp.abs(by_light) / wp.max(kept, 1.0e-3)
                        gradient = wp.vec4(0.0, 0.0, 0.0, length * by_light)
                        by_slope = float(0.0)
                        for channel in range(3):
                            if raw[channel] >= 0.0:
                                gradient[channel] = weight * grad_color[channel]
                                by_slope += gradient[channel]
                        slope = wp.vec4(by_slope * direction[0], by_slope * direction[1], by_slope * direction[2], 0.0)
                        for corner in range(8):
                            if sample.rows[corner] >= 0:
                                wp.atomic_add(grad_values, sample.rows[corner], sample.weights[corner] * gradient)
                                wp.atomic_add(grad_slopes, sample.rows[corner], sample.weights[corner] * slope)
            if gain > 0.0:
                wp.atomic_add(earned, brick.brick, gain)
            at = brick.end
    return light


@wp.kernel
def accumulate_shell_gradient(
    first: int,
    shells: Shells,
    rays: TrainingRays,
    front: wp.array(dtype=wp.vec4),
    behind: wp.array(dtype=wp.vec3),
    grad_front: wp.array(dtype=wp.vec4),
    grad_behind: wp.array(dtype=wp.vec3),
    by_front: float,
    by_sky: float,
    grad_values: wp.array(dtype=wp.vec4),
    grad_slopes: wp.array(dtype=wp.vec4),
    earned: wp.array(dtype=wp.float32),
    grad_sky: wp.array2d(dtype=wp.vec4),
):
    """As outer_loss.accumulate_outer_gradient, by values and slopes (rows,), what bricks earn (bricks,) and the sky
    (1, nodes). One item per ray. What it adds to is shared: on the CPU each thread needs its own."""
    n = first + wp.tid()
    pixel = batch_pixel(rays, n)
    if not in_picture(rays, pixel):
        return
    camera = rays.cameras[pixel[0]]
    origin = camera.center
    direction = pixel_direction(camera, pixel[2], pixel[1])
    between = front_of_box(shells, origin, direction)
    seen = front[n]
    if between > 0.0 and seen[3] < 1.0:
        change = grad_front[n] - wp.vec4(0.0, 0.0, 0.0, by_front)
        by_color = wp.vec3(change[0], change[1], change[2])
        total = wp.dot(seen, change)
        add_shell_gradient(shells, origin, direction, 0.0, between, by_color, total, grad_values, grad_slopes, earned)
    grad_color = grad_behind[n]
    if seen[3] > OUTER_STOP and wp.length_sq(grad_color) > 0.0:
        total = wp.dot(behind[n], grad_color)
        light = add_shell_gradient(
            shells, origin, direction, between, FAR_AWAY, grad_color, total, grad_values, grad_slopes, earned
        )
        place = surface_sample(shells.sky.side, direction)
        value = layer_value(shells.sky, 0, place)
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
def record_shell_ray(
    shells: Shells,
    origin: wp.vec3,
    direction: wp.vec3,
    begin: float,
    end: float,
    first_light: float,
    weights: wp.array(dtype=wp.float32),
):
    """Largest rendering weights along a ray. Returns the light that is left."""
    light = float(first_light)
    for n in range(2 * shells.cubes):
        part = cube_part(shells, origin, direction, n, begin, end)
        at = float(part.begin)
        while at < part.end and light > OUTER_STOP:
            brick = brick_part(shells, part, at)
            for k in range(brick.count):
                if light > OUTER_STOP:
                    c = brick.start + (at + (float(k) + 0.5) * brick.step) * brick.slope
                    sample = shell_sample(shells, brick.brick, c)
                    if sample.value[3] > 0.0:
                        kept = wp.exp(-sample.value[3] * brick.step / part.unit)
                        weight = light * (1.0 - kept)
                        for corner in range(8):
                            if sample.rows[corner] >= 0:
                                if weights[sample.rows[corner]] < weight:
                                    wp.atomic_max(weights, sample.rows[corner], weight)
                        light *= kept
            at = brick.end
    return light


@wp.func
def record_around_box(
    shells: Shells,
    inner: VoxelGrid,
    camera: PinholeCamera,
    column: int,
    row: int,
    step: float,
    weights: wp.array(dtype=wp.float32),
):
    """Raise the weights of the rows that a pixel's ray meets to the rendering weights that it gives them."""
    direction = pixel_direction(camera, column, row)
    between = front_of_box(shells, camera.center, direction)
    light = float(1.0)
    if between > 0.0:
        light = record_shell_ray(shells, camera.center, direction, 0.0, between, 1.0, weights)
    light *= light_through(inner, camera.center, direction, step)
    if light > OUTER_STOP:
        record_shell_ray(shells, camera.center, direction, between, FAR_AWAY, light, weights)


@wp.kernel
def record_shell_weights(
    first: int,
    shells: Shells,
    inner: VoxelGrid,
    cameras: wp.array(dtype=PinholeCamera),
    pixel_stride: int,
    step: float,
    weights: wp.array(dtype=wp.float32),
):
    """As outer_loss.record_outer_weights: largest rendering weight that any ray gives to each row (rows,)."""
    pixel = strided_pixel(first + wp.tid(), cameras[0].width, cameras[0].height, pixel_stride)
    record_around_box(shells, inner, cameras[pixel[0]], pixel[2], pixel[1], step, weights)


@wp.kernel
def record_counted_shell_weights(
    first: int,
    shells: Shells,
    inner: VoxelGrid,
    cameras: wp.array(dtype=PinholeCamera),
    pixel_stride: int,
    step: float,
    counted: wp.array3d(dtype=wp.uint8),
    weights: wp.array(dtype=wp.float32),
):
    """As record_shell_weights, of the pixels that count: counted (views, h, w) is not 0 there."""
    pixel = strided_pixel(first + wp.tid(), cameras[0].width, cameras[0].height, pixel_stride)
    if counted[pixel[0], pixel[1], pixel[2]] > wp.uint8(0):
        record_around_box(shells, inner, cameras[pixel[0]], pixel[2], pixel[1], step, weights)


@wp.func
def cell_node(cell: int, corner: int):
    """Number of a node of a brick's cell."""
    i = cell // 64 + (corner >> 2)
    j = (cell // 8) % 8 + ((corner >> 1) & 1)
    return (i * NODES + j) * NODES + cell % 8 + (corner & 1)


@wp.kernel
def accumulate_shell_variation(
    first: int,
    shells: Shells,
    first_cell: int,
    scale_color: float,
    scale_density: float,
    scale_slope: float,
    grad_values: wp.array(dtype=wp.vec4),
    grad_slopes: wp.array(dtype=wp.vec4),
):
    """Adds the gradient of the total variations of colours, densities and slopes. One item per cell of each brick, from
    first_cell on. Neighbours share rows: on the CPU each thread needs gradients of its own."""
    # As outer_loss.accumulate_outer_variation: forward differences from the cell's first node, within the brick. The
    # scales are for bricks of one entry; those of larger ones grow with their faces, which rays meet more often.
    n = (first_cell + first + wp.tid()) % (BRICK_CELLS * shells.links.shape[0])
    brick = n // BRICK_CELLS
    cell = n % BRICK_CELLS
    node = cell_node(cell, 0)
    row = shells.links[brick, node]
    if row < 0:
        return
    value = shells.values[row]
    slope = shells.slopes[row]
    rows = wp.vec3i(-1, -1, -1)
    squares = wp.vec4(1.0e-9, 1.0e-9, 1.0e-9, 1.0e-9)
    slope_squares = wp.vec4(1.0e-9, 1.0e-9, 1.0e-9, 1.0e-9)
    stride = wp.vec3i(NODES * NODES, NODES, 1)
    for axis in range(3):
        rows[axis] = shells.links[brick, node + stride[axis]]
        if rows[axis] >= 0:
            difference = shells.values[rows[axis]] - value
            squares += wp.cw_mul(difference, difference)
            turn = shells.slopes[rows[axis]] - slope
            slope_squares += wp.cw_mul(turn, turn)
    by_value = wp.vec4(scale_color, scale_color, scale_color, scale_density)
    by_slope = wp.vec4(scale_slope, scale_slope, scale_slope, 0.0)
    faces = float(shells.places[brick][3] * shells.places[brick][3])
    for channel in range(4):
        by_value[channel] = faces * by_value[channel] / wp.sqrt(squares[channel])
        by_slope[channel] = faces * by_slope[channel] / wp.sqrt(slope_squares[channel])
    total = wp.vec4()
    slope_total = wp.vec4()
    for axis in range(3):
        if rows[axis] >= 0:
            change = wp.cw_mul(by_value, shells.values[rows[axis]] - value)
            total -= change
            wp.atomic_add(grad_values, rows[axis], change)
            turn = wp.cw_mul(by_slope, shells.slopes[rows[axis]] - slope)
            slope_total -= turn
            wp.atomic_add(grad_slopes, rows[axis], turn)
    wp.atomic_add(grad_values, row, total)
    wp.atomic_add(grad_slopes, row, slope_total)


@wp.kernel
def apply_shell_rmsprop(
    first: int,
    rate_color: float,
    rate_density: float,
    rate_slope: float,
    beta: float,
    epsilon: float,
    sizes: wp.array(dtype=wp.uint8),
    grad_values: wp.array(dtype=wp.vec4),
    grad_slopes: wp.array(dtype=wp.vec4),
    moments: wp.array(dtype=wp.vec4),
    slope_moments: wp.array(dtype=wp.vec4),
    values: wp.array(dtype=wp.vec4),
    slopes: wp.array(dtype=wp.vec4),
):
    """Step of RMSProp where the gradient is not zero, which is cleared. One item per row. rate_density: for bricks of
    one entry; sizes: (rows,) entries along a side of a row's brick."""
    row = first + wp.tid()
    gradient = grad_values[row]
    if wp.length_sq(gradient) == 0.0:
        return
    value = values[row]
    moment = moments[row]
    slope = slopes[row]
    slope_moment = slope_moments[row]
    turn = grad_slopes[row]
    for channel in range(4):  # constant colours stay within [0, 1], as saved
        if gradient[channel] != 0.0:
            rate = wp.where(channel < 3, rate_color, rate_density / float(int(sizes[row])))
            number, spread = rmsprop_update(value[channel], moment[channel], gradient[channel], rate, beta, epsilon)
            value[channel] = wp.where(channel < 3, wp.clamp(number, 0.0, 1.0), number)
            moment[channel] = spread
        if turn[channel] != 0.0:
            number, spread = rmsprop_update(
                slope[channel], slope_moment[channel], turn[channel], rate_slope, beta, epsilon
            )
            slope[channel] = wp.clamp(number, -1.0, 1.0)
            slope_moment[channel] = spread
    values[row] = value
    moments[row] = moment
    slopes[row] = slope
    slope_moments[row] = slope_moment
    grad_values[row] = wp.vec4()
    grad_slopes[row] = wp.vec4()


# Which bricks there are


@wp.kernel
def mark_weighty_cells(
    first: int,
    links: wp.array2d(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    threshold: float,
    cells: wp.array2d(dtype=wp.uint8),
):
    """1 in cells (bricks, 512) one of whose rows (rows,) has a weight of a threshold, 0 in others."""
    n = first + wp.tid()
    brick = n // BRICK_CELLS
    cell = n % BRICK_CELLS
    kept = int(0)
    for corner in range(8):
        row = links[brick, cell_node(cell, corner)]
        if row >= 0:
            if weights[row] >= threshold:
                kept = int(1)
    cells[brick, cell] = wp.uint8(kept)


@wp.kernel
def count_octants(first: int, cells: wp.array2d(dtype=wp.uint8), counts: wp.array2d(dtype=wp.int32)):
    """Cells that are 1 in each octant of each brick, (bricks, 8). One item per octant."""
    n = first + wp.tid()
    brick = n // 8
    octant = n % 8
    count = int(0)
    for cell in range(64):
        i = 4 * (octant >> 2) + cell // 16
        j = 4 * ((octant >> 1) & 1) + (cell // 4) % 4
        k = 4 * (octant & 1) + cell % 4
        count += int(cells[brick, (i * 8 + j) * 8 + k])
    counts[brick, octant] = count


@wp.func
def cell_in_parent(octant: int, c: wp.vec3):
    """Where a brick's place in cells is in those of the brick that it comes from: its octant's, or (-1) the same."""
    if octant < 0:
        return c
    return 0.5 * c + 4.0 * wp.vec3(float(octant >> 2), float((octant >> 1) & 1), float(octant & 1))


@wp.kernel
def mark_nodes(
    first: int, parents: wp.array(dtype=wp.vec2i), cells: wp.array2d(dtype=wp.uint8), nodes: wp.array2d(dtype=wp.uint8)
):
    """1 at the nodes (bricks, 729) of the cells that are 1 in the bricks, and octants of these, that bricks come from.
    One item per cell of each new brick."""
    n = first + wp.tid()
    brick = n // BRICK_CELLS
    cell = n % BRICK_CELLS
    middle = wp.vec3(float(cell // 64) + 0.5, float((cell // 8) % 8) + 0.5, float(cell % 8) + 0.5)
    c = cell_in_parent(parents[brick][1], middle)
    if cells[parents[brick][0], (int(c[0]) * 8 + int(c[1])) * 8 + int(c[2])] > wp.uint8(0):
        for corner in range(8):
            nodes[brick, cell_node(cell, corner)] = OWNED


@wp.kernel
def resample_rows(
    first: int,
    before: wp.array2d(dtype=wp.int32),
    source: wp.array(dtype=wp.vec4),
    parents: wp.array(dtype=wp.vec2i),
    nodes: wp.array2d(dtype=wp.uint8),
    links: wp.array2d(dtype=wp.int32),
    target: wp.array(dtype=wp.vec4),
):
    """Numbers of the rows of new bricks from those (rows,) of the bricks that they come from, whose links `before` are:
    trilinear among nodes that have rows. One item per node of each new brick."""
    n = first + wp.tid()
    brick = n // BRICK_NODES
    number = n % BRICK_NODES
    if nodes[brick, number] == OWNED:
        node = node_place(number)
        c = cell_in_parent(parents[brick][1], wp.vec3(float(node[0]), float(node[1]), float(node[2])))
        sample = blend_rows(before, parents[brick][0], c)
        value = wp.vec4()
        total = float(0.0)
        for corner in range(8):
            if sample.rows[corner] >= 0:
                value += sample.weights[corner] * source[sample.rows[corner]]
                total += sample.weights[corner]
        target[links[brick, number]] = wp.where(total > 0.0, 1.0 / wp.max(total, 1.0e-12), 0.0) * value
