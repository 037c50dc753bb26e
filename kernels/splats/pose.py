"""Splats carried along by the map of a posed cage."""

# Splats are matter and move forward: phi(x) = A x + t + sum_j w_j(x) r_j, with the coordinates w of the cage at rest, A
# and t what fits the pose best among the maps that they reproduce, and r_j what that leaves of the posed vertices (of
# Green coordinates also of the stretched normals). So affine poses (Green: similarities) hold to the last digits. Its
# Jacobian is J = A + sum_j r_j (grad w_j)^T; the covariance S becomes J S J^T, harmonics turn by the rotation nearest
# to J.
#
# Opacity law, by `law`. LAW_RAYS keeps the opacity: a ray through the posed splat is as opaque as the ray that the map
# takes it from is through the splat at rest, as both pass it at the same distance in its own units (3DGS takes a
# splat's opacity at its centre in the picture, whatever its depth): this is density="opacity" of the voxels.
# LAW_DENSITY keeps matter per length, density="paper": the optical depth -ln(1 - o) grows with the length of the ray in
# the splat, by the root mean square of |J d| over directions, as a splat has one opacity for all of them.
#
# Shapes: splats (n,), rows (j, n) of weight and gradient, world units relative to one origin.

import warp as wp

from .jacobian import carried_covariance, nearest_rotation, rms_stretch

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
LAW_RAYS = wp.constant(0)
LAW_DENSITY = wp.constant(1)


@wp.struct
class CarriedSplats:
    """Splats on their way through the edits of a pose."""

    positions: wp.array(dtype=wp.vec3)
    jacobians: wp.array(dtype=wp.mat33)  # of all maps so far
    shares: wp.array(dtype=float)  # of the optical depth that is left, 0 to 1


@wp.kernel
def start_splats(first: int, centres: wp.array(dtype=wp.vec3), carried: CarriedSplats):
    """All splats to their places at rest, centres (n,)."""
    n = first + wp.tid()
    carried.positions[n] = centres[n]
    carried.jacobians[n] = wp.identity(n=3, dtype=float)


@wp.func
def put_splats(n: int, others: wp.array(dtype=int), position: wp.vec3, jacobian: wp.mat33, carried: CarriedSplats):
    """Put splat n, and those that go the same way: others (n,) names the next one of each, or -1."""
    each = int(n)
    while each >= 0:
        carried.positions[each] = position
        carried.jacobians[each] = jacobian
        each = others[each]


@wp.kernel
def carry_bound(
    first: int,
    members: wp.array(dtype=int),
    others: wp.array(dtype=int),
    anchors: wp.array(dtype=wp.vec3),
    offsets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    begin: int,
    slope: wp.mat33,
    shift: wp.vec3,
    inverse_size: float,
    carried: CarriedSplats,
):
    """Splats members (m,), at rest, and the others (n,) that go the same way, to where a pose takes them. rows (j, m),
    gradients per size of the cage; targets: r_j from number `begin` on; slope, shift: A - 1 and t."""
    # anchors (m,): where the map is taken, offsets (m,) from there to the splats.
    m = first + wp.tid()
    moved = wp.vec3(0.0, 0.0, 0.0)
    turned = wp.mat33()
    for j in range(rows.shape[0]):
        row = rows[j, m]
        residual = targets[begin + j]
        moved += row[0] * residual
        turned += wp.outer(residual, wp.vec3(row[1], row[2], row[3]))
    anchor = anchors[m]
    jacobian = wp.identity(n=3, dtype=float) + (slope + inverse_size * turned)
    position = anchor + (slope * anchor + shift + moved) + jacobian * offsets[m]
    put_splats(members[m], others, position, jacobian, carried)


@wp.kernel
def finish_splats(
    first: int,
    law: int,
    rest_covariances: wp.array2d(dtype=float),
    rest_opacities: wp.array(dtype=float),
    hidden: wp.array(dtype=wp.uint8),
    carried: CarriedSplats,
    centres: wp.array(dtype=wp.vec3),
    covariances: wp.array2d(dtype=float),
    opacities: wp.array(dtype=float),
    turns: wp.array(dtype=wp.quat),
):
    """Posed splats (n,) of what has been carried. hidden (n,): 1 where a splat is not drawn in this pose, or (0,)."""
    n = first + wp.tid()
    jacobian = carried.jacobians[n]
    centres[n] = carried.positions[n]
    rest = wp.mat33(
        rest_covariances[n, 0],
        rest_covariances[n, 1],
        rest_covariances[n, 2],
        rest_covariances[n, 1],
        rest_covariances[n, 3],
        rest_covariances[n, 4],
        rest_covariances[n, 2],
        rest_covariances[n, 4],
        rest_covariances[n, 5],
    )
    posed = carried_covariance(jacobian, rest)
    covariances[n, 0] = posed[0, 0]
    covariances[n, 1] = posed[0, 1]
    covariances[n, 2] = posed[0, 2]
    covariances[n, 3] = posed[1, 1]
    covariances[n, 4] = posed[1, 2]
    covariances[n, 5] = posed[2, 2]
    share = carried.shares[n]
    if law == LAW_DENSITY:
        share *= rms_stretch(jacobian)
    opacity = rest_opacities[n]
    if share != 1.0:
        opacity = 1.0 - wp.pow(1.0 - opacity, share)
    if hidden.shape[0] > 0:
        if hidden[n] != wp.uint8(0):
            opacity = 0.0
    opacities[n] = opacity
    turns[n] = wp.quat_from_matrix(nearest_rotation(jacobian))
