"""Look-ups around an object on a voxel grid: trilinear values, and the distance to the nearest of many points."""

# Sums in float64, nothing fused. A grid of shape (nx, ny, nz) holds node (i, j, k) at n = (i * ny + j) * nz + k, the
# first at `lower`, others `spacing` apart; a place in it counts spacings from there, and beyond it takes the value at
# its edge. A sample (p, i, j) of a face a, b, c has the barycentric weights (p - i - j, i, j) / p. Points (p,) are
# sorted by voxel: those of voxel n, at most half a spacing from its node along each axis, begin at starts[n].

import warp as wp

from ..core.gradients import forward_only_in

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

forward_only = forward_only_in(__name__, (wp.float64, wp.vec3d))

#: Voxels by which rounding may put a point into the next one.
BESIDE = wp.constant(wp.float64(1.0e-6))

#: What the radius of a search grows by where nothing lies within it.
GROWTH = wp.constant(wp.float64(1.5))

HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
ZERO = wp.constant(wp.float64(0.0))

#: Share of a bound that rounding to float32 leaves.
BELOW = wp.constant(wp.float64(1.0 - 1.0e-6))

#: Length of a slope below which it has no direction.
FLAT = wp.constant(1.0e-6)
TINY = wp.constant(wp.float64(1.0e-300))


@wp.struct
class DistanceGrid:
    """Distances (n,) from an object, world units, and their slopes (n,) at the nodes of a grid."""

    distances: wp.array(dtype=wp.float32)
    slopes: wp.array(dtype=wp.vec3)
    shape: wp.vec3i
    lower: wp.vec3d
    spacing: wp.float64


@wp.func
def grid_place(grid: DistanceGrid, x: wp.vec3d):
    """Where a point is in the grid."""
    return (x - grid.lower) / grid.spacing


@wp.func
def grid_cell(shape: wp.vec3i, place: wp.vec3d):
    """The node before a place, steps to the ones after it along the axes, and how far along them the place is."""
    x = wp.clamp(place[0], ZERO, wp.float64(shape[0] - 1))
    y = wp.clamp(place[1], ZERO, wp.float64(shape[1] - 1))
    z = wp.clamp(place[2], ZERO, wp.float64(shape[2] - 1))
    i = int(x)
    j = int(y)
    k = int(z)
    row = shape[2]
    step_x = wp.where(i + 1 < shape[0], row * shape[1], 0)
    step_y = wp.where(j + 1 < shape[1], row, 0)
    step_z = wp.where(k + 1 < row, 1, 0)
    share = wp.vec3d(x - wp.float64(i), y - wp.float64(j), z - wp.float64(k))
    return (i * shape[1] + j) * row + k, step_x, step_y, step_z, share


@wp.func
def between(values: wp.array(dtype=wp.float32), n: int, step: int, share: wp.float64):
    """A value between two nodes."""
    before = wp.float64(values[n])
    return before + share * (wp.float64(values[n + step]) - before)


@wp.func
def grid_distance(grid: DistanceGrid, place: wp.vec3d):
    """Distance at a place, trilinear."""
    n, x, y, z, share = grid_cell(grid.shape, place)
    a = between(grid.distances, n, z, share[2])
    b = between(grid.distances, n + y, z, share[2])
    c = between(grid.distances, n + x, z, share[2])
    d = between(grid.distances, n + x + y, z, share[2])
    a = a + share[1] * (b - a)
    c = c + share[1] * (d - c)
    return a + share[0] * (c - a)


@wp.func
def slope_direction(grid: DistanceGrid, place: wp.vec3d):
    """Unit direction in which the distance grows at a place, zero where it is flat."""
    n, x, y, z, share = grid_cell(grid.shape, place)
    u = float(share[0])
    v = float(share[1])
    w = float(share[2])
    slopes = grid.slopes
    a = wp.lerp(wp.lerp(slopes[n], slopes[n + z], w), wp.lerp(slopes[n + y], slopes[n + y + z], w), v)
    b = wp.lerp(wp.lerp(slopes[n + x], slopes[n + x + z], w), wp.lerp(slopes[n + x + y], slopes[n + x + y + z], w), v)
    slope = wp.lerp(a, b, u)
    length = wp.length(slope)
    if length > FLAT:
        return wp.vec3d(slope / length)
    return wp.vec3d(ZERO, ZERO, ZERO)


@wp.func
def sample_place(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, pieces: int, i: int, j: int):
    """Place of a sample of a face."""
    whole = wp.float64(pieces)
    return (wp.float64(pieces - i - j) / whole) * a + (wp.float64(i) / whole) * b + (wp.float64(j) / whole) * c


