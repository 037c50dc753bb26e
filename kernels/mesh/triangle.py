"""The point of a triangle nearest to the origin, in float64, for the few faces that lie next to a point."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.func
def nearest_barycentric(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Barycentric coordinates (of a, b, c) of the point nearest to the origin; the triangle must have an area."""
    # Christer Ericson, "Real-Time Collision Detection" (2005), section 5.1.5.
    ab = b - a
    ac = c - a
    d1 = -wp.dot(ab, a)
    d2 = -wp.dot(ac, a)
    d3 = -wp.dot(ab, b)
    d4 = -wp.dot(ac, b)
    d5 = -wp.dot(ab, c)
    d6 = -wp.dot(ac, c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2

    if d1 <= _ZERO and d2 <= _ZERO:
        return wp.vec3d(_ONE, _ZERO, _ZERO)
    if d3 >= _ZERO and d4 <= d3:
        return wp.vec3d(_ZERO, _ONE, _ZERO)
    if d6 >= _ZERO and d5 <= d6:
        return wp.vec3d(_ZERO, _ZERO, _ONE)
    if vc <= _ZERO and d1 >= _ZERO and d3 <= _ZERO:
        t = d1 / (d1 - d3)
        return wp.vec3d(_ONE - t, t, _ZERO)
    if vb <= _ZERO and d2 >= _ZERO and d6 <= _ZERO:
        t = d2 / (d2 - d6)
        return wp.vec3d(_ONE - t, _ZERO, t)
    if va <= _ZERO and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3d(_ZERO, _ONE - t, t)
    scale = _ONE / (va + vb + vc)
    return wp.vec3d(va * scale, vb * scale, vc * scale)
