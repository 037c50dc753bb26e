"""Mean value coordinates of points in (or around) a closed triangle cage, and the map they give.

Floater, Kos and Reimers, "Mean value coordinates in 3D" (CAGD 2005); Ju, Schaefer and Warren, "Mean value coordinates
for closed triangular meshes" (SIGGRAPH 2005). With a, b, c the corners of a face seen from the point x,

    C_a = b x c,  C_b = c x a,  C_c = a x b,  beta_i = the angle that C_i spans,
    m = 1/2 sum_i beta_i C_i / |C_i|          (integral of the unit directions over the face's solid angle),
    weight_i = (C_i . m) / det(a, b, c),      summed over faces, then divided by the sum over vertices.

The determinant is the distance to the plane times twice the face's area, and the cross products are taken with the
edges (b x c = b x (c - b)), so that float32 does not lose what is small beside the distances. What stays
ill-conditioned, faces whose plane passes within PLANE_BAND of the size, goes through float64. Well outside the cage,
where the contributions of its near and far side cancel, a second pass takes every face that way.

Defined everywhere but on the cage, where it tends to the linear interpolation on the face: points within SNAP of the
size take that. Shapes: points (n,), vertices and targets (v,), faces (f,); one unit of length for points, vertices and
size, which is the longest side of the vertices' bounding box. Keep coordinates near the origin (float32).
Siblings: entries, triangle.
"""

import warp as wp

from .entries import reciprocal_root, vec3_entry, vec3i_entry
from .triangle import nearest_barycentric

# so many registers a thread that larger blocks fill a GPU worse
wp.set_module_options({"enable_backward": False, "fast_math": True, "block_dim": 128})

#: Faces whose plane passes closer than this share of the size take the float64 path.
PLANE_BAND = wp.constant(1.0e-3)
#: So do faces lower than about the square root of this share of their length: their normal has few digits in float32.
SLIVER = wp.constant(1.0e-6)
#: And every face where the weights sum to less than CANCELLED / size, as they do well outside.
WIDE_BAND = wp.constant(1.0e4)
CANCELLED = wp.constant(10.0)
#: Points this close to a face, as a share of the size, count as on it.
SNAP = wp.constant(wp.float64(1.0e-6))
#: A face whose plane is this close, seen from beside it, spans no solid angle.
FLAT = wp.constant(wp.float64(1.0e-11))

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_TINY = wp.constant(wp.float64(1.0e-200))


@wp.struct
class NearFace:
    weights: wp.vec3  # of the three corners; barycentric coordinates where the point lies on the face
    touching: int


@wp.func(inline=False)
def near_face_weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """Corner weights of a face whose plane passes next to the origin, in float64."""
    p = wp.vec3d(a)
    q = wp.vec3d(b)
    r = wp.vec3d(c)
    normal = wp.cross(q - p, r - p)
    double_area = wp.length(normal)
    det = wp.dot(normal, p)
    height = wp.abs(det)  # times double_area
    unit = wp.float64(size) * double_area
    result = NearFace()
    if double_area == _ZERO:
        return result
    if height < SNAP * unit:
        nearest = nearest_barycentric(p, q, r)
        if wp.length(nearest[0] * p + nearest[1] * q + nearest[2] * r) < SNAP * wp.float64(size):
            result.weights = wp.vec3(nearest)
            result.touching = 1
            return result
        if height < FLAT * unit:
            return result
    cross_p = wp.cross(q, r - q)
    cross_q = wp.cross(r, p - r)
    cross_r = wp.cross(p, q - p)
    sine_p = wp.length(cross_p) + _TINY
    sine_q = wp.length(cross_q) + _TINY
    sine_r = wp.length(cross_r) + _TINY
    mean = (
        cross_p * (wp.atan2(sine_p, wp.dot(q, r)) / sine_p)
        + cross_q * (wp.atan2(sine_q, wp.dot(r, p)) / sine_q)
        + cross_r * (wp.atan2(sine_r, wp.dot(p, q)) / sine_r)
    )
    scale = _HALF / det
    result.weights = wp.vec3(
        wp.vec3d(wp.dot(cross_p, mean) * scale, wp.dot(cross_q, mean) * scale, wp.dot(cross_r, mean) * scale)
    )
    return result


@wp.func
def positive_angle(sine: float, cosine: float):
    """atan2(sine, cosine) for sine > 0, to 2e-7, without branches or special cases.

    atan t = t + t^3 p(t^2) on [0, 1], p interpolated at Chebyshev nodes.
    """
    across = wp.abs(cosine)
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
    return wp.where(cosine < 0.0, 3.141592653589793 - angle, angle)


@wp.func
def far_face_weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, edge_b: wp.vec3, edge_c: wp.vec3, det: float):
    """Corner weights of a face clear of the origin's plane; edge_b = b - a, edge_c = c - a, det = det(a, b, c)."""
    cross_a = wp.cross(b, c - b)
    cross_b = wp.cross(edge_c, c)
    cross_c = wp.cross(a, edge_b)
    squared_a = wp.dot(cross_a, cross_a)
    squared_b = wp.dot(cross_b, cross_b)
    squared_c = wp.dot(cross_c, cross_c)
    inverse_a = reciprocal_root(squared_a)
    inverse_b = reciprocal_root(squared_b)
    inverse_c = reciprocal_root(squared_c)
    mean = (
        cross_a * (positive_angle(squared_a * inverse_a, wp.dot(b, c)) * inverse_a)
        + cross_b * (positive_angle(squared_b * inverse_b, wp.dot(c, a)) * inverse_b)
        + cross_c * (positive_angle(squared_c * inverse_c, wp.dot(a, b)) * inverse_c)
    )
    return wp.vec3(wp.dot(cross_a, mean), wp.dot(cross_b, mean), wp.dot(cross_c, mean)) * (0.5 / det)


