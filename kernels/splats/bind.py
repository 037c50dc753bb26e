"""Coordinates of points and their gradients, in float64: rows by which points go with a cage."""

import warp as wp

from ..coordinates.biharmonic import face_layers
from ..coordinates.maximum_likelihood import MAX_PASSES, exact_face_term
from ..coordinates.quad_mean_value import NEAR_OUTSIDE, patch_rule, weights_by_rule

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

#: A face whose plane is this close spans no solid angle.
FLAT = wp.constant(wp.float64(1.0e-11))

_HALF = wp.constant(wp.float64(0.5))

_ONE = wp.constant(wp.float64(1.0))

_TINY = wp.constant(wp.float64(1.0e-200))


@wp.struct
class EdgeMean:
    """An edge from b to c of a face, seen from the point: beta n, and its derivative."""

    cross: wp.vec3d  # C = b x c
    mean: wp.vec3d  # beta C / |C|
    slope: wp.mat33d  # d (beta n) / d x


@wp.func
def edge_mean(b: wp.vec3d, c: wp.vec3d):
    edge = EdgeMean()
    edge.cross = wp.cross(b, c - b)
    length = wp.length(edge.cross) + _TINY
    beta = wp.atan2(length, wp.dot(b, c))
    normal = edge.cross / length
    edge.mean = beta * normal
    turning = wp.cross(normal, b / wp.length_sq(b) - c / wp.length_sq(c))
    d_cross = -wp.skew(b - c)  # dC = dx x (b - c) is the matrix -[b - c]_x
    across = d_cross - wp.outer(normal, wp.transpose(d_cross) * normal)
    edge.slope = wp.outer(normal, turning) + (beta / length) * across
    return edge


@wp.func
def corner_row(cross: wp.vec3d, along: wp.vec3d, mean: wp.vec3d, slope: wp.mat33d, normal: wp.vec3d, det: wp.float64):
    """Weight of a corner and its gradient; along: b - c of the edge across from it."""
    weight = _HALF * wp.dot(cross, mean) / det
    gradient = (_HALF / det) * (wp.cross(along, mean) + wp.transpose(slope) * cross) + (weight / det) * normal
    return wp.vec4d(weight, gradient[0], gradient[1], gradient[2])


@wp.kernel
def bind_mean_value(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    scratch: wp.array2d(dtype=wp.vec4d),
    rows: wp.array2d(dtype=wp.vec4),
):
    """rows (v, n): weight and gradient of each vertex at points (n,). scratch (v, n)."""
    n = first + wp.tid()
    x = points[n]
    total = wp.vec4d()
    for j in range(vertices.shape[0]):
        scratch[j, n] = wp.vec4d()
    for f in range(faces.shape[0]):
        face = faces[f]
        a = vertices[face[0]] - x
        b = vertices[face[1]] - x
        c = vertices[face[2]] - x
        normal = wp.cross(b - a, c - a)
        det = wp.dot(normal, a)
        if wp.abs(det) > FLAT * wp.length(normal):
            bc = edge_mean(b, c)
            ca = edge_mean(c, a)
            ab = edge_mean(a, b)
            mean = bc.mean + ca.mean + ab.mean
            slope = bc.slope + ca.slope + ab.slope
            row_a = corner_row(bc.cross, b - c, mean, slope, normal, det)
            row_b = corner_row(ca.cross, c - a, mean, slope, normal, det)
            row_c = corner_row(ab.cross, a - b, mean, slope, normal, det)
            scratch[face[0], n] = scratch[face[0], n] + row_a
            scratch[face[1], n] = scratch[face[1], n] + row_b
            scratch[face[2], n] = scratch[face[2], n] + row_c
            total += row_a + row_b + row_c
    inverse = _ONE / total[0]
    for j in range(vertices.shape[0]):
        row = scratch[j, n] * inverse
        share = row[0]
        rows[j, n] = wp.vec4(
            float(share),
            float(row[1] - share * total[1] * inverse),
            float(row[2] - share * total[2] * inverse),
            float(row[3] - share * total[3] * inverse),
        )


