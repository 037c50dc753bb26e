"""Biharmonic coordinates of points in a closed triangle cage, the map they give, and the equations they come from."""

# After Weber, Poranne and Gotsman, "Biharmonic coordinates" (CGF 2012) in the plane, and Thiery, Michel and Chen,
# "Biharmonic coordinates and their derivatives for triangular 3D cages" (TOG 2024). With G1 = -1 / (4 pi r) and
# G2 = -r / (8 pi), whose Laplacian is G1, a map whose Laplacian is harmonic obeys Green's identity twice over:
#   f(x) = sum_i phi_i(x) f_i + sum_j (psi_j(x) d_j + D_j(x) g_j + S_j(x) q_j),
# phi, psi as Green coordinates have them (green.py), f linear on faces, and constant on each face j: d_j the slope of f
# along the outward normal, g_j its Laplacian, q_j the slope of that. The layers of the latter two are, with h = n . a,
#   D = int dG2/dn = -h / (8 pi) int 1/r = -h psi / 2,
#   S = int r / (8 pi) = (sum_i (n . C_i) R_i + h^2 4 pi psi) / (24 pi),
#   R_i = int r ds / |e_i| = ((r + s) (|e|^2 + (r - s)^2) / 2 + |C_i|^2 K_i) / (2 |e|^2)   along edge i,
# by the divergence of r times the place in the plane, which is 3 r - h^2 / r. f and d are given (a pose's vertices and
# stretched normals); g and q make f and its slope right at the middle of each face: 2 f equations (fill_equations).
# Its slopes by x, with m_i the edge's outward normal in the plane, w from x to its line, Omega the solid angle:
#   grad int 1/r = n Omega - sum_i m_i int ds/r,   grad int r = -(n h int 1/r + sum_i m_i int r ds),
#   grad Omega = sum_i C_i T_i,   T_i = int ds/r^3 / |e_i| = (1/r + 1/s) / (r s + a . b),
#   grad K_i = e_i (1/r - 1/s) / |e_i|^2 + w T_i,
#   4 pi phi_k = N_k Omega - h grad N_k . sum_i m_i int ds/r,   N_k the hat functions, continued to all of the plane.
# points (n,), vertices, targets (v,), faces (f,), face_values (3 f,): d of all faces, then g, then q. Units as in
# green.py: one for points, vertices and size; layers are lengths to the powers 1, 2 and 3.

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import reciprocal_root, vec3_entry, vec3i_entry, vec4_entry
from .green import (
    FaceEdge,
    FaceIntegrals,
    face_edge,
    face_integrals,
    far_face_integrals,
    is_near,
    missing_winding,
    near_edge_integral,
    near_face_integrals,
)

# so many registers per thread that larger blocks would fill a GPU less well
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})


forward_only = forward_only_in(__name__, (wp.vec4, wp.vec3))

_FOUR_PI = wp.constant(12.566370614359172)
_INVERSE_24_PI = wp.constant(0.013262911924324612)
_INVERSE_FOUR_PI = wp.constant(wp.float64(0.07957747154594767))
_INVERSE_EIGHT_PI = wp.constant(wp.float64(0.039788735772973836))
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_THREE = wp.constant(wp.float64(3.0))
_TWO_PI = wp.constant(wp.float64(6.283185307179586))
_TOUCHING = wp.constant(wp.float64(1.0e-7))  # of faces, in sizes of the cage
_TINY = wp.constant(wp.float64(1.0e-24))


@wp.func
def edge_reach(edge: FaceEdge, r: float, s: float, along: wp.vec3):
    """R of an edge, the mean distance of its points; r, s: lengths of its ends."""
    squared = wp.dot(along, along)
    sine = wp.dot(edge.cross, edge.cross)
    on_line = wp.where(sine > 0.0, sine * edge.integral, 0.0)  # at an end of the edge its integral is infinite
    return 0.5 * (0.5 * (r + s) * (squared + (r - s) * (r - s)) + on_line) / squared


@wp.func
def second_layer(area_reach: float, height: float, psi: float):
    """S of a face; area_reach: sum of (n . C_i) R_i."""
    return (area_reach + height * height * _FOUR_PI * psi) * _INVERSE_24_PI