@wp.func
def near_plane(a: wp.vec3, normal: wp.vec3, edge_b: wp.vec3, edge_c: wp.vec3, det: float, band: float):
    """Whether a face with corner a, edges edge_b and edge_c from there, and their cross product `normal` is one for
    float64: its plane passes within `band` of the origin, or its normal has few digits."""
    squared = wp.dot(normal, normal)
    edges = wp.dot(edge_b, edge_b) + wp.dot(edge_c, edge_c)
    return det * det <= band * band * squared or squared <= SLIVER * edges * edges


@wp.func
def face_weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float, share: float):
    """Corner weights of the face a, b, c as seen from the origin, and whether the origin lies on it.

    share: of the size, the height above the plane up to which float64 is used.
    """
    edge_b = b - a
    edge_c = c - a
    normal = wp.cross(edge_b, edge_c)
    det = wp.dot(normal, a)
    result = NearFace()
    if near_plane(a, normal, edge_b, edge_c, det, share * size):
        result = near_face_weights(a, b, c, size)
    else:
        result.weights = far_face_weights(a, b, c, edge_b, edge_c, det)
    return result


@wp.func
def needs_wide_band(total: float, size: float, share: float):
    """Whether the weights, of this sum, came from a first pass and cancelled; they are negative outside the cage."""
    return share < WIDE_BAND and total * size > -CANCELLED and total <= 0.0


@wp.func
def mean_value_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """sum_j w_j(x) targets_j with w the mean value coordinates of x in the cage `vertices`.

    Faces for float64 wait until the others are done: the points of a warp rarely meet theirs at the same face.
    """
    total = float(0.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    share = float(PLANE_BAND)
    waiting = wp.uint64(0)  # up to four faces, 16 bits each: their number plus one
    going = int(1)
    while going == 1:
        band = share * size
        f = int(0)
        while f < faces.shape[0] or waiting != wp.uint64(0):
            # the float32 faces up to the next that must be looked at in float64 now: the waiting ones have no room or
            # all others are done
            number = int(-1)
            while f < faces.shape[0] and number < 0:
                face = vec3i_entry(faces, f)
                a = vec3_entry(vertices, face[0]) - x
                b = vec3_entry(vertices, face[1]) - x
                c = vec3_entry(vertices, face[2]) - x
                edge_b = b - a
                edge_c = c - a
                normal = wp.cross(edge_b, edge_c)
                det = wp.dot(normal, a)
                if not near_plane(a, normal, edge_b, edge_c, det, band):
                    w = far_face_weights(a, b, c, edge_b, edge_c, det)
                    total += w[0] + w[1] + w[2]
                    position += w[0] * vec3_entry(targets, face[0])
                    position += w[1] * vec3_entry(targets, face[1])
                    position += w[2] * vec3_entry(targets, face[2])
                elif f < 0xFFFF and (waiting >> wp.uint64(48)) == wp.uint64(0):
                    waiting = (waiting << wp.uint64(16)) | wp.uint64(f + 1)
                else:
                    number = f
                f += 1
            if number < 0 and waiting != wp.uint64(0):
                number = int(waiting & wp.uint64(0xFFFF)) - 1
                waiting = waiting >> wp.uint64(16)
            if number >= 0:
                face = faces[number]
                near = near_face_weights(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
                w = near.weights
                along = w[0] * targets[face[0]] + w[1] * targets[face[1]] + w[2] * targets[face[2]]
                if near.touching == 1:
                    return along
                total += w[0] + w[1] + w[2]
                position += along
        going = 0
        if needs_wide_band(total, size, share):
            share = WIDE_BAND
            total = 0.0
            position = wp.vec3(0.0, 0.0, 0.0)
            going = 1
    return position * wp.where(total == 0.0, 0.0, 1.0 / total)


@wp.kernel(launch_bounds=(128, 5))
def map_mean_value(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    positions: wp.array(dtype=wp.vec3),
):
    """positions (n,) = sum_j w_j(points) targets_j."""
    n = first + wp.tid()
    positions[n] = mean_value_position(points[n], vertices, faces, targets, size)


@wp.func
def clear_row(weights: wp.array2d(dtype=wp.float32), n: int):
    for j in range(weights.shape[1]):
        weights[n, j] = 0.0


@wp.func
def add_corners(weights: wp.array2d(dtype=wp.float32), n: int, face: wp.vec3i, corner_weights: wp.vec3):
    """Add to row n, which one item owns, at the corners of a face."""
    for k in range(3):
        weights[n, face[k]] = weights[n, face[k]] + corner_weights[k]


@wp.kernel
def weigh_mean_value(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    size: float,
    weights: wp.array2d(dtype=wp.float32),
):
    """weights (n, v): normalised mean value coordinates, whatever the rows held before."""
    n = first + wp.tid()
    x = points[n]
    total = float(0.0)
    share = float(PLANE_BAND)
    touched = int(-1)
    f = int(0)
    while f < faces.shape[0]:
        if f == 0:
            total = 0.0
            clear_row(weights, n)
        face = faces[f]
        near = face_weights(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size, share)
        if near.touching == 1:
            touched = f
            break
        add_corners(weights, n, face, near.weights)
        total += near.weights[0] + near.weights[1] + near.weights[2]
        f += 1
        if f == faces.shape[0] and needs_wide_band(total, size, share):
            share = WIDE_BAND
            f = 0
    if touched >= 0:
        face = faces[touched]
        near = face_weights(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size, share)
        clear_row(weights, n)
        add_corners(weights, n, face, near.weights)
        total = 1.0
    scale = wp.where(total == 0.0, 0.0, 1.0 / total)
    for j in range(weights.shape[1]):
        weights[n, j] = weights[n, j] * scale