#: Steps of differences, as a share of the distance to a patch: off by about their square.
PATCH_STEP = wp.constant(wp.float64(1.0e-4))


@wp.kernel
def bind_quad_mean_value(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    vertices: wp.array(dtype=wp.vec3d),
    quads: wp.array(dtype=wp.vec4i),
    scratch: wp.array2d(dtype=wp.vec4d),
    rows: wp.array2d(dtype=wp.vec4),
):
    """`bind_mean_value` of a cage of quads. Gradients are central differences by one rule of integration."""
    n = first + wp.tid()
    x = points[n]
    total = wp.vec4d()
    for j in range(vertices.shape[0]):
        scratch[j, n] = wp.vec4d()
    f = int(0)
    while f < quads.shape[0]:
        quad = quads[f]
        p = vertices[quad[0]] - x
        q = vertices[quad[1]] - x
        r = vertices[quad[2]] - x
        s = vertices[quad[3]] - x
        rule = patch_rule(p, q, r, s, NEAR_OUTSIDE)
        weights = weights_by_rule(p, q, r, s, rule, _ONE)
        step = PATCH_STEP * rule.distance
        axis = int(-1)
        while axis < 3:  # first the weights themselves
            slopes = weights
            if axis >= 0:
                h = wp.vec3d()
                h[axis] = step
                before = weights_by_rule(p + h, q + h, r + h, s + h, rule, _ONE)
                slopes = (weights_by_rule(p - h, q - h, r - h, s - h, rule, _ONE) - before) / (step + step)
            for k in range(4):
                row = scratch[quad[k], n]
                row[axis + 1] = row[axis + 1] + slopes[k]
                scratch[quad[k], n] = row
                total[axis + 1] = total[axis + 1] + slopes[k]
            axis += 1
        f += 1
    inverse = _ONE / total[0]
    for j in range(vertices.shape[0]):
        row = scratch[j, n] * inverse
        share = row[0]
        rows[j, n] = wp.vec4(
            float(share),
            float(row[1] - share * total[1] * inverse),
            float(row[2] - share * total[2] * inverse),
            float(row[3] - share * total[3] * inverse),
        )


_INVERSE_FOUR_PI = wp.constant(wp.float64(0.07957747154594767))

_TWO = wp.constant(wp.float64(2.0))


@wp.struct
class EdgeTerms:
    """An edge from p to q of a face, seen from the point."""

    along: wp.vec3d  # e = q - p
    area: wp.float64  # n . (p x q)
    area_slope: wp.vec3d
    integral: wp.float64  # K
    integral_slope: wp.vec3d


@wp.func
def edge_terms(p: wp.vec3d, q: wp.vec3d, normal: wp.vec3d):
    terms = EdgeTerms()
    terms.along = q - p
    edge = wp.length(terms.along)
    r = wp.length(p)
    s = wp.length(q)
    terms.area = wp.dot(normal, wp.cross(p, terms.along))
    terms.area_slope = wp.cross(p - q, normal)  # d (p x q) = dx x (p - q), so that n . d (p x q) = ((p - q) x n) . dx
    both = r + s
    # both^2 - edge^2 = 2 (r s + p . q), which next to the edge is more exact by the cross product
    cosine = wp.dot(p, q)
    low = r * s + cosine
    if cosine < wp.float64(0.0):
        low = wp.length_sq(wp.cross(p, terms.along)) / (r * s - cosine)
    terms.integral = wp.log(_ONE + edge * (both + edge) / low) / edge
    terms.integral_slope = (p / r + q / s) / low
    return terms


@wp.func
def row_of(value: wp.float64, slope: wp.vec3d):
    return wp.vec4d(value, slope[0], slope[1], slope[2])


@wp.struct
class GreenRows:
    """Green coordinates of a face and their gradients."""

    a: wp.vec4d  # phi of the corners
    b: wp.vec4d
    c: wp.vec4d
    psi: wp.vec4d


