"""Slopes of mean value maps and weights of many points by a cage of bilinear quads and triangles, patch by patch."""

# The corners r_i of a patch, as seen from a point, weigh w_i = int int b_i T / |r|^4 du dv, with r = sum b_i r_i and
# T = r . (r_u x r_v) (coordinates/quad_mean_value.py). With c_i as in mean_value_adjoint.py and beta = sum c_i b_i,
#   d sum_i c_i w_i = int int beta (dT / |r|^4 - 4 T r . dr / |r|^6) du dv,
#   dT = (r_u x r_v) . dr + (r_v x r) . dr_u + (r x r_u) . dr_v,   dr = sum b_i dr_i,
# and weights by the same nodes. Next to a patch c_i are as small as the distance, and beta vanishes at the nearest
# point: what is integrated stays bounded where weights do not. Far patches take Gauss-Legendre rules in float32, near
# ones the panels of the weights in float64, triangles what mean_value_adjoint.py has. A point on the cage counts as
# STEP_INSIDE it, where slopes jump.

from typing import Any

import warp as wp

from ..coordinates.face_slopes import STEP_INSIDE
from ..coordinates.mean_value import SNAP, has_cancelled
from ..coordinates.quad_mean_value import (
    NEAR,
    NEAR_OUTSIDE,
    bilinear_basis,
    mixed,
    patch_rule,
    quad_mean_value_point,
    sinh_panels,
)
from ..core.gradients import forward_only_in
from .mean_value_adjoint import PulledPoints, corner_slopes, corner_values

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})

forward_only = forward_only_in(__name__, (wp.mat44, wp.vec3), (wp.vec3, wp.vec3))

#: Patches whose middle is farther than this, in distances from there to their farthest corner, take 3 x 3 and 2 x 2
#: nodes; nearer ones 4 x 4.
THREE, TWO = wp.constant(4.0), wp.constant(9.0)

#: Where panels end, in s: slopes fade more slowly away from the nearest point than weights.
END = wp.constant(12.0)

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_INNER = wp.constant(wp.float64(0.6521451548625461))
_OUTER = wp.constant(wp.float64(0.34785484513745385))


@wp.func
def slopes_at(u: Any, v: Any, p: Any, q: Any, r: Any, s: Any, cotangents: Any, weight: Any):
    """What a node of the patch p, q, r, s adds: rows of corners, their slopes and their weight."""
    one = type(u)(1.0)
    b = type(cotangents)((one - u) * (one - v), u * (one - v), u * v, (one - u) * v)
    at = b[0] * p + b[1] * q + b[2] * r + b[3] * s
    by_u = (one - v) * (q - p) + v * (r - s)
    by_v = (one - u) * (s - p) + u * (r - q)
    normal = wp.cross(by_u, by_v)
    squared = wp.dot(at, at)
    share = weight / (squared * squared)
    t = wp.dot(at, normal)
    beta = share * wp.dot(cotangents, b)
    place = beta * (normal - (type(u)(4.0) * t / squared) * at)
    along_u = beta * wp.cross(by_v, at)
    along_v = beta * wp.cross(at, by_u)
    zero = type(u)(0.0)
    return (
        wp.outer(b, type(b)(place[0], place[1], place[2], share * t))
        + wp.outer(type(b)(v - one, one - v, v, -v), type(b)(along_u[0], along_u[1], along_u[2], zero))
        + wp.outer(type(b)(u - one, -u, u, one - u), type(b)(along_v[0], along_v[1], along_v[2], zero))
    )


@wp.func
def gauss_node(k: int, count: int):
    """Node k of 2, 3 or 4 in [0, 1], and its weight."""
    node = wp.vec2(wp.where(k == 0, 0.2113248654, 0.7886751346), 0.5)
    if count == 3:
        node = wp.vec2(0.5 + 0.3872983346 * float(k - 1), wp.where(k == 1, 0.4444444444, 0.2777777778))
    if count == 4:
        off = wp.where(k < 2, 0.1699905218, 0.4305681558)
        node = wp.vec2(0.5 + wp.where(k % 2 == 0, off, -off), wp.where(k < 2, 0.3260725774, 0.1739274226))
    return node


@wp.func
def far_patch_slopes(p: wp.vec3, q: wp.vec3, r: wp.vec3, s: wp.vec3, cotangents: wp.vec4, count: int):
    """Slopes and weights of the corners of a patch, by count x count nodes."""
    total = wp.mat44()
    k = int(0)
    while k < count * count:
        across = gauss_node(k / count, count)
        along = gauss_node(k % count, count)
        total += slopes_at(along[0], across[0], p, q, r, s, cotangents, along[1] * across[1])
        k += 1
    return forward_only(total, p)


