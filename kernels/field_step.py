"""Optimiser step of a voxel field: RMSProp on the rows that a gradient touched.

v <- beta v + (1 - beta) g^2 (v = g^2 at the first touch), x <- x - rate g / (sqrt(v) + eps): Tieleman and Hinton 2012,
with the start of Plenoxels' optimiser.
Siblings: spherical_harmonics.
"""

import warp as wp

from .spherical_harmonics import mat93

wp.set_module_options({"enable_backward": False})


@wp.func
def second_moment(v: float, gradient: float, beta: float):
    return wp.where(v == 0.0, gradient * gradient, beta * v + (1.0 - beta) * gradient * gradient)


@wp.kernel
def apply_rmsprop(
    first: int,
    rate_density: float,
    rate_sh: float,
    beta: float,
    epsilon: float,
    grad_density: wp.array(dtype=wp.float32),
    grad_sh: wp.array(dtype=mat93),
    moment_density: wp.array(dtype=wp.float32),
    moment_sh: wp.array(dtype=mat93),
    density: wp.array(dtype=wp.float32),
    sh: wp.array(dtype=mat93),
):
    """One row: step where the gradient is not zero, and clear the gradient for the next batch."""
    row = first + wp.tid()
    gradient = grad_density[row]
    if gradient != 0.0:
        v = second_moment(moment_density[row], gradient, beta)
        moment_density[row] = v
        density[row] = density[row] - rate_density * gradient / (wp.sqrt(v) + epsilon)
        grad_density[row] = 0.0
    gradients = grad_sh[row]
    if wp.ddot(gradients, gradients) != 0.0:
        moments = moment_sh[row]
        values = sh[row]
        for b in range(9):
            for channel in range(3):
                g = gradients[b, channel]
                if g != 0.0:
                    moments[b, channel] = second_moment(moments[b, channel], g, beta)
                    values[b, channel] = values[b, channel] - rate_sh * g / (wp.sqrt(moments[b, channel]) + epsilon)
        moment_sh[row] = moments
        sh[row] = values
        grad_sh[row] = mat93(0.0)


@wp.kernel
def add_gradients(
    first: int,
    other_density: wp.array(dtype=wp.float32),
    other_sh: wp.array(dtype=mat93),
    grad_density: wp.array(dtype=wp.float32),
    grad_sh: wp.array(dtype=mat93),
):
    """Move one thread's gradients into the total and clear them."""
    row = first + wp.tid()
    if other_density[row] != 0.0:
        grad_density[row] = grad_density[row] + other_density[row]
        other_density[row] = 0.0
    gradients = other_sh[row]
    if wp.ddot(gradients, gradients) != 0.0:
        grad_sh[row] = grad_sh[row] + gradients
        other_sh[row] = mat93(0.0)


@wp.kernel
def join_maximum(first: int, other: wp.array(dtype=wp.float32), values: wp.array(dtype=wp.float32)):
    n = first + wp.tid()
    values[n] = wp.max(values[n], other[n])
