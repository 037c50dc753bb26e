"""Gradients of the photometric and total-variation losses by the values of background layers."""

# With C = sum_l w_l c_l, w_l = T_l (1 - exp(-tau_l)) and g = dL/dC, dL/dc_l = w_l g and
# dL/dtau_l = T_{l+1} c_l . g - sum_{j>l} w_j c_j . g (Plenoxels 2022, section 3.2; TV on a cube's surface: Eq. 3).

import warp as wp

from ..field.background import (
    OPAQUE_TRANSMITTANCE,
    BackgroundLayers,
    background_color,
    layer_kept,
    layer_sample,
    layer_value,
    on_surface,
    surface_node,
    surface_place,
)
from ..view.rays import pixel_direction
from .batches import Pictures, picture_pixel
from .loss import TrainingRays, batch_pixel, evenly_exposed, in_picture
from .rmsprop import rmsprop_update

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def variation_slope(dx: float, dy: float, dz: float, scale: float):
    """scale / sqrt(dx^2 + dy^2 + dz^2 + eps): the factor of each difference in the variation's gradient."""
    return scale / wp.sqrt(dx * dx + dy * dy + dz * dz + 1.0e-9)


@wp.kernel
def gather_background(first: int, layers: BackgroundLayers, rays: TrainingRays, behind: wp.array(dtype=wp.vec3)):
    """behind: (rays,) what each ray of a batch sees of the layers. One item per ray."""
    n = first + wp.tid()
    pixel = batch_pixel(rays, n)
    if in_picture(rays, pixel):
        camera = rays.cameras[pixel[0]]
        behind[n] = background_color(layers, camera.center, pixel_direction(camera, pixel[2], pixel[1]))


@wp.kernel
def compare_surroundings(
    first: int,
    layers: BackgroundLayers,
    rays: TrainingRays,
    surroundings: Pictures,
    scale: float,
    grad_behind: wp.array(dtype=wp.vec3),
):
    """grad_behind: (rays,) scale * gradient of the sum over channels of (s C - S)^2 by the background C. One item per
    ray. surroundings: (views, h, w) what masks split off a picture: S, its colour times its share s, and s."""
    n = first + wp.tid()
    grad_behind[n] = wp.vec3(0.0, 0.0, 0.0)
    pixel = batch_pixel(rays, n)
    if in_picture(rays, pixel):
        seen = picture_pixel(surroundings, pixel[0], pixel[1], pixel[2])
        share = seen[3]
        if share > 0.0:
            camera = rays.cameras[pixel[0]]
            color = background_color(layers, camera.center, pixel_direction(camera, pixel[2], pixel[1]))
            error = share * color - evenly_exposed(rays, pixel[0], seen)
            grad_behind[n] = 2.0 * scale * share * error


@wp.kernel
def accumulate_background_gradient(
    first: int,
    layers: BackgroundLayers,
    rays: TrainingRays,
    grad_behind: wp.array(dtype=wp.vec3),
    grad_values: wp.array2d(dtype=wp.vec4),
):
    """Adds the gradient by the layers' values (layers, nodes), from that by each ray's background (rays,). One item per
    ray. Nodes are shared: on the CPU each thread needs grad_values of its own."""
    n = first + wp.tid()
    pixel = batch_pixel(rays, n)
    grad_color = grad_behind[n]
    if not in_picture(rays, pixel) or wp.length_sq(grad_color) == 0.0:
        return
    camera = rays.cameras[pixel[0]]
    origin = camera.center
    direction = pixel_direction(camera, pixel[2], pixel[1])
    later = wp.dot(background_color(layers, origin, direction), grad_color)
    transmittance = float(1.0)
    for layer in range(layers.values.shape[0]):
        if transmittance > OPAQUE_TRANSMITTANCE:
            sample = layer_sample(layers, layer, origin, direction)
            if sample.met == 1:
                value = layer_value(layers, layer, sample)
                kept = layer_kept(layers, layer, value)
                weight = transmittance * (1.0 - kept)
                transmittance *= kept
                radiance = wp.dot(wp.vec3(value[0], value[1], value[2]), grad_color)
                later -= weight * radiance
                grad_depth = float(0.0)
                if value[3] > 0.0 and layer < layers.values.shape[0] - 1:
                    grad_depth = transmittance * radiance - later
                gradient = wp.vec4(weight * grad_color[0], weight * grad_color[1], weight * grad_color[2], grad_depth)
                for corner in range(4):
                    wp.atomic_add(grad_values, layer, sample.nodes[corner], sample.weights[corner] * gradient)


@wp.kernel
def apply_layer_rmsprop(
    first: int,
    rate: float,
    beta: float,
    epsilon: float,
    gradients: wp.array(dtype=wp.float32),
    moments: wp.array(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
):
    """Step of RMSProp where the gradient is not zero, which is cleared. One item per number of the layers."""
    n = first + wp.tid()
    gradient = gradients[n]
    if gradient != 0.0:
        value, moment = rmsprop_update(values[n], moments[n], gradient, rate, beta, epsilon)
        values[n] = value
        moments[n] = moment
        gradients[n] = 0.0


@wp.kernel
def accumulate_layer_variation(
    first: int,
    layers: BackgroundLayers,
    moments: wp.array2d(dtype=wp.vec4),
    first_node: int,
    scale_color: float,
    scale_depth: float,
    grad_values: wp.array2d(dtype=wp.vec4),
):
    """Adds the gradient of scale_color * TV(colors) + scale_depth * TV(optical depths). One item per node, from
    first_node on. moments, grad_values: (layers, nodes); on the CPU each thread needs grad_values of its own."""
    # Differences to next nodes on the cube's surface count where a ray has met both (moments not zero).
    count = layers.values.shape[1]
    n = (first_node + first + wp.tid()) % (count * layers.values.shape[0])
    layer = n // count
    number = n % count
    if wp.length_sq(moments[layer, number]) == 0.0:
        return
    side = layers.side
    place = surface_place(side, number)
    value = layers.values[layer, number]
    total = wp.vec4()
    neighbors = wp.vec3i(-1, -1, -1)
    differences = wp.matrix(shape=(3, 4), dtype=wp.float32)
    for axis in range(3):
        node = place
        node[axis] = place[axis] + 1
        if node[axis] <= side and on_surface(side, node):
            other = surface_node(side, node)
            if wp.length_sq(moments[layer, other]) > 0.0:
                neighbors[axis] = other
                difference = layers.values[layer, other] - value
                for channel in range(4):
                    differences[axis, channel] = difference[channel]
    for channel in range(4):
        scale = wp.where(channel < 3, scale_color, scale_depth)
        slope = variation_slope(differences[0, channel], differences[1, channel], differences[2, channel], scale)
        for axis in range(3):
            differences[axis, channel] = slope * differences[axis, channel]
    for axis in range(3):
        if neighbors[axis] >= 0:
            step = wp.vec4(differences[axis, 0], differences[axis, 1], differences[axis, 2], differences[axis, 3])
            total -= step
            wp.atomic_add(grad_values, layer, neighbors[axis], step)
    wp.atomic_add(grad_values, layer, number, total)
