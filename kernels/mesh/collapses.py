"""Collapses of edges of a closed triangle mesh: where the new vertex goes, what it costs, and whether it may be."""

# Around vertex v are the faces ring[starts[v]] to ring[starts[v + 1]]. Around an edge (u, v) are those at its ends, the
# two of the edge itself once. Planes of faces: unit normals, offsets from the origin, doubled areas. In float64.

import warp as wp

from ..core.gradients import forward_only_in

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

forward_only = forward_only_in(__name__, (wp.float64, wp.vec3d))

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
SIX = wp.constant(wp.float64(6.0))
TINY = wp.constant(wp.float64(1.0e-300))

#: The cost of an edge that cannot collapse.
INFINITE = wp.constant(wp.float64(1.0e300))

#: Least climb over a plane that a lift along the mean normal is divided by, and least evenness.
MIN_CLIMB = wp.constant(wp.float64(0.05))
MIN_EVEN = wp.constant(wp.float64(1.0e-3))

#: 2 sqrt(3), which makes the evenness of an equilateral triangle 1.
EVEN_SCALE = wp.constant(wp.float64(3.4641016151377544))

#: Share of the trace of the planes' squares that holds the place where they nearly meet to the middle of the edge.
HOLD = wp.constant(wp.float64(1.0e-2))

#: Units of a cost, in cubes of the side, below which digits do not order collapses.
COST_UNITS = wp.constant(wp.float64(1.0e9))

#: Neighbours that a new vertex has at least and at most.
MIN_NEIGHBORS = wp.constant(3)
MAX_NEIGHBORS = wp.constant(10)


@wp.struct
class Planes:
    """A closed mesh, the faces around its vertices, and their planes."""

    vertices: wp.array(dtype=wp.vec3d)
    faces: wp.array(dtype=wp.vec3i)
    starts: wp.array(dtype=int)
    ring: wp.array(dtype=int)
    normals: wp.array(dtype=wp.vec3d)
    offsets: wp.array(dtype=wp.float64)
    double_areas: wp.array(dtype=wp.float64)


@wp.struct
class CollapseRules:
    """What collapses must keep to, and what they cost, in sides of the faces to come about an edge."""

    on_plane: wp.float64  # sides by which a place may lie behind a plane
    most_lift: wp.float64  # sides that a place may lie beyond its base
    least_turn: wp.float64  # cosine of how far a face may turn
    least_even: wp.float64  # evenness of a face, 1 for equilateral
    side_cost: wp.float64  # room, in cubes of the side, of a face's longest side, and of its being uneven
    shape_cost: wp.float64


@wp.func
def place_in_face(face: wp.vec3i, v: int):
    """Which corner of a face a vertex is, -1 for none."""
    if face[0] == v:
        return 0
    if face[1] == v:
        return 1
    if face[2] == v:
        return 2
    return -1


@wp.func
def degree(planes: Planes, v: int):
    """Number of faces around a vertex."""
    return planes.starts[v + 1] - planes.starts[v]


@wp.func
def keeps_manifold(planes: Planes, u: int, v: int):
    """Whether the ends have two neighbours in common and no vertex is left with three faces (link condition)."""
    merged = degree(planes, u) + degree(planes, v) - 4
    if merged < MIN_NEIGHBORS or merged > MAX_NEIGHBORS:
        return False
    common = int(0)
    for n in range(planes.starts[u], planes.starts[u + 1]):
        face = planes.faces[planes.ring[n]]
        k = place_in_face(face, u)
        near = face[(k + 1) % 3]  # every neighbour comes after it in one face
        if place_in_face(face, v) >= 0 and degree(planes, face[0] + face[1] + face[2] - u - v) <= 3:
            return False  # across the edge, where one face is lost
        for m in range(planes.starts[v], planes.starts[v + 1]):
            if near != v and place_in_face(planes.faces[planes.ring[m]], near) >= 0:
                common += 1  # once for each of the two faces around v that have it
    return common == 4


@wp.func
def face_around(planes: Planes, u: int, v: int, n: int):
    """Face n around an edge; -1 where it is one of the edge's own that came before."""
    first = degree(planes, u)
    if n < first:
        return planes.ring[planes.starts[u] + n]
    f = planes.ring[planes.starts[v] + n - first]
    if place_in_face(planes.faces[f], u) >= 0:
        return -1
    return f


@wp.func
def corner(planes: Planes, vertex: int, u: int, v: int, place: wp.vec3d):
    """Where a vertex is after the collapse."""
    if vertex == u or vertex == v:
        return place
    return planes.vertices[vertex]


