"""Slopes of mean value maps and weights of many points by the cage, face by face."""

# P = sum_j w_j t_j / W, W = sum_j w_j, and L a number of which g = dL/dP is known at each point. With c_i = g . (t_i -
# P) / W at the corners of a face, dL = sum over faces of sum_i c_i dw_i, w the corners' weights of that face alone. For
# these, as coordinates/mean_value.py has them, let d = sum_i c_i C_i / det, the slope of what is linear on the face and
# c_i at its corners. Then sum_i c_i w_i = d . m with m = 1/2 sum over edges of rho C, rho = beta / |C|, and
#   d (d . m) = d . dm - sum_i w_i d . dv_i,     as d . v_i = c_i is held,
#   d (d . rho C) by b and c of an edge, C = b x c:   rho (c x d) + (d . C) (kappa |c|^2 b + (mu - kappa b.c) c),
#                                                     rho (d x b) + (d . C) (kappa |b|^2 c + (mu - kappa b.c) b),
#   kappa = d rho / d|C| / |C|,  mu = d rho / d(b.c) = -1 / (|b| |c|)^2.
# Where c_i are entries of rows (n, v), L is sum of rows . weights. A group of lanes takes the faces for one point after
# the other: points without a slope cost nothing. Each part of the points has sums of its own (parts, f, 3), for each
# corner.

from typing import Any

import warp as wp

from ..coordinates.face_slopes import mean_value_slopes, off_the_plane
from ..coordinates.mean_value import (
    FLAT,
    angle_over_sine,
    exact_point,
    has_cancelled,
    mean_value_point,
    weights_in_double,
)
from ..core.loads import reciprocal_root
from ..mesh.fans import near_plane_limit

# so many registers per thread that larger blocks would fill a GPU less well
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})

#: Slopes lose twice the digits that weights lose next to the plane of a face: float64 begins ten times as far from it.
WIDER = wp.constant(100.0)


@wp.struct
class PulledPoints:
    """Points at which slopes are known, and what all faces need of each."""

    places: wp.array(dtype=wp.vec3)  # (n,), off the cage
    pulls: wp.array(dtype=wp.vec3)  # (n,) g / W, zero where the point counts for nothing; of rows: 1 / W, 0, 0
    positions: wp.array(dtype=wp.vec3)  # (n,) P; of rows: sum_j row_j w_j / W, 0, 0
    totals: wp.array(dtype=float)  # (n,) W


@wp.struct
class CornerSlopes:
    """Of L, by the corners of a face, and the weights of these."""

    p: wp.vec3
    q: wp.vec3
    r: wp.vec3
    weights: wp.vec3


@wp.func
def angle_slope(cosine: float):
    """(t - acos(t) / sqrt(1 - t^2)) / (1 - t^2) for t in [0, 1], to 7e-7: a polynomial, from Chebyshev nodes."""
    p = 0.6049010704 - 0.1114822684 * cosine
    p = p * cosine - 1.4994674204
    p = p * cosine + 2.3309182708
    p = p * cosine - 2.6904888729
    p = p * cosine + 2.6220048598
    p = p * cosine - 2.3521090586
    p = p * cosine + 1.9998517297
    return p * cosine - 1.5707954175


@wp.struct
class TurnedEdge:
    """The edge from b to c of a face, seen from the point."""

    cross: wp.vec3  # C
    product: float  # b . c
    rho: float
    kappa: float
    mu: float


@wp.func
def turned_edge(b: wp.vec3, c: wp.vec3):
    edge = TurnedEdge()
    edge.cross = wp.cross(b, c - b)
    squared = wp.dot(edge.cross, edge.cross)
    edge.product = wp.dot(b, c)
    inverse = reciprocal_root(squared + edge.product * edge.product)
    cosine = wp.abs(edge.product) * inverse
    edge.rho = inverse * angle_over_sine(cosine)
    edge.mu = -inverse * inverse
    edge.kappa = -edge.mu * inverse * angle_slope(cosine)
    if edge.product < 0.0:
        turn = 3.1415926536 * reciprocal_root(squared)
        edge.rho = turn - edge.rho
        edge.kappa = -edge.kappa - turn / squared
    return edge


