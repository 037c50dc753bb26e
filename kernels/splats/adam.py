"""Optimiser step of the values of splats: Adam (Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015)."""

# m <- b1 m + (1 - b1) g, v <- b2 v + (1 - b2) g^2, x <- x - rate m' / (sqrt(v') + eps), with m' = m / (1 - b1^t) and
# v' = v / (1 - b2^t) at step t.

import warp as wp

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
    """Values that are more than `most` above where they began are set back to that. begins, values: (count,)."""
    n = first + wp.tid()
    values[n] = wp.min(values[n], begins[n] + most)
