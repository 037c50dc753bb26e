"""Maximum likelihood coordinates of points inside a closed triangle cage, positive in concave ones, and their map."""

# After Chang, Deng and Hormann, "Maximum likelihood coordinates" (SGP 2023): the cage is projected to the sphere around
# the point x, each face becomes one direction of it, and the most likely shares of these directions that cancel are
# taken apart into weights of the corners. With m, C_k and det of a face as mean value coordinates have them
# (mean_value.py) and n its unit normal, of the faces that are seen from inside, det > 0:
#   d = m / |m|,  p = n . m  (the integral of the cosine over the solid angle: faces cut in parts weigh the same),
#   phi minimises -sum_f p_f log(1 + phi . d_f)   (convex, so that its slope sum_f y_f d_f is zero),
#   y_f = p_f / (1 + phi . d_f) > 0,
#   weight_i = sum_f y_f (C_i . m) / (|m| det),  divided by the sum over vertices.
# The directions are those of faces and not, as in the paper, of vertices, from sums of those of the faces around them:
# next to a face of a box these may all lie on one side, and nothing cancels. Here a solution exists wherever the
# winding number is 1 or more: a ray along any direction u leaves through a face of det > 0, whose part of the sphere is
# convex, so that d . u > 0. As p goes as det^2 next to the plane of a face, there is no kink where a face turns away.
# On the cage (C_i . m) / |m| det grows beyond all others: there the map is linear. Units as in mean_value.py.

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import reciprocal_root, vec3_entry, vec3i_entry, vec4_entry
from ..mesh.fans import near_plane_limit
from ..mesh.triangle import nearest_barycentric
from .mean_value import FLAT, SNAP, FaceEdge, add_corners, clear_row, face_edge, far_face_weights, weights_in_double

# so many registers per thread that larger blocks would fill a GPU less well
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True, "block_dim": 128})

forward_only = forward_only_in(__name__, (wp.vec4, wp.vec3))

#: Newton's method ends where a step changes no y by more than this share: what is left is less than its square, below
#: 1e-6 in all that was tried (1e-3 took a tenth longer).
LAST_CHANGE = wp.constant(4.0e-3)

#: Or where |sum y d| is no more than this share of sum y, as float32 has it.
ROUNDING = wp.constant(1.0e-6)

#: Steps are tried this many times as long as they are known to go down, and that many times again after each success.
BOLDER = wp.constant(4.0)

#: After so many passes it begins anew as interior point methods do, for cages as flat as a leaf: with MAX_EXTRA added
#: to each p, LESS times that whenever a step changes no y by more than CENTRAL, and nothing below MIN_EXTRA.
PATIENCE = wp.constant(10)
MAX_EXTRA = wp.constant(0.1)
MIN_EXTRA = wp.constant(1.0e-8)
LESS = wp.constant(0.05)
CENTRAL = wp.constant(0.3)

#: Where it has not ended after so many passes over the faces there is no solution; it takes 3 or 4 inside a cage.
MAX_PASSES = wp.constant(80)

#: A face is seen edge-on where it is this far beside a point, as a share of the size, and the point next to its plane.
BESIDE = wp.constant(0.1)

#: Edge-on faces weigh less than 1e-6 where det^2 is no more than this share of the limit for float64, and nothing here.
EDGE_ON = wp.constant(0.1)

#: Points this far out of the cage, as a share of the size, count as on it: 1e-5 in world units, and its rounding.
OUTSIDE = wp.constant(wp.float64(1.1e-5))

_ZERO = wp.constant(wp.float64(0.0))


@wp.struct
class FaceTerm:
    """A face as seen from the point."""

    corners: wp.vec3  # weights of the corners for y = 1; barycentric coordinates where the point lies on the face
    direction: wp.vec3  # d
    prior: float  # p; 0: seen from outside, or edge-on
    touching: int


@wp.struct
class ExactFaceTerm:
    """The same in float64, of a face that the point is not on."""

    corners: wp.vec3d
    direction: wp.vec3d
    prior: wp.float64


@wp.func
def exact_face_term(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, size: wp.float64):
    """The face p, q, r as seen from the origin."""
    normal = wp.cross(q - p, r - p)
    double_area = wp.length(normal)
    det = wp.dot(normal, p)
    term = ExactFaceTerm()
    if det > FLAT * size * double_area:
        weights = weights_in_double(p, q, r, det)
        mean = weights[0] * p + weights[1] * q + weights[2] * r
        length = wp.length(mean)
        term.corners = weights / length
        term.direction = mean / length
        term.prior = wp.dot(mean, normal) / double_area
    return term