@wp.struct
class PhiTerms:
    """What phi of the corners of a face share: the solid angle, the height, and the integrals along all edges."""

    scale: wp.float64
    angle: wp.float64
    angle_slope: wp.vec3d
    height: wp.float64
    normal: wp.vec3d
    pull: wp.vec3d
    pull_slope: wp.mat33d


@wp.func
def phi_row(edge: EdgeTerms, face: PhiTerms):
    """phi of the corner across an edge."""
    reach = wp.dot(edge.along, face.pull)
    value = face.scale * (edge.area * face.angle + face.height * reach)
    slope = face.scale * (
        edge.area_slope * face.angle
        + edge.area * face.angle_slope
        - reach * face.normal
        + face.height * (wp.transpose(face.pull_slope) * edge.along)
    )
    return row_of(value, slope)


@wp.func
def green_rows(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Green coordinates of the face a, b, c as seen from the origin."""
    cross = wp.cross(b - a, c - a)
    double_area = wp.length(cross)
    normal = cross / double_area
    height = wp.dot(normal, a)
    bc = edge_terms(b, c, normal)
    ca = edge_terms(c, a, normal)
    ab = edge_terms(a, b, normal)

    la = wp.length(a)
    lb = wp.length(b)
    lc = wp.length(c)
    det = height * double_area
    cos_ab = wp.dot(a, b)
    cos_bc = wp.dot(b, c)
    cos_ca = wp.dot(c, a)
    below = la * lb * lc + cos_ab * lc + cos_bc * la + cos_ca * lb
    angle = _TWO * wp.atan2(det, below)
    d_below = (
        (a / la) * (lb * lc + cos_bc)
        + (b / lb) * (la * lc + cos_ca)
        + (c / lc) * (la * lb + cos_ab)
        + (a + b) * lc
        + (b + c) * la
        + (c + a) * lb
    )
    # d det = -cross . dx, d below = -d_below . dx
    angle_slope = (_TWO / (det * det + below * below)) * (det * d_below - below * cross)

    pull = bc.integral * bc.along + ca.integral * ca.along + ab.integral * ab.along
    pull_slope = (
        wp.outer(bc.along, bc.integral_slope)
        + wp.outer(ca.along, ca.integral_slope)
        + wp.outer(ab.along, ab.integral_slope)
    )
    shared = PhiTerms(_INVERSE_FOUR_PI / double_area, angle, angle_slope, height, normal, pull, pull_slope)
    psi = _INVERSE_FOUR_PI * (bc.area * bc.integral + ca.area * ca.integral + ab.area * ab.integral - height * angle)
    psi_slope = _INVERSE_FOUR_PI * (
        bc.area_slope * bc.integral
        + bc.area * bc.integral_slope
        + ca.area_slope * ca.integral
        + ca.area * ca.integral_slope
        + ab.area_slope * ab.integral
        + ab.area * ab.integral_slope
        + angle * normal
        - height * angle_slope
    )
    return GreenRows(phi_row(bc, shared), phi_row(ca, shared), phi_row(ab, shared), row_of(psi, psi_slope))


@wp.kernel
def bind_green(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    scratch: wp.array2d(dtype=wp.vec4d),
    rows: wp.array2d(dtype=wp.vec4),
):
    """rows (v + f, n): phi of each vertex, then psi of each face, and their gradients, at points (n,).
    scratch (v, n)."""
    n = first + wp.tid()
    x = points[n]
    count = vertices.shape[0]
    for j in range(count):
        scratch[j, n] = wp.vec4d()
    for f in range(faces.shape[0]):
        face = faces[f]
        a = vertices[face[0]] - x
        b = vertices[face[1]] - x
        c = vertices[face[2]] - x
        green = green_rows(a, b, c)
        scratch[face[0], n] = scratch[face[0], n] + green.a
        scratch[face[1], n] = scratch[face[1], n] + green.b
        scratch[face[2], n] = scratch[face[2], n] + green.c
        rows[count + f, n] = wp.vec4(green.psi)
    for j in range(count):
        rows[j, n] = wp.vec4(scratch[j, n])


@wp.kernel
def bind_biharmonic(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    scratch: wp.array2d(dtype=wp.vec4d),
    rows: wp.array2d(dtype=wp.vec4d),
):
    """rows (v + 3 f, n): those of `bind_green`, then D and S of each face, see kernels/coordinates/biharmonic.py."""
    n = first + wp.tid()
    x = points[n]
    count = vertices.shape[0]
    second = count + faces.shape[0]
    third = second + faces.shape[0]
    for j in range(count):
        scratch[j, n] = wp.vec4d()
    for f in range(faces.shape[0]):
        face = faces[f]
        a = vertices[face[0]] - x
        b = vertices[face[1]] - x
        c = vertices[face[2]] - x
        green = green_rows(a, b, c)
        scratch[face[0], n] = scratch[face[0], n] + green.a
        scratch[face[1], n] = scratch[face[1], n] + green.b
        scratch[face[2], n] = scratch[face[2], n] + green.c
        rows[count + f, n] = green.psi
        layers = face_layers(a, b, c)
        rows[second + f, n] = row_of(layers.second, layers.second_slope)
        rows[third + f, n] = row_of(layers.third, layers.third_slope)
    for j in range(count):
        rows[j, n] = scratch[j, n]


#: Gradients of maximum likelihood coordinates are forward differences over this share of the size.
SIZE_STEP = wp.constant(wp.float64(1.0e-7))

#: Newton's method ends where a step changes no y by more than this share: the square is rounding.
LAST_CHANGE = wp.constant(wp.float64(1.0e-8))


@wp.kernel
def bind_maximum_likelihood(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    scratch: wp.array2d(dtype=wp.vec4d),
    rows: wp.array2d(dtype=wp.vec4),
):
    """rows (v, n): weight and gradient of each vertex at points (n,), NaN where there are none. scratch (v, n)."""
    n = first + wp.tid()
    total = wp.vec4d()
    for j in range(vertices.shape[0]):
        scratch[j, n] = wp.vec4d()
    phi = wp.vec3d()
    passes = int(0)
    number = int(0)  # of the point itself, then those a step along each axis from it
    while number < 4 and passes < MAX_PASSES:
        x = points[n]
        part = wp.vec4d()
        part[number] = _ONE
        x += SIZE_STEP * wp.vec3d(part[1], part[2], part[3])
        balance = wp.vec3d()
        matrix = wp.mat33d()
        largest = wp.float64(0.0)
        rarest = wp.float64(0.0)
        for f in range(faces.shape[0]):
            face = faces[f]
            term = exact_face_term(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, _ONE)
            if term.prior > wp.float64(0.0):
                share = _ONE / (_ONE + wp.dot(phi, term.direction))
                balance += term.prior * share * term.direction
                matrix += wp.outer(term.prior * share * share * term.direction, term.direction)
                largest = wp.max(largest, share)
                rarest = wp.max(rarest, _ONE / term.prior)
        step = wp.inverse(matrix) * balance
        decrement = wp.sqrt(wp.max(wp.dot(step, balance), wp.float64(0.0)) * rarest)
        change = wp.min(wp.length(step) * largest, decrement)
        phi += step / (_ONE + change)
        passes += 1
        if change < LAST_CHANGE:
            for f in range(faces.shape[0]):
                face = faces[f]
                term = exact_face_term(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, _ONE)
                if term.prior > wp.float64(0.0):
                    corners = (term.prior / (_ONE + wp.dot(phi, term.direction))) * term.corners
                    for k in range(3):
                        scratch[face[k], n] = scratch[face[k], n] + corners[k] * part
                        total += corners[k] * part
            number += 1
            passes = 0
    for j in range(vertices.shape[0]):
        weight = wp.cw_div(scratch[j, n], total)
        rows[j, n] = wp.vec4(
            float(weight[0]),
            float((weight[1] - weight[0]) / SIZE_STEP),
            float((weight[2] - weight[0]) / SIZE_STEP),
            float((weight[3] - weight[0]) / SIZE_STEP),
        )
