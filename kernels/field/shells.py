"""Voxels of a place around a box: nested cubes, each twice as large, of bricks of eight cells a side."""

# Cube k, 0 to K - 1, has half side U_k = H 2^k, H the longest half side of the box; it holds what is outside cube
# k - 1, cube 0 what is outside the box. A table of M^3 entries a cube says which brick is where: one of size s covers
# s^3 entries, its voxels are s / 8 of an entry: a voxel is a cube at any distance. Bricks exist only where there
# is something. Their corners are nodes: bricks of one size share those at which they meet. A row has a constant colour,
# density per U_k (a voxel stops as much light in each cube), and the slope by which colours change with the direction.
# A ray is cut at the cubes' faces, then at the bricks': both sides of a face compute it from the same numbers.
# Positions are from the middle of the box, in world units. Beyond the last cube is a cube of colours at infinity.

import warp as wp

from ..view.rays import PinholeCamera, box_span, pixel_direction, tile_pixel
from .background import BackgroundLayers, layer_value, surface_sample
from .grid import eight_rows, eight_weights
from .outer import FAR_AWAY, OUTER_STEP, OUTER_STOP, shown_color

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Cells along a side of a brick, nodes along it, and both cubed.
BRICK = wp.constant(8)
NODES = wp.constant(9)
BRICK_CELLS = wp.constant(512)
BRICK_NODES = wp.constant(729)

#: A brick is looked for so far ahead, in entries of the table: rounding may leave a ray on either side of a face.
AHEAD = wp.constant(1.0e-3)

#: And by at least this share of the distance, so that a ray from far away gets on.
LEAST_AHEAD = wp.constant(1.0e-6)


@wp.struct
class Shells:
    """Nested cubes around a box."""

    half: wp.vec3  # half sides of the box, world units
    cubes: int
    table: wp.array3d(dtype=wp.int32)  # (K M, M, M) brick, or -1; cube after cube along the first axis
    skip: wp.array3d(dtype=wp.uint8)  # (K M, M, M) entries to the nearest that has a brick, as in field/grid
    places: wp.array(dtype=wp.vec4i)  # (bricks,) first entry and size
    links: wp.array2d(dtype=wp.int32)  # (bricks, 729) row of a node, or -1
    values: wp.array(dtype=wp.vec4)  # (rows,) red, green, blue, density
    slopes: wp.array(dtype=wp.vec4)  # (rows,) change of all colours along x, y, z of the ray's direction; 4th spare
    sky: BackgroundLayers  # one layer, at infinity


@wp.struct
class CubePart:
    """A ray's way through one cube, without the one within: table entries q = start + t slope."""

    begin: float  # distances along the ray
    end: float
    cube: int
    start: wp.vec3
    slope: wp.vec3
    unit: float  # half side of the cube, world units


@wp.struct
class BrickPart:
    """A ray's way through one brick."""

    brick: int  # or -1
    end: float  # distance along the ray
    count: int  # samples
    step: float  # from one to the next, world units
    start: wp.vec3  # brick's cells c = start + t slope
    slope: wp.vec3


@wp.struct
class ShellSample:
    """Rows, trilinear weights and value in a cell."""

    rows: eight_rows
    weights: eight_weights
    value: wp.vec4
    slope: wp.vec4


@wp.func
def cube_part(shells: Shells, origin: wp.vec3, direction: wp.vec3, n: int, begin: float, end: float):
    """The n-th part of a ray between two distances, of 2 K in its order: inwards through the cubes, then outwards."""
    part = CubePart()
    part.cube = wp.where(n < shells.cubes, shells.cubes - 1 - n, n - shells.cubes)
    part.unit = wp.max(shells.half) * float(1 << part.cube)
    corner = wp.vec3(part.unit, part.unit, part.unit)
    inner = wp.where(part.cube == 0, shells.half, 0.5 * corner)
    whole = box_span(origin, direction, -corner, corner)
    within = box_span(origin, direction, -inner, inner)
    part.begin = whole[0]
    part.end = whole[1]
    if within[0] < within[1]:
        if n < shells.cubes:
            part.end = within[0]
        else:
            part.begin = within[1]
    elif n >= shells.cubes:
        part.begin = whole[1]
    part.begin = wp.max(part.begin, begin)
    part.end = wp.min(part.end, end)
    middle = 0.5 * float(shells.table.shape[1])
    part.start = (middle / part.unit) * origin + wp.vec3(middle, middle, middle)
    part.slope = (middle / part.unit) * direction
    return part


