"""Mean value coordinates of points in (or around) a closed cage of bilinear quads and triangles, and their map."""

# Thiery, Memari and Boubekeur, "Mean value coordinates for quad cages in 3D" (SIGGRAPH Asia 2018), by whose definition
# corner i of the patch r(u, v) = sum_i b_i(u, v) r_i, with r_i the corners seen from the point and b_i the bilinear
# basis, weighs the integral of b_i / |r| over the patch's solid angle:
#   w_i = int_0^1 int_0^1 b_i T / |r|^4 du dv,      T = r . (r_u x r_v), which is bilinear in u and v.
# Three of four unknowns are closed: sum_i w_i r_i = m, the integral of the unit directions over the solid angle, which
# the four straight edges alone decide (Stokes),
#   m = 1/2 sum_i beta_i C_i / |C_i|,   C_i = r_i x r_i+1,   beta_i = the angle that C_i spans.
# What is left is the part along the null vector n, for which sum_i n_i r_i = 0:
#   n_0 = det(r1, r2, r3),  n_1 = -det(r0, r2, r3),  n_2 = det(r0, r1, r3),  n_3 = -det(r0, r1, r2),
#   w = w_m + n G / |n|^2,  w_m the solution without a part along n,  G = int int (sum_i n_i b_i) T / |r|^4 du dv,
# where T has n_2, -n_3, n_0, -n_1 at the corners. G has no closed form: the paper sums 9 x 9 samples by a projection
# of the point. Here Gauss-Legendre rules give it to about 1e-6 of all weights: 3 x 3 nodes for patches that are FAR,
# nearer ones panels of 4 x 4 in s of u = u0 + a sinh(s), likewise of v, around the nearest point u0, v0 (Johnston and
# Elliott 2005), as many as keep that accuracy however near.
# On the patch w tends to its bilinear coordinates: points within SNAP of the size take those. A triangle is a quad that
# names its last corner twice. One unit for points (n,), vertices, targets (v,) and size; near the origin (float32).

from typing import Any

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import vec3_entry, vec4_entry
from ..mesh.fans import INFINITE, PLANE_BAND, SLIVER
from .mean_value import FLAT, SNAP, FaceEdge, clear_row, face_edge, has_cancelled

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})

forward_only = forward_only_in(__name__, (wp.vec4, wp.vec3), (wp.vec2d, wp.vec3d), (wp.float64, wp.vec3d))

#: Patches whose middle is farther than this, in distances from there to their farthest corner, take 3 x 3 nodes.
FAR = wp.constant(2.7)
NEAR = wp.constant(1.9)
NEAR_OUTSIDE = wp.constant(3.0)

#: Longest panel in s, whose poles lie pi / 2 or, in sheared patches, less off the real axis; and where integrands end.
PANEL = wp.constant(1.0)
END = wp.constant(8.0)

#: Nearest points are sought until steps are shorter than the root of this share of their distance.
ENOUGH = wp.constant(wp.float64(0.01))

#: Gauss-Legendre nodes in [-1, 1] and weights, 4 points; and 3 points (nodes at 0 and so far off, weights over 18).
_INNER_WEIGHT = wp.constant(wp.float64(0.6521451548625461))
_OUTER_WEIGHT = wp.constant(wp.float64(0.34785484513745385))
_OFF = wp.constant(0.7745966692)

_ZERO = wp.constant(wp.float64(0.0))
_QUARTER = wp.constant(wp.float64(0.25))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TINY = wp.constant(wp.float64(1.0e-200))


#: Patches of a point that wait for float64.
ROOM = wp.constant(24)
Queue = wp.types.vector(length=24, dtype=wp.int32)


@wp.struct
class NearQuad:
    weights: wp.vec4d  # of the four corners; bilinear coordinates where the point lies on the patch
    touching: int


@wp.func
def mixed(along: wp.vec4d, p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, s: wp.vec3d):
    return along[0] * p + along[1] * q + along[2] * r + along[3] * s


