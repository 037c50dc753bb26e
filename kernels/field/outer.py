"""A sparse voxel grid in contracted space around a box: what lies between cameras and the box, and beyond it."""

# In box units u (the box is [-1, 1]^3) with m = max |u_i| > 1, attained by coordinate a, p_i = u_i / m for the others
# and p_a = sign(u_a) (2 - 1 / m): the region before each face becomes a slab on it (Reiser et al., "MeRF", SIGGRAPH
# 2023). The map is continuous, and projective in a region: a straight ray stays straight, is marched cell by cell and
# goes on in another slab. Density is per unit of contracted length: a voxel stops as much light far away as nearby.
# Colours do not depend on direction. C = sum_k T_k (1 - exp(-sigma_k d_k)) c_k + T_end sky, a cube of colours at
# infinity (field/background). Node (i, j, k) of n^3 lies at p = (i, j, k) 4 / n + 2 / n - 2; positions are from the
# middle of the box, in world units.

import warp as wp

from ..view.rays import PinholeCamera, box_span, pixel_direction, tile_pixel
from .background import BackgroundLayers, layer_value, surface_sample
from .grid import eight_rows, eight_weights, exit_distance

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
vec6 = wp.types.vector(length=6, dtype=wp.float32)
six_regions = wp.types.vector(length=6, dtype=wp.int32)

#: A ray ends where this share of the light is left.
OUTER_STOP = wp.constant(1.0e-3)

#: Voxels from one sample to the next.
OUTER_STEP = wp.constant(0.5)

#: Distance that stands for infinity.
FAR_AWAY = wp.constant(1.0e30)


@wp.struct
class OuterGrid:
    """A grid around a box."""

    half: wp.vec3  # half sides of the box, world units
    links: wp.array3d(dtype=wp.int32)  # (n, n, n) row of a node, or -1
    skip: wp.array3d(dtype=wp.uint8)  # (n-1, n-1, n-1) cells to the nearest that holds anything, as in field/grid
    values: wp.array(dtype=wp.vec4)  # (rows,) red, green, blue, density per unit of contracted length
    sky: BackgroundLayers  # one layer, at infinity


@wp.struct
class OuterPath:
    """A ray's way around the box, in the order in which it goes from region to region."""

    count: int
    region: six_regions  # 2 * axis, and 1 more on the upper side
    begin: vec6  # distances along the ray
    end: vec6


@wp.struct
class OuterPiece:
    """A ray in one region: samples on a straight line in node coordinates."""

    start: wp.vec3  # where the ray comes in
    slope: wp.vec3  # from one sample to the next
    count: int  # samples
    length: float  # of contracted space from one sample to the next


@wp.struct
class OuterSample:
    """Rows, trilinear weights and value in a cell."""

    rows: eight_rows
    weights: eight_weights
    value: wp.vec4


@wp.func
def contracted_in(u: wp.vec3, region: int):
    """Contracted place of a point, box units, in or at the border of a region."""
    axis = region // 2
    sign = 2.0 * float(region % 2) - 1.0
    largest = sign * u[axis]
    p = u / largest
    p[axis] = sign * (2.0 - 1.0 / largest)
    return p


@wp.func
def expanded(p: wp.vec3):
    """The point in box units that is contracted to p, max |p_i| below 2."""
    axis = int(0)
    for other in range(1, 3):
        if wp.abs(p[other]) > wp.abs(p[axis]):
            axis = other
    if wp.abs(p[axis]) <= 1.0:
        return p
    largest = 1.0 / (2.0 - wp.abs(p[axis]))
    u = largest * p
    u[axis] = wp.where(p[axis] > 0.0, largest, -largest)
    return u


