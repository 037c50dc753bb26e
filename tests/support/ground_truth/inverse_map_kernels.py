"""The inverse of a cage's map in float64: which point of the deformed cage a point of the rest cage comes from."""

# A Deformer maps posed space to rest space, x -> sum_j w_j(x) v_j with coordinates of the *deformed* cage; matter at p
# at rest is seen at the x that is mapped to p, which Newton's iteration finds. Coordinates of the rest cage applied to
# the deformed one, a different map, are the first guess.
# Mean value coordinates are as in mean_value; Green (Lipman, Levin and Cohen-Or 2008) and harmonic ones are layer
# potentials: over triangles, the double layer of linear data plus the single layer of a constant density. These are the
# cage's faces and the stretched normals, or pieces of faces and the fluxes of boundary elements (collocation at
# centroids). With a, b, c the corners seen from x, m_e the outward normal of edge e in the plane, d_e the distance of
# the foot point behind it, L_e = log((r + s + l) / (r + s - l)), h the signed height and Omega the signed solid angle,
#   psi = (sum_e d_e L_e - h Omega) / 4 pi,    phi_i = (lambda_i Omega - h grad(lambda_i) . sum_e m_e L_e) / 4 pi.
# Written for accuracy at points clear of the cage, not for speed. Corners are (f, 3), in one unit of length.

import warp as wp

from warpcage.kernels.core.gradients import forward_only_in

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.vec3d, wp.vec3d))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))
_TWO = wp.constant(wp.float64(2.0))
_PI = wp.constant(wp.float64(3.141592653589793))
_TINY = wp.constant(wp.float64(1.0e-300))
_INVERSE_FOUR_PI = wp.constant(wp.float64(0.07957747154594767))

#: Differences for the Jacobian, as a share of the size: one-sided while iterating, central at the end.
_NEWTON_DIFFERENCE = wp.constant(wp.float64(1.0e-7))
_CENTRAL_DIFFERENCE = wp.constant(wp.float64(1.0e-5))
NEWTON_STEPS = wp.constant(40)
HALVINGS = wp.constant(12)


@wp.struct
class ExactMap:
    corners: wp.array2d(dtype=wp.vec3d)  # (f, 3) of the deformed cage
    data: wp.array2d(dtype=wp.vec3d)  # (f, 3) the corners in the rest cage
    density: wp.array(dtype=wp.vec3d)  # (f,) single layer; not used by mean value coordinates
    is_mean_value: int
    size: wp.float64


@wp.struct
class Layers:
    phi: wp.vec3d  # of the three corners
    psi: wp.float64


