"""Real spherical harmonics up to degree 2, in the order and with the signs of Plenoxels / svox2 (and PlenOctrees).

Needs: none.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})
vec9 = wp.types.vector(length=9, dtype=wp.float32)


@wp.func
def sh_basis(d: wp.vec3):
    """The nine basis functions Y_lm at a unit direction, l = 0, 1, 2 and m = -l .. l."""
    x = d[0]
    y = d[1]
    z = d[2]
    return vec9(
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    )
