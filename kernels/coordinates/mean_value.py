"""Mean value coordinates of points in (or around) a closed triangle cage, and the map they give."""

# Floater, Kos and Reimers, "Mean value coordinates in 3D" (CAGD 2005); Ju, Schaefer and Warren, "Mean value coordinates
# for closed triangular meshes" (SIGGRAPH 2005). With a, b, c the corners of a face seen from the point x,
#   C_a = b x c,  C_b = c x a,  C_c = a x b,  beta_i = the angle that C_i spans,
#   m = 1/2 sum_i beta_i C_i / |C_i|          (integral of the unit directions over the face's solid angle),
#   weight_i = (C_i . m) / det(a, b, c),      summed over faces, then divided by the sum over vertices.
# On the cage it tends to the linear interpolation on the face: points within SNAP of the size take that. One unit for
# points (n,), vertices, targets (v,) and size, the longest side; keep them near the origin (float32).

import warp as wp

from ..core.gradients import add_slope, forward_only_in, gradient_of
from ..core.loads import reciprocal_root, vec3_entry, vec3i_entry, vec4_entry
from ..mesh.fans import near_plane_limit
from ..mesh.triangle import nearest_barycentric
from .face_slopes import STEP_INSIDE, distance_to_face, mean_value_slopes, off_the_plane

# so many registers per thread that larger blocks would fill a GPU less well
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})


@wp.struct
class ExactPoint:
    """A point in float64, off the cage."""

    place: wp.vec3d
    position: wp.vec3d
    total: wp.float64  # sum of the weights


forward_only = forward_only_in(
    __name__,
    (wp.vec3, wp.vec3),
    (wp.vec4, wp.vec3),
    (wp.vec3d, wp.vec3),
    (wp.float64, wp.vec3),
    (wp.array2d(dtype=wp.float32),),
)

#: Every face takes the float64 path where the sum of weights is between these over the size, as it is well outside.
CANCELLED = wp.constant(10.0)
MIN_INSIDE = wp.constant(5.0)

#: Points this close to a face, as a share of the size, count as on it.
SNAP = wp.constant(wp.float64(1.0e-6))

#: A face whose plane is this close, seen from beside it, spans no solid angle.
FLAT = wp.constant(wp.float64(1.0e-11))
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TINY = wp.constant(wp.float64(1.0e-200))


@wp.struct
class NearFace:
    weights: wp.vec3  # of the three corners; barycentric coordinates where the point lies on the face
    touching: int


@wp.func
def weights_in_double(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, det: wp.float64):
    """Weights of the corners p, q, r of a face, det = det(p, q, r) not being zero."""
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
    return wp.vec3d(wp.dot(cross_p, mean) * scale, wp.dot(cross_q, mean) * scale, wp.dot(cross_r, mean) * scale)


