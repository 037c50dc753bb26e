"""Look-ups around an object on a voxel grid: trilinear values, and the distance to the nearest of many points."""

# In float64, operation by operation as SciPy (map_coordinates of order 1, KDTree.query), nothing fused: the last digit
# is the same. Node (0, 0, 0) is at `lower`, nodes are `spacing` apart; beyond the grid a point takes the value at its
# edge. Points (p,) are sorted by voxel, the last axis fastest: those of voxel (i, j, k), at most half a spacing from
# its node along each axis, are starts[n] to starts[n + 1] with n = (i * ny + j) * nz + k.

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

#: Length of a slope below which it has no direction.
FLAT = wp.constant(wp.float64(1.0e-6))


@wp.func
def held(voxel: wp.float64, count: int):
    """The index of a voxel, held to those of the grid."""
    return int(wp.min(wp.max(voxel, ZERO), wp.float64(count - 1)))


@wp.func
def trilinear(volume: wp.array3d(dtype=wp.float64), x: wp.vec3d, lower: wp.vec3d, spacing: wp.float64):
    """Value of a volume at x."""
    place_x = (x[0] - lower[0]) / spacing
    place_y = (x[1] - lower[1]) / spacing
    place_z = (x[2] - lower[2]) / spacing
    before_x = wp.floor(place_x)
    before_y = wp.floor(place_y)
    before_z = wp.floor(place_z)
    i = held(before_x, volume.shape[0])
    j = held(before_y, volume.shape[1])
    k = held(before_z, volume.shape[2])
    i1 = held(before_x + ONE, volume.shape[0])
    j1 = held(before_y + ONE, volume.shape[1])
    k1 = held(before_z + ONE, volume.shape[2])
    # beyond the grid both nodes are that of its edge
    x0 = ONE - (place_x - before_x)
    y0 = ONE - (place_y - before_y)
    z0 = ONE - (place_z - before_z)
    x1 = ONE - x0
    y1 = ONE - y0
    z1 = ONE - z0
    total = volume[i, j, k] * x0 * y0 * z0
    total = total + volume[i, j, k1] * x0 * y0 * z1
    total = total + volume[i, j1, k] * x0 * y1 * z0
    total = total + volume[i, j1, k1] * x0 * y1 * z1
    total = total + volume[i1, j, k] * x1 * y0 * z0
    total = total + volume[i1, j, k1] * x1 * y0 * z1
    total = total + volume[i1, j1, k] * x1 * y1 * z0
    return total + volume[i1, j1, k1] * x1 * y1 * z1


@wp.kernel
def look_up(
    first: int,
    x: wp.array(dtype=wp.vec3d),
    volume: wp.array3d(dtype=wp.float64),
    lower: wp.vec3d,
    spacing: wp.float64,
    values: wp.array(dtype=wp.float64),
):
    """Values (n,) of a volume at points x (n,)."""
    n = first + wp.tid()
    values[n] = trilinear(volume, x[n], lower, spacing)


@wp.kernel
def look_up_faces(
    first: int,
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    weights: wp.array(dtype=wp.vec3d),
    volume: wp.array3d(dtype=wp.float64),
    lower: wp.vec3d,
    spacing: wp.float64,
    values: wp.array2d(dtype=wp.float64),
):
    """Values (f, s) of a volume at the samples of barycentric weights (s,) on faces (f,)."""
    f = first + wp.tid()
    face = faces[f]
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    for s in range(weights.shape[0]):
        w = weights[s]
        x = wp.vec3d(
            a[0] * w[0] + b[0] * w[1] + c[0] * w[2],
            a[1] * w[0] + b[1] * w[1] + c[1] * w[2],
            a[2] * w[0] + b[2] * w[1] + c[2] * w[2],
        )
        values[f, s] = trilinear(volume, x, lower, spacing)


@wp.kernel
def look_up_directions(
    first: int,
    x: wp.array(dtype=wp.vec3d),
    slope_x: wp.array3d(dtype=wp.float64),
    slope_y: wp.array3d(dtype=wp.float64),
    slope_z: wp.array3d(dtype=wp.float64),
    lower: wp.vec3d,
    spacing: wp.float64,
    directions: wp.array(dtype=wp.vec3d),
):
    """Unit directions (n,) of a slope at points x (n,), zero where it is flat."""
    n = first + wp.tid()
    u = trilinear(slope_x, x[n], lower, spacing)
    v = trilinear(slope_y, x[n], lower, spacing)
    w = trilinear(slope_z, x[n], lower, spacing)
    length = wp.sqrt(u * u + v * v + w * w)
    if length > FLAT:
        directions[n] = wp.vec3d(u / length, v / length, w / length)
    else:
        directions[n] = wp.vec3d(ZERO, ZERO, ZERO)


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
    most: wp.float64,
    points: wp.array(dtype=wp.vec3d),
    starts: wp.array(dtype=int),
    shape: wp.vec3i,
    lower: wp.vec3d,
    spacing: wp.float64,
    distance: wp.array(dtype=wp.float64),
):
    """Distance (n,) from x (n,) to the nearest of the points, of which there is at least one; `most` if it is more.
    about (n,): radius greater than 0 in which the search begins; it grows until there is one within it."""
    n = first + wp.tid()
    limit = wp.min(about[n], most)
    best = least_squared(x[n], limit, points, starts, shape, lower, spacing)
    while best >= limit * limit and limit < most:
        limit = wp.min(limit * GROWTH, most)
        best = least_squared(x[n], limit, points, starts, shape, lower, spacing)
    distance[n] = wp.sqrt(best)