@wp.func
def lifted(planes: Planes, rules: CollapseRules, side: wp.float64, u: int, v: int, base: wp.vec3d, mean: wp.vec3d):
    """How far a base must go along the mean normal to the outer side of all planes; negative where it cannot."""
    lift = wp.float64(0.0)
    for n in range(degree(planes, u) + degree(planes, v)):
        f = face_around(planes, u, v, n)
        if f >= 0:
            below = planes.offsets[f] - wp.dot(planes.normals[f], base)
            if below > rules.on_plane * side:
                climb = wp.dot(planes.normals[f], mean)
                if climb < MIN_CLIMB:
                    return -ONE
                lift = wp.max(lift, below / climb)
    return forward_only(lift, base)


@wp.func
def room_added(planes: Planes, u: int, v: int, place: wp.vec3d):
    """Volume between the faces and the place."""
    room = wp.float64(0.0)
    for n in range(degree(planes, u) + degree(planes, v)):
        f = face_around(planes, u, v, n)
        if f >= 0:
            room += planes.double_areas[f] * (wp.dot(planes.normals[f], place) - planes.offsets[f])
    return forward_only(room / SIX, place)


@wp.func
def shape_cost(planes: Planes, rules: CollapseRules, side: wp.float64, u: int, v: int, place: wp.vec3d):
    """What long sides and uneven faces cost; infinite where a face turns too far or becomes too flat."""
    square = wp.float64(0.0)
    lacking = wp.float64(0.0)
    for n in range(degree(planes, u) + degree(planes, v)):
        f = face_around(planes, u, v, n)
        if f >= 0:
            face = planes.faces[f]
            if place_in_face(face, u) < 0 or place_in_face(face, v) < 0:  # those of the edge vanish
                a = corner(planes, face[0], u, v, place)
                b = corner(planes, face[1], u, v, place)
                c = corner(planes, face[2], u, v, place)
                normal = wp.cross(b - a, c - b)
                double_area = wp.length(normal)
                square_ab = wp.length_sq(b - a)
                square_bc = wp.length_sq(c - b)
                square_ca = wp.length_sq(a - c)
                even = EVEN_SCALE * double_area / wp.max(square_ab + square_bc + square_ca, TINY)
                turn = wp.dot(normal, planes.normals[f]) / wp.max(double_area, TINY)
                if not (turn > rules.least_turn and even > rules.least_even):
                    return INFINITE
                square = wp.max(square, wp.max(square_ab, wp.max(square_bc, square_ca)))
                lacking += ONE / wp.max(even, MIN_EVEN) - ONE
    longest = wp.sqrt(square) / side
    return forward_only(rules.side_cost * longest * longest * longest + rules.shape_cost * lacking, place)


@wp.kernel
def measure_collapses(
    first: int,
    edges: wp.array(dtype=wp.vec2i),
    sides: wp.array(dtype=wp.float64),
    planes: Planes,
    rules: CollapseRules,
    places: wp.array(dtype=wp.vec3d),
    costs: wp.array(dtype=wp.float64),
):
    """Where the new vertex (e,) of edges (e,) goes and what it costs (e,), in cubes of the side (e,) of faces to come
    there: the room that it adds, long sides and uneven faces; INFINITE where the edge cannot collapse."""
    # It is lifted along the mean normal to the outer side of all planes from the cheapest of four bases: the middle of
    # the edge, its ends, and where the planes nearly meet (least squares, Garland and Heckbert 1997).
    e = first + wp.tid()
    u = edges[e][0]
    v = edges[e][1]
    side = sides[e]
    costs[e] = INFINITE
    places[e] = planes.vertices[u]
    if not keeps_manifold(planes, u, v):
        return
    middle = HALF * (planes.vertices[u] + planes.vertices[v])
    mean = wp.vec3d()
    squares = wp.matrix(shape=(3, 3), dtype=wp.float64)
    right = wp.vec3d()
    for n in range(degree(planes, u) + degree(planes, v)):
        f = face_around(planes, u, v, n)
        if f >= 0:
            weighted = planes.double_areas[f] * planes.normals[f]
            mean += weighted
            squares += wp.outer(weighted, planes.normals[f])
            right += planes.offsets[f] * weighted
    mean = mean / wp.max(wp.length(mean), TINY)
    hold = HOLD * wp.trace(squares)
    squares += wp.diag(wp.vec3d(hold, hold, hold))
    meeting = wp.inverse(squares) * (right + hold * middle)
    best = wp.float64(INFINITE)
    for k in range(4):
        base = middle
        if k == 1:
            base = planes.vertices[u]
        if k == 2:
            base = planes.vertices[v]
        if k == 3:
            base = meeting
        lift = lifted(planes, rules, side, u, v, base, mean)
        if lift >= ZERO and lift <= rules.most_lift * side:
            place = base + lift * mean
            cost = room_added(planes, u, v, place) / (side * side * side)
            if cost < best:  # a shape only adds to it
                cost = wp.round((cost + shape_cost(planes, rules, side, u, v, place)) * COST_UNITS) / COST_UNITS
                if cost < best:
                    best = cost
                    places[e] = place
    costs[e] = best