@wp.func
def bilinear_basis(u: wp.float64, v: wp.float64):
    return wp.vec4d((_ONE - u) * (_ONE - v), u * (_ONE - v), u * v, (_ONE - u) * v)


@wp.func
def nearest_share(from_: wp.vec3d, along: wp.vec3d):
    """Where on the line from_ + t along, t in [0, 1], it is nearest to the origin."""
    return wp.clamp(-wp.dot(from_, along) / (wp.dot(along, along) + _TINY), _ZERO, _ONE)


@wp.func
def nearest_bilinear(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, s: wp.vec3d):
    """u, v of the patch's point nearest to the origin; if it is strongly bent, perhaps only nearer than all around."""
    best = wp.vec2d(_HALF, _HALF)
    nearest = wp.length_sq(mixed(bilinear_basis(_HALF, _HALF), p, q, r, s))
    for k in range(4):
        u = _QUARTER + _HALF * wp.float64(k % 2)
        v = _QUARTER + _HALF * wp.float64(k / 2)
        squared = wp.length_sq(mixed(bilinear_basis(u, v), p, q, r, s))
        if squared < nearest:
            nearest = squared
            best = wp.vec2d(u, v)
    step = int(0)
    while step < 12:
        u = best[0]
        v = best[1]
        at = mixed(bilinear_basis(u, v), p, q, r, s)
        by_u = (_ONE - v) * (q - p) + v * (r - s)
        by_v = (_ONE - u) * (s - p) + u * (r - q)
        uu = wp.dot(by_u, by_u)
        uv = wp.dot(by_u, by_v)
        vv = wp.dot(by_v, by_v)
        below = uu * vv - uv * uv
        if below > wp.float64(1.0e-12) * uu * vv:  # Gauss-Newton
            a = wp.dot(at, by_u)
            b = wp.dot(at, by_v)
            u = wp.clamp(u - (a * vv - b * uv) / below, _ZERO, _ONE)
            v = wp.clamp(v - (b * uu - a * uv) / below, _ZERO, _ONE)
            if wp.length_sq(mixed(bilinear_basis(u, v), p, q, r, s)) > nearest:
                u = best[0]
                v = best[1]
        left = p + v * (s - p)  # then along either axis, which never leads away
        u = nearest_share(left, q + v * (r - q) - left)
        low = p + u * (q - p)
        v = nearest_share(low, s + u * (r - s) - low)
        moved = mixed(bilinear_basis(u, v), p, q, r, s)
        nearest = wp.length_sq(moved)
        step = wp.where(wp.length_sq(moved - at) <= ENOUGH * nearest, 12, step + 1)
        best = wp.vec2d(u, v)
    return forward_only(best, p)


@wp.struct
class PatchRule:
    """How G of a patch is integrated as seen from a point."""

    center: wp.vec2d  # u0, v0: of the nearest point, if the patch is near
    scale: wp.vec2d  # a of either axis
    longest: float  # of panels
    distance: wp.float64  # of the nearest point, or of the middle


@wp.func
def patch_rule(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, s: wp.vec3d, near: float):
    rule = PatchRule()
    middle = _QUARTER * (p + q + r + s)
    radius = wp.max(
        wp.max(wp.length_sq(p - middle), wp.length_sq(q - middle)),
        wp.max(wp.length_sq(r - middle), wp.length_sq(s - middle)),
    )
    rule.longest = float(PANEL)
    rule.center = wp.vec2d(_HALF, _HALF)
    rule.scale = wp.vec2d(wp.float64(4.0), wp.float64(4.0))
    rule.distance = wp.length(middle)
    if wp.length_sq(middle) < wp.float64(near * near) * radius:
        foot = nearest_bilinear(p, q, r, s)
        distance = wp.length(mixed(bilinear_basis(foot[0], foot[1]), p, q, r, s))
        by_u = (_ONE - foot[1]) * (q - p) + foot[1] * (r - s)
        by_v = (_ONE - foot[0]) * (s - p) + foot[0] * (r - q)
        length_u = wp.length(by_u) + wp.float64(0.1) * distance
        length_v = wp.length(by_v) + wp.float64(0.1) * distance
        rule.center = foot
        rule.scale = wp.vec2d(distance / length_u, distance / length_v)
        rule.longest = PANEL * wp.max(float(wp.length(wp.cross(by_u, by_v)) / (length_u * length_v)), 0.2)
        rule.distance = distance
    return rule