@wp.func
def brick_part(shells: Shells, part: CubePart, at: float):
    """The way from a distance on through a brick, or among entries that have none."""
    result = BrickPart()
    side = shells.table.shape[1]
    entry = wp.vec3i()
    ahead = at + wp.max(AHEAD / wp.length(part.slope), LEAST_AHEAD * at)
    for axis in range(3):
        entry[axis] = wp.clamp(int(wp.floor(part.start[axis] + ahead * part.slope[axis])), 0, side - 1)
    offset = part.cube * side
    result.brick = shells.table[offset + entry[0], entry[1], entry[2]]
    lower = entry
    upper = entry
    size = int(1)
    if result.brick >= 0:
        place = shells.places[result.brick]
        size = place[3]
        lower = wp.vec3i(place[0] - offset, place[1], place[2])
        upper = wp.vec3i(lower[0] + size, lower[1] + size, lower[2] + size)
    else:
        reach = int(shells.skip[offset + entry[0], entry[1], entry[2]])
        lower = wp.vec3i(entry[0] - reach + 1, entry[1] - reach + 1, entry[2] - reach + 1)
        upper = wp.vec3i(entry[0] + reach, entry[1] + reach, entry[2] + reach)
    leave = float(part.end)
    for axis in range(3):
        if wp.abs(part.slope[axis]) > 1.0e-12:
            plane = float(wp.where(part.slope[axis] > 0.0, upper[axis], lower[axis]))
            leave = wp.min(leave, (plane - part.start[axis]) / part.slope[axis])
    result.end = wp.max(leave, wp.min(ahead, part.end))
    if result.brick >= 0:
        cells = float(BRICK) / float(size)
        corner = wp.vec3(float(lower[0]), float(lower[1]), float(lower[2]))
        result.start = cells * (part.start - corner)
        result.slope = cells * part.slope
        length = result.end - at
        result.count = wp.max(1, int(wp.ceil(length * wp.length(result.slope) / OUTER_STEP - 1.0e-3)))
        result.step = length / float(result.count)
    return result


@wp.func
def blend_rows(links: wp.array2d(dtype=wp.int32), brick: int, c: wp.vec3):
    """Rows and weights of the eight nodes around a place in a brick's cells."""
    result = ShellSample()
    top = float(BRICK)
    g = wp.vec3(wp.clamp(c[0], 0.0, top), wp.clamp(c[1], 0.0, top), wp.clamp(c[2], 0.0, top))
    i = wp.min(int(g[0]), BRICK - 1)
    j = wp.min(int(g[1]), BRICK - 1)
    k = wp.min(int(g[2]), BRICK - 1)
    f = g - wp.vec3(float(i), float(j), float(k))
    for corner in range(8):
        di = corner >> 2
        dj = (corner >> 1) & 1
        dk = corner & 1
        result.rows[corner] = links[brick, ((i + di) * NODES + j + dj) * NODES + k + dk]
        result.weights[corner] = (
            wp.where(di == 1, f[0], 1.0 - f[0])
            * wp.where(dj == 1, f[1], 1.0 - f[1])
            * wp.where(dk == 1, f[2], 1.0 - f[2])
        )
    return result


