"""Splats as densities at the nodes of a grid: matter to put a cage around, or to select parts of."""

# A splat of covariance S and opacity o, seen where it is thinnest, has the optical depth -ln(1 - o). Widened to the
# grid, S' = S + (h / 2)^2 with h a cell's side, it adds at x, of a density per world unit,
#
#   -ln(1 - o) / (sqrt(2 pi) s') exp(-1/2 (x - c)^T S'^-1 (x - c)),   s' its smallest standard deviation,
#
# so that a ray along that direction through the middle meets the same optical depth on a grid of any fineness.

import warp as wp

from .inside import covariance_of
from .splats import Splats

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

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
    centre = (splats.centres[n] - lower) / side
    lows = wp.vec3i()
    highs = wp.vec3i()
    shape = wp.vec3i(density.shape[0], density.shape[1], density.shape[2])
    for axis in range(3):
        reach = REACH * wp.sqrt(wide[axis, axis]) / side
        lows[axis] = int(wp.clamp(wp.ceil(centre[axis] - reach), 0.0, float(shape[axis])))
        highs[axis] = int(wp.clamp(wp.floor(centre[axis] + reach) + 1.0, 0.0, float(shape[axis])))
    for i in range(lows[0], highs[0]):
        for j in range(lows[1], highs[1]):
            for k in range(lows[2], highs[2]):
                d = side * (wp.vec3(float(i), float(j), float(k)) - centre)
                far = wp.dot(d, inverse * d)
                if far < REACH * REACH:
                    wp.atomic_add(density, i, j, k, peak * wp.exp(-0.5 * far))
