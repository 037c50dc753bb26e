"""Faces of a closed mesh held off an object: where they are too near, and how their vertices move."""

# Samples of faces whose distance is below a level carry the face: each has a share in the moves of its face's corners.
# What a face gives its corners (3 f,) is summed around vertices: corners[starts[v]] to corners[starts[v + 1]] are those
# of vertex v, numbered 3 f + k. Descent: Adam (Kingma and Ba 2015) with one scale a vertex. In float64.

import warp as wp

from ..core.gradients import forward_only_in
from .shell import DistanceGrid, grid_distance, grid_place, sample_place, slope_direction

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

forward_only = forward_only_in(__name__, (wp.vec3d, wp.vec3d))

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1.0e-30))
SIXTH = wp.constant(wp.float64(1.0 / 6.0))

#: Decay a round of Adam's means of the slope and of its square: shorter than usual, as there are 100 rounds only; and
#: what keeps the steps of vertices at rest finite (slopes are of the size of 1).
MEAN_DECAY = wp.constant(wp.float64(0.8))
SQUARE_DECAY = wp.constant(wp.float64(0.9))
STEADY = wp.constant(wp.float64(0.05))

#: How steep interpolated distances may be: samples of a row that cannot be below the level are left out.
STEEPEST = wp.constant(wp.float64(1.25))


@wp.func
def unit(v: wp.vec3d):
    """The direction of a vector, zero for none."""
    return v / wp.max(wp.length(v), TINY)


@wp.func
def way_out(grid: DistanceGrid, x: wp.vec3d, distance: wp.float64, blind: wp.float64, normal: wp.vec3d):
    """Unit direction in which a sample leaves the object: where its distance grows, or its face looks."""
    # Where the object passes through a face, the slope may push to a thin wall's wrong side: there the normal counts.
    away = slope_direction(grid, x)
    if distance < blind:
        share = wp.clamp(distance / blind, ZERO, ONE)
        return unit(share * away + (ONE - share) * normal)
    return away


@wp.kernel
def measure_contacts(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    pieces: wp.array(dtype=int),
    levels: wp.array(dtype=wp.float64),
    blind: wp.float64,
    softness: wp.float64,
    grid: DistanceGrid,
    starts: wp.array(dtype=int),
    touched: wp.array(dtype=wp.vec3d),
    travels: wp.array(dtype=wp.float64),
    rooms: wp.array(dtype=wp.float32),
    shortest: wp.array(dtype=wp.float64),
    areas: wp.array(dtype=wp.float64),
    moves: wp.array(dtype=wp.vec3d),
    weights: wp.array(dtype=wp.float64),
    slopes: wp.array(dtype=wp.vec3d),
):
    """How far (f,) faces, cut in pieces (f,), are short of levels (f,) at most, 0 or less where they are not; their
    areas (f,); at their corners (3 f,) moves by weights that bring the samples there, and slopes of volume and load."""
    # Load: area * mean (shortfall^2) / (2 softness), over the samples that are short. Faces whose corners are where
    # they were touched before (v,) keep what was found; others leave out samples that cannot have become short. travels
    # (f,): how much nearer any of their samples may have come since all were measured, negative before that. rooms,
    # from starts (f,) on: row by row its least one, then those of its samples: how far off the level, on top of travels
    f = first + wp.tid()
    face = faces[f]
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    cross = wp.cross(b - a, c - a)
    normal = unit(cross)
    whole = pieces[f]
    level = levels[f]
    far_a = wp.length(a - touched[face[0]])
    far_b = wp.length(b - touched[face[1]])
    far_c = wp.length(c - touched[face[2]])
    if far_a == ZERO and far_b == ZERO and far_c == ZERO:
        return  # all is as it was found there
    travel = wp.float64(0.0)
    if travels[f] >= ZERO:
        travel = travels[f] + STEEPEST * wp.max(wp.max(far_a, far_b), far_c)
    travels[f] = travel
    along = STEEPEST * wp.length(c - a) / wp.float64(whole)
    at_a = grid_place(grid, a)
    at_b = grid_place(grid, b)
    at_c = grid_place(grid, c)
    worst = wp.float64(-1.0e30)
    count = int(0)
    move = wp.matrix(shape=(3, 3), dtype=wp.float64)
    load = wp.matrix(shape=(3, 3), dtype=wp.float64)
    weight = wp.vec3d()
    row = starts[f]
    for i in range(whole + 1):
        last = whole - i
        least = wp.float64(rooms[row]) - travel
        if least <= ZERO:
            least = wp.float64(1.0e30)
            j = int(0)
            while j <= last:
                n = row + 1 + j
                room = wp.float64(rooms[n]) - travel
                j += 1
                if room <= ZERO:
                    x = sample_place(at_a, at_b, at_c, whole, i, j - 1)
                    distance = grid_distance(grid, x)
                    room = distance - level
                    rooms[n] = wp.float32(travel + room)
                    if room < ZERO:
                        away = -room * way_out(grid, x, distance, blind, normal)
                        w = wp.vec3d(wp.float64(last + 1 - j), wp.float64(i), wp.float64(j - 1)) / wp.float64(whole)
                        # the corners that carry a sample share its move so that the sample itself makes all of it
                        # (least squares); samples far too near count for more than those nearly clear
                        urgent = -room * w
                        move += wp.outer(wp.cw_mul(urgent, w) / wp.dot(w, w), away)
                        load += wp.outer(w, away)
                        weight += urgent
                        count += 1
                    else:
                        # those after it that cannot be below the level
                        while j <= last and room > along:
                            n += 1
                            j += 1
                            room -= along
                            rooms[n] = wp.float32(travel + room)
                least = wp.min(least, room)
            rooms[row] = wp.float32(travel + least)
        worst = wp.max(worst, -least)
        row += last + 2
    # the samples that carry a face share its area, were it one only
    area = HALF * wp.length(cross)
    scale = area / (softness * wp.float64(wp.max(count, 1)))
    shortest[f] = worst
    areas[f] = area
    for k in range(3):
        moves[3 * f + k] = wp.vec3d(move[k, 0], move[k, 1], move[k, 2])
        weights[3 * f + k] = weight[k]
        slopes[3 * f + k] = SIXTH * cross - scale * wp.vec3d(load[k, 0], load[k, 1], load[k, 2])


