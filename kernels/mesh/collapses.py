"""Collapses of edges of a closed triangle mesh: where the new vertex goes, and what its faces are like."""

# In float64, operation by operation as NumPy does (products of sums as its einsum, sums over faces pairwise), nothing
# fused: the last digit is the same. Around an edge (u, v) are (r,) the faces at its ends, -1 for none, with their unit
# normals, offsets of their planes from the origin and doubled areas before the collapse.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1.0e-300))

#: Least climb over a plane that a lift along the mean normal is divided by, and least evenness.
MIN_CLIMB = wp.constant(wp.float64(0.05))
MIN_EVEN = wp.constant(wp.float64(1.0e-3))

#: 2 sqrt(3), which makes the evenness of an equilateral triangle 1.
EVEN_SCALE = wp.constant(wp.float64(3.4641016151377544))

#: Sums of many terms that NumPy keeps side by side.
vec8d = wp.types.vector(length=8, dtype=wp.float64)


@wp.func
def paired_dot(a: wp.vec3d, b: wp.vec3d):
    """Sum of products, the first and the last before the middle one."""
    return (a[0] * b[0] + a[2] * b[2]) + a[1] * b[1]


@wp.func
def crossed(a: wp.vec3d, b: wp.vec3d):
    """Cross product."""
    return wp.vec3d(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@wp.func
def joined(sums: vec8d):
    """Sum of the eight."""
    return ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]))


@wp.func
def corner(vertex: int, u: int, v: int, place: wp.vec3d, vertices: wp.array(dtype=wp.vec3d)):
    """Where a vertex is after the collapse."""
    if vertex == u or vertex == v:
        return place
    return vertices[vertex]


@wp.func
def is_end(vertex: int, u: int, v: int):
    """1 for an end of the edge, else 0."""
    return wp.where(vertex == u or vertex == v, 1, 0)


@wp.kernel
def measure_collapses(
    first: int,
    edges: wp.array(dtype=wp.vec2i),
    bases: wp.array(dtype=wp.vec3d),
    means: wp.array(dtype=wp.vec3d),
    around: wp.array2d(dtype=int),
    normals: wp.array2d(dtype=wp.vec3d),
    offsets: wp.array2d(dtype=wp.float64),
    double_areas: wp.array2d(dtype=wp.float64),
    rooms_allowed: wp.array(dtype=wp.float64),
    on_plane: wp.float64,
    least_turn: wp.float64,
    least_even: wp.float64,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    places: wp.array(dtype=wp.vec3d),
    rooms: wp.array(dtype=wp.float64),
    longest: wp.array(dtype=wp.float64),
    uneven: wp.array(dtype=wp.float64),
):
    """Place (e,) of the new vertex, room (e,) that it adds, square (e,) of the longest side of its faces and what they
    lack (e,) of being even; a negative square where the edge cannot collapse there."""
    # The place is a base (e,) lifted along the mean normal (e,) to the outer side of all planes, less on_plane. Refused
    # if not lifted, adding the room allowed, or with a face turned past least_turn or flatter than least_even.
    e = first + wp.tid()
    u = edges[e][0]
    v = edges[e][1]
    count = around.shape[1]
    base = bases[e]
    mean = means[e]
    longest[e] = -ONE
    lift = wp.float64(0.0)
    for r in range(count):
        if around[e, r] >= 0:
            below = offsets[e, r] - paired_dot(normals[e, r], base)
            if below > on_plane:
                climb = paired_dot(normals[e, r], mean)
                if climb < MIN_CLIMB:
                    return
                lift = wp.max(lift, below / wp.max(climb, MIN_CLIMB))
    place = wp.vec3d(base[0] + lift * mean[0], base[1] + lift * mean[1], base[2] + lift * mean[2])

    whole = count - count % 8
    sums = vec8d()
    for r in range(whole):
        sums[r % 8] = sums[r % 8] + double_areas[e, r] * (paired_dot(normals[e, r], place) - offsets[e, r])
    room = joined(sums)
    for r in range(whole, count):
        room = room + double_areas[e, r] * (paired_dot(normals[e, r], place) - offsets[e, r])
    room = room / wp.float64(6.0)
    if not (room < rooms_allowed[e]):
        return

    square = wp.float64(0.0)
    sums = vec8d()
    lacking = wp.float64(0.0)
    for r in range(count):
        if r == whole:
            lacking = joined(sums)
        if around[e, r] >= 0:
            face = faces[around[e, r]]
            if is_end(face[0], u, v) + is_end(face[1], u, v) + is_end(face[2], u, v) == 1:  # those of the edge vanish
                a = corner(face[0], u, v, place, vertices)
                b = corner(face[1], u, v, place, vertices)
                c = corner(face[2], u, v, place, vertices)
                ab = wp.vec3d(b[0] - a[0], b[1] - a[1], b[2] - a[2])
                bc = wp.vec3d(c[0] - b[0], c[1] - b[1], c[2] - b[2])
                ca = wp.vec3d(a[0] - c[0], a[1] - c[1], a[2] - c[2])
                normal = crossed(ab, bc)
                double_area = wp.sqrt(paired_dot(normal, normal))
                square_ab = paired_dot(ab, ab)
                square_bc = paired_dot(bc, bc)
                square_ca = paired_dot(ca, ca)
                even = EVEN_SCALE * double_area / wp.max(square_ab + square_bc + square_ca, TINY)
                turn = paired_dot(normal, normals[e, r]) / wp.max(double_area, TINY)
                if not (turn > least_turn and even > least_even):
                    return
                square = wp.max(square, wp.max(square_ab, wp.max(square_bc, square_ca)))
                lack = ONE / wp.max(even, MIN_EVEN) - ONE
                if r < whole:
                    sums[r % 8] = sums[r % 8] + lack
                else:
                    lacking = lacking + lack
    if whole == count:
        lacking = joined(sums)
    places[e] = place
    rooms[e] = room
    longest[e] = square
    uneven[e] = lacking
