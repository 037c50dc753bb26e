"""Optimiser step of a voxel field: RMSProp on the values that a gradient touched.

v <- beta v + (1 - beta) g^2 (v = g^2 at the first touch), x <- x - rate g / (sqrt(v) + eps): Tieleman and Hinton 2012,
with the start of Plenoxels' optimiser. One item per number, so that neighbouring threads read neighbouring numbers.
Needs: field/harmonics.
"""

import warp as wp

from ..field.harmonics import DIFFERENCE_BASIS, LUMINANCE_BASIS

wp.set_module_options({"enable_backward": False})

#: Numbers of a voxel's SH (field/harmonics): sixteen of luminance, four of orange, four of green.
COEFFICIENTS = wp.constant(24)

#: Numbers of a gradient row: the coefficients, then the density.
GRADIENT_ROW = wp.constant(25)


@wp.func
def harmonic_degree(number: int):
    """Degree of the harmonic that a coefficient belongs to: 0 to 3."""
    basis = number
    if number >= LUMINANCE_BASIS:
        basis = (number - LUMINANCE_BASIS) % DIFFERENCE_BASIS
    return wp.where(basis == 0, 0, wp.where(basis < 4, 1, wp.where(basis < 9, 2, 3)))


@wp.func
def rmsprop_update(value: float, moment: float, gradient: float, rate: float, beta: float, epsilon: float):
    """(value, moment) after a step by a gradient. A moment of 0 has met no gradient before."""
    v = gradient * gradient
    if moment != 0.0:
        v = beta * moment + (1.0 - beta) * gradient * gradient
    return value - rate * gradient / (wp.sqrt(v) + epsilon), v


@wp.kernel
def apply_rmsprop(
    first: int,
    rate_density: float,
    rates_sh: wp.vec4,
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

    GRADIENT_ROW items per row. touched: (rows,) 1 where any gradient may be. gradients, moments: (rows, 25), 24
    coefficients, then density. density: (rows,) per world unit. coefficients: (rows, 24): they step by the one of
    rates_sh that is for their degree. Moments have 8 bits of mantissa: they only scale steps, and a share of 1 - beta
    moves them by more than a last bit.
    """
    n = first + wp.tid()
    row = n // GRADIENT_ROW
    number = n % GRADIENT_ROW
    if touched[row] == wp.uint8(0):
        return
    gradient = gradients[row, number]
    if gradient != 0.0:
        moment = float(moments[row, number])
        if number < COEFFICIENTS:
            rate = rates_sh[harmonic_degree(number)]
            value = coefficients[row, number]
            value, moment = rmsprop_update(value, moment, gradient, rate, beta, epsilon_sh)
            coefficients[row, number] = value
        else:
            sigma = density[row]
            sigma, moment = rmsprop_update(sigma, moment, gradient, rate_density, beta, epsilon_density)
            density[row] = sigma
        moments[row, number] = wp.bfloat16(moment)
        gradients[row, number] = 0.0


@wp.kernel
def add_gradients(first: int, other: wp.array(dtype=wp.float32), total: wp.array(dtype=wp.float32)):
    """Move one thread's gradients into the total and clear them. One item per number."""
    n = first + wp.tid()
    gradient = other[n]
    if gradient != 0.0:
        total[n] = total[n] + gradient
        other[n] = 0.0


@wp.kernel
def join_maximum(first: int, other: wp.array(dtype=wp.float32), values: wp.array(dtype=wp.float32)):
    """The larger of two numbers, in `values`. One item per number."""
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
    """Moments of the nodes that stay, from the rows that `links` gave them before.

    GRADIENT_ROW items per row. links: (nx, ny, nz) row of each node, or -1. nodes: (rows,) grid indices of the rows
    that stay. moments: (rows before, 25); kept: (rows, 25).
    """
    n = first + wp.tid()
    row = n // GRADIENT_ROW
    node = nodes[row]
    before = links[node[0], node[1], node[2]]
    kept[row, n % GRADIENT_ROW] = moments[before, n % GRADIENT_ROW]


@wp.kernel
def shrink_view_dependence(first: int, factor: float, coefficients: wp.array2d(dtype=wp.float32)):
    """Multiplies the coefficients (rows, 24) that depend on direction by a factor. One item per number."""
    n = first + wp.tid()
    row = n // COEFFICIENTS
    number = n % COEFFICIENTS
    if harmonic_degree(number) > 0:
        coefficients[row, number] = factor * coefficients[row, number]