@wp.func
def node_off(k: int, inner: wp.float64, outer: wp.float64):
    """Factor on exp(s) of the middle of a panel for its node k of four."""
    off = wp.where(k < 2, inner, outer)
    return wp.where(k % 2 == 0, off, _ONE / off)


@wp.func(inline=False)
def near_patch_slopes(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3, cotangents: wp.vec4, size: float):
    """The same of a patch that may be near, in float64; nothing of one that the origin lies on."""
    p = wp.vec3d(a)
    q = wp.vec3d(b)
    r = wp.vec3d(c)
    s = wp.vec3d(d)
    rule = patch_rule(p, q, r, s, NEAR_OUTSIDE)
    total = wp.mat44d()
    if rule.distance >= SNAP * wp.float64(size):
        along = sinh_panels(rule.center[0], rule.scale[0], rule.longest, END)
        across = sinh_panels(rule.center[1], rule.scale[1], rule.longest, END)
        scale = rule.scale[0] * rule.scale[1] * along.half * across.half
        values = wp.vec4d(cotangents)
        k = int(0)
        middle = across.first
        while k < 4 * across.count:
            power = middle * node_off(k % 4, across.inner, across.outer)
            v = rule.center[1] + rule.scale[1] * _HALF * (power - _ONE / power)
            of_row = scale * wp.where(k % 4 < 2, _INNER, _OUTER) * _HALF * (power + _ONE / power)
            j = int(0)
            here = along.first
            while j < 4 * along.count:
                power = here * node_off(j % 4, along.inner, along.outer)
                u = rule.center[0] + rule.scale[0] * _HALF * (power - _ONE / power)
                weight = of_row * wp.where(j % 4 < 2, _INNER, _OUTER) * _HALF * (power + _ONE / power)
                total += slopes_at(u, v, p, q, r, s, values, weight)
                j += 1
                if j % 4 == 0:
                    here = here * along.step
            k += 1
            if k % 4 == 0:
                middle = middle * across.step
    return forward_only(wp.mat44(total), a)


@wp.func
def patch_slopes(
    points: PulledPoints,
    n: int,
    quad: wp.vec4i,
    vertices: wp.array(dtype=wp.vec3),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
):
    """Rows of corners: slopes of what a point adds to L by each, and the weight of it."""
    y = points.places[n]
    pull = points.pulls[n]
    position = points.positions[n]
    total = points.totals[n]
    cotangents = wp.vec4(
        wp.dot(pull, corner_values(quad, targets, rows, n, 0) - position),
        wp.dot(pull, corner_values(quad, targets, rows, n, 1) - position),
        wp.dot(pull, corner_values(quad, targets, rows, n, 2) - position),
        wp.dot(pull, corner_values(quad, targets, rows, n, 3) - position),
    )
    a = vertices[quad[0]] - y
    b = vertices[quad[1]] - y
    c = vertices[quad[2]] - y
    d = vertices[quad[3]] - y
    middle = 0.25 * (a + b + c + d)
    radius = wp.max(
        wp.max(wp.length_sq(a - middle), wp.length_sq(b - middle)),
        wp.max(wp.length_sq(c - middle), wp.length_sq(d - middle)),
    )
    away = wp.length_sq(middle)
    found = wp.mat44()
    if quad[2] == quad[3]:
        face = corner_slopes(a, b, c, wp.vec3(cotangents[0], cotangents[1], cotangents[2]), total, size)
        found = wp.matrix_from_rows(
            wp.vec4(face.p[0], face.p[1], face.p[2], face.weights[0]),
            wp.vec4(face.q[0], face.q[1], face.q[2], face.weights[1]),
            wp.vec4(face.r[0], face.r[1], face.r[2], face.weights[2]),
            wp.vec4(),
        )
    elif away < NEAR * NEAR * radius or has_cancelled(total, size):
        found = near_patch_slopes(a, b, c, d, cotangents, size)
    else:
        count = 4 - int(away > THREE * THREE * radius) - int(away > TWO * TWO * radius)
        found = far_patch_slopes(a, b, c, d, cotangents, count)
    return found


@wp.func
def place_in_cage(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), quads: wp.array(dtype=wp.vec4i), size: float):
    """Where a point on the cage counts: STEP_INSIDE it, along the normal of the diagonals."""
    place = x
    for f in range(quads.shape[0]):
        quad = quads[f]
        p = wp.vec3d(vertices[quad[0]]) - wp.vec3d(x)
        q = wp.vec3d(vertices[quad[1]]) - wp.vec3d(x)
        r = wp.vec3d(vertices[quad[2]]) - wp.vec3d(x)
        s = wp.vec3d(vertices[quad[3]]) - wp.vec3d(x)
        rule = patch_rule(p, q, r, s, NEAR)
        if rule.distance < SNAP * wp.float64(size):
            foot = mixed(bilinear_basis(rule.center[0], rule.center[1]), p, q, r, s)
            inwards = wp.normalize(wp.cross(s - q, r - p)) * (STEP_INSIDE * wp.float64(size))
            place = wp.vec3(wp.vec3d(x) + foot + inwards)
    return forward_only(place, x)


