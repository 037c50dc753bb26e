"""Pictures as bytes and at smaller sizes: rounding, supersampling against aliasing, previews with a few depths."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: What is left in `state` where all colours are finite, and where one is not.
DONE = wp.constant(1)

NOT_FINITE = wp.constant(2)


@wp.kernel
def round_colors(
    first: int, colors: wp.array(dtype=wp.vec3), packed: wp.array2d(dtype=wp.uint8), state: wp.array(dtype=wp.int32)
):
    """colours: (n,), [0, 1] is the range of a byte. packed: (n, 3), rounded half to even, to the bit as NumPy does it.
    state: (1,), DONE beforehand."""
    n = first + wp.tid()
    color = colors[n]
    for channel in range(3):
        value = color[channel]
        if wp.isfinite(value):
            packed[n, channel] = wp.uint8(wp.int32(wp.rint(wp.clamp(value, 0.0, 1.0) * 255.0)))
        else:
            packed[n, channel] = wp.uint8(0)
            state[0] = NOT_FINITE


@wp.func
def part_index(n: int, part: int, side: int, width: int):
    """Flat index, in the fine picture, of a part of the n-th pixel. width: pixels of the coarse picture."""
    row = (n // width) * side + part // side
    column = (n % width) * side + part % side
    return row * width * side + column


@wp.kernel
def average_colors(first: int, side: int, width: int, parts: wp.array(dtype=wp.vec3), colors: wp.array(dtype=wp.vec3)):
    """parts: (h * side * width * side,). colours: (h * width,)."""
    n = first + wp.tid()
    total = wp.vec3()
    for part in range(side * side):
        total += parts[part_index(n, part, side, width)]
    colors[n] = total / float(side * side)


@wp.kernel
def average_values(
    first: int, side: int, width: int, parts: wp.array(dtype=wp.float32), values: wp.array(dtype=wp.float32)
):
    """parts: (h * side * width * side,). values: (h * width,)."""
    n = first + wp.tid()
    total = float(0.0)
    for part in range(side * side):
        total += parts[part_index(n, part, side, width)]
    values[n] = total / float(side * side)


@wp.kernel
def average_depths(
    first: int,
    side: int,
    width: int,
    parts: wp.array(dtype=wp.float32),
    alphas: wp.array(dtype=wp.float32),
    depths: wp.array(dtype=wp.float32),
):
    """Mean of the finite depths, weighted by opacity; inf where no part is finite. Shapes as above."""
    n = first + wp.tid()
    total = float(0.0)
    weight = float(0.0)
    for part in range(side * side):
        at = part_index(n, part, side, width)
        if wp.isfinite(parts[at]):
            total += alphas[at] * parts[at]
            weight += alphas[at]
    depths[n] = wp.where(weight > 0.0, total / wp.max(weight, 1.0e-12), wp.inf)


@wp.func
def color_byte(value: float):
    """A colour in [0, 1] as a byte, rounded half up."""
    return wp.uint8(wp.int32(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5))


@wp.kernel
def pack_colors(first: int, colors: wp.array(dtype=wp.vec3), packed: wp.array2d(dtype=wp.uint8)):
    """colours: (n,) in [0, 1]. packed: (n, 3)."""
    n = first + wp.tid()
    color = colors[n]
    for channel in range(3):
        packed[n, channel] = color_byte(color[channel])


@wp.kernel
def sample_depths(
    first: int,
    width: int,
    height: int,
    columns: int,
    rows: int,
    alpha_limit: float,
    near: float,
    far: float,
    alphas: wp.array(dtype=wp.float32),
    depths: wp.array(dtype=wp.float32),
    sampled: wp.array(dtype=wp.uint16),
):
    """alphas, depths: (height * width,), world units. sampled: (rows * columns,), each the pixel in its middle."""
    n = first + wp.tid()
    row = ((2 * (n // columns) + 1) * height) // (2 * rows)
    column = ((2 * (n % columns) + 1) * width) // (2 * columns)
    at = row * width + column
    depth = depths[at]
    value = wp.uint16(0)
    if alphas[at] >= alpha_limit and wp.isfinite(depth) and depth > 0.0:
        share = wp.clamp(wp.log(depth / near) / wp.log(far / near), 0.0, 1.0)
        value = wp.uint16(wp.int32(1.5 + 65534.0 * share))
    sampled[n] = value
