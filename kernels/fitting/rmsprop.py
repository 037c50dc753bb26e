"""Optimiser step of a voxel field: RMSProp on the values that a gradient touched.

v <- beta v + (1 - beta) g^2 (v = g^2 at the first touch), x <- x - rate g / (sqrt(v) + eps): Tieleman and Hinton 2012,
with the start of Plenoxels' optimiser. One item a number, so that neighbouring threads read neighbouring numbers.
Needs: field/harmonics.
"""

import warp as wp

from ..field.harmonics import vec9

wp.set_module_options({"enable_backward": False})

#: Numbers of a voxel's SH: nine of red, nine of green, nine of blue.
COEFFICIENTS = wp.constant(27)
BASIS_COUNT = wp.constant(9)

#: Numbers of a gradient row: 27 coefficients, red first, then the density.
GRADIENT_ROW = wp.constant(28)


@wp.kernel
def apply_rmsprop(
    first: int,
    rate_density: float,
    rate_sh: float,
    rate_directional: float,
    beta: float,
    epsilon_density: float,
    epsilon_sh: float,
    touched: wp.array(dtype=wp.uint8),
    gradients: wp.array2d(dtype=wp.float32),
    moments: wp.array2d(dtype=wp.bfloat16),
    density: wp.array(dtype=wp.float32),
    coefficients: wp.array2d(dtype=wp.float32),
):
    """Step where the gradient is not zero, and clear the gradient for the next batch.

    GRADIENT_ROW items a row. gradients, moments: (rows, 28), 27 coefficients, then density. coefficients: (rows, 27),
    whose constant terms step by rate_sh and whose others, which tell directions apart, by rate_directional. Moments
    have 8 bits of mantissa: they only scale steps, and a share of 1 - beta moves them by more than a last bit.
    """
    n = first + wp.tid()
    row = n // GRADIENT_ROW
    number = n % GRADIENT_ROW
    if touched[row] == wp.uint8(0):
        return
    gradient = gradients[row, number]
    if gradient != 0.0:
        v = float(moments[row, number])
        if v == 0.0:
            v = gradient * gradient
        else:
            v = beta * v + (1.0 - beta) * gradient * gradient
        moments[row, number] = wp.bfloat16(v)
        gradients[row, number] = 0.0
        if number < COEFFICIENTS:
            rate = wp.where(number % BASIS_COUNT == 0, rate_sh, rate_directional)
            coefficients[row, number] = coefficients[row, number] - rate * gradient / (wp.sqrt(v) + epsilon_sh)
        else:
            density[row] = density[row] - rate_density * gradient / (wp.sqrt(v) + epsilon_density)


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


@wp.kernel
def gather_moments(
    first: int,
    links: wp.array3d(dtype=wp.int32),
    nodes: wp.array(dtype=wp.vec3i),
    moments: wp.array2d(dtype=wp.bfloat16),
    kept: wp.array2d(dtype=wp.bfloat16),
):
    """Moments of the nodes that stay, from the rows that `links` gave them. GRADIENT_ROW items a row."""
    n = first + wp.tid()
    row = n // GRADIENT_ROW
    node = nodes[row]
    before = links[node[0], node[1], node[2]]
    kept[row, n % GRADIENT_ROW] = moments[before, n % GRADIENT_ROW]


wp.set_module_options({"enable_backward": False})


@wp.kernel
def shrink_view_dependence(first: int, factor: float, sh: wp.array2d(dtype=vec9)):
    """One item a row and channel, in memory order."""
    n = first + wp.tid()
    value = sh[n // sh.shape[1], n % sh.shape[1]]
    mean = value[0]
    value *= factor
    value[0] = mean
    sh[n // sh.shape[1], n % sh.shape[1]] = value