@wp.func
def biharmonic_point(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    face_values: wp.array(dtype=wp.vec3),
    size: float,
):
    """biharmonic_position, and 1 where the point is in the cage, or within SURFACE of it, else 0: the sum of phi is the
    winding number."""
    position = wp.vec3(0.0, 0.0, 0.0)
    winding = float(0.0)
    touched = int(-1)
    count = faces.shape[0]
    f = int(0)
    while f < count:
        face = vec3i_entry(faces, f)
        a = vec3_entry(vertices, face[0]) - x
        b = vec3_entry(vertices, face[1]) - x
        length_a = wp.length(a)
        length_b = wp.length(b)
        target_a = vec3_entry(targets, face[0])
        target_b = vec3_entry(targets, face[1])
        ba = face_edge(b, a, length_b, length_a)
        reach_ba = edge_reach(ba, length_b, length_a, b - a)
        index = int(0)
        while index >= 0:
            corner = vec4_entry(fans, 2 * f)
            plane = vec4_entry(fans, 2 * f + 1)
            slope = vec3_entry(face_values, f)
            laplacian = vec3_entry(face_values, count + f)
            flux = vec3_entry(face_values, 2 * count + f)
            index = wp.cast(corner[3], int)
            c = wp.vec3(corner[0], corner[1], corner[2]) - x
            normal = wp.vec3(plane[0], plane[1], plane[2])
            target_c = vec3_entry(targets, wp.where(index < 0, -1 - index, index))
            length_c = wp.length(c)
            bc = face_edge(b, c, length_b, length_c)
            ca = face_edge(c, a, length_c, length_a)
            reach_bc = edge_reach(bc, length_b, length_c, c - b)
            reach_ca = edge_reach(ca, length_c, length_a, a - c)
            det = wp.dot(normal, c)
            volume = length_a * length_b * length_c
            below = volume + bc.cosine * length_a + ca.cosine * length_b + ba.cosine * length_c
            shortest = wp.min(wp.min(length_a, length_b), length_c)
            integrals = far_face_integrals(c - b, a - c, b - a, bc, ca, ba, normal, det, below)
            if is_near(plane[3], det, below, volume, shortest, size):
                integrals = near_face_integrals(a, b, c, size)
                if integrals.touching != 0:
                    touched = f
            inverse_area = reciprocal_root(wp.dot(normal, normal))
            height = det * inverse_area
            reaches = bc.cross * reach_bc + ca.cross * reach_ca - ba.cross * reach_ba
            second = second_layer(wp.dot(normal, reaches) * inverse_area, height, integrals.psi)
            phi = integrals.phi
            position += phi[0] * target_a
            position += phi[1] * target_b
            position += phi[2] * target_c
            position += integrals.psi * (slope - 0.5 * height * laplacian) + second * flux
            winding += phi[0] + phi[1] + phi[2]
            b = c
            length_b = length_c
            target_b = target_c
            ba = ca
            reach_ba = reach_ca
            f += 1
    if touched >= 0:
        face = faces[touched]
        near = near_face_integrals(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
        missing = missing_winding(winding, near.touching) * near.nearest
        position += missing[0] * targets[face[0]] + missing[1] * targets[face[1]] + missing[2] * targets[face[2]]
    inside = wp.where(touched >= 0 or winding > 0.5, 1.0, 0.0)
    return forward_only(wp.vec4(position[0], position[1], position[2], inside), x)


@wp.func
def biharmonic_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    face_values: wp.array(dtype=wp.vec3),
    size: float,
):
    """sum_i phi_i(x) targets_i and the layers of face_values, of the cage `vertices`. fans: see prepare_fans."""
    point = biharmonic_point(x, vertices, faces, fans, targets, face_values, size)
    return wp.vec3(point[0], point[1], point[2])


@wp.kernel
def map_biharmonic(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    face_values: wp.array(dtype=wp.vec3),
    size: float,
    positions: wp.array(dtype=wp.vec3),
    outside: wp.array(dtype=int),
):
    """positions (n,) of points; outside (1,) becomes 1 where one is not inside."""
    n = first + wp.tid()
    point = biharmonic_point(points[n], vertices, faces, fans, targets, face_values, size)
    positions[n] = wp.vec3(point[0], point[1], point[2])
    if point[3] == 0.0:
        outside[0] = 1


@wp.struct
class EdgeLayers:
    """The edge from p to q, seen from the point."""

    cross: wp.vec3d  # C = p x q
    integral: wp.float64  # K
    reach: wp.float64  # R
    third: wp.float64  # T
    out: wp.vec3d  # outward normal in the plane times the length
    integral_slope: wp.vec3d  # grad K