@wp.struct
class Panels:
    """Of an integral over [0, 1] in s, with u = u0 + a sinh(s): of one length, each with four nodes."""

    count: int
    first: wp.float64  # exp(s) at the middle of the first panel
    step: wp.float64  # exp of their length
    inner: wp.float64  # exp of how far the inner nodes are off the middle
    outer: wp.float64
    half: wp.float64  # of the length


@wp.func
def asinh(x: float):
    size = wp.abs(x)
    return wp.sign(x) * wp.log(size + wp.sqrt(size * size + 1.0))


@wp.func
def sinh_panels(center: wp.float64, scale: wp.float64, longest: float, farthest: float):
    # float32 will do for the ends of panels: what is left out or counted twice there is 1e-7 of the integral
    begin = wp.max(-asinh(float(center / scale)), -farthest)
    end = wp.min(asinh(float((_ONE - center) / scale)), farthest)
    panels = Panels()
    panels.count = int(wp.ceil((end - begin) / longest))
    half = 0.5 * (end - begin) / float(panels.count)
    panels.half = wp.float64(half)
    panels.first = wp.float64(wp.exp(begin + half))
    panels.inner = wp.float64(wp.exp(0.33998104358485626 * half))
    panels.outer = wp.float64(wp.exp(0.8611363115940526 * half))
    panels.step = wp.float64(wp.exp(half + half))
    return panels


@wp.struct
class PatchLine:
    """The line of one v on a patch: r, T and sum n b are what they are at its start, and u times a slope more."""

    start: wp.vec3d
    along: wp.vec3d
    t: wp.vec2d
    g: wp.vec2d


@wp.func
def node_integrand(line: PatchLine, center: wp.float64, scale: wp.float64, power: wp.float64, inverse: wp.float64):
    """Integrand of G times 2 du / ds / scale at s = log(power)."""
    u = center + scale * (_HALF * (power - inverse))
    squared = wp.length_sq(line.start + u * line.along)
    return (line.t[0] + u * line.t[1]) * (line.g[0] + u * line.g[1]) * (power + inverse) / (squared * squared)


@wp.func
def null_integral(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, s: wp.vec3d, n: wp.vec4d, rule: PatchRule):
    """G of the patch p, q, r, s with null vector n."""
    center = rule.center
    scale = rule.scale
    along = sinh_panels(center[0], scale[0], rule.longest, END)
    across = sinh_panels(center[1], scale[1], rule.longest, END)
    inner_back = _ONE / along.inner
    outer_back = _ONE / along.outer
    step_back = _ONE / along.step
    total = _ZERO
    k = int(0)
    middle = across.first
    while k < 4 * across.count:
        off = wp.where(k % 4 < 2, across.inner, across.outer)
        power = middle * wp.where(k % 2 == 0, off, _ONE / off)
        inverse = _ONE / power
        v = center[1] + scale[1] * (_HALF * (power - inverse))
        w = _ONE - v
        start = w * p + v * s
        t = n[2] * w - n[1] * v
        g = n[0] * w + n[3] * v
        line = PatchLine(
            start, w * q + v * r - start, wp.vec2d(t, n[0] * v - n[3] * w - t), wp.vec2d(g, n[1] * w + n[2] * v - g)
        )
        row = _ZERO
        j = int(0)
        here = along.first
        back = _ONE / here
        while j < along.count:
            row += _INNER_WEIGHT * (
                node_integrand(line, center[0], scale[0], here * along.inner, back * inner_back)
                + node_integrand(line, center[0], scale[0], here * inner_back, back * along.inner)
            )
            row += _OUTER_WEIGHT * (
                node_integrand(line, center[0], scale[0], here * along.outer, back * outer_back)
                + node_integrand(line, center[0], scale[0], here * outer_back, back * along.outer)
            )
            here = here * along.step
            back = back * step_back
            j += 1
        total += row * wp.where(k % 4 < 2, _INNER_WEIGHT, _OUTER_WEIGHT) * (power + inverse)
        k += 1
        if k % 4 == 0:
            middle = middle * across.step
    return forward_only(total * (_QUARTER * scale[0] * scale[1] * along.half * across.half), p)