@wp.func
def moved(
    v: int,
    starts: wp.array(dtype=int),
    corners: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    moves: wp.array(dtype=wp.vec3d),
    weights: wp.array(dtype=wp.float64),
):
    """A vertex moved by the mean of what its faces' samples ask for."""
    total = wp.vec3d()
    weight = wp.float64(0.0)
    for n in range(starts[v], starts[v + 1]):
        total += moves[corners[n]]
        weight += weights[corners[n]]
    place = vertices[v]
    if weight > ZERO:
        place += total / weight
    return forward_only(place, vertices[v])


@wp.kernel
def push_vertices(
    first: int,
    starts: wp.array(dtype=int),
    corners: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    moves: wp.array(dtype=wp.vec3d),
    weights: wp.array(dtype=wp.float64),
    places: wp.array(dtype=wp.vec3d),
):
    """Places (v,) of vertices (v,) moved by moves (3 f,) of weights (3 f,)."""
    v = first + wp.tid()
    places[v] = moved(v, starts, corners, vertices, moves, weights)


@wp.kernel
def descend(
    first: int,
    starts: wp.array(dtype=int),
    corners: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    moves: wp.array(dtype=wp.vec3d),
    weights: wp.array(dtype=wp.float64),
    slopes: wp.array(dtype=wp.vec3d),
    scale: wp.float64,
    step: wp.float64,
    mean_share: wp.float64,
    square_share: wp.float64,
    means: wp.array(dtype=wp.vec3d),
    squares: wp.array(dtype=wp.float64),
    places: wp.array(dtype=wp.vec3d),
):
    """Places (v,) of vertices (v,) after a step down slopes (3 f,) times scale, moved as by `push_vertices`.
    means, squares (v,): of Adam, in and out, what they hold of all rounds' weight being mean_share, square_share."""
    v = first + wp.tid()
    slope = wp.vec3d()
    for n in range(starts[v], starts[v + 1]):
        slope += slopes[corners[n]]
    slope = scale * slope
    mean = MEAN_DECAY * means[v] + (ONE - MEAN_DECAY) * slope
    square = SQUARE_DECAY * squares[v] + (ONE - SQUARE_DECAY) * wp.dot(slope, slope)
    means[v] = mean
    squares[v] = square
    down = (mean / mean_share) / (wp.sqrt(square / square_share) + STEADY)
    places[v] = moved(v, starts, corners, vertices, moves, weights) - step * down


@wp.kernel
def smooth_vertices(
    first: int,
    starts: wp.array(dtype=int),
    corners: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    share: wp.float64,
    grid: DistanceGrid,
    limit: wp.float64,
    inward: wp.float64,
    places: wp.array(dtype=wp.vec3d),
):
    """Places (v,) of vertices (v,) a share of the way to the mean of their neighbours, along the surface only; of those
    farther off the object than the limit a share `inward` along its normal too, as far as that is inward."""
    v = first + wp.tid()
    x = vertices[v]
    total = wp.vec3d()
    normal = wp.vec3d()
    for n in range(starts[v], starts[v + 1]):
        k = corners[n] % 3
        face = faces[corners[n] / 3]
        after = vertices[face[(k + 1) % 3]]  # closed and wound alike: every neighbour comes after it in one face
        total += after
        normal += wp.cross(after - x, vertices[face[(k + 2) % 3]] - x)
    count = starts[v + 1] - starts[v]
    if count == 0:
        places[v] = x
        return
    normal = unit(normal)
    step = total / wp.float64(count) - x
    along = wp.dot(step, normal)
    place = x + share * (step - along * normal)
    if along < ZERO:
        beyond = grid_distance(grid, grid_place(grid, x)) - limit
        if beyond > ZERO:
            place += wp.max(inward * along, -beyond) * normal
    places[v] = place
