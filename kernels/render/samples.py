"""Samples of a posed field of any representation: their places on rays, their densities in a pose, their picture."""

# The packed samples of Li et al., "NerfAcc" (ICCV 2023): those of a ray follow each other, and rays have as many as
# they need. Between the kernels the field itself is sampled, by its own function.

import warp as wp

from ..edits.structs import CLEARED, MAPPED
from ..field.grid import steps_to_sample
from ..field.march import visible_depth
from ..view.rays import PinholeCamera, box_span, pixel_direction

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def count_samples(
    first: int,
    camera: PinholeCamera,
    lower: wp.vec3,
    upper: wp.vec3,
    step: float,
    begins: wp.array(dtype=wp.float32),
    counts: wp.array(dtype=wp.int32),
):
    """Where each ray (h * w,) enters a box, world units, and how many steps it takes to leave it."""
    n = first + wp.tid()
    direction = pixel_direction(camera, n % camera.width, n // camera.width)
    span = box_span(camera.center, direction, lower, upper)
    begins[n] = span[0]
    counts[n] = wp.max(int(wp.ceil((span[1] - span[0]) / step)), 0)


@wp.kernel
def place_samples(
    first: int,
    camera: PinholeCamera,
    ray: int,
    step: float,
    origin: wp.vec3,
    begins: wp.array(dtype=wp.float32),
    ends: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
):
    """Samples of rays from number `ray` on, and their directions. ends (rays,): of the samples of each
    ray; `origin` is added to what is relative to that of the camera."""
    n = first + wp.tid()
    pixel = ray + n
    direction = pixel_direction(camera, pixel % camera.width, pixel // camera.width)
    begin = int(0)
    if n > 0:
        begin = ends[n - 1]
    for k in range(begin, ends[n]):
        t = begins[pixel] + steps_to_sample(float(k - begin)) * step
        points[k] = camera.center + t * direction + origin
        directions[k] = direction


@wp.kernel
def move_along(
    first: int,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    step: float,
    moved: wp.array(dtype=wp.vec3),
):
    """Points (n,) a step farther along directions (n,) of any length."""
    n = first + wp.tid()
    moved[n] = points[n] + step * wp.normalize(directions[n])


@wp.kernel
def pose_densities(
    first: int,
    density: wp.array(dtype=wp.float32),
    here: wp.array(dtype=wp.vec3),
    region: wp.array(dtype=wp.int32),
    ahead: wp.array(dtype=wp.vec3),
    region_ahead: wp.array(dtype=wp.int32),
    lower: wp.vec3,
    upper: wp.vec3,
    step: float,
    posed: wp.array(dtype=wp.float32),
    bad: wp.array(dtype=int),
):
    """Densities (n,) at canonical points `here` and `ahead`, a step farther, in the posed scene; 0 where it is cleared
    or beside the box. bad[0] becomes 1 where a density is negative or not finite."""
    # `ahead` is of no points where optical depth is not in canonical arc length
    n = first + wp.tid()
    sigma = density[n]
    if not wp.isfinite(sigma) or sigma < 0.0:
        bad[0] = 1
    if ahead.shape[0] > 0:
        if region[n] == MAPPED and region_ahead[n] == MAPPED:
            sigma *= wp.length(ahead[n] - here[n]) / step
    is_out = int(region[n] == CLEARED)
    for axis in range(3):
        if here[n][axis] < lower[axis] or here[n][axis] > upper[axis]:
            is_out = 1
    posed[n] = wp.where(is_out == 1, 0.0, sigma)


@wp.kernel
def composite_samples(
    first: int,
    ray: int,
    step: float,
    background: wp.vec3,
    begins: wp.array(dtype=wp.float32),
    ends: wp.array(dtype=wp.int32),
    colors: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=wp.float32),
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """The pixels of rays from number `ray` on, of samples as `place_samples` has placed them."""
    n = first + wp.tid()
    pixel = ray + n
    begin = int(0)
    if n > 0:
        begin = ends[n - 1]
    color = wp.vec3()
    light = float(1.0)
    far = float(0.0)  # sum of w_k t_k
    for k in range(begin, ends[n]):
        kept = wp.exp(-density[k] * step)
        weight = light * (1.0 - kept)
        color += weight * colors[k]
        far += weight * (begins[pixel] + steps_to_sample(float(k - begin)) * step)
        light *= kept
    rgb[pixel] = color + light * background
    alpha[pixel] = 1.0 - light
    depth[pixel] = visible_depth(far, 1.0 - light)