@wp.func(inline=False)
def position_at(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    planes: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """quad_mean_value_point, which is large, as a call."""
    return quad_mean_value_point(x, vertices, quads, planes, targets, size)


@wp.func
def pull_patches(
    pulled: PulledPoints,
    n: int,
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    planes: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """Entry n of `pulled` but for its pull."""
    place = x
    point = position_at(x, vertices, quads, planes, targets, size)
    if point[3] == 0.0:
        place = place_in_cage(x, vertices, quads, size)
        point = position_at(place, vertices, quads, planes, targets, size)
    pulled.places[n] = place
    pulled.positions[n] = wp.vec3(point[0], point[1], point[2])
    pulled.totals[n] = point[3]


@wp.kernel
def pull_quad_positions(
    first: int,
    points: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    planes: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    pulled: PulledPoints,
):
    """`pulled` of points (n,) in the unit of the vertices, from slopes (n,) = dL / dP. planes: see prepare_quads."""
    n = first + wp.tid()
    pulled.pulls[n] = wp.vec3(0.0, 0.0, 0.0)
    if wp.length_sq(slopes[n]) > 0.0:
        pull_patches(pulled, n, points[n], vertices, quads, planes, targets, size)
        pulled.pulls[n] = slopes[n] / pulled.totals[n]


@wp.kernel
def pull_quad_weights(
    first: int,
    points: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    weights: wp.array2d(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    planes: wp.array(dtype=wp.vec4),
    size: float,
    pulled: PulledPoints,
):
    """`pulled` of points (n,), from rows (n, v) = dL / d weights, and these."""
    n = first + wp.tid()
    mean = float(0.0)
    for j in range(rows.shape[1]):
        mean += rows[n, j] * weights[n, j]
    pull_patches(pulled, n, points[n], vertices, quads, planes, vertices, size)
    pulled.positions[n] = wp.vec3(mean, 0.0, 0.0)
    pulled.pulls[n] = wp.vec3(1.0 / pulled.totals[n], 0.0, 0.0)


@wp.kernel
def sum_quad_corners(
    first: int,
    points: PulledPoints,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
    by_vertices: wp.array3d(dtype=wp.vec3),
    by_targets: wp.array3d(dtype=wp.vec3),
):
    """Add to by_vertices, by_targets (parts, q, 4): slopes of L by the corners of each patch in the cage, and by their
    targets, over each part of the points. One item per part and patch."""
    item = first + wp.tid()
    f = item % quads.shape[0]
    part = item / quads.shape[0]
    quad = quads[f]
    total = wp.mat44()
    to_p = wp.vec3()
    to_q = wp.vec3()
    to_r = wp.vec3()
    to_s = wp.vec3()
    n = part
    while n < points.pulls.shape[0]:
        pull = points.pulls[n]
        if wp.length_sq(pull) > 0.0:
            found = patch_slopes(points, n, quad, vertices, targets, rows, size)
            total += found
            to_p += found[0, 3] * pull
            to_q += found[1, 3] * pull
            to_r += found[2, 3] * pull
            to_s += found[3, 3] * pull
        n += by_vertices.shape[0]
    for k in range(4):
        by_vertices[part, f, k] = by_vertices[part, f, k] + wp.vec3(total[k, 0], total[k, 1], total[k, 2])
    by_targets[part, f, 0] = by_targets[part, f, 0] + to_p
    by_targets[part, f, 1] = by_targets[part, f, 1] + to_q
    by_targets[part, f, 2] = by_targets[part, f, 2] + to_r
    by_targets[part, f, 3] = by_targets[part, f, 3] + to_s


@wp.kernel
def slope_quad_points(
    first: int,
    points: PulledPoints,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    targets: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    size: float,
    by_points: wp.array(dtype=wp.vec3),
):
    """by_points (n,): slopes of L by the points, what is left of those by the cage, as all moves together."""
    n = first + wp.tid()
    total = wp.vec4()
    if wp.length_sq(points.pulls[n]) > 0.0:
        f = int(0)
        while f < quads.shape[0]:
            found = patch_slopes(points, n, quads[f], vertices, targets, rows, size)
            total -= found[0] + found[1] + found[2] + found[3]
            f += 1
    by_points[n] = wp.vec3(total[0], total[1], total[2])
