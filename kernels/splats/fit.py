"""Loss of a picture beside the one that should be seen, and its slope by each pixel."""

import warp as wp

from ..view.pictures import part_index
from .pose import covariance_of, write_covariance
from .splats import Splats

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class AdamStep:
    """One step of one kind of values."""

    width: int  # numbers of a row
    lead: int  # so many of them come first
    lead_rate: float  # rate of those
    rate: float  # rate of the others
    beta1: float
    beta2: float
    share1: float  # 1 - beta1^t
    share2: float  # 1 - beta2^t
    epsilon: float


@wp.kernel
def step_adam(
    first: int,
    step: AdamStep,
    slopes: wp.array(dtype=wp.float32),
    means: wp.array(dtype=wp.float32),
    squares: wp.array(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
):
    """One item per number. slopes, means, squares, values: (rows * width,)."""
    n = first + wp.tid()
    slope = slopes[n]
    mean = step.beta1 * means[n] + (1.0 - step.beta1) * slope
    square = step.beta2 * squares[n] + (1.0 - step.beta2) * slope * slope
    means[n] = mean
    squares[n] = square
    rate = wp.where(n % step.width < step.lead, step.lead_rate, step.rate)
    values[n] = values[n] - rate * (mean / step.share1) / (wp.sqrt(square / step.share2) + step.epsilon)


@wp.kernel
def hold_below(first: int, most: float, begins: wp.array(dtype=wp.float32), values: wp.array(dtype=wp.float32)):
    """Limit values (count,) to at most `most` above their first ones. begins, values: (count,)."""
    n = first + wp.tid()
    values[n] = wp.min(values[n], begins[n] + most)


#: Standard deviations to which a splat is added, and the opacity that counts as whole.
REACH = wp.constant(3.0)

OPAQUE = wp.constant(0.999)


@wp.func
def smallest_eigenvalue(s: wp.mat33):
    """Smallest eigenvalue of a symmetric matrix (Smith 1961)."""
    mean = wp.trace(s) / 3.0
    off = s - mean * wp.identity(n=3, dtype=float)
    p = wp.sqrt(wp.ddot(off, off) / 6.0)
    if not p > 1.0e-6 * mean:
        return mean
    r = wp.clamp(0.5 * wp.determinant(off * (1.0 / p)), -1.0, 1.0)
    return mean + 2.0 * p * wp.cos((wp.acos(r) + 2.0 * wp.pi) / 3.0)


@wp.kernel
def deposit_splats(
    first: int, splats: Splats, lower: wp.vec3, side: float, least: float, density: wp.array3d(dtype=float)
):
    """Add splats of opacity `least` or more to density (nx, ny, nz); node (i, j, k) lies at lower + side (i, j, k).
    Items write to the same nodes."""
    n = first + wp.tid()
    opacity = wp.min(splats.opacities[n], OPAQUE)
    if opacity < least:
        return
    wide = covariance_of(splats.covariances, n) + (0.25 * side * side) * wp.identity(n=3, dtype=float)
    thin = wp.sqrt(wp.max(smallest_eigenvalue(wide), 0.2 * side * side))
    inverse = wp.inverse(wide)
    peak = -wp.log(1.0 - opacity) / (2.5066282746310002 * thin)
    center = (splats.centers[n] - lower) / side
    lows = wp.vec3i()
    highs = wp.vec3i()
    shape = wp.vec3i(density.shape[0], density.shape[1], density.shape[2])
    for axis in range(3):
        reach = REACH * wp.sqrt(wide[axis, axis]) / side
        lows[axis] = int(wp.clamp(wp.ceil(center[axis] - reach), 0.0, float(shape[axis])))
        highs[axis] = int(wp.clamp(wp.floor(center[axis] + reach) + 1.0, 0.0, float(shape[axis])))
    for i in range(lows[0], highs[0]):
        for j in range(lows[1], highs[1]):
            for k in range(lows[2], highs[2]):
                d = side * (wp.vec3(float(i), float(j), float(k)) - center)
                far = wp.dot(d, inverse * d)
                if far < REACH * REACH:
                    wp.atomic_add(density, i, j, k, peak * wp.exp(-0.5 * far))


@wp.func
def unit_quaternion(q: wp.vec4):
    """w x y z of length one."""
    square = wp.dot(q, q)
    return wp.where(square > 0.0, q / wp.sqrt(square), wp.vec4(1.0, 0.0, 0.0, 0.0))


@wp.func
def splat_axes(q: wp.vec4):
    """Axes of a splat, one per column, from its quaternion w x y z of any length."""
    unit = unit_quaternion(q)
    w = unit[0]
    x = unit[1]
    y = unit[2]
    z = unit[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
def quaternion_slope(q: wp.vec4, g: wp.mat33):
    """Slope of a quaternion from that of its axes."""
    square = wp.dot(q, q)
    unit = unit_quaternion(q)
    w = unit[0]
    x = unit[1]
    y = unit[2]
    z = unit[3]
    plain = 2.0 * wp.vec4(
        x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]),
        y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]) - 2.0 * x * (g[1, 1] + g[2, 2]),
        x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]) - 2.0 * y * (g[0, 0] + g[2, 2]),
        x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]) - 2.0 * z * (g[0, 0] + g[1, 1]),
    )
    along = plain - wp.dot(plain, unit) * unit  # its length changes nothing
    return wp.where(square > 0.0, along / wp.sqrt(wp.max(square, 1.0e-30)), wp.vec4())


@wp.func
def write_splat(splats: Splats, n: int, log_scales: wp.vec3, quaternion: wp.vec4, logit: float):
    """Covariance and opacity of splat n from its values."""
    axes = splat_axes(quaternion)
    factor = axes * wp.diag(wp.vec3(wp.exp(log_scales[0]), wp.exp(log_scales[1]), wp.exp(log_scales[2])))
    covariance = factor * wp.transpose(factor)
    write_covariance(splats.covariances, n, covariance)
    splats.opacities[n] = 1.0 / (1.0 + wp.exp(-logit))


@wp.kernel
def make_splats(
    first: int,
    log_scales: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    logits: wp.array(dtype=wp.float32),
    splats: Splats,
):
    """log_scales: (n,) of world units. quaternions: (n,) w x y z. logits: (n,). splats: their covariances (n, 6) and
    opacities (n,) are written."""
    n = first + wp.tid()
    write_splat(splats, n, log_scales[n], quaternions[n], logits[n])


@wp.kernel
def slope_of_picture(
    first: int,
    side: int,
    width: int,
    squared: int,
    drawn: wp.array(dtype=wp.vec3),
    picture: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    errors: wp.array(dtype=wp.float32),
):
    """slopes, as `drawn` (h * side * width * side,): of the sum over all pixels; errors (h * width,): mean square of
    the colors' differences. One item per pixel of the picture (h * width,) to be seen; squared: 1 for d^2 / 2."""
    n = first + wp.tid()
    mean = wp.vec3()
    share = 1.0 / float(side * side)
    for part in range(side * side):
        mean += share * drawn[part_index(n, part, side, width)]
    difference = mean - picture[n]
    errors[n] = wp.dot(difference, difference) / 3.0
    slope = difference
    if squared == 0:
        slope = wp.vec3(wp.sign(difference[0]), wp.sign(difference[1]), wp.sign(difference[2]))
    for part in range(side * side):
        slopes[part_index(n, part, side, width)] = share * slope
