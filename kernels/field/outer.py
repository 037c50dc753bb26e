"""A sparse voxel grid in contracted space around a box: what lies between cameras and the box, and beyond it."""

# In box units u (the box is [-1, 1]^3) with m = max |u_i| > 1, attained by coordinate a, p_i = u_i / m for the others
# and p_a = sign(u_a) (2 - 1 / m): the region before each face becomes a slab on it (Reiser et al., "MeRF", SIGGRAPH
# 2023). The map is continuous, and projective in a region: a straight ray stays straight, is marched cell by cell and
# goes on in another slab. Density is per unit of contracted length: a voxel stops as much light far away as nearby.
# Colours do not depend on direction. C = sum_k T_k (1 - exp(-sigma_k d_k)) c_k + T_end sky, a cube of colours at
# infinity (field/background). Node (i, j, k) of n^3 lies at p = (i, j, k) 4 / n + 2 / n - 2; positions are from the
# middle of the box, in world units.

import warp as wp

from ..core.gradients import forward, forward_only_in
from ..core.lanes import (
    from_octet_lane,
    grid_place,
    index_from_octet_lane,
    octet_ballot,
    octet_product_before,
    octets_go_on,
    sum_of_octet,
)
from ..view.rays import PinholeCamera, box_span, pixel_direction, tile_pixel
from .background import BackgroundLayers, layer_value, surface_sample
from .columns import Columns, cell_rows
from .grid import eight_rows, eight_weights, exit_distance, steps_to_sample
from .outer_bricks import ACROSS_BITS, BRICK_CELLS, OuterBricks, brick_value, reads_textures

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

vec6 = wp.types.vector(length=6, dtype=wp.float32)

forward_only = forward_only_in(
    __name__, (wp.vec4, wp.vec3), (wp.vec3, wp.vec3), (vec6, wp.vec3), (eight_weights, wp.vec3)
)

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
    columns: Columns  # of (n, n, n) nodes, rows in memory order
    skip: wp.array3d(dtype=wp.uint8)  # (n-1, n-1, n-1) cells to the nearest that holds anything, as in field/grid
    values: wp.array(dtype=wp.vec4)  # (rows,) red, green, blue, density per unit of contracted length
    sky: BackgroundLayers  # one layer, at infinity
    bricks: OuterBricks  # the values once more, for frames on a GPU


@wp.struct
class OuterPath:
    """A ray's way around the box."""

    begin: vec6  # distances along the ray between which it is in each region: 2 * axis, and 1 more on the upper side;
    end: vec6  # not beyond the first where it is not in it


@wp.struct
class OuterTurn:
    """A part of a path in one region."""

    region: int  # or -1, none
    begin: float
    end: float


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


@wp.struct
class OuterStep:
    """What one of the lanes that march a ray together finds of their next samples, one a lane."""

    sample: OuterSample
    has_matter: int
    before: float  # light that comes to the sample
    kept: float  # share of it that passes
    light: float  # that is left behind the samples of all lanes
    following: int  # the sample with which the next step begins


@wp.func
def along(v: wp.vec3, axis: int):
    """v[axis] by branches: a runtime index would put v into local memory."""
    return wp.where(axis == 0, v[0], wp.where(axis == 1, v[1], v[2]))