@wp.func
def mean_of_edge(cross: wp.vec3d, cosine: wp.float64):
    sine = wp.length(cross) + _TINY
    return cross * (wp.atan2(sine, cosine) / sine)


@wp.func
def on_the_corners(n: Any, g: Any, m: Any, c01: Any, c12: Any, c23: Any, c30: Any, c02: Any, c13: Any):
    """w = w_m + n g / |n|^2, with c_ij = r_i x r_j."""
    d01 = wp.dot(m, c01)
    d12 = wp.dot(m, c12)
    d23 = wp.dot(m, c23)
    d30 = wp.dot(m, c30)
    d02 = wp.dot(m, c02)
    d13 = wp.dot(m, c13)
    w = type(n)(
        n[2] * d13 - n[1] * d23 - n[3] * d12,
        n[0] * d23 + n[2] * d30 + n[3] * d02,
        -n[0] * d13 - n[1] * d30 - n[3] * d01,
        n[0] * d12 - n[1] * d02 + n[2] * d01,
    )
    return (w + g * n) / wp.dot(n, n)


@wp.func
def weights_by_rule(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, s: wp.vec3d, rule: PatchRule, size: wp.float64):
    """Weights of the corners of a patch that the point does not lie on."""
    c01 = wp.cross(p, q - p)
    c12 = wp.cross(q, r - q)
    c23 = wp.cross(r, s - r)
    c30 = wp.cross(s, p - s)
    normal_3 = wp.cross(q - p, r - p)
    normal_1 = wp.cross(r - p, s - p)
    normal_2 = wp.cross(q - p, s - p)
    normal_0 = wp.cross(r - q, s - q)
    n = wp.vec4d(wp.dot(normal_0, q), -wp.dot(normal_1, p), wp.dot(normal_2, p), -wp.dot(normal_3, p))
    areas = wp.length_sq(normal_0) + wp.length_sq(normal_1) + wp.length_sq(normal_2) + wp.length_sq(normal_3)
    flat = FLAT * size
    if wp.dot(n, n) <= flat * flat * areas:
        return wp.vec4d()
    mean = _HALF * (
        mean_of_edge(c01, wp.dot(p, q))
        + mean_of_edge(c12, wp.dot(q, r))
        + mean_of_edge(c23, wp.dot(r, s))
        + mean_of_edge(c30, wp.dot(s, p))
    )
    g = _ZERO
    if wp.length_sq(s - r) > _ZERO:  # else a triangle, whose last two corners share what they weigh
        g = null_integral(p, q, r, s, n, rule)
    c02 = wp.cross(p, r - p)
    c13 = wp.cross(q, s - q)
    return on_the_corners(n, g, mean, c01, c12, c23, c30, c02, c13)