@wp.func
def shell_sample(shells: Shells, brick: int, c: wp.vec3):
    """Rows, weights and value at a place in a brick's cells."""
    result = blend_rows(shells.links, brick, c)
    for corner in range(8):
        row = result.rows[corner]
        if row >= 0:
            result.value += result.weights[corner] * shells.values[row]
            result.slope += result.weights[corner] * shells.slopes[row]
    return result


@wp.func
def seen_color(sample: ShellSample, direction: wp.vec3):
    """Colour of a sample along a direction, before the clamp at zero."""
    change = sample.slope[0] * direction[0] + sample.slope[1] * direction[1] + sample.slope[2] * direction[2]
    return wp.vec3(sample.value[0] + change, sample.value[1] + change, sample.value[2] + change)


@wp.func
def march_shells(shells: Shells, origin: wp.vec3, direction: wp.vec3, begin: float, end: float):
    """Colour before what is behind, and the light that is left, of a ray between two distances, outside the box."""
    color = wp.vec3()
    light = float(1.0)
    for n in range(2 * shells.cubes):
        part = cube_part(shells, origin, direction, n, begin, end)
        at = float(part.begin)
        while at < part.end and light > OUTER_STOP:
            brick = brick_part(shells, part, at)
            for k in range(brick.count):
                if light > OUTER_STOP:
                    c = brick.start + (at + (float(k) + 0.5) * brick.step) * brick.slope
                    sample = shell_sample(shells, brick.brick, c)
                    if sample.value[3] > 0.0:
                        kept = wp.exp(-sample.value[3] * brick.step / part.unit)
                        color += light * (1.0 - kept) * wp.max(seen_color(sample, direction), wp.vec3())
                        light *= kept
            at = brick.end
    return wp.vec4(color[0], color[1], color[2], light)


@wp.func
def front_of_box(shells: Shells, origin: wp.vec3, direction: wp.vec3):
    """Distance up to which a ray's way is before the box: where it enters it, or half of the way by it."""
    span = box_span(origin, direction, -shells.half, shells.half)
    if span[0] < span[1]:
        return span[0]
    return wp.max(0.5 * -wp.dot(origin, direction), 0.0)


@wp.func
def color_around(shells: Shells, origin: wp.vec3, direction: wp.vec3, begin: float):
    """What a ray sees from a distance on, the sky included."""
    seen = march_shells(shells, origin, direction, begin, FAR_AWAY)
    color = wp.vec3(seen[0], seen[1], seen[2])
    if seen[3] > OUTER_STOP:
        color += seen[3] * shown_color(layer_value(shells.sky, 0, surface_sample(shells.sky.side, direction)))
    return color


@wp.kernel
def sample_shells(
    first: int,
    shells: Shells,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    rgb: wp.array(dtype=wp.vec3),
):
    """Colours (n,) along rays from origins (n,) in unit directions (n,), with nothing in the box."""
    n = first + wp.tid()
    rgb[n] = color_around(shells, origins[n], directions[n], 0.0)


@wp.kernel
def compose_shells(
    first: int,
    shells: Shells,
    camera: PinholeCamera,
    depth: wp.array(dtype=wp.float32),
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    light: wp.array(dtype=wp.float32),
):
    """As field/outer.compose_outer: what is around the box before and behind a picture on black, (h * w,) all."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        n = row * camera.width + column
        direction = pixel_direction(camera, column, row)
        between = depth[n]
        color = wp.vec3()
        left = float(1.0)
        if between < FAR_AWAY:
            front = march_shells(shells, camera.center, direction, 0.0, between)
            color = wp.vec3(front[0], front[1], front[2])
            left = front[3]
        else:
            between = float(0.0)
        color += left * rgb[n]
        passed = left * (1.0 - alpha[n])
        if passed > OUTER_STOP:
            color += passed * color_around(shells, camera.center, direction, between)
        rgb[n] = color
        alpha[n] = left * alpha[n]
        light[n] = left


# Bricks


@wp.kernel
def fill_table(
    first: int, places: wp.array(dtype=wp.vec4i), table: wp.array3d(dtype=wp.int32), skip: wp.array3d(dtype=wp.uint8)
):
    """Write a brick's number into the entries that it covers, and 0 into those of the distances to bricks."""
    brick = first + wp.tid()
    place = places[brick]
    for i in range(place[3]):
        for j in range(place[3]):
            for k in range(place[3]):
                table[place[0] + i, place[1] + j, place[2] + k] = brick
                skip[place[0] + i, place[1] + j, place[2] + k] = wp.uint8(0)