@wp.func
def mean_value_weights(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Corner weights of a face seen from the origin; zero where the origin is in its plane."""
    det = wp.dot(a, wp.cross(b, c))
    cross_a = wp.cross(b, c - b)
    cross_b = wp.cross(c, a - c)
    cross_c = wp.cross(a, b - a)
    sine_a = wp.length(cross_a)
    sine_b = wp.length(cross_b)
    sine_c = wp.length(cross_c)
    weights = wp.vec3d(_ZERO, _ZERO, _ZERO)
    if wp.abs(det) > _TINY and sine_a * sine_b * sine_c > _TINY:
        mean = (
            cross_a * (wp.atan2(sine_a, wp.dot(b, c)) / sine_a)
            + cross_b * (wp.atan2(sine_b, wp.dot(c, a)) / sine_b)
            + cross_c * (wp.atan2(sine_c, wp.dot(a, b)) / sine_c)
        )
        weights = wp.vec3d(wp.dot(cross_a, mean), wp.dot(cross_b, mean), wp.dot(cross_c, mean)) * (_HALF / det)
    return weights


@wp.func
def edge_logarithm(p: wp.vec3d, q: wp.vec3d):
    """L_e of the edge from p to q seen from the origin."""
    length = wp.length(q - p)
    around = wp.length(p) + wp.length(q)
    return wp.log((around + length) / wp.max(around - length, _TINY))


@wp.func
def triangle_layers(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, on_triangle: int):
    """Layer potentials of a triangle at the origin. on_triangle: 1 where the origin lies on the triangle and takes the
    limit from behind."""
    normal = wp.cross(b - a, c - a)
    double_area = wp.length(normal)
    normal = normal / double_area
    height = wp.dot(normal, a)
    length_a = wp.length(a)
    length_b = wp.length(b)
    length_c = wp.length(c)
    below = length_a * length_b * length_c + wp.dot(b, c) * length_a + wp.dot(c, a) * length_b + wp.dot(a, b) * length_c
    omega = _TWO * wp.atan2(height * double_area, below)
    if on_triangle == 1:
        omega = _TWO * _PI
        height = _ZERO
    # edge i lies opposite to corner i; out_i has the length of that edge
    out_a = wp.cross(c - b, normal)
    out_b = wp.cross(a - c, normal)
    out_c = wp.cross(b - a, normal)
    log_a = edge_logarithm(b, c) / wp.length(out_a)
    log_b = edge_logarithm(c, a) / wp.length(out_b)
    log_c = edge_logarithm(a, b) / wp.length(out_c)
    rim = wp.vec3d(wp.dot(out_a, b), wp.dot(out_b, c), wp.dot(out_c, a))  # lambda_i times twice the area
    pull = log_a * out_a + log_b * out_b + log_c * out_c
    slope = wp.vec3d(wp.dot(out_a, pull), wp.dot(out_b, pull), wp.dot(out_c, pull))  # -grad lambda_i . pull times it
    result = Layers()
    result.psi = (rim[0] * log_a + rim[1] * log_b + rim[2] * log_c - height * omega) * _INVERSE_FOUR_PI
    result.phi = (omega * rim + height * slope) * (_INVERSE_FOUR_PI / double_area)
    return result


@wp.func
def exact_position(exact: ExactMap, x: wp.vec3d):
    """The position that the map takes x to."""
    total = _ZERO
    position = wp.vec3d(_ZERO, _ZERO, _ZERO)
    for f in range(exact.corners.shape[0]):
        a = exact.corners[f, 0] - x
        b = exact.corners[f, 1] - x
        c = exact.corners[f, 2] - x
        if exact.is_mean_value == 1:
            weights = mean_value_weights(a, b, c)
            total += weights[0] + weights[1] + weights[2]
        else:
            layers = triangle_layers(a, b, c, 0)
            weights = layers.phi
            position += layers.psi * exact.density[f]
        position += weights[0] * exact.data[f, 0] + weights[1] * exact.data[f, 1] + weights[2] * exact.data[f, 2]
    if exact.is_mean_value == 1:
        position = position / total
    return forward_only(position, x)


@wp.func
def axis_step(axis: int, h: wp.float64):
    step = wp.vec3d(_ZERO, _ZERO, _ZERO)
    step[axis] = h
    return step


@wp.func
def forward_jacobian(exact: ExactMap, x: wp.vec3d, here: wp.vec3d):
    jacobian = wp.mat33d()
    h = _NEWTON_DIFFERENCE * exact.size
    for axis in range(3):
        column = (exact_position(exact, x + axis_step(axis, h)) - here) / h
        for row in range(3):
            jacobian[row, axis] = column[row]
    return jacobian


@wp.func
def central_jacobian(exact: ExactMap, x: wp.vec3d):
    jacobian = wp.mat33d()
    h = _CENTRAL_DIFFERENCE * exact.size
    for axis in range(3):
        ahead = exact_position(exact, x + axis_step(axis, h))
        behind = exact_position(exact, x - axis_step(axis, h))
        for row in range(3):
            jacobian[row, axis] = (ahead[row] - behind[row]) / (_TWO * h)
    return jacobian


@wp.kernel
def map_exactly(first: int, exact: ExactMap, points: wp.array(dtype=wp.vec3d), positions: wp.array(dtype=wp.vec3d)):
    """positions (n,) = the map of points (n,)."""
    n = first + wp.tid()
    positions[n] = exact_position(exact, points[n])


@wp.kernel
def invert_map(
    first: int,
    exact: ExactMap,
    targets: wp.array(dtype=wp.vec3d),
    guesses: wp.array(dtype=wp.vec3d),
    tolerance: wp.float64,
    points: wp.array(dtype=wp.vec3d),
    residuals: wp.array(dtype=wp.float64),
    jacobians: wp.array(dtype=wp.mat33d),
):
    """points (n,) that the map takes to targets (n,), the remaining distances (n,), and the map's Jacobians (n,) there.
    Newton's iteration from guesses (n,), steps halved until the distance shrinks; lengths in the corners' unit."""
    n = first + wp.tid()
    x = guesses[n]
    here = exact_position(exact, x)
    left = wp.length(here - targets[n])
    step_count = int(0)
    while left > tolerance and step_count < NEWTON_STEPS:
        newton = wp.inverse(forward_jacobian(exact, x, here)) * (targets[n] - here)
        share = _ONE
        halving = int(0)
        better = int(0)
        while halving < HALVINGS and better == 0:
            tried = exact_position(exact, x + share * newton)
            distance = wp.length(tried - targets[n])
            if distance < left:
                x = x + share * newton
                here = tried
                left = distance
                better = 1
            share = share * _HALF
            halving += 1
        step_count = wp.where(better == 1, step_count + 1, NEWTON_STEPS)
    points[n] = x
    residuals[n] = left
    jacobians[n] = central_jacobian(exact, x)


@wp.kernel
def assemble_layers(
    first: int,
    corners: wp.array2d(dtype=wp.vec3d),
    data: wp.array2d(dtype=wp.vec3d),
    single_layer: wp.array2d(dtype=wp.float64),
    double_layer: wp.array(dtype=wp.vec3d),
):
    """Single layer matrix (f, f) and double layer (f,) of linear data at the centroids of the triangles, the limit from
    inside; one item per centroid."""
    n = first + wp.tid()
    x = (corners[n, 0] + corners[n, 1] + corners[n, 2]) / wp.float64(3.0)
    total = wp.vec3d(_ZERO, _ZERO, _ZERO)
    for f in range(corners.shape[0]):
        layers = triangle_layers(corners[f, 0] - x, corners[f, 1] - x, corners[f, 2] - x, wp.where(f == n, 1, 0))
        single_layer[n, f] = layers.psi
        total += layers.phi[0] * data[f, 0] + layers.phi[1] * data[f, 1] + layers.phi[2] * data[f, 2]
    double_layer[n] = total
