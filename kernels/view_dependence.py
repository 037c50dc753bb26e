"""Shrink what depends on the view: decoupled decay of the SH coefficients of degree 1 and up.

k_lm <- factor k_lm for l >= 1 (Loshchilov and Hutter 2019, weight decay apart from the gradient step). A surface that
few views saw takes a colour of its own for each of them otherwise.
Siblings: spherical_harmonics.
"""

import warp as wp

from .spherical_harmonics import vec9

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