@wp.func(inline=False)
def quad_weights_in_double(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), quad: wp.vec4i, size: float, near: float):
    """Corner weights of a patch as seen from x, however near, in float64."""
    p = wp.vec3d(vertices[quad[0]]) - wp.vec3d(x)
    q = wp.vec3d(vertices[quad[1]]) - wp.vec3d(x)
    r = wp.vec3d(vertices[quad[2]]) - wp.vec3d(x)
    s = wp.vec3d(vertices[quad[3]]) - wp.vec3d(x)
    rule = patch_rule(p, q, r, s, near)
    result = NearQuad()
    if rule.distance < SNAP * wp.float64(size):
        result.weights = bilinear_basis(rule.center[0], rule.center[1])
        result.touching = 1
    else:
        result.weights = weights_by_rule(p, q, r, s, rule, wp.float64(size))
    return result


@wp.func
def line_of_three(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3, n: wp.vec4, v: float):
    """18 times the integral of g T / |r|^4 over the line of one v, by three nodes."""
    w = 1.0 - v
    low = w * a + v * d
    high = w * b + v * c
    t_low = w * n[2] - v * n[1]
    t_high = v * n[0] - w * n[3]
    g_low = w * n[0] + v * n[3]
    g_high = w * n[1] + v * n[2]
    middle = 0.5 * (low + high)
    off = (0.5 * _OFF) * (high - low)
    t = 0.5 * (t_low + t_high)
    g = 0.5 * (g_low + g_high)
    t_off = (0.5 * _OFF) * (t_high - t_low)
    g_off = (0.5 * _OFF) * (g_high - g_low)
    before = wp.length_sq(middle - off)
    at = wp.length_sq(middle)
    after = wp.length_sq(middle + off)
    outer = (t - t_off) * (g - g_off) / (before * before) + (t + t_off) * (g + g_off) / (after * after)
    return 5.0 * outer + 8.0 * t * g / (at * at)


@wp.func
def far_quad_weights(
    a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3, n: wp.vec4, ab: FaceEdge, bc: FaceEdge, cd: FaceEdge, da: FaceEdge
):
    """Corner weights of a patch clear of the origin and of its plane, with null vector n."""
    outer = line_of_three(a, b, c, d, n, 0.5 - 0.5 * _OFF) + line_of_three(a, b, c, d, n, 0.5 + 0.5 * _OFF)
    g = (5.0 * outer + 8.0 * line_of_three(a, b, c, d, n, 0.5)) * (1.0 / 324.0)
    mean = 0.5 * (ab.mean + bc.mean + cd.mean + da.mean)
    c02 = wp.cross(a, c - a)
    c13 = wp.cross(b, d - b)
    return on_the_corners(n, g, mean, ab.cross, bc.cross, cd.cross, da.cross, c02, c13)


@wp.struct
class QuadPlanes:
    """What all points have in common of a patch: the normals of triangles of all corners but one, and limits."""

    normal_3: wp.vec4  # (b - a) x (c - a); the patch is for float64 where |n|^2 is no more than this
    normal_1: wp.vec4  # (c - a) x (d - a); or where its middle is nearer than the root of this
    normal_2: wp.vec4  # (b - a) x (d - a); det(b - a, c - a, d - a)


@wp.func
def quad_planes(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3, size: float):
    ab = b - a
    ac = c - a
    ad = d - a
    normal_3 = wp.cross(ab, ac)
    normal_1 = wp.cross(ac, ad)
    normal_2 = wp.cross(ab, ad)
    squared = (
        wp.length_sq(normal_3) + wp.length_sq(normal_1) + wp.length_sq(normal_2) + wp.length_sq(wp.cross(c - b, d - b))
    )
    edges = wp.length_sq(ab) + wp.length_sq(ac) + wp.length_sq(ad)
    band = PLANE_BAND * size
    limit = wp.where(squared <= SLIVER * edges * edges, INFINITE, band * band * squared)
    middle = 0.25 * (ab + ac + ad)
    radius = wp.max(
        wp.max(wp.length_sq(middle), wp.length_sq(ab - middle)),
        wp.max(wp.length_sq(ac - middle), wp.length_sq(ad - middle)),
    )
    planes = QuadPlanes()
    planes.normal_3 = wp.vec4(normal_3[0], normal_3[1], normal_3[2], limit)
    planes.normal_1 = wp.vec4(normal_1[0], normal_1[1], normal_1[2], FAR * FAR * radius)
    planes.normal_2 = wp.vec4(normal_2[0], normal_2[1], normal_2[2], wp.dot(normal_3, ad))
    return planes