@wp.func
def corner_slope(p: wp.vec3, q: wp.vec3, r: wp.vec3, pq: TurnedEdge, rp: TurnedEdge, half: wp.vec3):
    """By corner p, the first end of one edge and the second of another, of half . sum rho C over both."""
    half_pq = wp.dot(half, pq.cross)
    half_rp = wp.dot(half, rp.cross)
    return (
        wp.cross(pq.rho * q - rp.rho * r, half)
        + (half_pq * pq.kappa * wp.dot(q, q) + half_rp * rp.kappa * wp.dot(r, r)) * p
        + half_pq * (pq.mu - pq.kappa * pq.product) * q
        + half_rp * (rp.mu - rp.kappa * rp.product) * r
    )


@wp.func
def far_slopes(p: wp.vec3, q: wp.vec3, r: wp.vec3, det: float, cotangents: wp.vec3):
    """Of a face clear of the origin's plane."""
    bc = turned_edge(q, r)
    ca = turned_edge(r, p)
    ab = turned_edge(p, q)
    inverse = 1.0 / det
    mean = 0.5 * (bc.rho * bc.cross + ca.rho * ca.cross + ab.rho * ab.cross)
    d = inverse * (cotangents[0] * bc.cross + cotangents[1] * ca.cross + cotangents[2] * ab.cross)
    result = CornerSlopes()
    result.weights = inverse * wp.vec3(wp.dot(bc.cross, mean), wp.dot(ca.cross, mean), wp.dot(ab.cross, mean))
    half = 0.5 * d
    result.p = corner_slope(p, q, r, ab, ca, half) - result.weights[0] * d
    result.q = corner_slope(q, r, p, bc, ab, half) - result.weights[1] * d
    result.r = corner_slope(r, p, q, ca, bc, half) - result.weights[2] * d
    return result


@wp.func(inline=False)
def near_slopes(a: wp.vec3, b: wp.vec3, c: wp.vec3, cotangents: wp.vec3, size: float):
    """Of a face whose plane passes next to the origin, in float64."""
    p = wp.vec3d(a)
    q = wp.vec3d(b)
    r = wp.vec3d(c)
    unit = wp.float64(size)
    result = CornerSlopes()
    normal = wp.cross(q - p, r - p)
    if wp.length(normal) > wp.float64(0.0):
        det = wp.dot(normal, p)
        if wp.abs(det) > FLAT * unit * wp.length(normal):
            result.weights = wp.vec3(weights_in_double(p, q, r, det))
        off = off_the_plane(p, q, r, unit)
        slopes = mean_value_slopes(p + off, q + off, r + off, wp.vec3d(cotangents))
        result.p = wp.vec3(slopes.p)
        result.q = wp.vec3(slopes.q)
        result.r = wp.vec3(slopes.r)
    return result


@wp.func
def corner_slopes(a: wp.vec3, b: wp.vec3, c: wp.vec3, cotangents: wp.vec3, total: float, size: float):
    """Of the face a, b, c as seen from the origin."""
    edge_b = b - a
    edge_c = c - a
    normal = wp.cross(edge_b, edge_c)
    det = wp.dot(normal, a)
    result = CornerSlopes()
    if det * det <= WIDER * near_plane_limit(normal, edge_b, edge_c, size) or has_cancelled(total, size):
        result = near_slopes(a, b, c, cotangents, size)
    else:
        result = far_slopes(a, b, c, det, cotangents)
    return result


@wp.func
def corner_values(face: Any, targets: wp.array(dtype=wp.vec3), rows: wp.array2d(dtype=float), n: int, k: int):
    """What a corner's weight multiplies: its target, or its entry of the point's row."""
    if rows.shape[0] > 0:
        return wp.vec3(rows[n, face[k]], 0.0, 0.0)
    return targets[face[k]]


@wp.func
def point_slopes(
    points: PulledPoints,
    n: int,
    face: wp.vec3i,
    vertices: wp.array(dtype=wp.vec3),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
):
    """Slopes of what a point adds to L by the corners of a face."""
    y = points.places[n]
    pull = points.pulls[n]
    position = points.positions[n]
    cotangents = wp.vec3(
        wp.dot(pull, corner_values(face, targets, rows, n, 0) - position),
        wp.dot(pull, corner_values(face, targets, rows, n, 1) - position),
        wp.dot(pull, corner_values(face, targets, rows, n, 2) - position),
    )
    return corner_slopes(
        vertices[face[0]] - y, vertices[face[1]] - y, vertices[face[2]] - y, cotangents, points.totals[n], size
    )


