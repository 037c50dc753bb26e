"""Real spherical harmonics up to degree 3, and the two ways in which a row of numbers makes a colour of them."""

# Order and signs: Plenoxels / svox2 (and PlenOctrees). Rows of 27: degrees 0 to 2 of red, green and blue. Rows of 24:
# sixteen of degree 0 to 3 for luminance, four each for differences of colour, orange and green (YCoCg): highlights take
# on the light's colour, so luminance changes fast (Shafer 1985, dichromatic reflection).

import warp as wp

from ..core.variants import native_source

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
vec16 = wp.types.vector(length=16, dtype=wp.float32)

#: Numbers of a luminous row, and harmonics of its parts.
LUMINANCE_NUMBERS = wp.constant(24)
LUMINANCE_BASIS = wp.constant(16)
DIFFERENCE_BASIS = wp.constant(4)

#: C++ of several functions: colour = numbers . basis of a row c of `width` numbers.
COLOR_OF_ROW = native_source(__file__, "cpp/color_of_row.h")


@wp.func
def sh_basis(d: wp.vec3):
    """The basis functions Y_lm at a unit direction, l = 0 to 3 and m = -l .. l."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    return vec16(
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    )


@wp.func
def luminance_color(parts: wp.vec3):
    """Red, green and blue of luminance, orange and green difference."""
    grey = parts[0] - 0.5 * parts[2]
    return wp.vec3(grey + parts[1], parts[0] + parts[2], grey - parts[1])