@wp.func
def node_place(number: int):
    """(i, j, k) of a brick's node."""
    return wp.vec3i(number // (NODES * NODES), (number // NODES) % NODES, number % NODES)


@wp.func
def owner_of_node(table: wp.array3d(dtype=wp.int32), places: wp.array(dtype=wp.vec4i), brick: int, number: int):
    """Brick and number of a node in the first, in one order for all, of the bricks of its size that have it."""
    place = places[brick]
    node = node_place(number)
    side = table.shape[1]
    offset = place[0] // side * side
    own = wp.vec3i(place[0], place[1], place[2])
    for turn in range(8):
        there = own
        local = node
        possible = bool(True)
        for axis in range(3):
            lower = (turn >> axis) & 1  # of the two bricks that meet at a face
            if node[axis] == 0 and lower == 1:
                there[axis] = there[axis] - place[3]
                local[axis] = BRICK
            elif node[axis] == BRICK and lower == 0:
                there[axis] = there[axis] + place[3]
                local[axis] = 0
            elif node[axis] != BRICK and lower == 1:
                possible = False
            first_entry = wp.where(axis == 0, offset, 0)
            if there[axis] < first_entry or there[axis] >= first_entry + side:
                possible = False
        if possible:
            other = table[there[0], there[1], there[2]]
            if other >= 0:
                found = places[other]
                same = found[0] == there[0] and found[1] == there[1] and found[2] == there[2]
                if same and found[3] == place[3]:
                    return wp.vec2i(other, (local[0] * NODES + local[1]) * NODES + local[2])
    return wp.vec2i(brick, number)


#: What a node of a brick is: none, one that has a row, or one whose row is in another brick.
OWNED = wp.constant(wp.uint8(1))
BORROWED = wp.constant(wp.uint8(2))


@wp.kernel
def share_nodes(
    first: int, table: wp.array3d(dtype=wp.int32), places: wp.array(dtype=wp.vec4i), nodes: wp.array2d(dtype=wp.uint8)
):
    """Tell which of the nodes (bricks, 729) that are not 0 are borrowed, and have their owners own them."""
    n = first + wp.tid()
    brick = n // BRICK_NODES
    number = n % BRICK_NODES
    if nodes[brick, number] != wp.uint8(0):
        owner = owner_of_node(table, places, brick, number)
        if owner[0] != brick:
            nodes[brick, number] = BORROWED
            nodes[owner[0], owner[1]] = OWNED  # all that write here write this


@wp.kernel
def adopt_nodes(
    first: int, table: wp.array3d(dtype=wp.int32), places: wp.array(dtype=wp.vec4i), nodes: wp.array2d(dtype=wp.uint8)
):
    """Have bricks borrow the nodes on their faces that others of their size have: values go on across faces."""
    n = first + wp.tid()
    brick = n // BRICK_NODES
    number = n % BRICK_NODES
    if nodes[brick, number] == wp.uint8(0):
        owner = owner_of_node(table, places, brick, number)
        if owner[0] != brick:
            if nodes[owner[0], owner[1]] == OWNED:
                nodes[brick, number] = BORROWED


@wp.kernel
def count_owned(first: int, nodes: wp.array2d(dtype=wp.uint8), counts: wp.array(dtype=wp.int32)):
    """Rows of each brick, (bricks,)."""
    brick = first + wp.tid()
    count = int(0)
    for number in range(BRICK_NODES):
        if nodes[brick, number] == OWNED:
            count += 1
    counts[brick] = count


@wp.kernel
def link_owned(
    first: int,
    places: wp.array(dtype=wp.vec4i),
    nodes: wp.array2d(dtype=wp.uint8),
    running_count: wp.array(dtype=wp.int32),
    links: wp.array2d(dtype=wp.int32),
    sizes: wp.array(dtype=wp.uint8),
):
    """Number the nodes that have rows, -1 for others. running_count: (bricks,) inclusive scan; sizes: (rows,)."""
    brick = first + wp.tid()
    row = int(0)
    if brick > 0:
        row = running_count[brick - 1]
    for number in range(BRICK_NODES):
        links[brick, number] = -1
        if nodes[brick, number] == OWNED:
            links[brick, number] = row
            sizes[row] = wp.uint8(places[brick][3])
            row += 1


@wp.kernel
def link_borrowed(
    first: int,
    table: wp.array3d(dtype=wp.int32),
    places: wp.array(dtype=wp.vec4i),
    nodes: wp.array2d(dtype=wp.uint8),
    links: wp.array2d(dtype=wp.int32),
):
    """Give the nodes that borrow a row that of their owner. One item per node of each brick."""
    n = first + wp.tid()
    brick = n // BRICK_NODES
    number = n % BRICK_NODES
    if nodes[brick, number] == BORROWED:
        owner = owner_of_node(table, places, brick, number)
        links[brick, number] = links[owner[0], owner[1]]


@wp.kernel
def mark_seen_cells(
    first: int,
    half: wp.vec3,
    side: int,
    places: wp.array(dtype=wp.vec4i),
    cameras: wp.array(dtype=PinholeCamera),
    nearest: float,
    front: float,
    least: int,
    cells: wp.array2d(dtype=wp.uint8),
):
    """1 in cells (bricks, 512) that may hold matter, by where cameras stand and look; 0 in others. side: of the table.
    Otherwise as outer.mark_outer_nodes; a cell is seen where its middle or a corner is."""
    n = first + wp.tid()
    brick = n // BRICK_CELLS
    cell = n % BRICK_CELLS
    place = places[brick]
    cube = place[0] // side
    unit = wp.max(half) * float(1 << cube)
    entry = 2.0 * unit / float(side)
    voxel = entry * float(place[3]) / float(BRICK)
    lower = wp.vec3(float(place[0] - cube * side), float(place[1]), float(place[2]))
    within = wp.vec3(float(cell // 64), float((cell // 8) % 8), float(cell % 8)) + wp.vec3(0.5, 0.5, 0.5)
    x = entry * lower + voxel * within - wp.vec3(unit, unit, unit)
    inner = wp.where(cube == 0, half, wp.vec3(0.5 * unit, 0.5 * unit, 0.5 * unit))
    kept = int(0)
    for axis in range(3):
        if wp.abs(x[axis]) + 0.5 * voxel > inner[axis]:
            kept = int(1)
    needed = int(1)
    seen = int(0)
    for view in range(cameras.shape[0]):
        camera = cameras[view]
        distance = wp.length(x - camera.center)
        if distance < nearest:
            kept = int(0)
        shown = bool(False)
        for corner in range(9):
            y = x
            if corner < 8:
                y = x + voxel * wp.vec3(
                    float(corner >> 2) - 0.5, float((corner >> 1) & 1) - 0.5, float(corner & 1) - 0.5
                )
            local = wp.transpose(camera.rotation) * (y - camera.center)
            if local[2] > 0.0:
                column = camera.focal[0] * local[0] / local[2] + camera.principal_point[0]
                row = camera.focal[1] * local[1] / local[2] + camera.principal_point[1]
                if column >= 0.0 and row >= 0.0 and column < float(camera.width) and row < float(camera.height):
                    shown = True
        if shown:
            seen += 1
            if distance < front * wp.length(camera.center):
                needed = least
    if seen < needed:
        kept = int(0)
    cells[brick, cell] = wp.uint8(kept)
