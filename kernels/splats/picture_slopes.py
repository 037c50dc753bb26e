"""Loss of a picture beside the one that should be seen, and its slope by each pixel."""

# Of each pixel and colour |d| (Kerbl et al. 2023, Eq. 7, without its second term) or d^2 / 2, d the difference. A pixel
# may be the mean of side x side ones that were drawn, as splats are measured with several rays a pixel.

import warp as wp

from ..view.downsample import part_index

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def slope_of_picture(
    first: int,
    side: int,
    width: int,
    squared: int,
    drawn: wp.array(dtype=wp.vec3),
    picture: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    errors: wp.array(dtype=wp.float32),
):
    """slopes, as `drawn` (h * side * width * side,): of the sum over all pixels; errors (h * width,): mean square of
    the colours' differences. One item per pixel of the picture (h * width,) that should be seen."""
    # side: parts along each side of a pixel. width: of the picture, pixels. squared: 1 for d^2 / 2.
    n = first + wp.tid()
    mean = wp.vec3()
    share = 1.0 / float(side * side)
    for part in range(side * side):
        mean += share * drawn[part_index(n, part, side, width)]
    difference = mean - picture[n]
    errors[n] = wp.dot(difference, difference) / 3.0
    slope = difference
    if squared == 0:
        slope = wp.vec3(wp.sign(difference[0]), wp.sign(difference[1]), wp.sign(difference[2]))
    for part in range(side * side):
        slopes[part_index(n, part, side, width)] = share * slope
