"""Gaussian splats as kernels read them, and the colour of one from a direction."""

# Model: Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (SIGGRAPH 2023). Splat i is matter
# around its centre c: opacity o exp(-1/2 (x - c)^T S^-1 (x - c)), with a covariance S. Its colour along a direction d,
# from the camera into the scene, is max(0, 0.5 + sum_b h_b Y_b(d)) with the real spherical harmonics Y of
# field/harmonics, whose order and signs 3DGS shares.
#
# A posed splat may be turned: its harmonics are those of the splat at rest, and are looked up along the direction
# turned back, Y(turn^-1 d), so that a pose need not write them anew. It may also be one of several pieces or copies of
# a splat at rest, which share a row of harmonics.
#
# Positions are world units relative to any origin that the caller keeps to (warpcage: the field's centre, so that
# float32 suffices).

import warp as wp

from ..field.harmonics import sh_basis

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Splats:
    centres: wp.array(dtype=wp.vec3)  # (n,) world units
    covariances: wp.array2d(dtype=wp.float32)  # (n, 6) xx xy xz yy yz zz, world units squared
    opacities: wp.array(dtype=wp.float32)  # (n,) 0 to 1; 0 where there is nothing (a splat that is cleared away)
    harmonics: wp.array2d(dtype=wp.float32)  # (rows, 3 (degree + 1)^2) coefficient-major, red green blue last
    degree: int  # 0 to 3
    turns: wp.array(dtype=wp.quat)  # (n,) unit quaternion x y z w, from rest to pose; or (0,): nothing is turned
    rows: wp.array(dtype=wp.int32)  # (n,) row of harmonics of each splat; or (0,): splat i has row i


@wp.func
def harmonics_row(splats: Splats, n: int):
    """The row of harmonics of splat n."""
    row = n
    if splats.rows.shape[0] > 0:
        row = splats.rows[n]
    return row


@wp.func
def rest_direction(splats: Splats, n: int, direction: wp.vec3):
    """A direction in the frame in which the harmonics of splat n were found."""
    turned = direction
    if splats.turns.shape[0] > 0:
        turned = wp.quat_rotate_inv(splats.turns[n], direction)
    return turned


@wp.func
def splat_colour(splats: Splats, n: int, direction: wp.vec3):
    """Colour of splat n seen along a unit direction, from the camera into the scene; not below 0."""
    row = harmonics_row(splats, n)
    basis = sh_basis(rest_direction(splats, n, direction))
    red = float(0.5)
    green = float(0.5)
    blue = float(0.5)
    count = (splats.degree + 1) * (splats.degree + 1)
    for b in range(count):
        red += basis[b] * splats.harmonics[row, 3 * b]
        green += basis[b] * splats.harmonics[row, 3 * b + 1]
        blue += basis[b] * splats.harmonics[row, 3 * b + 2]
    return wp.max(wp.vec3(red, green, blue), wp.vec3(0.0, 0.0, 0.0))


@wp.func
def splat_covariance(splats: Splats, n: int):
    """Covariance of splat n, world units squared."""
    xx = splats.covariances[n, 0]
    xy = splats.covariances[n, 1]
    xz = splats.covariances[n, 2]
    yy = splats.covariances[n, 3]
    yz = splats.covariances[n, 4]
    zz = splats.covariances[n, 5]
    return wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)
