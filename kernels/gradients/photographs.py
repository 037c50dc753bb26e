"""What photographs hold besides a posed object: surroundings before and behind it, and an exposure of their own."""

import warp as wp

from .differences import ROBUST, Pixels

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Mean squares of frames below which they are black: no exposure can be known.
LEAST = wp.constant(1.0e-6)


@wp.struct
class Around:
    """What is around an empty field in the pixels of stacked views, (views * h * w,) each."""

    front: wp.array(dtype=wp.vec3)  # colors of what is before the field
    light: wp.array(dtype=wp.float32)  # share of light that passes it
    behind: wp.array(dtype=wp.vec3)  # colors of what is behind the field, as they show


@wp.kernel
def compose_surroundings(first: int, frames: Pixels, around: Around, composed: wp.array(dtype=wp.vec3)):
    """composed: colors of frames that were drawn before black, with what is around the field."""
    n = first + wp.tid()
    composed[n] = around.front[n] + around.light[n] * frames.rgb[n] + (1.0 - frames.alpha[n]) * around.behind[n]


@wp.kernel
def pull_surroundings(first: int, around: Around, slopes: Pixels):
    """slopes: those by composed colors become those by colors before black; opacities get their share."""
    n = first + wp.tid()
    by_color = slopes.rgb[n]
    slopes.rgb[n] = around.light[n] * by_color
    slopes.alpha[n] = slopes.alpha[n] - wp.dot(by_color, around.behind[n])


@wp.kernel
def sum_exposure_lines(
    first: int,
    frames: wp.array(dtype=wp.vec3),
    pictures: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.float32),
    exposures: wp.array(dtype=wp.vec3),
    width: int,
    height: int,
    squares: wp.array(dtype=wp.vec3),
    products: wp.array(dtype=wp.vec3),
    counts: wp.array(dtype=wp.vec3),
):
    """squares, products, counts (views * h,): of each line's frames, of frames and pictures, and of weights, which
    count less where the present exposures leave a difference."""
    # Reweighted least squares of (e frame - picture)^2: what moved, or is not in the field, counts little.
    line = first + wp.tid()
    exposure = exposures[line // height]
    square = wp.vec3()
    product = wp.vec3()
    count = wp.vec3()
    for n in range(line * width, (line + 1) * width):
        frame = frames[n]
        off = (wp.cw_mul(exposure, frame) - pictures[n]) / ROBUST
        counted = wp.vec3()
        for c in range(3):
            counted[c] = weights[n] / wp.sqrt(1.0 + off[c] * off[c])
        square += wp.cw_mul(counted, wp.cw_mul(frame, frame))
        product += wp.cw_mul(counted, wp.cw_mul(frame, pictures[n]))
        count += counted
    squares[line] = square
    products[line] = product
    counts[line] = count


@wp.kernel
def solve_exposures(
    first: int,
    squares: wp.array(dtype=wp.vec3),
    products: wp.array(dtype=wp.vec3),
    counts: wp.array(dtype=wp.vec3),
    height: int,
    exposures: wp.array(dtype=wp.vec3),
):
    """exposures (views,): the least squares of `sum_exposure_lines`, 1 where frames are black."""
    view = first + wp.tid()
    square = wp.vec3()
    product = wp.vec3()
    count = wp.vec3()
    for line in range(view * height, (view + 1) * height):
        square += squares[line]
        product += products[line]
        count += counts[line]
    found = wp.vec3(1.0)
    for c in range(3):
        if square[c] > LEAST * count[c]:
            found[c] = wp.max(product[c], 0.0) / square[c]
    exposures[view] = found