@wp.func(inline=False)
def far_face_weights_in_double(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """Weights of the corners a, b, c of a face as seen from x, which is not on it."""
    p = wp.vec3d(a) - wp.vec3d(x)
    q = wp.vec3d(b) - wp.vec3d(x)
    r = wp.vec3d(c) - wp.vec3d(x)
    normal = wp.cross(q - p, r - p)
    det = wp.dot(normal, p)
    if wp.abs(det) <= FLAT * wp.float64(size) * wp.length(normal):
        return wp.vec3d(_ZERO, _ZERO, _ZERO)
    return weights_in_double(p, q, r, det)


@wp.func(inline=False)
def near_face_weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """Corner weights of a face whose plane passes next to the origin, in float64, as it is ill-conditioned."""
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
    result.weights = wp.vec3(weights_in_double(p, q, r, det))
    return result


@wp.struct
class FaceEdge:
    """The edge from b to c of a face, seen from the point."""

    cross: wp.vec3  # C = b x c
    mean: wp.vec3  # beta C / |C|, with beta the angle that b and c span


@wp.func
def angle_over_sine(cosine: float):
    """acos(t) / sqrt(1 - t^2) for t in [0, 1], to 2e-7: a polynomial, interpolated at Chebyshev nodes."""
    p = 0.0171853692 * cosine - 0.0960763046
    p = p * cosine + 0.2501265289
    p = p * cosine - 0.4218957183
    p = p * cosine + 0.5557489579
    p = p * cosine - 0.6607586189
    p = p * cosine + 0.7848538133
    p = p * cosine - 0.9999801696
    return p * cosine + 1.5707962051


@wp.func
def face_edge(b: wp.vec3, c: wp.vec3):
    """The edge from b to c, without division or branch: beta / |C| is angle_over_sine(|cos beta|) / (|b| |c|), and for
    obtuse angles, whose sine the cosine does not give, pi / |C| less that."""
    edge = FaceEdge()
    edge.cross = wp.cross(b, c - b)
    squared = wp.dot(edge.cross, edge.cross)
    product = wp.dot(b, c)
    inverse = reciprocal_root(squared + product * product)
    acute = inverse * angle_over_sine(wp.abs(product) * inverse)
    obtuse = 3.1415926536 * reciprocal_root(squared) - acute
    edge.mean = edge.cross * wp.where(product < 0.0, obtuse, acute)
    return edge


@wp.func
def far_face_weights(edge_ba: FaceEdge, edge_bc: FaceEdge, edge_ca: FaceEdge, det: float):
    """Weights of the corners a, b, c of a face clear of the origin's plane; det = det(a, b, c). The first edge is as
    the face across it has it."""
    # Cross products are taken with the edges, b x c = b x (c - b): float32 keeps what is small beside the distances.
    mean = edge_bc.mean + edge_ca.mean - edge_ba.mean
    return wp.vec3(wp.dot(edge_bc.cross, mean), wp.dot(edge_ca.cross, mean), -wp.dot(edge_ba.cross, mean)) * (
        0.5 * (1.0 / det)
    )


@wp.func
def face_weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """Corner weights of the face a, b, c as seen from the origin, and whether the origin lies on it."""
    edge_b = b - a
    edge_c = c - a
    normal = wp.cross(edge_b, edge_c)
    det = wp.dot(normal, a)
    result = NearFace()
    if det * det <= near_plane_limit(normal, edge_b, edge_c, size):
        result = near_face_weights(a, b, c, size)
    else:
        result.weights = far_face_weights(face_edge(b, a), face_edge(b, c), face_edge(c, a), det)
    return result


@wp.func
def has_cancelled(total: float, size: float):
    """Whether the weights, of this sum, cancel, as they do well outside the cage, where it is negative save for
    rounding: all faces are for float64 then. Inside it is the integral of 1 / distance, 7 / size or more."""
    return total * size > -CANCELLED and total * size < MIN_INSIDE


@wp.func(inline=False)
def position_in_double(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """`mean_value_position` of a point that is not on the cage, in float64."""
    total = _ZERO
    position = wp.vec3d(_ZERO, _ZERO, _ZERO)
    for f in range(faces.shape[0]):
        face = faces[f]
        weights = far_face_weights_in_double(x, vertices[face[0]], vertices[face[1]], vertices[face[2]], size)
        total += weights[0] + weights[1] + weights[2]
        for k in range(3):
            position += weights[k] * wp.vec3d(targets[face[k]])
    return forward_only(wp.vec3(position * wp.where(total == _ZERO, _ZERO, _ONE / total)), x)


@wp.func
def clear_row(weights: wp.array2d(dtype=wp.float32), n: int):
    for j in range(weights.shape[1]):
        weights[n, j] = 0.0


@wp.func
def add_corners(weights: wp.array2d(dtype=wp.float32), n: int, face: wp.vec3i, corner_weights: wp.vec3):
    """Add to row n, which one item owns, at the corners of a face."""
    for k in range(3):
        weights[n, face[k]] = weights[n, face[k]] + corner_weights[k]


@wp.func(inline=False)
def weigh_in_double(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    size: float,
    weights: wp.array2d(dtype=wp.float32),
    n: int,
):
    """Row n of normalised weights of a point that is not on the cage, each face in float64."""
    total = _ZERO
    for f in range(faces.shape[0]):
        face = faces[f]
        w = far_face_weights_in_double(x, vertices[face[0]], vertices[face[1]], vertices[face[2]], size)
        total += w[0] + w[1] + w[2]
    scale = wp.where(total == _ZERO, _ZERO, _ONE / total)
    clear_row(weights, n)
    for f in range(faces.shape[0]):
        face = faces[f]
        w = far_face_weights_in_double(x, vertices[face[0]], vertices[face[1]], vertices[face[2]], size)
        add_corners(weights, n, face, wp.vec3(scale * w))
    forward_only(weights)


@wp.func
def mean_value_point(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """mean_value_position, and the sum of the weights before they are divided by it: 0 where the point lies on the
    cage, or all faces were for float64."""
    total = float(0.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    waiting = int(-1)  # faces for float64, done last: the points of a warp rarely meet theirs at the same face
    next_waiting = int(-1)
    f = int(0)
    while f < faces.shape[0] or waiting >= 0:
        if f < faces.shape[0]:
            face = vec3i_entry(faces, f)
            a = vec3_entry(vertices, face[0]) - x
            b = vec3_entry(vertices, face[1]) - x
            target_a = vec3_entry(targets, face[0])
            target_b = vec3_entry(targets, face[1])
            edge_ba = face_edge(b, a)
            index = int(0)
            while index >= 0 and next_waiting < 0:
                corner = vec4_entry(fans, 2 * f)
                plane = vec4_entry(fans, 2 * f + 1)
                index = wp.cast(corner[3], int)
                c = wp.vec3(corner[0], corner[1], corner[2]) - x
                target_c = vec3_entry(targets, wp.where(index < 0, -1 - index, index))
                edge_bc = face_edge(b, c)
                edge_ca = face_edge(c, a)
                det = plane[0] * c[0] + plane[1] * c[1] + plane[2] * c[2]
                if det * det > plane[3]:
                    w = far_face_weights(edge_ba, edge_bc, edge_ca, det)
                    total += w[0] + w[1] + w[2]
                    position += w[0] * target_a
                    position += w[1] * target_b
                    position += w[2] * target_c
                else:
                    next_waiting = waiting
                    waiting = f
                b = c
                target_b = target_c
                edge_ba = edge_ca
                f += 1
        if waiting >= 0 and (next_waiting >= 0 or f >= faces.shape[0]):
            face = faces[waiting]
            waiting = next_waiting
            next_waiting = -1
            near = near_face_weights(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
            w = near.weights
            along = w[0] * targets[face[0]] + w[1] * targets[face[1]] + w[2] * targets[face[2]]
            if near.touching == 1:
                return forward_only(wp.vec4(along[0], along[1], along[2], 0.0), x)
            total += w[0] + w[1] + w[2]
            position += along
    if has_cancelled(total, size):
        position = position_in_double(x, vertices, faces, targets, size)
        total = 0.0
    else:
        position = position * wp.where(total == 0.0, 0.0, 1.0 / total)
    return forward_only(wp.vec4(position[0], position[1], position[2], total), x)


@wp.func
def mean_value_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """sum_j w_j(x) targets_j with w the mean value coordinates of x in the cage `vertices`. fans: see prepare_fans."""
    point = mean_value_point(x, vertices, faces, fans, targets, size)
    return wp.vec3(point[0], point[1], point[2])


@wp.func
def exact_point(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """mean_value_position of x in float64, of a point on the cage STEP_INSIDE it, where slopes jump."""
    result = ExactPoint()
    result.place = wp.vec3d(x)
    unit = wp.float64(size)
    for f in range(faces.shape[0]):
        face = faces[f]
        p = wp.vec3d(vertices[face[0]]) - wp.vec3d(x)
        q = wp.vec3d(vertices[face[1]]) - wp.vec3d(x)
        r = wp.vec3d(vertices[face[2]]) - wp.vec3d(x)
        if distance_to_face(p, q, r) < SNAP * unit:
            result.place = wp.vec3d(x) - wp.normalize(wp.cross(q - p, r - p)) * (STEP_INSIDE * unit)
    for f in range(faces.shape[0]):
        face = faces[f]
        p = wp.vec3d(vertices[face[0]]) - result.place
        q = wp.vec3d(vertices[face[1]]) - result.place
        r = wp.vec3d(vertices[face[2]]) - result.place
        normal = wp.cross(q - p, r - p)
        det = wp.dot(normal, p)
        if wp.abs(det) > FLAT * unit * wp.length(normal):
            w = weights_in_double(p, q, r, det)
            result.total += w[0] + w[1] + w[2]
            result.position += w[0] * wp.vec3d(targets[face[0]])
            result.position += w[1] * wp.vec3d(targets[face[1]])
            result.position += w[2] * wp.vec3d(targets[face[2]])
    result.place = forward_only(result.place, x)
    result.position = forward_only(result.position / result.total, x)
    result.total = forward_only(result.total, x)
    return result


@gradient_of(face_weights, NearFace)
def grad_face_weights(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float, grad: NearFace):
    """Slopes by the corners; NaN where the origin lies on the face, where the weights alone have none."""
    p = wp.vec3d(a)
    q = wp.vec3d(b)
    r = wp.vec3d(c)
    if distance_to_face(p, q, r) < SNAP * wp.float64(size):
        nan = wp.vec3(wp.nan, wp.nan, wp.nan)
        wp.adjoint[a] += nan
        wp.adjoint[b] += nan
        wp.adjoint[c] += nan
    else:
        off = off_the_plane(p, q, r, wp.float64(size))
        slopes = mean_value_slopes(p + off, q + off, r + off, wp.vec3d(grad.weights))
        wp.adjoint[a] += wp.vec3(slopes.p)
        wp.adjoint[b] += wp.vec3(slopes.q)
        wp.adjoint[c] += wp.vec3(slopes.r)


@gradient_of(mean_value_position, wp.vec3)
def grad_mean_value_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    grad: wp.vec3,
):
    """Slopes by the point, the cage (not its fans, which are the same once more) and the targets, in float64. On the
    cage they are those STEP_INSIDE it."""
    unit = wp.float64(size)
    point = exact_point(x, vertices, faces, targets, size)
    y = point.place
    position = point.position
    slope = wp.vec3d(grad) / point.total
    by_point = wp.vec3d(_ZERO, _ZERO, _ZERO)
    for f in range(faces.shape[0]):
        face = faces[f]
        p = wp.vec3d(vertices[face[0]]) - y
        q = wp.vec3d(vertices[face[1]]) - y
        r = wp.vec3d(vertices[face[2]]) - y
        by_weights = wp.vec3d(
            wp.dot(slope, wp.vec3d(targets[face[0]]) - position),
            wp.dot(slope, wp.vec3d(targets[face[1]]) - position),
            wp.dot(slope, wp.vec3d(targets[face[2]]) - position),
        )
        normal = wp.cross(q - p, r - p)
        det = wp.dot(normal, p)
        if wp.length(normal) > _ZERO:
            off = off_the_plane(p, q, r, unit)
            slopes = mean_value_slopes(p + off, q + off, r + off, by_weights)
            by_point -= slopes.p + slopes.q + slopes.r
            add_slope(vertices, wp.adjoint[vertices], face[0], wp.vec3(slopes.p))
            add_slope(vertices, wp.adjoint[vertices], face[1], wp.vec3(slopes.q))
            add_slope(vertices, wp.adjoint[vertices], face[2], wp.vec3(slopes.r))
        if wp.abs(det) > FLAT * unit * wp.length(normal):
            w = weights_in_double(p, q, r, det)
            add_slope(targets, wp.adjoint[targets], face[0], wp.vec3(w[0] * slope))
            add_slope(targets, wp.adjoint[targets], face[1], wp.vec3(w[1] * slope))
            add_slope(targets, wp.adjoint[targets], face[2], wp.vec3(w[2] * slope))
    wp.adjoint[x] += wp.vec3(by_point)


@wp.kernel(launch_bounds=(128, 5))
def map_mean_value(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    positions: wp.array(dtype=wp.vec3),
):
    """positions (n,) = sum_j w_j(points) targets_j."""
    n = first + wp.tid()
    positions[n] = mean_value_position(points[n], vertices, faces, fans, targets, size)


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
    touched = int(-1)
    clear_row(weights, n)
    for f in range(faces.shape[0]):
        face = faces[f]
        near = face_weights(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
        if near.touching == 1:
            touched = f
            break
        add_corners(weights, n, face, near.weights)
        total += near.weights[0] + near.weights[1] + near.weights[2]
    if touched >= 0:
        face = faces[touched]
        near = near_face_weights(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
        clear_row(weights, n)
        add_corners(weights, n, face, near.weights)
    elif has_cancelled(total, size):
        weigh_in_double(x, vertices, faces, size, weights, n)
    else:
        scale = wp.where(total == 0.0, 0.0, 1.0 / total)
        for j in range(weights.shape[1]):
            weights[n, j] = weights[n, j] * scale
