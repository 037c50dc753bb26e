"""Green coordinates of points in a closed triangle cage, and the map they give."""

# Lipman, Levin and Cohen-Or, "Green coordinates" (SIGGRAPH 2008): inside, x = sum_i phi_i(x) v_i + sum_f psi_f(x) n_f,
# layer potentials in closed form. With a, b, c the corners of a face seen from x, e_i the edge opposite to corner i,
# C_i the cross product of its ends, n the unit normal, A2 twice the area, h = n . a the signed distance to the plane
# and Omega the signed solid angle (van Oosterom and Strackee 1983),
#   K_i = log((r + s + |e_i|) / (r + s - |e_i|)) / |e_i|     r, s: lengths of the ends of edge i,
#   psi = (sum_i (n . C_i) K_i - h Omega) / 4 pi,
#   phi_i = ((n . C_i) Omega + h e_i . sum_k K_k e_k) / (4 pi A2).
# Faces next to x go through float64. On the cage Omega jumps: points within SURFACE of the size get the limit from
# inside, by leaving Omega of the touched faces out and giving what the winding number then lacks to the hat functions
# there. Farther outside the sum of phi is zero, and the map is not a position.
# points (n,), vertices, targets (v,), faces (f,), target_normals (f,): unit normals times each face's stretch. One unit
# for points, vertices and size, their longest side; psi is a length. Keep them near the origin (float32).

import warp as wp

from ..core.gradients import add_slope, gradient_of
from ..core.loads import reciprocal_root, vec3_entry, vec3i_entry, vec4_entry
from ..mesh.fans import INFINITE, PLANE_BAND, near_plane_limit
from ..mesh.triangle import nearest_barycentric
from .face_slopes import STEP_INSIDE, distance_to_face, green_layers

# so many registers per thread that larger blocks would fill a GPU less well
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})

#: Faces take the float64 path if they are seen wide and their plane passes closer than this many bands of fans.py.
BANDS = wp.constant(2.0)

#: Points this close to a face, as a share of the size, and not clearly in front of it, take the limit from inside.
SURFACE = wp.constant(wp.float64(1.05e-5))
IN_FRONT = wp.constant(wp.float64(1.0e-7))
ON = wp.constant(1)
BEHIND = wp.constant(2)
_INVERSE_FOUR_PI = wp.constant(0.07957747154594767)
_INVERSE_FOUR_PI_64 = wp.constant(wp.float64(0.07957747154594767))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_TINY = wp.constant(wp.float64(1.0e-24))


@wp.struct
class FaceIntegrals:
    phi: wp.vec3  # of the three corners
    psi: float
    touching: int  # ON or BEHIND where the origin lies on the face or just behind it: then phi lacks the solid angle
    nearest: wp.vec3  # and this is where, in barycentric coordinates


@wp.func
def edge_integral(r: float, s: float, cosine: float, sine: float, edge_squared: float):
    """Integral of 1 / distance along an edge, over its length. r, s: distances of its ends; cosine, sine: their dot
    product and the length squared of their cross product."""
    # log(1 + |e| (r + s + |e|) / q) with q = r s + dot cancels neither next to the edge nor far from it.
    inverse_edge = reciprocal_root(edge_squared)
    edge = edge_squared * inverse_edge
    product = r * s
    q = wp.where(cosine > 0.0, product + cosine, sine / (product - cosine))
    z = edge * (r + s + edge) / q
    y = z / (2.0 + z)
    yy = y * y
    series = 2.0 * y * (1.0 + yy * (0.33333333 + yy * (0.2 + yy * (0.14285714 + yy * 0.11111111))))
    return wp.where(z < 0.4, series, wp.log(1.0 + z)) * inverse_edge


@wp.func
def near_edge_integral(p: wp.vec3d, q: wp.vec3d, cross: wp.vec3d):
    """The same in float64, bounded where the origin lies on the edge."""
    edge = wp.length(q - p)
    r = wp.length(p)
    s = wp.length(q)
    cosine = wp.dot(p, q)
    product = r * s
    low = product + cosine
    if cosine <= _ZERO:
        low = wp.dot(cross, cross) / wp.max(product - cosine, _TINY * edge * edge)
    z = edge * (r + s + edge) / wp.max(low, _TINY * edge * edge)
    return wp.log(_ONE + z) / edge