@wp.func
def edge_layers(p: wp.vec3d, q: wp.vec3d, normal: wp.vec3d):
    """The integrals along an edge, and the slope of the first by the point, which is not on the edge."""
    along = q - p
    squared = wp.dot(along, along)
    r = wp.length(p)
    s = wp.length(q)
    cosine = wp.dot(p, q)
    edge = EdgeLayers()
    edge.cross = wp.cross(p, q)
    sine = wp.dot(edge.cross, edge.cross)
    edge.integral = near_edge_integral(p, q, edge.cross)
    edge.reach = _HALF * (_HALF * (r + s) * (squared + (r - s) * (r - s)) + sine * edge.integral) / squared
    below = r * s + cosine
    if cosine < _ZERO:
        below = sine / wp.max(r * s - cosine, _TINY * squared)
    edge.third = (_ONE / r + _ONE / s) / wp.max(below, _TINY * squared)
    edge.out = wp.cross(along, normal)
    across = p - along * (wp.dot(p, along) / squared)
    edge.integral_slope = along * ((_ONE / r - _ONE / s) / squared) + across * edge.third
    return edge


@wp.struct
class FaceLayers:
    """The layers of a face as seen from a point clear of its rim, in float64, with their slopes by the point."""

    bc: EdgeLayers
    ca: EdgeLayers
    ab: EdgeLayers
    normal: wp.vec3d
    double_area: wp.float64
    height: wp.float64  # h
    angle: wp.float64  # Omega
    pull: wp.vec3d  # sum_i m_i int ds/r
    first: wp.float64  # 4 pi psi
    first_slope: wp.vec3d
    second: wp.float64  # D
    second_slope: wp.vec3d
    third: wp.float64  # S
    third_slope: wp.vec3d


@wp.func
def with_layers(layers: FaceLayers):
    """The layers from the edges, the height and the solid angle."""
    bc = layers.bc
    ca = layers.ca
    ab = layers.ab
    normal = layers.normal
    height = layers.height
    layers.pull = bc.out * bc.integral + ca.out * ca.integral + ab.out * ab.integral
    edges = bc.cross * bc.integral + ca.cross * ca.integral + ab.cross * ab.integral
    layers.first = wp.dot(normal, edges) - height * layers.angle
    layers.first_slope = normal * layers.angle - layers.pull
    reaches = bc.cross * bc.reach + ca.cross * ca.reach + ab.cross * ab.reach
    layers.second = -_INVERSE_EIGHT_PI * height * layers.first
    layers.second_slope = _INVERSE_EIGHT_PI * (layers.first * normal - height * layers.first_slope)
    layers.third = _INVERSE_EIGHT_PI * (wp.dot(normal, reaches) + height * height * layers.first) / _THREE
    along = bc.out * bc.reach + ca.out * ca.reach + ab.out * ab.reach
    layers.third_slope = -_INVERSE_EIGHT_PI * (height * layers.first * normal + along)
    return layers