@wp.func(inline=False)
def near_face_term(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """The face a, b, c whose plane passes next to the origin, in float64, as it is ill-conditioned."""
    p = wp.vec3d(a)
    q = wp.vec3d(b)
    r = wp.vec3d(c)
    normal = wp.cross(q - p, r - p)
    double_area = wp.length(normal)
    det = wp.dot(normal, p)
    unit = wp.float64(size) * double_area
    term = FaceTerm()
    if double_area == _ZERO:
        return term
    if det < SNAP * unit and det > -OUTSIDE * unit:
        nearest = nearest_barycentric(p, q, r)
        reach = wp.where(det > _ZERO, SNAP, OUTSIDE) * wp.float64(size)
        if wp.length(nearest[0] * p + nearest[1] * q + nearest[2] * r) < reach:
            term.corners = wp.vec3(nearest)
            term.touching = 1
            return term
    exact = exact_face_term(p, q, r, wp.float64(size))
    term.corners = wp.vec3(exact.corners)
    term.direction = wp.vec3(exact.direction)
    term.prior = float(exact.prior)
    return term


@wp.func
def far_face_term(edge_ba: FaceEdge, edge_bc: FaceEdge, edge_ca: FaceEdge, normal: wp.vec3, det: float):
    """The face a, b, c clear of the origin's plane, seen from inside; arguments as those of `far_face_weights`, and its
    normal of any length."""
    mean = edge_bc.mean + edge_ca.mean - edge_ba.mean  # 2 m
    inverse = reciprocal_root(wp.dot(mean, mean))
    term = FaceTerm()
    term.direction = inverse * mean
    term.prior = wp.max(0.5 * wp.dot(mean, normal) * reciprocal_root(wp.dot(normal, normal)), 0.0)
    term.corners = (2.0 * inverse) * far_face_weights(edge_ba, edge_bc, edge_ca, det)
    return term


@wp.func
def face_term(a: wp.vec3, b: wp.vec3, c: wp.vec3, size: float):
    """The face a, b, c as seen from the origin."""
    edge_b = b - a
    edge_c = c - a
    normal = wp.cross(edge_b, edge_c)
    det = wp.dot(normal, a)
    term = FaceTerm()
    if det * det <= near_plane_limit(normal, edge_b, edge_c, size):
        term = near_face_term(a, b, c, size)
    elif det > 0.0:
        term = far_face_term(face_edge(b, a), face_edge(b, c), face_edge(c, a), normal, det)
    return term


@wp.struct
class Likelihood:
    """Sums over the faces at some phi, and the step of Newton's method from there."""

    balance: wp.vec3  # sum y d
    squares: wp.vec3  # sum y^2 / p d d^T: xx, yy, zz
    products: wp.vec3  # yz, zx, xy
    total: float  # sum y
    largest: float  # of 1 / (1 + phi . d)
    rarest: float  # the largest 1 / p
    beyond: int  # 1: some 1 + phi . d is not positive, phi is none
    step: wp.vec3
    change: float  # no y changes by more than this share over the step


@wp.func
def with_face(sums: Likelihood, direction: wp.vec3, prior: float, share: float):
    """Sums with one more face, of a prior above 0; share: 1 / (1 + phi . d)."""
    y = prior * share
    slope = (y * share) * direction
    sums.balance += y * direction
    sums.squares += wp.cw_mul(slope, direction)
    sums.products += wp.vec3(slope[1] * direction[2], slope[2] * direction[0], slope[0] * direction[1])
    sums.total += y
    sums.largest = wp.max(sums.largest, share)
    sums.rarest = wp.max(sums.rarest, 1.0 / prior)
    if share <= 0.0:
        sums.beyond = 1
    return sums


@wp.func
def with_step(sums: Likelihood):
    """Sums with the step of Newton's method, the inverse of the matrix times the balance."""
    s = sums.squares
    t = sums.products
    first = wp.vec3(s[1] * s[2] - t[0] * t[0], t[0] * t[1] - t[2] * s[2], t[2] * t[0] - s[1] * t[1])
    second = wp.vec3(first[1], s[2] * s[0] - t[1] * t[1], t[1] * t[2] - t[0] * s[0])
    third = wp.vec3(first[2], second[2], s[0] * s[1] - t[2] * t[2])
    det = s[0] * first[0] + t[2] * first[1] + t[1] * first[2]
    b = sums.balance
    sums.change = 1.0
    if det > 0.0:
        sums.step = wp.vec3(wp.dot(first, b), wp.dot(second, b), wp.dot(third, b)) / det
        # of y / p both bounds hold: |d| is 1, and the matrix is no less than any of its parts
        decrement = wp.max(wp.dot(b, sums.step), 0.0)
        sums.change = wp.min(wp.length(sums.step) * sums.largest, wp.sqrt(decrement * sums.rarest))
    return sums


@wp.func
def has_settled(sums: Likelihood):
    """Whether the step is the last one."""
    return (
        sums.beyond == 0
        and sums.total > 0.0
        and (sums.change < LAST_CHANGE or wp.length(sums.balance) <= ROUNDING * sums.total)
    )


@wp.struct
class Search:
    """Where the search for phi is, and how it came there."""

    phi: wp.vec3
    step: wp.vec3  # whole
    taken: float  # of the step
    safe: float  # as much of the step as goes down all its way
    slope: float  # along the step, where it began
    bold: float
    extra: float  # that each p has more: the way of interior points


@wp.func
def searched(search: Search, sums: Likelihood, passes: int):
    """The next phi to try, after the sums of the last one: a step on, or back to the part of the last step that is safe
    where it went too far."""
    if passes == PATIENCE:
        search = Search()
        search.extra = MAX_EXTRA
        return search
    if sums.beyond == 1 or wp.dot(sums.balance, search.step) < -0.25 * search.slope:
        search.phi -= (search.taken - search.safe) * search.step
        search.taken = search.safe
        search.bold = 1.0
        return search
    if search.extra > 0.0 and sums.change < CENTRAL:
        search.phi += sums.step
        search.step = wp.vec3(0.0, 0.0, 0.0)
        search.slope = 0.0
        search.taken = 0.0
        search.safe = 0.0
        search.bold = 1.0
        search.extra = wp.where(search.extra < MIN_EXTRA, 0.0, LESS * search.extra)
        return search
    search.step = sums.step
    search.slope = wp.dot(sums.balance, sums.step)
    search.bold = BOLDER * wp.max(search.bold, 1.0)
    search.safe = 1.0 / (1.0 + sums.change)  # along it no 1 + phi . d shrinks to less than this share of itself
    search.taken = wp.min(search.bold * search.safe, 1.0)
    search.phi += search.taken * search.step
    return search


@wp.func
def fan_term(
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    edge_ba: FaceEdge,
    edge_bc: FaceEdge,
    edge_ca: FaceEdge,
    plane: wp.vec4,
    size: float,
):
    """The face a, b, c as seen from the origin; plane: of `prepare_fans`."""
    normal = wp.vec3(plane[0], plane[1], plane[2])
    det = wp.dot(normal, c)
    term = FaceTerm()
    is_far = det * det > plane[3]
    if not is_far and not (
        is_beside(edge_bc.cross, c - b, normal, size)
        or is_beside(edge_ca.cross, a - c, normal, size)
        or is_beside(-edge_ba.cross, b - a, normal, size)
    ):
        term = near_face_term(a, b, c, size)
    elif det > 0.0 and (is_far or det * det > EDGE_ON * plane[3]):
        term = far_face_term(edge_ba, edge_bc, edge_ca, normal, det)
    return term


@wp.func
def is_beside(cross: wp.vec3, edge: wp.vec3, normal: wp.vec3, size: float):
    """Whether the origin, next to the plane of a face, is well outside of the face across this edge."""
    side = wp.dot(cross, normal)
    reach = BESIDE * size
    return side < 0.0 and side * side > reach * reach * wp.dot(edge, edge) * wp.dot(normal, normal)


@wp.struct
class Likeliest:
    """The solution at a point."""

    phi: wp.vec3
    residual: float  # |sum y d| / sum y where none was found, else 0
    touched: int  # a face that the point lies on, else -1


@wp.func
def likeliest(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    size: float,
):
    """Newton's method: three unknowns, and a pass over the faces for each step."""
    found = Likeliest()
    found.touched = -1
    search = Search()
    passes = int(0)
    while passes < MAX_PASSES:
        sums = Likelihood()
        a = wp.vec3(0.0, 0.0, 0.0)
        b = wp.vec3(0.0, 0.0, 0.0)
        edge_ba = FaceEdge()
        begins = int(1)
        f = int(0)
        while f < faces.shape[0]:
            if begins == 1:
                face = vec3i_entry(faces, f)
                a = vec3_entry(vertices, face[0]) - x
                b = vec3_entry(vertices, face[1]) - x
                edge_ba = face_edge(b, a)
            corner = vec4_entry(fans, 2 * f)
            begins = wp.where(wp.cast(corner[3], int) < 0, 1, 0)
            c = wp.vec3(corner[0], corner[1], corner[2]) - x
            edge_bc = face_edge(b, c)
            edge_ca = face_edge(c, a)
            term = fan_term(a, b, c, edge_ba, edge_bc, edge_ca, vec4_entry(fans, 2 * f + 1), size)
            if term.touching == 1:
                found.touched = f
            if term.prior > 0.0:
                share = 1.0 / (1.0 + wp.dot(search.phi, term.direction))
                sums = with_face(sums, term.direction, term.prior + search.extra, share)
            b = c
            edge_ba = edge_ca
            f += 1
        sums = with_step(sums)
        found.residual = wp.where(sums.total == 0.0, 1.0, wp.length(sums.balance) / sums.total)
        if found.touched >= 0 or (search.extra == 0.0 and has_settled(sums)):
            search.phi += sums.step
            found.residual = 0.0
            passes = MAX_PASSES
        else:
            search = searched(search, sums, passes)
            passes += 1
    found.phi = search.phi
    return found


@wp.func
def maximum_likelihood_point(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """`maximum_likelihood_position`, and the residual |sum y d| / sum y where the iterations have found no solution
    and the position is a guess, else 0."""
    found = likeliest(x, vertices, faces, fans, size)
    total = float(0.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    f = wp.max(found.touched, 0)
    after = wp.where(found.touched < 0, faces.shape[0], f + 1)
    while f < after:
        face = vec3i_entry(faces, f)
        a = vec3_entry(vertices, face[0]) - x
        b = vec3_entry(vertices, face[1]) - x
        c = vec3_entry(vertices, face[2]) - x
        plane = vec4_entry(fans, 2 * f + 1)
        term = fan_term(a, b, c, face_edge(b, a), face_edge(b, c), face_edge(c, a), plane, size)
        y = wp.where(term.touching == 1, 1.0, term.prior / (1.0 + wp.dot(found.phi, term.direction)))
        weights = y * term.corners
        total += weights[0] + weights[1] + weights[2]
        position += weights[0] * vec3_entry(targets, face[0])
        position += weights[1] * vec3_entry(targets, face[1])
        position += weights[2] * vec3_entry(targets, face[2])
        f += 1
    position = position * wp.where(total == 0.0, 0.0, 1.0 / total)
    return forward_only(wp.vec4(position[0], position[1], position[2], found.residual), x)


@wp.func
def maximum_likelihood_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """sum_j w_j(x) targets_j with w the maximum likelihood coordinates of x in the cage `vertices`, NaN where there are
    none. fans: see prepare_fans."""
    point = maximum_likelihood_point(x, vertices, faces, fans, targets, size)
    if point[3] > 0.0:
        return wp.vec3(wp.nan, wp.nan, wp.nan)
    return wp.vec3(point[0], point[1], point[2])


@wp.kernel(launch_bounds=(128, 4))
def map_maximum_likelihood(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
    positions: wp.array(dtype=wp.vec3),
):
    """positions (n,) = sum_j w_j(points) targets_j, NaN where there are no such coordinates."""
    n = first + wp.tid()
    positions[n] = maximum_likelihood_position(points[n], vertices, faces, fans, targets, size)


@wp.kernel
def weigh_maximum_likelihood(
    first: int,
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    size: float,
    weights: wp.array2d(dtype=wp.float32),
):
    """weights (n, v): normalised coordinates, whatever the rows held before; NaN where there are none."""
    n = first + wp.tid()
    x = points[n]
    search = Search()
    passes = int(0)
    touched = int(-1)
    while passes < MAX_PASSES:
        sums = Likelihood()
        for f in range(faces.shape[0]):
            face = faces[f]
            term = face_term(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
            if term.touching == 1:
                touched = f
                break
            if term.prior > 0.0:
                share = 1.0 / (1.0 + wp.dot(search.phi, term.direction))
                sums = with_face(sums, term.direction, term.prior + search.extra, share)
        if touched >= 0:
            break
        sums = with_step(sums)
        if search.extra == 0.0 and has_settled(sums):
            search.phi += sums.step
            break
        search = searched(search, sums, passes)
        passes += 1
    clear_row(weights, n)
    if touched >= 0:
        face = faces[touched]
        term = face_term(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
        add_corners(weights, n, face, term.corners)
    else:
        total = float(0.0)
        for f in range(faces.shape[0]):
            face = faces[f]
            term = face_term(vertices[face[0]] - x, vertices[face[1]] - x, vertices[face[2]] - x, size)
            if term.prior > 0.0:
                corners = term.corners * (term.prior / (1.0 + wp.dot(search.phi, term.direction)))
                add_corners(weights, n, face, corners)
                total += corners[0] + corners[1] + corners[2]
        scale = wp.where(passes < MAX_PASSES, 1.0 / total, wp.nan)
        for j in range(weights.shape[1]):
            weights[n, j] = weights[n, j] * scale
