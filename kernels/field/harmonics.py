"""Real spherical harmonics up to degree 3, and the two ways in which a row of numbers makes a colour of them.

Order and signs are those of Plenoxels / svox2 (and PlenOctrees). A row of 27 numbers has nine of degree 0 to 2 for red,
for green and for blue. A row of 24 numbers has sixteen of degree 0 to 3 for luminance, then four of degree 0 and 1 for
each of two differences of colour, orange and green: a highlight takes on the colour of the light, so that it is
luminance that changes fast with direction (Shafer 1985, dichromatic reflection; the differences are those of YCoCg).
Needs: none.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
vec16 = wp.types.vector(length=16, dtype=wp.float32)

#: Numbers of a luminous row, and harmonics of its parts.
LUMINANCE_NUMBERS = wp.constant(24)
LUMINANCE_BASIS = wp.constant(16)
DIFFERENCE_BASIS = wp.constant(4)

#: C++ of several functions: colour = numbers . basis of a row c of `width` numbers.
COLOUR_OF_ROW = """
    float red = 0.0f, green = 0.0f, blue = 0.0f;
    if (width == 24)
    {
        float y = 0.0f, orange = 0.0f;
        for (int b = 0; b < 16; ++b)
            y += basis.c[b] * c[b];
        for (int b = 0; b < 4; ++b)
        {
            orange += basis.c[b] * c[16 + b];
            green += basis.c[b] * c[20 + b];
        }
        red = y + orange - 0.5f * green;
        blue = y - orange - 0.5f * green;
        green += y;
    }
    else
    {
        for (int b = 0; b < 9; ++b)
        {
            red += basis.c[b] * c[b];
            green += basis.c[b] * c[9 + b];
            blue += basis.c[b] * c[18 + b];
        }
    }
"""

#: C++ of marches on a CPU: `values` of sh_basis at x, y, z; nine where rows have 27 numbers, which lie between zeros.
BASIS_OF_DIRECTION = """
                const float xx = x * x, yy = y * y, zz = z * z;
                values[0] = 0.28209479177387814f;
                values[1] = -0.4886025119029199f * y;
                values[2] = 0.4886025119029199f * z;
                values[3] = -0.4886025119029199f * x;
                values[4] = 1.0925484305920792f * x * y;
                values[5] = -1.0925484305920792f * y * z;
                values[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
                values[7] = -1.0925484305920792f * x * z;
                values[8] = 0.5462742152960396f * (xx - yy);
                if (width == 24)
                {
                    values[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
                    values[10] = 2.890611442640554f * x * y * z;
                    values[11] = -0.4570457994644658f * y * (4.0f * zz - xx - yy);
                    values[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
                    values[13] = -0.4570457994644658f * x * (4.0f * zz - xx - yy);
                    values[14] = 1.445305721320277f * z * (xx - yy);
                    values[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
                }
"""


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
def luminance_colour(parts: wp.vec3):
    """Red, green and blue of luminance, orange and green difference."""
    grey = parts[0] - 0.5 * parts[2]
    return wp.vec3(grey + parts[1], parts[0] + parts[2], grey - parts[1])
