"""Inside or outside of a closed triangle cage, and distance to it."""

# Winding number: sum of signed solid angles (Van Oosterom and Strackee 1983) / 4 pi, 1 inside faces counterclockwise
# seen from outside, 0 outside (Jacobson et al., "Robust Inside-Outside Segmentation using Generalized Winding Numbers",
# SIGGRAPH 2013). Closest point: Ericson, "Real-Time Collision Detection" (2005), section 5.1.5. vertices (v,) vec3,
# faces (f,) vec3i, points (n,) vec3, from one origin. Points visit every face: for a few hundred.

import warp as wp

from ..core.gradients import forward_only_in

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3))


@wp.func
def closest_point_on_triangle(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The point of triangle abc nearest to x."""
    ab = b - a
    ac = c - a
    ax = x - a
    d1 = wp.dot(ab, ax)
    d2 = wp.dot(ac, ax)
    if d1 <= 0.0 and d2 <= 0.0:
        return a

    bx = x - b
    d3 = wp.dot(ab, bx)
    d4 = wp.dot(ac, bx)
    if d3 >= 0.0 and d4 <= d3:
        return b

    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return a + ab * (d1 / wp.max(d1 - d3, 1.0e-30))

    cx = x - c
    d5 = wp.dot(ab, cx)
    d6 = wp.dot(ac, cx)
    if d6 >= 0.0 and d5 <= d6:
        return c

    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return a + ac * (d2 / wp.max(d2 - d6, 1.0e-30))

    va = d3 * d6 - d5 * d4
    along = d4 - d3
    across = d5 - d6
    if va <= 0.0 and along >= 0.0 and across >= 0.0:
        return b + (c - b) * (along / wp.max(along + across, 1.0e-30))

    scale = 1.0 / wp.max(va + vb + vc, 1.0e-30)
    return a + ab * (vb * scale) + ac * (vc * scale)


@wp.func
def triangle_distance_squared(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Squared distance from x to triangle abc."""
    return wp.length_sq(x - closest_point_on_triangle(x, a, b, c))


@wp.func
def solid_angle(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Signed solid angle of triangle abc seen from x, positive where x lies behind the face."""
    u = a - x
    v = b - x
    w = c - x
    lu = wp.length(u)
    lv = wp.length(v)
    lw = wp.length(w)
    # cross products of differences: the triple product of near points keeps its digits
    volume = wp.dot(u, wp.cross(v - u, w - u))
    cosine = lu * lv * lw + wp.dot(u, v) * lw + wp.dot(v, w) * lu + wp.dot(w, u) * lv
    return 2.0 * wp.atan2(volume, cosine)


@wp.func
def winding_number(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i)):
    """Winding number of the cage around x: 1 inside, 0 outside, fractions on the surface."""
    total = float(0.0)
    for f in range(faces.shape[0]):
        face = faces[f]
        total += solid_angle(x, vertices[face[0]], vertices[face[1]], vertices[face[2]])
    return total / (4.0 * wp.pi)


@wp.func
def cage_distance(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i)):
    """Unsigned distance from x to the nearest face."""
    nearest = float(1.0e30)
    for f in range(faces.shape[0]):
        face = faces[f]
        nearest = wp.min(nearest, triangle_distance_squared(x, vertices[face[0]], vertices[face[1]], vertices[face[2]]))
    return forward_only(wp.sqrt(nearest), x)


@wp.kernel
def measure_winding_number(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    winding: wp.array(dtype=float),
):
    """Winding number (n,) of the cage around points (n,)."""
    n = first + wp.tid()
    winding[n] = winding_number(points[n], vertices, faces)


@wp.kernel
def measure_distance(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    distance: wp.array(dtype=float),
):
    """Unsigned distance (n,) from points (n,) to the nearest face."""
    n = first + wp.tid()
    distance[n] = cage_distance(points[n], vertices, faces)