@wp.func
def samples_clear(room: wp.float64, along: wp.float64, pieces: int):
    """How many samples after one in a row of a face, `along` apart, are off a level that this one is `room` off."""
    return int(wp.min(wp.floor(room / wp.max(along, TINY)), wp.float64(pieces)))


@wp.kernel
def look_up_directions(
    first: int, x: wp.array(dtype=wp.vec3d), grid: DistanceGrid, directions: wp.array(dtype=wp.vec3d)
):
    """Unit directions (n,) in which the distance grows at points x (n,), zero where it is flat."""
    n = first + wp.tid()
    directions[n] = slope_direction(grid, grid_place(grid, x[n]))


@wp.kernel
def look_up_faces(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    pieces: int,
    grid: DistanceGrid,
    values: wp.array2d(dtype=wp.float64),
):
    """Distances (f, s) at the samples of faces (f,): those of i = 0 first, j from 0 up."""
    f = first + wp.tid()
    face = faces[f]
    a = grid_place(grid, vertices[face[0]])
    b = grid_place(grid, vertices[face[1]])
    c = grid_place(grid, vertices[face[2]])
    s = int(0)
    for i in range(pieces + 1):
        for j in range(pieces + 1 - i):
            values[f, s] = grid_distance(grid, sample_place(a, b, c, pieces, i, j))
            s += 1


@wp.func
def bound_squared(values: wp.array(dtype=wp.float32), n: int, bounds: wp.vec3d):
    """Square of a lower bound of the distance at a node, as in `least_distance`."""
    value = wp.float64(values[n])
    if value < bounds[0]:
        return ZERO
    value = wp.min(value, bounds[1]) + bounds[2]
    return value * value


@wp.func
def least_distance(grid: DistanceGrid, place: wp.vec3d, bounds: wp.vec3d):
    """A distance that none from a place to the points is below. bounds: the grid's values are at most distances to the
    points from the first one on; beyond the second one distances may be as short as that; what they lack, all alike."""
    # A squared distance less |x|^2 is the least of many linear functions, so it is concave: between nodes it is no less
    # than what is interpolated. Of |x|^2 the interpolated value is more by the sum of share (1 - share) along the axes.
    n, x, y, z, share = grid_cell(grid.shape, place)
    values = grid.distances
    a = wp.lerp(bound_squared(values, n, bounds), bound_squared(values, n + z, bounds), share[2])
    b = wp.lerp(bound_squared(values, n + y, bounds), bound_squared(values, n + y + z, bounds), share[2])
    c = wp.lerp(bound_squared(values, n + x, bounds), bound_squared(values, n + x + z, bounds), share[2])
    d = wp.lerp(bound_squared(values, n + x + y, bounds), bound_squared(values, n + x + y + z, bounds), share[2])
    squared = wp.lerp(wp.lerp(a, b, share[1]), wp.lerp(c, d, share[1]), share[0])
    squared -= grid.spacing * grid.spacing * (wp.dot(share, wp.vec3d(ONE, ONE, ONE) - share))
    return wp.sqrt(wp.max(squared, ZERO)) * BELOW - bounds[2]


@wp.kernel
def list_near_samples(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    pieces: wp.array(dtype=int),
    levels: wp.array(dtype=wp.float64),
    error: wp.float64,
    bounds: wp.vec3d,
    grid: DistanceGrid,
    starts: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    places: wp.array(dtype=wp.vec3d),
    distances: wp.array(dtype=wp.float64),
):
    """How many samples (f,) of faces (f,), cut in pieces (f,), may be nearer than levels (f,); their places and
    distances, which err by less than `error`, from starts (f,) on. bounds: as in `least_distance`."""
    # a distance grows by no more than one's way: samples of a row are left out that cannot be near
    f = first + wp.tid()
    face = faces[f]
    a = grid_place(grid, vertices[face[0]])
    b = grid_place(grid, vertices[face[1]])
    c = grid_place(grid, vertices[face[2]])
    along = grid.spacing * wp.length(c - a) / wp.float64(pieces[f])
    far = levels[f] + error
    count = int(0)
    for i in range(pieces[f] + 1):
        j = int(0)
        while j <= pieces[f] - i:
            x = sample_place(a, b, c, pieces[f], i, j)
            distance = grid_distance(grid, x)
            if distance >= far:
                j += 1 + samples_clear(distance - far, along, pieces[f])
            else:
                if least_distance(grid, x, bounds) <= levels[f]:
                    places[starts[f] + count] = grid.lower + grid.spacing * x
                    distances[starts[f] + count] = distance
                    count += 1
                j += 1
    counts[f] = count


