"""Mean value coordinates of points and their gradients, in float64: rows by which points are carried with a cage."""

# Floater, Kos and Reimers, "Mean value coordinates in 3D" (CAGD 2005), in the form of coordinates/mean_value. With a,
# b, c the corners of a face seen from the point x, C_a = b x c, beta_a the angle between b and c, n_a = C_a / |C_a|,
# m = sum_i beta_i n_i and D = det(a, b, c) = N . a, a face gives corner a the weight w_a = C_a . m / (2 D). Corners
# move by -dx where x moves by dx, so that
#
#   d C_a = dx x (b - c),    d beta_a = (n_a x (b / |b|^2 - c / |c|^2)) . dx,    d D = -N . dx,
#   d (beta n) = n d beta + beta / |C| (d C - n (n . d C)),
#   grad w_a = ((b - c) x m + (d m)^T C_a) / (2 D) + w_a N / D,
#
# and with W the sum over vertices, lambda = w / W has grad lambda = (grad w - lambda grad W) / W.
#
# Shapes: points (m,), vertices (v,), faces (f,), one unit of length, in which the cage's longest side is about 1.
# Points lie inside, no nearer to a face than 1e-6.

import warp as wp

# one item writes a column of its own; two of its many numbers are needed at a time, so that registers matter little
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
    # dC = dx x (b - c) is the matrix -[b - c]_x
    d_cross = -wp.skew(b - c)
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