@wp.func
def null_vector(planes: QuadPlanes, a: wp.vec3):
    n1 = -(planes.normal_1[0] * a[0] + planes.normal_1[1] * a[1] + planes.normal_1[2] * a[2])
    n2 = planes.normal_2[0] * a[0] + planes.normal_2[1] * a[1] + planes.normal_2[2] * a[2]
    n3 = -(planes.normal_3[0] * a[0] + planes.normal_3[1] * a[1] + planes.normal_3[2] * a[2])
    return wp.vec4(planes.normal_2[3] - n1 - n2 - n3, n1, n2, n3)


@wp.func
def is_for_double(planes: QuadPlanes, n: wp.vec4, a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3):
    return wp.dot(n, n) <= planes.normal_3[3] or wp.length_sq(a + b + c + d) < 16.0 * planes.normal_1[3]


@wp.kernel
def prepare_quads(
    first: int,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    size: float,
    planes: wp.array(dtype=wp.vec4),
):
    """planes (3 q,): the fields of QuadPlanes of each patch. size: of the cage."""
    f = first + wp.tid()
    quad = quads[f]
    of_quad = quad_planes(vertices[quad[0]], vertices[quad[1]], vertices[quad[2]], vertices[quad[3]], size)
    planes[3 * f] = of_quad.normal_3
    planes[3 * f + 1] = of_quad.normal_1
    planes[3 * f + 2] = of_quad.normal_2


