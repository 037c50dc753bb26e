"""Splats carried along by the map of a posed cage."""

import warp as wp

from ..core.gradients import forward_only_in
from ..lattice.cage_map import CageMap, make_inverse, map_distance, map_position, map_slope
from ..mesh.containment import winding_number

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.mat33, wp.mat33), (wp.array(dtype=wp.vec3),), (wp.array(dtype=wp.mat33),))

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
    return forward_only(r, jacobian)


@wp.func
def covariance_of(covariances: wp.array2d(dtype=float), n: int):
    """The matrix of a row xx xy xz yy yz zz."""
    xx = covariances[n, 0]
    xy = covariances[n, 1]
    xz = covariances[n, 2]
    yy = covariances[n, 3]
    yz = covariances[n, 4]
    zz = covariances[n, 5]
    return wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)


@wp.func
def write_covariance(covariances: wp.array2d(dtype=float), n: int, covariance: wp.mat33):
    """Row n of a symmetric matrix, by its upper triangle."""
    covariances[n, 0] = covariance[0, 0]
    covariances[n, 1] = covariance[0, 1]
    covariances[n, 2] = covariance[0, 2]
    covariances[n, 3] = covariance[1, 1]
    covariances[n, 4] = covariance[1, 2]
    covariances[n, 5] = covariance[2, 2]


LAW_RAYS = wp.constant(0)

LAW_DENSITY = wp.constant(1)


@wp.struct
class CarriedSplats:
    """Splats on their way through the edits of a pose."""

    positions: wp.array(dtype=wp.vec3)
    jacobians: wp.array(dtype=wp.mat33)  # of all maps so far
    shares: wp.array(dtype=float)  # of the optical depth that is left, 0 to 1


@wp.kernel
def start_splats(first: int, centers: wp.array(dtype=wp.vec3), carried: CarriedSplats):
    """All splats to their places at rest, centres (n,)."""
    n = first + wp.tid()
    carried.positions[n] = centers[n]
    carried.jacobians[n] = wp.identity(n=3, dtype=float)


@wp.func
def put_splats(n: int, others: wp.array(dtype=int), position: wp.vec3, jacobian: wp.mat33, carried: CarriedSplats):
    """Put splat n, and those that go the same way: others (n,) names the next one of each, or -1."""
    each = int(n)
    while each >= 0:
        carried.positions[each] = position
        carried.jacobians[each] = jacobian
        each = others[each]
    forward_only(carried.positions)
    forward_only(carried.jacobians)


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
    centers: wp.array(dtype=wp.vec3),
    covariances: wp.array2d(dtype=float),
    opacities: wp.array(dtype=float),
    turns: wp.array(dtype=wp.quat),
):
    """Posed splats (n,) of what has been carried. hidden (n,): 1 where a splat is not drawn in this pose, or (0,)."""
    n = first + wp.tid()
    jacobian = carried.jacobians[n]
    centers[n] = carried.positions[n]
    # symmetric to the last bit, as its six numbers are taken from the upper triangle
    write_covariance(covariances, n, jacobian * covariance_of(rest_covariances, n) * wp.transpose(jacobian))
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


#: What becomes of a splat that an edit may meet: it goes or stays; goes or is gone (a copy that moves); stays, whatever
#: is taken from there (a copy that is left).
GOES_OR_STAYS = wp.constant(0)

GOES = wp.constant(1)

STAYS = wp.constant(2)


@wp.func
def lies_in_cage(
    x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i), lower: wp.vec3, upper: wp.vec3
):
    """Whether a point is in a cage, of vertices (v,) and faces (f,), in the box from lower to upper."""
    for axis in range(3):
        if x[axis] < lower[axis] or x[axis] > upper[axis]:
            return False
    return winding_number(x, vertices, faces) > 0.5


@wp.kernel
def follow_map(
    first: int,
    members: wp.array(dtype=int),
    ways: wp.array(dtype=wp.uint8),
    forward: CageMap,
    tolerance: float,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    lower: wp.vec3,
    upper: wp.vec3,
    carried: CarriedSplats,
):
    """Splats members (m,), ways (m,), through an edit. forward: from the cage at rest, where its distances are of, to
    the posed one, of vertices (v,) and faces (f,) in the box lower to upper."""
    m = first + wp.tid()
    n = members[m]
    way = int(ways[m])
    x = carried.positions[n]
    if way != STAYS and map_distance(forward, x) <= tolerance:
        carried.jacobians[n] = map_slope(forward, x) * carried.jacobians[n]
        carried.positions[n] = map_position(forward, x)
    elif way == GOES or lies_in_cage(x, vertices, faces, lower, upper):
        carried.shares[n] = 0.0


@wp.kernel
def clear_inside(
    first: int,
    members: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    lower: wp.vec3,
    upper: wp.vec3,
    carried: CarriedSplats,
):
    """Clear of splats members (m,), which an earlier edit moved, what lies in a cage whose content is removed."""
    m = first + wp.tid()
    n = members[m]
    if lies_in_cage(carried.positions[n], vertices, faces, lower, upper):
        carried.shares[n] = 0.0


#: The place that a map on a lattice takes to a target.
inverse_position = make_inverse(CageMap, map_position, map_slope)


@wp.kernel
def invert_map(
    first: int,
    members: wp.array(dtype=int),
    targets: wp.array(dtype=wp.vec3),
    backward: CageMap,
    tolerance: float,
    close: float,
    carried: CarriedSplats,
    missed: wp.array(dtype=wp.uint8),
):
    """Splats members (m,) to the places that `backward` takes to targets (m,), their places at rest. missed (m,): 1
    where there is no such place near, and the splat stays where the forward map took it."""
    # tolerance: how far out of the posed cage a place may be; close: to its target it must be taken; world units.
    m = first + wp.tid()
    n = members[m]
    target = targets[m]
    x = inverse_position(backward, carried.positions[n], target, backward.spacing, 0.01 * close)
    found = int(0)
    off = wp.length(map_position(backward, x) - target)
    if off <= close and map_distance(backward, x) <= tolerance:
        slope = map_slope(backward, x)
        if wp.abs(wp.determinant(slope)) > 1.0e-9:
            found = 1
            carried.positions[n] = x
            carried.jacobians[n] = wp.inverse(slope)
    missed[m] = wp.uint8(1 - found)
