"""Optimiser step of a voxel field: RMSProp on the values that a gradient touched.

v <- beta v + (1 - beta) g^2 (v = g^2 at the first touch), x <- x - rate g / (sqrt(v) + eps): Tieleman and Hinton 2012,
with the start of Plenoxels' optimiser. Arrays are flat, so that neighbouring threads read neighbouring numbers.
Siblings: none.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def apply_rmsprop(
    first: int,
    rate: float,
    beta: float,
    epsilon: float,
    gradients: wp.array(dtype=wp.float32),
    moments: wp.array(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
):
    """Step where the gradient is not zero, and clear the gradient for the next batch."""
    n = first + wp.tid()
    gradient = gradients[n]
    if gradient != 0.0:
        v = moments[n]
        if v == 0.0:
            v = gradient * gradient
        else:
            v = beta * v + (1.0 - beta) * gradient * gradient
        moments[n] = v
        values[n] = values[n] - rate * gradient / (wp.sqrt(v) + epsilon)
        gradients[n] = 0.0


@wp.kernel
def add_gradients(first: int, other: wp.array(dtype=wp.float32), total: wp.array(dtype=wp.float32)):
    """Move one thread's gradients into the total and clear them."""
    n = first + wp.tid()
    gradient = other[n]
    if gradient != 0.0:
        total[n] = total[n] + gradient
        other[n] = 0.0


@wp.kernel
def join_maximum(first: int, other: wp.array(dtype=wp.float32), values: wp.array(dtype=wp.float32)):
    n = first + wp.tid()
    values[n] = wp.max(values[n], other[n])