@wp.func
def pulled_point(
    pulled: PulledPoints,
    n: int,
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """Entry n of `pulled` but for its pull. A point on the cage counts as STEP_INSIDE it, where slopes jump."""
    point = mean_value_point(x, vertices, faces, fans, targets, size)
    pulled.places[n] = x
    pulled.positions[n] = wp.vec3(point[0], point[1], point[2])
    pulled.totals[n] = point[3]
    if point[3] == 0.0:
        exact = exact_point(x, vertices, faces, targets, size)
        pulled.places[n] = wp.vec3(exact.place)
        pulled.positions[n] = wp.vec3(exact.position)
        pulled.totals[n] = float(exact.total)


@wp.kernel
def pull_positions(
    first: int,
    points: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    pulled: PulledPoints,
):
    """`pulled` of points (n,) in the unit of the vertices, from slopes (n,) = dL / dP. faces: in the order of fans."""
    n = first + wp.tid()
    pulled.pulls[n] = wp.vec3(0.0, 0.0, 0.0)
    if wp.length_sq(slopes[n]) > 0.0:
        pulled_point(pulled, n, points[n], vertices, faces, fans, targets, size)
        pulled.pulls[n] = slopes[n] / pulled.totals[n]


@wp.kernel
def pull_weights(
    first: int,
    points: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    weights: wp.array2d(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    size: float,
    pulled: PulledPoints,
):
    """`pulled` of points (n,), from rows (n, v) = dL / d weights, and these."""
    n = first + wp.tid()
    mean = float(0.0)
    for j in range(rows.shape[1]):
        mean += rows[n, j] * weights[n, j]
    pulled_point(pulled, n, points[n], vertices, faces, fans, vertices, size)
    pulled.positions[n] = wp.vec3(mean, 0.0, 0.0)
    pulled.pulls[n] = wp.vec3(1.0 / pulled.totals[n], 0.0, 0.0)


@wp.kernel
def sum_mean_value_corners(
    first: int,
    points: PulledPoints,
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
    face = faces[f]
    by_p = wp.vec3(0.0, 0.0, 0.0)
    by_q = wp.vec3(0.0, 0.0, 0.0)
    by_r = wp.vec3(0.0, 0.0, 0.0)
    to_p = wp.vec3(0.0, 0.0, 0.0)
    to_q = wp.vec3(0.0, 0.0, 0.0)
    to_r = wp.vec3(0.0, 0.0, 0.0)
    n = part
    while n < points.pulls.shape[0]:
        pull = points.pulls[n]
        if wp.length_sq(pull) > 0.0:
            found = point_slopes(points, n, face, vertices, targets, rows, size)
            by_p += found.p
            by_q += found.q
            by_r += found.r
            to_p += found.weights[0] * pull
            to_q += found.weights[1] * pull
            to_r += found.weights[2] * pull
        n += by_vertices.shape[0]
    by_vertices[part, f, 0] = by_vertices[part, f, 0] + by_p
    by_vertices[part, f, 1] = by_vertices[part, f, 1] + by_q
    by_vertices[part, f, 2] = by_vertices[part, f, 2] + by_r
    by_targets[part, f, 0] = by_targets[part, f, 0] + to_p
    by_targets[part, f, 1] = by_targets[part, f, 1] + to_q
    by_targets[part, f, 2] = by_targets[part, f, 2] + to_r


@wp.kernel
def slope_mean_value_points(
    first: int,
    points: PulledPoints,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
    by_points: wp.array(dtype=wp.vec3),
):
    """by_points (n,): slopes of L by the points, what is left of those by the cage, as all moves together."""
    n = first + wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    if wp.length_sq(points.pulls[n]) > 0.0:
        f = int(0)
        while f < faces.shape[0]:
            found = point_slopes(points, n, faces[f], vertices, targets, rows, size)
            total -= found.p + found.q + found.r
            f += 1
    by_points[n] = total
