"""Slopes of mean value and Green weights of a face by its corners, as seen from the point, in float64."""

# Reverse sweeps through the formulas of mean_value.py and green.py: a wp.Tape cannot go back through their loops, which
# gather in fans and put faces off. What is asked for is L = sum of `grad_..` times the value; slopes are dL / d corner.

import warp as wp

from ..mesh.triangle import nearest_barycentric

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: On the cage slopes are those this far inside it, as a share of the size, as they jump there.
STEP_INSIDE = wp.constant(wp.float64(1.0e-4))

#: Next to the plane of a far face mean value weights lose their digits: the slope there is taken STEP_INSIDE off it.
IN_PLANE = wp.constant(wp.float64(1.0e-5))
FAR_OFF = wp.constant(wp.float64(1.0e-3))

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))
_TWO = wp.constant(wp.float64(2.0))
_SMALL = wp.constant(wp.float64(1.0e-4))
_TINY = wp.constant(wp.float64(1.0e-200))
_INVERSE_FOUR_PI = wp.constant(wp.float64(0.07957747154594767))


@wp.struct
class FaceSlopes:
    """Of a number, by the corners of a face."""

    p: wp.vec3d
    q: wp.vec3d
    r: wp.vec3d


@wp.struct
class EdgeSlopes:
    """Of a number, by the ends of an edge."""

    b: wp.vec3d
    c: wp.vec3d


@wp.func
def distance_to_face(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d):
    """From the origin."""
    nearest = nearest_barycentric(p, q, r)
    return wp.length(nearest[0] * p + nearest[1] * q + nearest[2] * r)


@wp.func
def off_the_plane(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, size: wp.float64):
    """How far to shift a face whose plane the origin is next to, beside the face itself; zero for others."""
    normal = wp.cross(q - p, r - p)
    length = wp.length(normal) + _TINY
    height = wp.dot(normal, p) / length
    if wp.abs(height) >= IN_PLANE * size or distance_to_face(p, q, r) < FAR_OFF * size:
        return wp.vec3d(_ZERO, _ZERO, _ZERO)
    return normal * ((STEP_INSIDE * size - height) / length)


@wp.func
def edge_mean_slopes(b: wp.vec3d, c: wp.vec3d, cross: wp.vec3d, grad_cross: wp.vec3d, grad_mean: wp.vec3d):
    """By the ends of an edge, cross = b x c: of grad_cross . cross + grad_mean . (beta cross / |cross|)."""
    sine = wp.length(cross) + _TINY
    cosine = wp.dot(b, c)
    squared = sine * sine + cosine * cosine
    beta = wp.atan2(sine, cosine)
    grad_ratio = wp.dot(grad_mean, cross)  # of beta / sine
    by_sine = (cosine / squared - beta / sine) / (
        sine * sine
    )  # over sine once more, which turns into the cross product
    if sine < _SMALL * cosine:
        by_sine = -_TWO / (wp.float64(3.0) * cosine * cosine * cosine)
    turned = grad_cross + grad_mean * (beta / sine) + cross * (grad_ratio * by_sine)
    by_cosine = -grad_ratio / squared
    slopes = EdgeSlopes()
    slopes.b = wp.cross(c, turned) + by_cosine * c
    slopes.c = wp.cross(turned, b) + by_cosine * b
    return slopes


@wp.func
def mean_value_slopes(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, grad_weights: wp.vec3d):
    """Of grad_weights . weights, the mean value weights of a face that the origin is not in the plane of."""
    cross_p = wp.cross(q, r - q)
    cross_q = wp.cross(r, p - r)
    cross_r = wp.cross(p, q - p)
    det = wp.dot(wp.cross(q - p, r - p), p)
    mean = (
        cross_p * (wp.atan2(wp.length(cross_p), wp.dot(q, r)) / (wp.length(cross_p) + _TINY))
        + cross_q * (wp.atan2(wp.length(cross_q), wp.dot(r, p)) / (wp.length(cross_q) + _TINY))
        + cross_r * (wp.atan2(wp.length(cross_r), wp.dot(p, q)) / (wp.length(cross_r) + _TINY))
    )
    scale = _HALF / det
    grad_mean = scale * (grad_weights[0] * cross_p + grad_weights[1] * cross_q + grad_weights[2] * cross_r)
    bc = edge_mean_slopes(q, r, cross_p, (scale * grad_weights[0]) * mean, grad_mean)
    ca = edge_mean_slopes(r, p, cross_q, (scale * grad_weights[1]) * mean, grad_mean)
    ab = edge_mean_slopes(p, q, cross_r, (scale * grad_weights[2]) * mean, grad_mean)
    grad_det = -wp.dot(grad_mean, mean) / det
    slopes = FaceSlopes()
    slopes.p = ca.c + ab.b + grad_det * cross_p
    slopes.q = ab.c + bc.b + grad_det * cross_q
    slopes.r = bc.c + ca.b + grad_det * cross_r
    return slopes


@wp.struct
class FaceLayers:
    """phi of the corners and psi of a face, and their slopes."""

    phi: wp.vec3d
    psi: wp.float64
    slopes: FaceSlopes


