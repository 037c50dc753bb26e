"""What is sent of a frame: colours as bytes, and few depths in 16 bits."""

# Depths are kept by ratio: v = 1 + 65534 log(depth / near) / log(far / near), rounded and held to 1 ... 65535; 0 where
# nothing is seen.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def colour_byte(value: float):
    """A colour in [0, 1] as a byte, rounded half up."""
    return wp.uint8(wp.int32(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5))


@wp.kernel
def pack_colours(first: int, colours: wp.array(dtype=wp.vec3), packed: wp.array2d(dtype=wp.uint8)):
    """colours: (n,) in [0, 1]. packed: (n, 3)."""
    n = first + wp.tid()
    colour = colours[n]
    for channel in range(3):
        packed[n, channel] = colour_byte(colour[channel])


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
