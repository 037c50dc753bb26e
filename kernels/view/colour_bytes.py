"""Colours of pictures as bytes."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: What is left in `state` where all colours are finite, and where one is not.
DONE = wp.constant(1)
NOT_FINITE = wp.constant(2)


@wp.kernel
def round_colours(
    first: int, colours: wp.array(dtype=wp.vec3), packed: wp.array2d(dtype=wp.uint8), state: wp.array(dtype=wp.int32)
):
    """colours: (n,), [0, 1] is the range of a byte. packed: (n, 3), rounded half to even, to the bit as NumPy does it.
    state: (1,), DONE beforehand."""
    n = first + wp.tid()
    colour = colours[n]
    for channel in range(3):
        value = colour[channel]
        if wp.isfinite(value):
            packed[n, channel] = wp.uint8(wp.int32(wp.rint(wp.clamp(value, 0.0, 1.0) * 255.0)))
        else:
            packed[n, channel] = wp.uint8(0)
            state[0] = NOT_FINITE
