"""Slopes of maximum likelihood maps and weights of many points by the cage, face by face, in float64."""

# With w, m = sum w_i v_i and the unit normal n of a face as coordinates/maximum_likelihood.py has them,
#   y = m.n / (1 + phi . m / |m|),   weights y w / |m|,   balance sum_f y m / |m| = 0, which phi solves.
# Of L g = dL/dP is known at each point, P = sum weights t / W. With c_i = g . (t_i - P) / W at a face's corners and
# the adjoint lambda of phi, H lambda = -sum_f y s (c . w / |m|) m / |m|, s = 1 / (1 + phi . m / |m|), H the matrix
# of Newton's method, dL is the sum over faces of the change by their corners, phi and lambda held, of
#   h = (m.n) A / (|m| + phi.m),   A = c . w + lambda . m.
# See mean_value_adjoint.py for how points are shared out.

import warp as wp

from ..coordinates.face_slopes import FaceSlopes, mean_value_slopes
from ..coordinates.maximum_likelihood import MAX_PASSES, exact_face_term
from ..coordinates.mean_value import weights_in_double
from .mean_value_adjoint import corner_values

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

#: Newton's method ends where a step changes no y by more than this share: the square is rounding.
LAST_CHANGE = wp.constant(wp.float64(1.0e-8))

#: Faces weigh less than the square of this where the point is this near to their plane, as a share of the size.
EDGE_ON = wp.constant(wp.float64(1.0e-5))

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.struct
class LikelyPoints:
    """Points at which slopes are known, and what all faces need of each."""

    places: wp.array(dtype=wp.vec3)  # (n,), off the cage
    pulls: wp.array(dtype=wp.vec3)  # (n,) g / W, zero where the point counts for nothing; of rows: 1 / W, 0, 0
    positions: wp.array(dtype=wp.vec3)  # (n,) P; of rows: sum_j row_j w_j / W, 0, 0
    phis: wp.array(dtype=wp.vec3d)  # (n,)
    lambdas: wp.array(dtype=wp.vec3d)  # (n,)


@wp.func
def corner_differences(
    face: wp.vec3i, targets: wp.array(dtype=wp.vec3), rows: wp.array2d(dtype=float), n: int, position: wp.vec3
):
    """What corners of a face have more than the point, one a row."""
    return wp.matrix_from_rows(
        corner_values(face, targets, rows, n, 0) - position,
        corner_values(face, targets, rows, n, 1) - position,
        corner_values(face, targets, rows, n, 2) - position,
    )


@wp.kernel
def pull_likely_points(
    first: int,
    slopes: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    points: LikelyPoints,
):
    """The rest of `points`, of places (n,), from slopes (n,) = dL / dP, or from rows (n, v) = dL / d weights where
    there are any. Points without coordinates count for nothing."""
    n = first + wp.tid()
    points.pulls[n] = wp.vec3()
    if rows.shape[0] == 0:
        if wp.length_sq(slopes[n]) == 0.0:
            return
    x = wp.vec3d(points.places[n])
    unit = wp.float64(size)
    phi = wp.vec3d()
    inverse = wp.mat33d()
    settled = int(0)
    passes = int(0)
    while passes < MAX_PASSES:
        balance = wp.vec3d()
        matrix = wp.mat33d()
        largest = _ZERO
        rarest = _ZERO
        for f in range(faces.shape[0]):
            face = faces[f]
            a = wp.vec3d(vertices[face[0]]) - x
            term = exact_face_term(a, wp.vec3d(vertices[face[1]]) - x, wp.vec3d(vertices[face[2]]) - x, unit)
            if term.prior > _ZERO:
                share = _ONE / (_ONE + wp.dot(phi, term.direction))
                balance += term.prior * share * term.direction
                matrix += wp.outer(term.prior * share * share * term.direction, term.direction)
                largest = wp.max(largest, share)
                rarest = wp.max(rarest, _ONE / term.prior)
        inverse = wp.inverse(matrix)
        step = inverse * balance
        change = wp.min(wp.length(step) * largest, wp.sqrt(wp.max(wp.dot(step, balance), _ZERO) * rarest))
        phi += step / (_ONE + change)
        passes += 1
        if change < LAST_CHANGE:
            settled = int(1)
            passes = MAX_PASSES
    if settled == 0:
        return
    total = _ZERO
    sums = wp.vec3d()
    by_face = wp.vec3d()  # sum of y s (w . t / |m|) d, one product less position than lambda needs
    by_ones = wp.vec3d()
    moved = wp.mat33d()
    for f in range(faces.shape[0]):
        face = faces[f]
        a = wp.vec3d(vertices[face[0]]) - x
        term = exact_face_term(a, wp.vec3d(vertices[face[1]]) - x, wp.vec3d(vertices[face[2]]) - x, unit)
        if term.prior > _ZERO:
            share = _ONE / (_ONE + wp.dot(phi, term.direction))
            y = term.prior * share
            values = corner_differences(face, targets, rows, n, wp.vec3())
            value = wp.transpose(wp.mat33d(values)) * term.corners
            ones = term.corners[0] + term.corners[1] + term.corners[2]
            total += y * ones
            sums += y * value
            moved += wp.outer((y * share) * term.direction, value)
            by_ones += (y * share * ones) * term.direction
    position = sums / total
    pull = wp.vec3d(_ONE, _ZERO, _ZERO)
    if rows.shape[0] == 0:
        pull = wp.vec3d(slopes[n])
    pull = pull / total
    by_face = moved * pull - wp.dot(pull, position) * by_ones
    points.pulls[n] = wp.vec3(pull)
    points.positions[n] = wp.vec3(position)
    points.phis[n] = phi
    points.lambdas[n] = -(inverse * by_face)