@wp.func(inline=False)
def near_face_integrals(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """phi and psi of a face next to the origin, in float64."""
    p = wp.vec3d(a)
    q = wp.vec3d(b)
    r = wp.vec3d(c)
    normal = wp.cross(q - p, r - p)
    double_area = wp.length(normal)
    result = FaceIntegrals()
    if double_area == _ZERO:
        return result
    normal /= double_area
    height = wp.dot(normal, p)
    cross_p = wp.cross(q, r - q)
    cross_q = wp.cross(r, p - r)
    cross_r = wp.cross(p, q - p)
    k_p = near_edge_integral(q, r, cross_p)
    k_q = near_edge_integral(r, p, cross_q)
    k_r = near_edge_integral(p, q, cross_r)
    area_p = wp.dot(normal, cross_p)
    area_q = wp.dot(normal, cross_q)
    area_r = wp.dot(normal, cross_r)

    unit = wp.float64(size)
    solid_angle = _ZERO
    if height < IN_FRONT * unit and height > -SURFACE * unit:
        nearest = nearest_barycentric(p, q, r)
        distance = wp.length(nearest[0] * p + nearest[1] * q + nearest[2] * r)
        if distance < SURFACE * unit:
            result.touching = wp.where(distance < IN_FRONT * unit, ON, BEHIND)
            result.nearest = wp.vec3(nearest)
    if result.touching == 0:
        length_p = wp.length(p)
        length_q = wp.length(q)
        length_r = wp.length(r)
        below = (
            length_p * length_q * length_r + wp.dot(p, q) * length_r + wp.dot(q, r) * length_p + wp.dot(r, p) * length_q
        )
        solid_angle = _TWO * wp.atan2(height * double_area, below)

    pull = (r - q) * k_p + (p - r) * k_q + (q - p) * k_r
    scale = _INVERSE_FOUR_PI_64 / double_area
    result.phi = wp.vec3(
        wp.vec3d(
            scale * (area_p * solid_angle + height * wp.dot(r - q, pull)),
            scale * (area_q * solid_angle + height * wp.dot(p - r, pull)),
            scale * (area_r * solid_angle + height * wp.dot(q - p, pull)),
        )
    )
    result.psi = wp.float32(_INVERSE_FOUR_PI_64 * (area_p * k_p + area_q * k_q + area_r * k_r - height * solid_angle))
    return result


@wp.struct
class FaceEdge:
    """The edge from b to c of a face, seen from the point."""

    cross: wp.vec3  # C = b x c
    cosine: float  # b . c
    integral: float  # K


@wp.func
def face_edge(b: wp.vec3, c: wp.vec3, r: float, s: float):
    """The edge from b to c; r, s: their lengths."""
    along = c - b
    edge = FaceEdge()
    edge.cross = wp.cross(b, along)
    edge.cosine = wp.dot(b, c)
    edge.integral = edge_integral(r, s, edge.cosine, wp.dot(edge.cross, edge.cross), wp.dot(along, along))
    return edge


@wp.func
def half_solid_angle(det: float, below: float):
    """atan2(det, below), to 2e-7 of it, without branches or special cases: atan t = t + t^3 p(t^2) on [0, 1], p
    interpolated at Chebyshev nodes."""
    sine = wp.abs(det)
    across = wp.abs(below)
    t = wp.min(sine, across) / wp.max(sine, across)
    s = t * t
    p = 0.003866739 * s - 0.020026748
    p = p * s + 0.048914322
    p = p * s - 0.080096817
    p = p * s + 0.108657591
    p = p * s - 0.142570449
    p = p * s + 0.199986812
    p = p * s - 0.333333231
    angle = t + t * s * p
    angle = wp.where(sine > across, 1.5707963267948966 - angle, angle)
    angle = wp.where(below < 0.0, 3.141592653589793 - angle, angle)
    return wp.where(det < 0.0, -angle, angle)


@wp.func
def is_near(limit: float, det: float, below: float, volume: float, shortest: float, size: float):
    """Whether a face is for float64: it is a sliver, or its plane passes near and it is seen wide. limit: its
    near_plane_limit; volume: product of the distances of its corners; shortest: the least of these."""
    # det and `below` both vanish on the triangle's rim, so their quotient has no digits there in float32
    rim = below <= 0.1 * volume or shortest <= BANDS * PLANE_BAND * size
    return limit >= INFINITE or (rim and det * det <= BANDS * BANDS * limit)


@wp.func
def far_face_integrals(
    edge_a: wp.vec3,
    edge_b: wp.vec3,
    edge_c: wp.vec3,
    bc: FaceEdge,
    ca: FaceEdge,
    ba: FaceEdge,
    normal: wp.vec3,
    det: float,
    below: float,
):
    """phi and psi of a face clear of the origin. normal: cross product of two edges; det, below: sine and cosine, times
    the same, of half the solid angle."""
    # edge_a, ..: opposite to a, b, c; bc, ca, ba: the same from the origin, the last as the face across it has it.
    inverse_area = reciprocal_root(wp.dot(normal, normal))
    unit = normal * inverse_area
    height = det * inverse_area
    area_a = wp.dot(unit, bc.cross)
    area_b = wp.dot(unit, ca.cross)
    area_c = -wp.dot(unit, ba.cross)
    solid_angle = 2.0 * half_solid_angle(det, below)
    pull = edge_a * bc.integral + edge_b * ca.integral + edge_c * ba.integral
    scale = _INVERSE_FOUR_PI * inverse_area
    turned = scale * solid_angle
    pulled = (scale * height) * pull
    result = FaceIntegrals()
    result.phi = wp.vec3(
        area_a * turned + wp.dot(edge_a, pulled),
        area_b * turned + wp.dot(edge_b, pulled),
        area_c * turned + wp.dot(edge_c, pulled),
    )
    result.psi = _INVERSE_FOUR_PI * (
        area_a * bc.integral + area_b * ca.integral + area_c * ba.integral - height * solid_angle
    )
    return result


@wp.func
def face_integrals(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """phi and psi of the face a, b, c as seen from the origin."""
    edge_a = c - b
    edge_b = a - c
    edge_c = b - a
    normal = wp.cross(edge_b, edge_c)
    det = wp.dot(normal, a)
    length_a = wp.length(a)
    length_b = wp.length(b)
    length_c = wp.length(c)
    bc = face_edge(b, c, length_b, length_c)
    ca = face_edge(c, a, length_c, length_a)
    ba = face_edge(b, a, length_b, length_a)
    volume = length_a * length_b * length_c
    below = volume + bc.cosine * length_a + ca.cosine * length_b + ba.cosine * length_c
    shortest = wp.min(wp.min(length_a, length_b), length_c)
    result = FaceIntegrals()
    if is_near(near_plane_limit(normal, edge_c, -edge_b, size), det, below, volume, shortest, size):
        result = near_face_integrals(a, b, c, size)
    else:
        result = far_face_integrals(edge_a, edge_b, edge_c, bc, ca, ba, normal, det, below)
    return result


@wp.func
def missing_winding(winding: float, touching: int):
    """What the touched faces would add to the sum of phi: just inside them, up to the next whole number; just outside
    where the point is behind them and in another part of the cage."""
    whole = wp.ceil(winding - 1.0e-4)
    return wp.max(wp.where(touching == BEHIND, whole - 1.0, whole), 1.0) - winding


@wp.struct
class GreenPoint:
    position: wp.vec3
    inside: int  # 1 where the point is in the cage, or within SURFACE of it


@wp.func
def green_point(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
):
    """green_position, and whether it is one: the sum of phi is the winding number."""
    position = wp.vec3(0.0, 0.0, 0.0)
    winding = float(0.0)
    touched = int(-1)
    f = int(0)
    while f < faces.shape[0]:
        face = vec3i_entry(faces, f)
        a = vec3_entry(vertices, face[0]) - x
        b = vec3_entry(vertices, face[1]) - x
        length_a = wp.length(a)
        length_b = wp.length(b)
        target_a = vec3_entry(targets, face[0])
        target_b = vec3_entry(targets, face[1])
        ba = face_edge(b, a, length_b, length_a)
        index = int(0)
        while index >= 0:
            corner = vec4_entry(fans, 2 * f)
            plane = vec4_entry(fans, 2 * f + 1)
            index = wp.cast(corner[3], int)
            c = wp.vec3(corner[0], corner[1], corner[2]) - x
            normal = wp.vec3(plane[0], plane[1], plane[2])
            target_c = vec3_entry(targets, wp.where(index < 0, -1 - index, index))
            length_c = wp.length(c)
            bc = face_edge(b, c, length_b, length_c)
            ca = face_edge(c, a, length_c, length_a)
            det = wp.dot(normal, c)
            volume = length_a * length_b * length_c
            below = volume + bc.cosine * length_a + ca.cosine * length_b + ba.cosine * length_c
            shortest = wp.min(wp.min(length_a, length_b), length_c)
            integrals = far_face_integrals(c - b, a - c, b - a, bc, ca, ba, normal, det, below)
            if is_near(plane[3], det, below, volume, shortest, size):
                integrals = near_face_integrals(a, b, c, size)
                if integrals.touching != 0:
                    touched = f
            phi = integrals.phi
            position += phi[0] * target_a
            position += phi[1] * target_b
            position += phi[2] * target_c
            position += integrals.psi * vec3_entry(target_normals, f)
            winding += phi[0] + phi[1] + phi[2]
            b = c
            length_b = length_c
            target_b = target_c
            ba = ca
            f += 1
    result = GreenPoint()
    if touched >= 0:
        face = faces[touched]
        near = near_face_integrals(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
        missing = missing_winding(winding, near.touching) * near.nearest
        position += missing[0] * targets[face[0]] + missing[1] * targets[face[1]] + missing[2] * targets[face[2]]
    if touched >= 0 or winding > 0.5:
        result.inside = 1
    result.position = position
    return result


@gradient_of(green_point, GreenPoint)
def grad_green_point(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
    grad: GreenPoint,
):
    """Slopes by the point, the cage (not its fans, which are the same once more), the targets and their normals, in
    float64. On the cage they are those STEP_INSIDE it."""
    y = wp.vec3d(x)
    unit = wp.float64(size)
    for f in range(faces.shape[0]):
        face = faces[f]
        p = wp.vec3d(vertices[face[0]]) - wp.vec3d(x)
        q = wp.vec3d(vertices[face[1]]) - wp.vec3d(x)
        r = wp.vec3d(vertices[face[2]]) - wp.vec3d(x)
        if distance_to_face(p, q, r) < SURFACE * unit:
            y = wp.vec3d(x) - wp.normalize(wp.cross(q - p, r - p)) * (STEP_INSIDE * unit)
    slope = wp.vec3d(grad.position)
    by_point = wp.vec3d(_ZERO, _ZERO, _ZERO)
    for f in range(faces.shape[0]):
        face = faces[f]
        p = wp.vec3d(vertices[face[0]]) - y
        q = wp.vec3d(vertices[face[1]]) - y
        r = wp.vec3d(vertices[face[2]]) - y
        if wp.length(wp.cross(q - p, r - p)) > _ZERO:
            by_phi = wp.vec3d(
                wp.dot(slope, wp.vec3d(targets[face[0]])),
                wp.dot(slope, wp.vec3d(targets[face[1]])),
                wp.dot(slope, wp.vec3d(targets[face[2]])),
            )
            layers = green_layers(p, q, r, by_phi, wp.dot(slope, wp.vec3d(target_normals[f])))
            by_point -= layers.slopes.p + layers.slopes.q + layers.slopes.r
            add_slope(vertices, wp.adjoint[vertices], face[0], wp.vec3(layers.slopes.p))
            add_slope(vertices, wp.adjoint[vertices], face[1], wp.vec3(layers.slopes.q))
            add_slope(vertices, wp.adjoint[vertices], face[2], wp.vec3(layers.slopes.r))
            add_slope(targets, wp.adjoint[targets], face[0], wp.vec3(layers.phi[0] * slope))
            add_slope(targets, wp.adjoint[targets], face[1], wp.vec3(layers.phi[1] * slope))
            add_slope(targets, wp.adjoint[targets], face[2], wp.vec3(layers.phi[2] * slope))
            add_slope(target_normals, wp.adjoint[target_normals], f, wp.vec3(layers.psi * slope))
    wp.adjoint[x] += wp.vec3(by_point)


@wp.func
def green_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
):
    """sum_i phi_i(x) targets_i + sum_f psi_f(x) target_normals_f with phi, psi of the cage `vertices`. fans: see
    prepare_fans."""
    return green_point(x, vertices, faces, fans, targets, target_normals, size).position


@gradient_of(face_integrals, FaceIntegrals)
def grad_face_integrals(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float, grad: FaceIntegrals):
    """Slopes by the corners; NaN where the origin lies on the face, where phi jumps."""
    p = wp.vec3d(a)
    q = wp.vec3d(b)
    r = wp.vec3d(c)
    if distance_to_face(p, q, r) < SURFACE * wp.float64(size):
        nan = wp.vec3(wp.nan, wp.nan, wp.nan)
        wp.adjoint[a] += nan
        wp.adjoint[b] += nan
        wp.adjoint[c] += nan
    else:
        slopes = green_layers(p, q, r, wp.vec3d(grad.phi), wp.float64(grad.psi)).slopes
        wp.adjoint[a] += wp.vec3(slopes.p)
        wp.adjoint[b] += wp.vec3(slopes.q)
        wp.adjoint[c] += wp.vec3(slopes.r)


@wp.kernel
def map_green(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
    positions: wp.array(dtype=wp.vec3),
):
    """positions (n,) = sum_i phi_i(points) targets_i + sum_f psi_f(points) target_normals_f."""
    n = first + wp.tid()
    positions[n] = green_position(points[n], vertices, faces, fans, targets, target_normals, size)


@wp.kernel
def map_green_inside(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    target_normals: wp.array(dtype=wp.vec3),
    size: float,
    positions: wp.array(dtype=wp.vec3),
    outside: wp.array(dtype=int),
):
    """The same; outside (1,) becomes 1 where a point is not inside."""
    n = first + wp.tid()
    point = green_point(points[n], vertices, faces, fans, targets, target_normals, size)
    positions[n] = point.position
    if point.inside == 0:
        outside[0] = 1


@wp.kernel
def weigh_green(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    size: float,
    vertex_weights: wp.array2d(dtype=wp.float32),
    face_weights: wp.array2d(dtype=wp.float32),
):
    """vertex_weights (n, v) = phi and face_weights (n, f) = psi, whatever the rows held before."""
    n = first + wp.tid()
    x = points[n]
    for j in range(vertex_weights.shape[1]):
        vertex_weights[n, j] = 0.0
    winding = float(0.0)
    touched = int(-1)
    touching = int(0)
    nearest = wp.vec3(0.0, 0.0, 0.0)
    for f in range(faces.shape[0]):
        face = faces[f]
        integrals = face_integrals(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
        face_weights[n, f] = integrals.psi
        for k in range(3):
            vertex_weights[n, face[k]] = vertex_weights[n, face[k]] + integrals.phi[k]
            winding += integrals.phi[k]
        if integrals.touching != 0:
            touched = f
            touching = integrals.touching
            nearest = integrals.nearest
    if touched >= 0:
        missing = missing_winding(winding, touching)
        face = faces[touched]
        for k in range(3):
            vertex_weights[n, face[k]] = vertex_weights[n, face[k]] + missing * nearest[k]
