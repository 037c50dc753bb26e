"""Pictures of several objects in one scene, put together pixel by pixel by their depths."""

# Premultiplied colours, near over far (Porter and Duff, "Compositing Digital Images", SIGGRAPH 1984): the objects of a
# pixel are sorted by their depths, C = sum_k T_k C_k + T_end behind, T_k = prod_{j before k} (1 - a_j). That is what a
# march through all of them sees where each is solid, or where they are apart along the ray.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def compose_objects(
    first: int,
    scales: wp.array(dtype=wp.float32),  # (objects,) from the depths of each to world units
    behind: wp.vec3,
    unit: float,  # of `around`, world units
    colors: wp.array2d(dtype=wp.vec3),  # (objects, h * w) on black
    alphas: wp.array2d(dtype=wp.float32),  # (objects, h * w)
    depths: wp.array2d(dtype=wp.float32),  # (objects, h * w), inf for nothing
    masks: wp.array3d(dtype=wp.float32),  # (names, objects, h * w)
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),  # world units
    around: wp.array(dtype=wp.float32),  # (h * w,), or empty where it is not needed
    mask: wp.array2d(dtype=wp.float32),  # (names, h * w)
):
    """Put objects over each other before a colour; rgb, alpha and depth (h * w,). Masks are dimmed by what is before
    their objects; around: the same depth in other units."""
    n = first + wp.tid()
    color = wp.vec3()
    light = float(1.0)
    covered = float(0.0)
    weight = float(0.0)
    total = float(0.0)
    last = int(-1)
    last_depth = float(-1.0)
    for name in range(masks.shape[0]):
        mask[name, n] = 0.0
    for _ in range(colors.shape[0]):
        nearest_object = int(-1)
        nearest = float(0.0)
        for other in range(colors.shape[0]):
            distance = scales[other] * depths[other, n]
            follows = distance > last_depth or (distance == last_depth and other > last)
            if follows and (nearest_object < 0 or distance < nearest):
                nearest_object = other
                nearest = distance
        if nearest_object >= 0:
            opacity = wp.clamp(alphas[nearest_object, n], 0.0, 1.0)
            color += light * colors[nearest_object, n]
            covered += light * opacity
            if wp.isfinite(nearest):
                weight += light * opacity
                total += light * opacity * nearest
            for name in range(masks.shape[0]):
                mask[name, n] += light * masks[name, nearest_object, n]
            light *= 1.0 - opacity
            last = nearest_object
            last_depth = nearest
    distance_seen = wp.where(weight > 0.0, total / wp.max(weight, 1.0e-12), wp.inf)
    rgb[n] = color + (1.0 - covered) * behind
    alpha[n] = covered
    depth[n] = distance_seen
    if around.shape[0] > 0:
        around[n] = distance_seen / unit