@wp.func(inline=False)
def quad_position_in_double(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """`quad_mean_value_point` of a point that is not on the cage, in float64."""
    total = _ZERO
    position = wp.vec3d(_ZERO, _ZERO, _ZERO)
    f = int(0)
    while f < quads.shape[0]:
        quad = quads[f]
        w = quad_weights_in_double(x, vertices, quad, size, NEAR_OUTSIDE).weights
        total += w[0] + w[1] + w[2] + w[3]
        for k in range(4):
            position += w[k] * wp.vec3d(targets[quad[k]])
        f += 1
    position = position * wp.where(total == _ZERO, _ZERO, _ONE / total)
    return forward_only(wp.vec4(float(position[0]), float(position[1]), float(position[2]), float(total)), x)


@wp.func
def quad_mean_value_point(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    planes: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """quad_mean_value_position, and the sum of the weights before they are divided by it, 0 on the cage."""
    total = float(0.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    queue = Queue()  # patches for float64, done last: the points of a warp rarely meet theirs at the same patch
    waiting = int(0)
    last = wp.vec4i(-1, -1, -1, -1)
    shared = FaceEdge()  # from c to d of the last quad
    f = int(0)
    while f < quads.shape[0] or waiting > 0:
        while f < quads.shape[0] and waiting < ROOM:
            quad = quads[f]
            a = vec3_entry(vertices, quad[0]) - x
            b = vec3_entry(vertices, quad[1]) - x
            c = vec3_entry(vertices, quad[2]) - x
            d = vec3_entry(vertices, quad[3]) - x
            of_quad = QuadPlanes(
                vec4_entry(planes, 3 * f), vec4_entry(planes, 3 * f + 1), vec4_entry(planes, 3 * f + 2)
            )
            n = null_vector(of_quad, a)
            if is_for_double(of_quad, n, a, b, c, d):
                queue[waiting] = f
                waiting += 1
            else:
                ab = FaceEdge()
                if quad[0] == last[3] and quad[1] == last[2]:  # as in strips (warpcage/coordinates/quad_mean_value.py)
                    ab.cross = -shared.cross
                    ab.mean = -shared.mean
                else:
                    ab = face_edge(a, b)
                shared = face_edge(c, d)
                last = quad
                w = far_quad_weights(a, b, c, d, n, ab, face_edge(b, c), shared, face_edge(d, a))
                total += w[0] + w[1] + w[2] + w[3]
                for k in range(4):
                    position += w[k] * vec3_entry(targets, quad[k])
            f += 1
        while waiting > 0:
            waiting -= 1
            quad = quads[queue[waiting]]
            near = quad_weights_in_double(x, vertices, quad, size, NEAR)
            w = wp.vec4(near.weights)
            along = (
                w[0] * targets[quad[0]] + w[1] * targets[quad[1]] + w[2] * targets[quad[2]] + w[3] * targets[quad[3]]
            )
            if near.touching == 1:
                return forward_only(wp.vec4(along[0], along[1], along[2], 0.0), x)
            total += w[0] + w[1] + w[2] + w[3]
            position += along
    position = position * wp.where(total == 0.0, 0.0, 1.0 / total)
    point = wp.vec4(position[0], position[1], position[2], total)
    if has_cancelled(total, size):
        point = quad_position_in_double(x, vertices, quads, targets, size)
    return forward_only(point, x)


@wp.func
def quad_mean_value_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    planes: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """sum_j w_j(x) targets_j with w the mean value coordinates of x in the cage. planes: see prepare_quads."""
    point = quad_mean_value_point(x, vertices, quads, planes, targets, size)
    return wp.vec3(point[0], point[1], point[2])


@wp.kernel(launch_bounds=(128, 5))
def map_quad_mean_value(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    planes: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    positions: wp.array(dtype=wp.vec3),
):
    """positions (n,) = sum_j w_j(points) targets_j."""
    n = first + wp.tid()
    positions[n] = quad_mean_value_position(points[n], vertices, quads, planes, targets, size)


@wp.kernel
def weigh_quad_mean_value(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    quads: wp.array(dtype=wp.vec4i),
    size: float,
    weights: wp.array2d(dtype=wp.float32),
):
    """weights (n, v): normalised mean value coordinates, whatever the rows held before."""
    n = first + wp.tid()
    x = points[n]
    total = _ZERO
    clear_row(weights, n)
    f = int(0)
    in_double = bool(False)  # for all patches, where what float32 finds cancels
    while f < quads.shape[0]:
        quad = quads[f]
        a = vertices[quad[0]] - x
        b = vertices[quad[1]] - x
        c = vertices[quad[2]] - x
        d = vertices[quad[3]] - x
        planes = quad_planes(a, b, c, d, size)
        null = null_vector(planes, a)
        found = NearQuad()
        if in_double or is_for_double(planes, null, a, b, c, d):
            found = quad_weights_in_double(x, vertices, quad, size, wp.where(in_double, NEAR_OUTSIDE, NEAR))
        else:
            found.weights = wp.vec4d(
                far_quad_weights(a, b, c, d, null, face_edge(a, b), face_edge(b, c), face_edge(c, d), face_edge(d, a))
            )
        w = found.weights
        f += 1
        if found.touching == 1:
            clear_row(weights, n)
            total = _ONE
            in_double = True
            f = quads.shape[0]
        else:
            total += w[0] + w[1] + w[2] + w[3]
        for k in range(4):
            weights[n, quad[k]] = weights[n, quad[k]] + float(w[k])
        if f == quads.shape[0] and not in_double and has_cancelled(float(total), size):
            clear_row(weights, n)
            total = _ZERO
            in_double = True
            f = 0
    scale = wp.where(total == _ZERO, 0.0, float(_ONE / total))
    for j in range(weights.shape[1]):
        weights[n, j] = weights[n, j] * scale
