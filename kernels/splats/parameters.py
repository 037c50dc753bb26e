"""Splats as files and optimisers hold them, and the slopes of what kernels draw by these."""

# A splat is held by the logarithms of its three standard deviations s along its own axes R, a quaternion w x y z of any
# length that R belongs to, and the logit of its opacity: S = R diag(s^2) R^T, o = 1 / (1 + exp(-logit)) (Kerbl et al.,
# "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, Eq. 6). A quaternion of length zero turns
# nothing.
#
# The slope of a number is the derivative of a loss by it.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


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


@wp.kernel
def make_splats(
    first: int,
    log_scales: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    logits: wp.array(dtype=wp.float32),
    covariances: wp.array2d(dtype=wp.float32),
    opacities: wp.array(dtype=wp.float32),
):
    """log_scales: (n,) of world units. quaternions: (n,) w x y z. logits: (n,). covariances: (n, 6) and opacities:
    (n,) of splats/splats."""
    n = first + wp.tid()
    axes = splat_axes(quaternions[n])
    scales = log_scales[n]
    factor = axes * wp.diag(wp.vec3(wp.exp(scales[0]), wp.exp(scales[1]), wp.exp(scales[2])))
    covariance = factor * wp.transpose(factor)
    covariances[n, 0] = covariance[0, 0]
    covariances[n, 1] = covariance[0, 1]
    covariances[n, 2] = covariance[0, 2]
    covariances[n, 3] = covariance[1, 1]
    covariances[n, 4] = covariance[1, 2]
    covariances[n, 5] = covariance[2, 2]
    opacities[n] = 1.0 / (1.0 + wp.exp(-logits[n]))