@wp.func
def contracted_in(u: wp.vec3, region: int):
    """Contracted place of a point, box units, in or at the border of a region."""
    sign = 2.0 * float(region % 2) - 1.0
    largest = sign * along(u, region // 2)
    p = u / largest
    for axis in range(3):
        if axis == region // 2:
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
    return forward_only(u, p)


@wp.func
def region_span(o: wp.vec3, d: wp.vec3, region: int, begin: float, end: float):
    """Distances between which a ray o + t d, box units, is in a region; none where the second is not the larger."""
    axis = region // 2
    sign = 2.0 * float(region % 2) - 1.0  # regions share borders to the bit: conditions are each other's negatives
    near = begin
    far = end
    for side in range(5):
        a = sign * along(o, axis)
        b = sign * along(d, axis)
        if side == 4:
            a -= 1.0
        else:
            other = (axis + 1 + side // 2) % 3
            turned = 2.0 * float(side % 2) - 1.0
            a += turned * along(o, other)
            b += turned * along(d, other)
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
        path.begin[region] = span[0]
        path.end[region] = span[1]
    path.begin = forward_only(path.begin, origin)
    path.end = forward_only(path.end, origin)
    return path


@wp.func
def turn_before_all():
    """What comes before the first turn of any path."""
    turn = OuterTurn()
    turn.region = -1
    turn.begin = -1.0
    return turn


@wp.func
def turn_after(path: OuterPath, last: OuterTurn):
    """The turn that follows in the order in which the ray goes from region to region."""
    turn = OuterTurn()
    turn.region = -1
    turn.begin = FAR_AWAY  # nothing follows none
    for region in range(6):
        begin = path.begin[region]
        follows = begin > last.begin or (begin == last.begin and region > last.region)
        if follows and path.end[region] > begin and (turn.region < 0 or begin < turn.begin):
            turn.region = region
            turn.begin = begin
            turn.end = path.end[region]
    return turn


@wp.func
def outer_piece(outer: OuterGrid, origin: wp.vec3, direction: wp.vec3, turn: OuterTurn):
    """The piece of a turn; without samples for none."""
    o = wp.cw_div(origin, outer.half)
    d = wp.cw_div(direction, outer.half)
    per_unit = 0.25 * float(outer.columns.node_counts[0])
    corner = wp.vec3(2.0, 2.0, 2.0)
    shift = wp.vec3(0.5, 0.5, 0.5)
    begin = per_unit * (contracted_in(o + turn.begin * d, turn.region) + corner) - shift
    end = per_unit * (contracted_in(o + turn.end * d, turn.region) + corner) - shift
    length = wp.length(end - begin)
    piece = OuterPiece()
    if turn.region >= 0:
        piece.count = int(wp.ceil(length / OUTER_STEP))
    piece.start = begin
    piece.slope = (end - begin) / float(wp.max(piece.count, 1))
    piece.length = length / float(wp.max(piece.count, 1)) / per_unit
    return piece


@wp.func
def outer_place(outer: OuterGrid, piece: OuterPiece, k: int):
    """Node coordinates of a sample, clamped to the last nodes towards infinity."""
    g = piece.start + steps_to_sample(float(k)) * piece.slope
    top = float(outer.columns.node_counts[0] - 1) - 1.0e-3
    return wp.vec3(wp.clamp(g[0], 0.0, top), wp.clamp(g[1], 0.0, top), wp.clamp(g[2], 0.0, top))


@wp.func
def outer_empty(outer: OuterGrid, g: wp.vec3):
    """Cells from that of g to the nearest that holds anything."""
    return int(outer.skip[int(g[0]), int(g[1]), int(g[2])])


@wp.func
def sample_after(piece: OuterPiece, k: int, g: wp.vec3, empty: int):
    """The first sample after k, at g, that is not among the cells within empty - 1 of its own."""
    return wp.max(k + 1, int(wp.min(wp.ceil(float(k) + exit_distance(g, piece.slope, empty)), 1.0e6)))


@forward.func_native("""
    wp::vec_t<4, wp::float32> sum;
#if defined(__CUDA_ARCH__)
    const float4* numbers = reinterpret_cast<const float4*>(values.data);
    float4 read[8];
    #pragma unroll
    for (int c = 0; c < 8; ++c)
        read[c] = rows.c[c] >= 0 ? __ldg(numbers + rows.c[c]) : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    #pragma unroll
    for (int c = 0; c < 8; ++c)
    {
        sum.c[0] += weights.c[c] * read[c].x;
        sum.c[1] += weights.c[c] * read[c].y;
        sum.c[2] += weights.c[c] * read[c].z;
        sum.c[3] += weights.c[c] * read[c].w;
    }
#else
    for (int c = 0; c < 8; ++c)
        if (rows.c[c] >= 0)
            for (int channel = 0; channel < 4; ++channel)
                sum.c[channel] += weights.c[c] * values.data[rows.c[c]].c[channel];
#endif
    return sum;
""")
def blended_rows(values: wp.array(dtype=wp.vec4), rows: eight_rows, weights: eight_weights) -> wp.vec4:
    """Rows in their weights, added up; -1 is none. On CUDA eight reads of 16 bytes, all under way at once."""
    ...


@wp.func
def outer_rows(outer: OuterGrid, g: wp.vec3):
    """Rows of the eight nodes around node coordinates within the grid."""
    return cell_rows(outer.columns, int(g[0]), int(g[1]), int(g[2]))


@wp.func
def outer_sample(outer: OuterGrid, g: wp.vec3, rows: eight_rows):
    """Rows, weights and value at node coordinates within the grid."""
    result = OuterSample()
    f = g - wp.vec3(wp.floor(g[0]), wp.floor(g[1]), wp.floor(g[2]))
    result.rows = rows
    for c in range(8):
        di = c >> 2
        dj = (c >> 1) & 1
        dk = c & 1
        result.weights[c] = (
            wp.where(di == 1, f[0], 1.0 - f[0])
            * wp.where(dj == 1, f[1], 1.0 - f[1])
            * wp.where(dk == 1, f[2], 1.0 - f[2])
        )
    result.weights = forward_only(result.weights, g)
    result.value = blended_rows(outer.values, result.rows, result.weights)
    return result


@wp.func
def outer_value(outer: OuterGrid, g: wp.vec3):
    """Value at node coordinates in a cell that holds anything, by the texture units of a GPU."""
    if reads_textures() == 1:
        return brick_value(outer.bricks, g, BRICK_CELLS, ACROSS_BITS)
    return outer_sample(outer, g, outer_rows(outer, g)).value


@wp.func
def shown_color(value: wp.vec4):
    """Colour of a sample, not below zero."""
    return wp.max(wp.vec3(value[0], value[1], value[2]), wp.vec3(0.0, 0.0, 0.0))


@wp.func
def any_goes_on(goes_on: bool, lanes: int):
    """Whether a march goes on: its own, or that of any octet of the warp where an octet takes a ray."""
    if lanes > 1:
        return octets_go_on(int(goes_on)) != 0
    return goes_on


@wp.func
def outer_step(outer: OuterGrid, piece: OuterPiece, k: int, light: float, lane: int, lanes: int):
    """The samples from k on of a march. lanes: 1, or an octet at one piece; those of a march that is at its end, or
    dark, find nothing."""
    step = OuterStep()
    own = k + lane
    g = outer_place(outer, piece, own)
    empty = int(1)
    rows = eight_rows()
    if own < piece.count and light > OUTER_STOP:
        empty = outer_empty(outer, g)
        rows = outer_rows(outer, g)  # before it is known whether any is there: both reads are under way at once
    step.kept = 1.0
    step.following = k + lanes
    after = own + 1
    if empty > 0:
        after = sample_after(piece, own, g, empty)
    else:
        step.sample = outer_sample(outer, g, rows)
        if step.sample.value[3] > 0.0:
            step.has_matter = 1
            step.kept = wp.exp(-step.sample.value[3] * piece.length)
    step.before = light
    if lanes > 1:
        last = index_from_octet_lane(after, lanes - 1)
        if octet_ballot(1 - wp.min(empty, 1)) == 0:
            step.following = last
        step.before = light * octet_product_before(step.kept, lane)
        if step.before <= OUTER_STOP:
            step.has_matter = 0
        step.light = from_octet_lane(step.before * step.kept, lanes - 1)
    else:
        step.following = after
        step.light = light * step.kept
    return step


@wp.func
def march_outer(outer: OuterGrid, origin: wp.vec3, direction: wp.vec3, begin: float, end: float, lane: int, lanes: int):
    """Colour before what is behind, and the light that is left, of a ray between two distances, outside the box.
    lanes: an octet (core/lanes) at one ray, all of its warp at once, or 1, which reads `bricks` on a GPU."""
    color = wp.vec3()
    light = float(1.0)
    path = outer_path(outer, origin, direction, begin, end)
    turn = turn_after(path, turn_before_all())
    while any_goes_on(turn.region >= 0, lanes):
        piece = outer_piece(outer, origin, direction, turn)
        k = int(0)
        while any_goes_on(k < piece.count and light > OUTER_STOP, lanes):
            if lanes > 1:
                step = outer_step(outer, piece, k, light, lane, lanes)
                if step.has_matter > 0:
                    color += step.before * (1.0 - step.kept) * shown_color(step.sample.value)
                light = step.light
                k = step.following
            else:
                g = outer_place(outer, piece, k)
                empty = outer_empty(outer, g)
                if empty > 0:
                    k = sample_after(piece, k, g, empty)
                else:
                    value = outer_value(outer, g)
                    if value[3] > 0.0:
                        kept = wp.exp(-value[3] * piece.length)
                        color += light * (1.0 - kept) * shown_color(value)
                        light *= kept
                    k += 1
        turn = turn_after(path, turn)
    if lanes > 1:
        for channel in range(3):
            color[channel] = sum_of_octet(color[channel])
    return forward_only(wp.vec4(color[0], color[1], color[2], light), origin)


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
    seen = march_outer(outer, origin, direction, begin, FAR_AWAY, 0, 1)
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
            front = march_outer(outer, camera.center, direction, 0.0, between, 0, 1)
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
    side = mask.shape[0]
    i, j, k = grid_place(first + wp.tid(), side, side)
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
    first: int, coarse: OuterGrid, nodes: wp.array(dtype=wp.int32), side: int, values: wp.array(dtype=wp.vec4)
):
    """Values of the nodes (rows,) of a grid of side^3 from those of another, trilinear among nodes that have rows."""
    row = first + wp.tid()
    i, j, k = grid_place(nodes[row], side, side)
    ratio = float(coarse.columns.node_counts[0]) / float(side)
    top = float(coarse.columns.node_counts[0] - 1) - 1.0e-3
    g = ratio * wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5)
    for axis in range(3):
        g[axis] = wp.clamp(g[axis] - 0.5, 0.0, top)
    sample = outer_sample(coarse, g, outer_rows(coarse, g))
    total = float(0.0)
    for c in range(8):
        if sample.rows[c] >= 0:
            total += sample.weights[c]
    values[row] = wp.where(total > 0.0, 1.0 / wp.max(total, 1.0e-12), 0.0) * sample.value
