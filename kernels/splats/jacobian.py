"""What the Jacobian of a map does to a splat: its covariance, the rotation nearest to it, and its stretch."""

# A map takes the Gaussian of covariance S around c to the Gaussian of covariance J S J^T around phi(c), to first order.
# The rotation nearest to J is R of the polar decomposition J = R P (Higham, "Computing the Polar Decomposition with
# Applications", 1986): X <- (X + X^-T) / 2 doubles its digits each time, with a scaling at first. Where J turns over or
# is nearly flat it is that of the singular value decomposition, with the sign of the smallest direction chosen so that
# R is a rotation.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Below this determinant, as a share of the cube of J's root mean square stretch, J counts as flat or turned over.
FLAT = wp.constant(1.0e-3)


@wp.func
def rms_stretch(jacobian: wp.mat33):
    """Root mean square of |J d| over all directions d: sqrt(tr(J^T J) / 3)."""
    return wp.sqrt(wp.ddot(jacobian, jacobian) / 3.0)


@wp.func(inline=False)  # rare
def rotation_by_svd(jacobian: wp.mat33):
    """The nearest rotation of any J; of J = 0 the identity."""
    largest = rms_stretch(jacobian)
    if not largest > 0.0:
        return wp.identity(n=3, dtype=float)
    u = wp.mat33()
    v = wp.mat33()
    s = wp.vec3()
    wp.svd3(jacobian / largest, u, s, v)
    sign = wp.where(wp.determinant(u) * wp.determinant(v) < 0.0, -1.0, 1.0)
    return u * wp.diag(wp.vec3(1.0, 1.0, sign)) * wp.transpose(v)


@wp.func
def nearest_rotation(jacobian: wp.mat33):
    """R of the polar decomposition J = R P; of a map that turns over, the nearest rotation."""
    largest = rms_stretch(jacobian)
    det = wp.determinant(jacobian)
    if not det > FLAT * largest * largest * largest:
        return rotation_by_svd(jacobian)
    r = jacobian * (1.0 / largest)
    for _ in range(12):
        # the inverse transposed is the matrix of cofactors over the determinant
        a = wp.vec3(r[0, 0], r[0, 1], r[0, 2])
        b = wp.vec3(r[1, 0], r[1, 1], r[1, 2])
        c = wp.vec3(r[2, 0], r[2, 1], r[2, 2])
        bc = wp.cross(b, c)
        scale = 1.0 / wp.dot(a, bc)
        inverse = scale * wp.matrix_from_rows(bc, wp.cross(c, a), wp.cross(a, b))
        # after Higham: balances r and its inverse, so that far from a rotation few steps are needed
        gamma = wp.sqrt(wp.sqrt(wp.ddot(inverse, inverse) / wp.ddot(r, r)))
        r = 0.5 * (gamma * r + (1.0 / gamma) * inverse)
        off = wp.ddot(r, r) - 3.0
        if wp.abs(gamma - 1.0) < 1.0e-4 and wp.abs(off) < 1.0e-6:
            break
    return r


@wp.func
def carried_covariance(jacobian: wp.mat33, covariance: wp.mat33):
    """J S J^T, symmetric to the last bit where its six numbers are taken from the upper triangle."""
    return jacobian * covariance * wp.transpose(jacobian)