@wp.func
def beside(place: wp.float64, voxel: int):
    """Least distance along an axis from a place to points of a voxel, both in voxels."""
    return wp.max(wp.abs(place - wp.float64(voxel)) - HALF - BESIDE, ZERO)


@wp.func
def outwards(middle: int, step: int):
    """The middle, the one after it, the one before it, the second after it, and so on."""
    away = (step + 1) / 2
    if step % 2 == 0:
        away = -away
    return middle + away


@wp.func
def least_squared(
    x: wp.vec3d,
    radius: wp.float64,
    points: wp.array(dtype=wp.vec3d),
    starts: wp.array(dtype=int),
    shape: wp.vec3i,
    lower: wp.vec3d,
    spacing: wp.float64,
):
    """Squared distance from x to the nearest point, or that of the radius where none is nearer."""
    place_x = (x[0] - lower[0]) / spacing
    place_y = (x[1] - lower[1]) / spacing
    place_z = (x[2] - lower[2]) / spacing
    # bounds in voxels: what lies within them is measured in units of the points
    voxels = ONE / (spacing * spacing)
    reach = radius / spacing + HALF + BESIDE
    first_i = wp.max(int(wp.ceil(place_x - reach)), 0)
    last_i = wp.min(int(wp.floor(place_x + reach)), shape[0] - 1)
    first_j = wp.max(int(wp.ceil(place_y - reach)), 0)
    last_j = wp.min(int(wp.floor(place_y + reach)), shape[1] - 1)
    middle_i = int(wp.floor(place_x + HALF))  # from the middle outwards: what is found there leaves the least to search
    middle_j = int(wp.floor(place_y + HALF))
    best = radius * radius
    room = best * voxels + BESIDE
    for m in range(2 * wp.max(last_i - middle_i, middle_i - first_i) + 1):
        i = outwards(middle_i, m)
        off_x = beside(place_x, i)
        left_x = room - off_x * off_x
        if i >= first_i and i <= last_i and left_x > ZERO:
            for n in range(2 * wp.max(last_j - middle_j, middle_j - first_j) + 1):
                j = outwards(middle_j, n)
                off_y = beside(place_y, j)
                left = room - off_x * off_x - off_y * off_y
                if j >= first_j and j <= last_j and left > ZERO:
                    half = wp.sqrt(left) + HALF + BESIDE
                    first_k = wp.max(int(wp.ceil(place_z - half)), 0)
                    last_k = wp.min(int(wp.floor(place_z + half)), shape[2] - 1)
                    if first_k <= last_k:
                        row = (i * shape[1] + j) * shape[2]
                        begin = starts[row + first_k]
                        end = starts[row + last_k + 1]
                        if begin < end:
                            for p in range(begin, end):
                                point = points[p]
                                u = point[0] - x[0]
                                v = point[1] - x[1]
                                w = point[2] - x[2]
                                squared = u * u + v * v + w * w
                                if squared < best:
                                    best = squared
                            room = best * voxels + BESIDE
    return forward_only(best, x)


@wp.kernel
def measure_nearest(
    first: int,
    x: wp.array(dtype=wp.vec3d),
    about: wp.array(dtype=wp.float64),
    most: wp.array(dtype=wp.float64),
    points: wp.array(dtype=wp.vec3d),
    starts: wp.array(dtype=int),
    shape: wp.vec3i,
    lower: wp.vec3d,
    spacing: wp.float64,
    distance: wp.array(dtype=wp.float64),
):
    """Distance (n,) from x (n,) to the nearest of the points, of which there is at least one; most (n,) if it is more.
    about (n,): radius greater than 0 in which the search begins; it grows until there is one within it."""
    n = first + wp.tid()
    limit = wp.min(about[n], most[n])
    best = least_squared(x[n], limit, points, starts, shape, lower, spacing)
    while best >= limit * limit and limit < most[n]:
        limit = wp.min(limit * GROWTH, most[n])
        best = least_squared(x[n], limit, points, starts, shape, lower, spacing)
    distance[n] = wp.sqrt(best)


@wp.kernel
def find_largest_balls(
    first: int,
    x: wp.array(dtype=wp.vec3d),
    middles: wp.array(dtype=wp.vec3d),
    reaches: wp.array(dtype=wp.float64),
    found: wp.array(dtype=int),
):
    """The first (n,) of balls, given by middles and reaches (b,), in which x (n,) lies; their count for none."""
    n = first + wp.tid()
    place = x[n]
    ball = int(0)
    while ball < reaches.shape[0] and wp.length_sq(middles[ball] - place) > reaches[ball] * reaches[ball]:
        ball += 1
    found[n] = ball
