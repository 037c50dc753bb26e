"""Join the pixels of a picture in squares of side x side: supersampling against aliasing."""

# Colours and opacities are averaged as an area filter has it; depths by how opaque each part is.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def part_index(n: int, part: int, side: int, width: int):
    """Flat index, in the fine picture, of a part of the n-th pixel. width: pixels of the coarse picture."""
    row = (n // width) * side + part // side
    column = (n % width) * side + part % side
    return row * width * side + column


@wp.kernel
def average_colours(
    first: int, side: int, width: int, parts: wp.array(dtype=wp.vec3), colours: wp.array(dtype=wp.vec3)
):
    """parts: (h * side * width * side,). colours: (h * width,)."""
    n = first + wp.tid()
    total = wp.vec3()
    for part in range(side * side):
        total += parts[part_index(n, part, side, width)]
    colours[n] = total / float(side * side)


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