@wp.func
def face_layers(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """The layers of the face a, b, c as seen from the origin."""
    layers = FaceLayers()
    normal = wp.cross(b - a, c - a)
    layers.double_area = wp.length(normal)
    layers.normal = normal / layers.double_area
    layers.height = wp.dot(layers.normal, c)
    layers.bc = edge_layers(b, c, layers.normal)
    layers.ca = edge_layers(c, a, layers.normal)
    layers.ab = edge_layers(a, b, layers.normal)
    la = wp.length(a)
    lb = wp.length(b)
    lc = wp.length(c)
    below = la * lb * lc + wp.dot(b, c) * la + wp.dot(c, a) * lb + wp.dot(a, b) * lc
    layers.angle = _TWO * wp.atan2(layers.height * layers.double_area, below)
    return with_layers(layers)


@wp.kernel
def weigh_biharmonic(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    size: float,
    vertex_weights: wp.array2d(dtype=wp.float64),
    face_weights: wp.array2d(dtype=wp.float64),
):
    """vertex_weights (n, v) = phi and face_weights (n, 3 f) = psi, then D, then S, whatever the rows held before: what
    D and S are multiplied by is large, and cancels."""
    n = first + wp.tid()
    x = points[n]
    y = wp.vec3d(x)
    count = faces.shape[0]
    for j in range(vertex_weights.shape[1]):
        vertex_weights[n, j] = _ZERO
    winding = float(0.0)
    touched = int(-1)
    nearest = FaceIntegrals()
    for f in range(count):
        face = faces[f]
        integrals = face_integrals(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
        for k in range(3):
            vertex_weights[n, face[k]] = vertex_weights[n, face[k]] + wp.float64(integrals.phi[k])
            winding += integrals.phi[k]
        if integrals.touching != 0:
            touched = f
            nearest = integrals
        layers = face_layers(
            wp.vec3d(vertices[face[0]]) - y, wp.vec3d(vertices[face[1]]) - y, wp.vec3d(vertices[face[2]]) - y
        )
        face_weights[n, f] = wp.float64(integrals.psi)
        face_weights[n, count + f] = layers.second
        face_weights[n, 2 * count + f] = layers.third
    if touched >= 0:
        missing = missing_winding(winding, nearest.touching)
        face = faces[touched]
        for k in range(3):
            vertex_weights[n, face[k]] = vertex_weights[n, face[k]] + wp.float64(missing * nearest.nearest[k])


@wp.func
def least_share(layers: FaceLayers):
    """The smallest barycentric coordinate of the foot of the place, below 0 beside the triangle."""
    least = wp.min(wp.dot(layers.normal, layers.bc.cross), wp.dot(layers.normal, layers.ca.cross))
    return wp.min(least, wp.dot(layers.normal, layers.ab.cross)) / layers.double_area


@wp.kernel
def fill_equations(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    known: wp.array2d(dtype=wp.float64),
    unknown: wp.array2d(dtype=wp.float64),
    winding: wp.array(dtype=wp.float64),
):
    """Values at the middles of faces from inside, then slopes along normals, by what is given (v + f) and what is not
    (2 f), and winding (f,): the sum of phi there, 0 where faces lie on each other."""
    i = first + wp.tid()
    count = faces.shape[0]
    corners = vertices.shape[0]
    own = faces[i]
    x = (vertices[own[0]] + vertices[own[1]] + vertices[own[2]]) / _THREE
    away = wp.normalize(
        wp.cross(vertices[own[1]] - vertices[own[0]], vertices[own[2]] - vertices[own[0]])
    )  # slopes are along this
    for j in range(corners):
        known[i, j] = _ZERO
        known[count + i, j] = _ZERO
    total = wp.float64(0.0)
    is_alone = _ONE
    for j in range(count):
        face = faces[j]
        a = vertices[face[0]] - x
        b = vertices[face[1]] - x
        c = vertices[face[2]] - x
        layers = face_layers(a, b, c)
        if j == i:  # half of all directions, from inside
            layers.height = _ZERO
            layers.angle = _TWO_PI
            layers = with_layers(layers)
        elif wp.abs(layers.height) < _TOUCHING and least_share(layers) > -_TOUCHING:
            is_alone = _ZERO
        total += _INVERSE_FOUR_PI * layers.angle
        bc = layers.bc
        ca = layers.ca
        ab = layers.ab
        height = layers.height
        angle = layers.angle
        pull = layers.pull
        angle_slope = wp.dot(away, bc.cross * bc.third + ca.cross * ca.third + ab.cross * ab.third)
        facing = wp.dot(away, layers.normal)
        known[i, corners + j] = _INVERSE_FOUR_PI * layers.first
        known[count + i, corners + j] = _INVERSE_FOUR_PI * wp.dot(away, layers.first_slope)
        unknown[i, j] = layers.second
        unknown[count + i, j] = wp.dot(away, layers.second_slope)
        unknown[i, count + j] = layers.third
        unknown[count + i, count + j] = wp.dot(away, layers.third_slope)
        for k in range(3):
            opposite = bc
            if k == 1:
                opposite = ca
            elif k == 2:
                opposite = ab
            hat = wp.dot(layers.normal, opposite.cross) / layers.double_area
            hat_slope = -opposite.out / layers.double_area
            tilt = wp.dot(hat_slope, pull)
            tilt_slope = (
                wp.dot(hat_slope, bc.out) * wp.dot(away, bc.integral_slope)
                + wp.dot(hat_slope, ca.out) * wp.dot(away, ca.integral_slope)
                + wp.dot(hat_slope, ab.out) * wp.dot(away, ab.integral_slope)
            )
            phi = hat * angle - height * tilt
            phi_slope = wp.dot(away, hat_slope) * angle + hat * angle_slope + facing * tilt - height * tilt_slope
            known[i, face[k]] = known[i, face[k]] + _INVERSE_FOUR_PI * phi
            known[count + i, face[k]] = known[count + i, face[k]] + _INVERSE_FOUR_PI * phi_slope
    winding[i] = total * is_alone
