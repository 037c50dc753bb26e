"""Green coordinates of points and their gradients, in float64: rows by which points are carried along with a cage."""

# Lipman, Levin and Cohen-Or, "Green coordinates" (SIGGRAPH 2008), in the form of coordinates/green. With a, b, c the
# corners of a face seen from x, e_i the edge across from corner i, C_i the cross product of its ends, A2 twice the
# area, n the unit normal, h = n . a, Omega the solid angle and K_i = log((r + s + |e_i|) / (r + s - |e_i|)) / |e_i|, r
# and s being the lengths of the ends,
#
#   psi = (sum_i (n . C_i) K_i - h Omega) / 4 pi,
#   phi_i = ((n . C_i) Omega + h e_i . P) / (4 pi A2),    P = sum_k K_k e_k.
#
# Where x moves by dx corners move by -dx: d (n . C_i) = (e_i x n) . dx for e_i = from the first end to the second,
#
#   d h = -n . dx,    d K = 2 (u_r + u_s) . dx / ((r + s)^2 - |e|^2) with the unit vectors u to the ends,
#   d Omega = 2 (B dD - D dB) / (D^2 + B^2) with Omega = 2 atan2(D, B), D = det(a, b, c),
#   B = |a| |b| |c| + (a . b) |c| + (b . c) |a| + (c . a) |b|.
#
# Shapes: points (m,), vertices (v,), faces (f,), one unit of length, in which the cage's longest side is about 1.
# Points lie inside, no nearer to a face than 1e-6.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})
_INVERSE_FOUR_PI = wp.constant(wp.float64(0.07957747154594767))
_ONE = wp.constant(wp.float64(1.0))
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
    # d (p x q) = dx x (p - q), so that n . d (p x q) = ((p - q) x n) . dx
    terms.area_slope = wp.cross(p - q, normal)
    both = r + s
    # both^2 - edge^2 = 2 (r s + p . q), which next to the edge is better told by the cross product
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
        scale = _INVERSE_FOUR_PI / double_area
        for k in range(3):
            terms = bc
            if k == 1:
                terms = ca
            elif k == 2:
                terms = ab
            reach = wp.dot(terms.along, pull)
            value = scale * (terms.area * angle + height * reach)
            slope = scale * (
                terms.area_slope * angle
                + terms.area * angle_slope
                - reach * normal
                + height * (wp.transpose(pull_slope) * terms.along)
            )
            scratch[face[k], n] = scratch[face[k], n] + row_of(value, slope)
        psi = _INVERSE_FOUR_PI * (
            bc.area * bc.integral + ca.area * ca.integral + ab.area * ab.integral - height * angle
        )
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
        rows[count + f, n] = wp.vec4(row_of(psi, psi_slope))
    for j in range(count):
        rows[j, n] = wp.vec4(scratch[j, n])