@wp.func
def region_span(o: wp.vec3, d: wp.vec3, region: int, begin: float, end: float):
    """Distances between which a ray o + t d, box units, is in a region; none where the second is not the larger."""
    axis = region // 2
    sign = 2.0 * float(region % 2) - 1.0  # regions share borders to the bit: conditions are each other's negatives
    near = begin
    far = end
    for side in range(5):
        a = sign * o[axis]
        b = sign * d[axis]
        if side == 4:
            a -= 1.0
        else:
            other = (axis + 1 + side // 2) % 3
            turned = 2.0 * float(side % 2) - 1.0
            a += turned * o[other]
            b += turned * d[other]
        if b > 0.0:
            near = wp.max(near, -a / b)
        elif b < 0.0:
            far = wp.min(far, -a / b)
        elif a < 0.0:
            far = -1.0
    return wp.vec2(near, far)


@wp.func
def outer_path(outer: OuterGrid, origin: wp.vec3, direction: wp.vec3, begin: float, end: float):
    """The way of a ray around the box between two distances. direction: of unit length in world units."""
    path = OuterPath()
    o = wp.cw_div(origin, outer.half)
    d = wp.cw_div(direction, outer.half)
    for region in range(6):
        span = region_span(o, d, region, begin, end)
        if span[1] > span[0]:
            place = path.count
            while place > 0 and path.begin[wp.max(place - 1, 0)] > span[0]:
                path.region[place] = path.region[place - 1]
                path.begin[place] = path.begin[place - 1]
                path.end[place] = path.end[place - 1]
                place -= 1
            path.region[place] = region
            path.begin[place] = span[0]
            path.end[place] = span[1]
            path.count += 1
    return path


@wp.func
def outer_piece(outer: OuterGrid, origin: wp.vec3, direction: wp.vec3, path: OuterPath, n: int):
    """The n-th piece of a path."""
    o = wp.cw_div(origin, outer.half)
    d = wp.cw_div(direction, outer.half)
    per_unit = 0.25 * float(outer.links.shape[0])
    corner = wp.vec3(2.0, 2.0, 2.0)
    shift = wp.vec3(0.5, 0.5, 0.5)
    begin = per_unit * (contracted_in(o + path.begin[n] * d, path.region[n]) + corner) - shift
    end = per_unit * (contracted_in(o + path.end[n] * d, path.region[n]) + corner) - shift
    length = wp.length(end - begin)
    piece = OuterPiece()
    piece.count = int(wp.ceil(length / OUTER_STEP))
    piece.start = begin
    piece.slope = (end - begin) / float(wp.max(piece.count, 1))
    piece.length = length / float(wp.max(piece.count, 1)) / per_unit
    return piece


@wp.func
def outer_place(outer: OuterGrid, piece: OuterPiece, k: int):
    """Node coordinates of a sample; what is beyond the last nodes, towards infinity, is as they are."""
    g = piece.start + (float(k) + 0.5) * piece.slope
    top = float(outer.links.shape[0] - 1) - 1.0e-3
    return wp.vec3(wp.clamp(g[0], 0.0, top), wp.clamp(g[1], 0.0, top), wp.clamp(g[2], 0.0, top))


@wp.func
def outer_empty(outer: OuterGrid, g: wp.vec3):
    """Cells from that of g to the nearest that holds anything."""
    return int(outer.skip[int(g[0]), int(g[1]), int(g[2])])


@wp.func
def sample_after(piece: OuterPiece, k: int, g: wp.vec3, empty: int):
    """The first sample after k, at g, that is not among the cells within empty - 1 of its own."""
    return wp.max(k + 1, int(wp.min(wp.ceil(float(k) + exit_distance(g, piece.slope, empty)), 1.0e6)))


@wp.func
def outer_sample(outer: OuterGrid, g: wp.vec3):
    """Rows, weights and value at node coordinates within the grid."""
    result = OuterSample()
    i = int(g[0])
    j = int(g[1])
    k = int(g[2])
    f = g - wp.vec3(float(i), float(j), float(k))
    for c in range(8):
        di = c >> 2
        dj = (c >> 1) & 1
        dk = c & 1
        row = outer.links[i + di, j + dj, k + dk]
        weight = (
            wp.where(di == 1, f[0], 1.0 - f[0])
            * wp.where(dj == 1, f[1], 1.0 - f[1])
            * wp.where(dk == 1, f[2], 1.0 - f[2])
        )
        result.rows[c] = row
        result.weights[c] = weight
        if row >= 0:
            result.value += weight * outer.values[row]
    return result


@wp.func
def shown_color(value: wp.vec4):
    """Colour of a sample, not below zero."""
    return wp.max(wp.vec3(value[0], value[1], value[2]), wp.vec3(0.0, 0.0, 0.0))


@wp.func
def march_outer(outer: OuterGrid, origin: wp.vec3, direction: wp.vec3, begin: float, end: float):
    """Colour before what is behind, and the light that is left, of a ray between two distances, outside the box."""
    color = wp.vec3()
    light = float(1.0)
    path = outer_path(outer, origin, direction, begin, end)
    for n in range(path.count):
        piece = outer_piece(outer, origin, direction, path, n)
        k = int(0)
        while k < piece.count and light > OUTER_STOP:
            g = outer_place(outer, piece, k)
            empty = outer_empty(outer, g)
            if empty > 0:
                k = sample_after(piece, k, g, empty)
            else:
                value = outer_sample(outer, g).value
                if value[3] > 0.0:
                    kept = wp.exp(-value[3] * piece.length)
                    color += light * (1.0 - kept) * shown_color(value)
                    light *= kept
                k += 1
    return wp.vec4(color[0], color[1], color[2], light)


@wp.func
def front_end(outer: OuterGrid, origin: wp.vec3, direction: wp.vec3):
    """Distance up to which a ray's way is before the box: where it enters it, or half of the way by it."""
    span = box_span(origin, direction, -outer.half, outer.half)
    if span[0] < span[1]:
        return span[0]
    return wp.max(0.5 * -wp.dot(origin, direction), 0.0)


@wp.func
def sky_color(outer: OuterGrid, direction: wp.vec3):
    """Colour of the sky in a direction."""
    value = layer_value(outer.sky, 0, surface_sample(outer.sky.side, direction))
    return shown_color(value)


@wp.func
def outer_color(outer: OuterGrid, origin: wp.vec3, direction: wp.vec3, begin: float):
    """What a ray sees from a distance on, the sky included."""
    seen = march_outer(outer, origin, direction, begin, FAR_AWAY)
    color = wp.vec3(seen[0], seen[1], seen[2])
    if seen[3] > OUTER_STOP:
        color += seen[3] * sky_color(outer, direction)
    return color


@wp.kernel
def sample_outer(
    first: int,
    outer: OuterGrid,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    rgb: wp.array(dtype=wp.vec3),
):
    """Colours (n,) along rays from origins (n,) in unit directions (n,), with nothing in the box."""
    n = first + wp.tid()
    rgb[n] = outer_color(outer, origins[n], directions[n], 0.0)


@wp.kernel
def compose_outer(
    first: int,
    outer: OuterGrid,
    camera: PinholeCamera,
    depth: wp.array(dtype=wp.float32),
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    light: wp.array(dtype=wp.float32),
):
    """Put what is around the box before and behind a picture on black, (h * w,) all. depth: of what the picture shows,
    inf where that is nothing; light: share that passes what is before it. One thread per pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        n = row * camera.width + column
        direction = pixel_direction(camera, column, row)
        between = depth[n]
        color = wp.vec3()
        left = float(1.0)
        if between < FAR_AWAY:
            front = march_outer(outer, camera.center, direction, 0.0, between)
            color = wp.vec3(front[0], front[1], front[2])
            left = front[3]
        else:
            between = float(0.0)
        color += left * rgb[n]
        passed = left * (1.0 - alpha[n])
        if passed > OUTER_STOP:
            color += passed * outer_color(outer, camera.center, direction, between)
        rgb[n] = color
        alpha[n] = left * alpha[n]
        light[n] = left


@wp.kernel
def dim_pixels(first: int, light: wp.array(dtype=wp.float32), values: wp.array(dtype=wp.float32)):
    """Multiply the pixels of a mask by the light that passes what is before them."""
    n = first + wp.tid()
    values[n] = light[n] * values[n]


@wp.kernel
def mark_outer_nodes(
    first: int,
    half: wp.vec3,
    cameras: wp.array(dtype=PinholeCamera),
    nearest: float,
    front: float,
    least: int,
    mask: wp.array3d(dtype=wp.uint8),
):
    """1 at nodes (n, n, n) before the faces of the box, and next to there, that may hold matter; 0 elsewhere."""
    # A node must be seen by a camera, and by `least` of them where one of them is nearer to it than `front` times its
    # distance to the middle of the box. It must be no nearer to any than `nearest`, world units.
    n = first + wp.tid()
    side = mask.shape[0]
    k = n % side
    j = (n // side) % side
    i = n // (side * side)
    voxel = 4.0 / float(side)
    p = voxel * wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5) - wp.vec3(2.0, 2.0, 2.0)
    largest = wp.max(wp.abs(p))
    seen = int(0)
    kept = int(0)
    outside = int(0)
    for axis in range(3):
        if wp.abs(p[axis]) > 1.0 + voxel:
            outside += 1
    if largest > 1.0 - voxel and outside < 2:  # between the slabs of two faces there is no space
        u = expanded(p)
        x = wp.cw_mul(u, half)
        needed = int(1)
        kept = int(1)
        for view in range(cameras.shape[0]):
            camera = cameras[view]
            local = wp.transpose(camera.rotation) * (x - camera.center)
            if wp.length(local) < nearest:
                kept = int(0)
            if local[2] > 0.0:
                column = camera.focal[0] * local[0] / local[2] + camera.principal_point[0]
                row = camera.focal[1] * local[1] / local[2] + camera.principal_point[1]
                if column >= 0.0 and row >= 0.0 and column < float(camera.width) and row < float(camera.height):
                    seen += 1
                    if wp.length(local) < front * wp.length(camera.center):
                        needed = least
        if seen < needed:
            kept = int(0)
    mask[i, j, k] = wp.uint8(kept)


@wp.kernel
def resample_outer(
    first: int, coarse: OuterGrid, nodes: wp.array(dtype=wp.vec3i), side: int, values: wp.array(dtype=wp.vec4)
):
    """Values of the nodes (rows,) of a grid of side^3 from those of another, trilinear among nodes that have rows."""
    row = first + wp.tid()
    node = nodes[row]
    ratio = float(coarse.links.shape[0]) / float(side)
    top = float(coarse.links.shape[0] - 1) - 1.0e-3
    g = wp.vec3()
    for axis in range(3):
        g[axis] = wp.clamp((float(node[axis]) + 0.5) * ratio - 0.5, 0.0, top)
    sample = outer_sample(coarse, g)
    total = float(0.0)
    for c in range(8):
        if sample.rows[c] >= 0:
            total += sample.weights[c]
    values[row] = wp.where(total > 0.0, 1.0 / wp.max(total, 1.0e-12), 0.0) * sample.value