@wp.func
def layer_edge(b: wp.vec3d, c: wp.vec3d):
    """K of an edge and what its slopes need: K, (r + s) / low, 1 / low, |e|; low = r s + b . c."""
    r = wp.length(b)
    s = wp.length(c)
    edge = wp.length(c - b)
    cosine = wp.dot(b, c)
    low = r * s + cosine
    if cosine < _ZERO:
        low = wp.length_sq(wp.cross(b, c - b)) / (r * s - cosine)
    both = r + s
    return wp.vec4d(wp.log(_ONE + edge * (both + edge) / low) / edge, both / low, _ONE / low, edge)


@wp.func
def layer_edge_slopes(
    b: wp.vec3d, c: wp.vec3d, terms: wp.vec4d, grad: wp.float64, grad_along: wp.vec3d, grad_cross: wp.vec3d
):
    """By the ends of an edge: of grad K + grad_along . (c - b) + grad_cross . (b x c)."""
    along = grad_along + (c - b) * (grad * (terms[1] - terms[0]) / (terms[3] * terms[3]))
    slopes = EdgeSlopes()
    slopes.b = wp.cross(c, grad_cross) - along - b * (grad * terms[2] / (wp.length(b) + _TINY))
    slopes.c = wp.cross(grad_cross, b) + along - c * (grad * terms[2] / (wp.length(c) + _TINY))
    return slopes


@wp.func
def green_layers(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, grad_phi: wp.vec3d, grad_psi: wp.float64):
    """phi and psi of a face that the origin is not on, and the slopes of grad_phi . phi + grad_psi psi."""
    edge_u = q - p
    edge_v = r - p
    normal = wp.cross(edge_u, edge_v)
    double_area = wp.length(normal)
    unit = normal / double_area
    height = wp.dot(unit, p)
    det = wp.dot(normal, p)
    length_p = wp.length(p)
    length_q = wp.length(q)
    length_r = wp.length(r)
    pq = wp.dot(p, q)
    qr = wp.dot(q, r)
    rp = wp.dot(r, p)
    below = length_p * length_q * length_r + pq * length_r + qr * length_p + rp * length_q
    angle = _TWO * wp.atan2(det, below)
    k_p = layer_edge(q, r)
    k_q = layer_edge(r, p)
    k_r = layer_edge(p, q)
    cross_p = wp.cross(q, r)
    cross_q = wp.cross(r, p)
    cross_r = wp.cross(p, q)
    area = wp.vec3d(wp.dot(unit, cross_p), wp.dot(unit, cross_q), wp.dot(unit, cross_r))
    pull = k_p[0] * (r - q) + k_q[0] * (p - r) + k_r[0] * (q - p)
    reach = wp.vec3d(wp.dot(r - q, pull), wp.dot(p - r, pull), wp.dot(q - p, pull))
    scale = _INVERSE_FOUR_PI / double_area
    result = FaceLayers()
    result.phi = scale * (angle * area + height * reach)
    result.psi = _INVERSE_FOUR_PI * (area[0] * k_p[0] + area[1] * k_q[0] + area[2] * k_r[0] - height * angle)

    g = scale * grad_phi
    s = _INVERSE_FOUR_PI * grad_psi
    grad_area = g * angle + s * wp.vec3d(k_p[0], k_q[0], k_r[0])
    grad_angle = wp.dot(g, area) - s * height
    grad_height = wp.dot(g, reach) - s * angle
    grad_pull = height * (g[0] * (r - q) + g[1] * (p - r) + g[2] * (q - p))
    grad_det = grad_angle * _TWO * below / (det * det + below * below)
    grad_below = -grad_angle * _TWO * det / (det * det + below * below)
    bc = layer_edge_slopes(
        q,
        r,
        k_p,
        wp.dot(grad_pull, r - q) + s * area[0],
        (height * g[0]) * pull + k_p[0] * grad_pull,
        grad_area[0] * unit,
    )
    ca = layer_edge_slopes(
        r,
        p,
        k_q,
        wp.dot(grad_pull, p - r) + s * area[1],
        (height * g[1]) * pull + k_q[0] * grad_pull,
        grad_area[1] * unit,
    )
    ab = layer_edge_slopes(
        p,
        q,
        k_r,
        wp.dot(grad_pull, q - p) + s * area[2],
        (height * g[2]) * pull + k_r[0] * grad_pull,
        grad_area[2] * unit,
    )
    # by the normal: unit = normal / double_area, which phi is divided by once more
    grad_unit = grad_area[0] * cross_p + grad_area[1] * cross_q + grad_area[2] * cross_r + grad_height * p
    grad_size = -(wp.dot(grad_unit, unit) + wp.dot(grad_phi, result.phi)) / double_area
    grad_normal = grad_unit / double_area + grad_size * unit + grad_det * p
    by_u = wp.cross(edge_v, grad_normal)
    by_v = wp.cross(grad_normal, edge_u)
    result.slopes.p = (
        ca.c
        + ab.b
        - by_u
        - by_v
        + grad_height * unit
        + grad_det * normal
        + grad_below * (p * ((length_q * length_r + qr) / length_p) + q * length_r + r * length_q)
    )
    result.slopes.q = (
        ab.c + bc.b + by_u + grad_below * (q * ((length_r * length_p + rp) / length_q) + p * length_r + r * length_p)
    )
    result.slopes.r = (
        bc.c + ca.b + by_v + grad_below * (r * ((length_p * length_q + pq) / length_r) + q * length_p + p * length_q)
    )
    return result