@wp.struct
class LikelySlopes:
    """Of what a point adds to L, by the corners of a face, and the weights of these."""

    corners: FaceSlopes
    weights: wp.vec3d


@wp.func
def likely_slopes(
    points: LikelyPoints,
    n: int,
    face: wp.vec3i,
    vertices: wp.array(dtype=wp.vec3),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
):
    y = wp.vec3d(points.places[n])
    p = wp.vec3d(vertices[face[0]]) - y
    q = wp.vec3d(vertices[face[1]]) - y
    r = wp.vec3d(vertices[face[2]]) - y
    along = q - p
    across = r - p
    normal = wp.cross(along, across)
    double_area = wp.length(normal)
    det = wp.dot(normal, p)
    found = LikelySlopes()
    if not det > EDGE_ON * wp.float64(size) * double_area:
        return found
    normal = normal / double_area
    phi = points.phis[n]
    adjoint = points.lambdas[n]
    values = corner_differences(face, targets, rows, n, points.positions[n])
    cotangents = wp.mat33d(values) * wp.vec3d(points.pulls[n])
    weights = weights_in_double(p, q, r, det)
    mean = weights[0] * p + weights[1] * q + weights[2] * r
    length = wp.length(mean)
    below = length + wp.dot(phi, mean)
    height = wp.dot(mean, normal)
    alpha = (wp.dot(cotangents, weights) + wp.dot(adjoint, mean)) / below
    beta = height / below
    by_mean = alpha * normal - alpha * beta * (mean / length + phi) + beta * adjoint
    by_weights = beta * cotangents + wp.vec3d(wp.dot(by_mean, p), wp.dot(by_mean, q), wp.dot(by_mean, r))
    slopes = mean_value_slopes(p, q, r, by_weights)
    by_normal = (alpha / double_area) * (mean - height * normal)
    by_along = wp.cross(across, by_normal)
    by_across = wp.cross(by_normal, along)
    slopes.p += weights[0] * by_mean - by_along - by_across
    slopes.q += weights[1] * by_mean + by_along
    slopes.r += weights[2] * by_mean + by_across
    found.corners = slopes
    found.weights = beta * weights
    return found


@wp.kernel
def sum_likely_corners(
    first: int,
    points: LikelyPoints,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
    by_vertices: wp.array3d(dtype=wp.vec3),
    by_targets: wp.array3d(dtype=wp.vec3),
):
    """Add to by_vertices, by_targets (parts, f, 3): slopes of L by the corners of each face in the cage, and by their
    targets, over each part of the points. One item per part and face."""
    item = first + wp.tid()
    f = item % faces.shape[0]
    part = item / faces.shape[0]
    by_p = wp.vec3d()
    by_q = wp.vec3d()
    by_r = wp.vec3d()
    to_p = wp.vec3d()
    to_q = wp.vec3d()
    to_r = wp.vec3d()
    n = part
    while n < points.pulls.shape[0]:
        pull = wp.vec3d(points.pulls[n])
        if wp.length_sq(pull) > _ZERO:
            found = likely_slopes(points, n, faces[f], vertices, targets, rows, size)
            by_p += found.corners.p
            by_q += found.corners.q
            by_r += found.corners.r
            to_p += found.weights[0] * pull
            to_q += found.weights[1] * pull
            to_r += found.weights[2] * pull
        n += by_vertices.shape[0]
    by_vertices[part, f, 0] = by_vertices[part, f, 0] + wp.vec3(by_p)
    by_vertices[part, f, 1] = by_vertices[part, f, 1] + wp.vec3(by_q)
    by_vertices[part, f, 2] = by_vertices[part, f, 2] + wp.vec3(by_r)
    by_targets[part, f, 0] = by_targets[part, f, 0] + wp.vec3(to_p)
    by_targets[part, f, 1] = by_targets[part, f, 1] + wp.vec3(to_q)
    by_targets[part, f, 2] = by_targets[part, f, 2] + wp.vec3(to_r)


@wp.kernel
def slope_likely_points(
    first: int,
    points: LikelyPoints,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
    by_points: wp.array(dtype=wp.vec3),
):
    """by_points (n,): slopes of L by the points, what is left of those by the cage, as all moves together."""
    n = first + wp.tid()
    total = wp.vec3d()
    if wp.length_sq(points.pulls[n]) > 0.0:
        f = int(0)
        while f < faces.shape[0]:
            found = likely_slopes(points, n, faces[f], vertices, targets, rows, size)
            total -= found.corners.p + found.corners.q + found.corners.r
            f += 1
    by_points[n] = wp.vec3(total)
