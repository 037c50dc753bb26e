"""Density and colour of a voxel grid with their derivatives by place and by direction."""

import warp as wp

from ..core.gradients import forward
from ..field.grid import VoxelGrid, eight_rows, eight_weights
from ..field.harmonics import vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Red, green and blue in the columns; in the rows the value, its derivatives by the node coordinates, and by the
#: components of the direction.
ColorSlopes = wp.types.matrix(shape=(7, 3), dtype=wp.float32)


@wp.func
def cell_slopes(g: wp.vec3, axis: int):
    """Derivatives by one axis of the trilinear weights of the eight nodes around node coordinates g."""
    result = eight_weights()
    f = g - wp.vec3(wp.floor(g[0]), wp.floor(g[1]), wp.floor(g[2]))
    for c in range(8):
        wx = wp.where((c >> 2) == 1, f[0], 1.0 - f[0])
        wy = wp.where(((c >> 1) & 1) == 1, f[1], 1.0 - f[1])
        wz = wp.where((c & 1) == 1, f[2], 1.0 - f[2])
        if axis == 0:
            wx = wp.where((c >> 2) == 1, 1.0, -1.0)
        elif axis == 1:
            wy = wp.where(((c >> 1) & 1) == 1, 1.0, -1.0)
        else:
            wz = wp.where((c & 1) == 1, 1.0, -1.0)
        result[c] = wx * wy * wz
    return result


@wp.func
def density_slope(grid: VoxelGrid, rows: eight_rows, by_x: eight_weights, by_y: eight_weights, by_z: eight_weights):
    """Derivatives of the density before the ReLU by the node coordinates. by_x, by_y, by_z: of `cell_slopes`."""
    slope = wp.vec3()
    for c in range(8):
        if rows[c] >= 0:
            slope += grid.density[rows[c]] * wp.vec3(by_x[c], by_y[c], by_z[c])
    return slope


@wp.func
def sh_basis_slope(d: wp.vec3, axis: int):
    """Derivatives of `sh_basis` by one component of the direction."""
    x = d[0]
    y = d[1]
    z = d[2]
    zero = float(0.0)
    if axis == 0:
        return vec16(
            zero,
            0.0,
            0.0,
            -0.4886025119029199,
            1.0925484305920792 * y,
            0.0,
            -0.6307831305050401 * x,
            -1.0925484305920792 * z,
            1.0925484305920792 * x,
            -3.5402615395598610 * x * y,
            2.890611442640554 * y * z,
            0.9140915989289316 * x * y,
            -2.2390579955406924 * x * z,
            -0.4570457994644658 * (4.0 * z * z - 3.0 * x * x - y * y),
            2.890611442640554 * x * z,
            -1.7701307697799305 * (x * x - y * y),
        )
    if axis == 1:
        return vec16(
            zero,
            -0.4886025119029199,
            0.0,
            0.0,
            1.0925484305920792 * x,
            -1.0925484305920792 * z,
            -0.6307831305050401 * y,
            0.0,
            -1.0925484305920792 * y,
            -1.7701307697799305 * (x * x - y * y),
            2.890611442640554 * x * z,
            -0.4570457994644658 * (4.0 * z * z - x * x - 3.0 * y * y),
            -2.2390579955406924 * y * z,
            0.9140915989289316 * x * y,
            -2.890611442640554 * y * z,
            3.5402615395598610 * x * y,
        )
    return vec16(
        zero,
        0.0,
        0.4886025119029199,
        0.0,
        0.0,
        -1.0925484305920792 * y,
        1.2615662610100802 * z,
        -1.0925484305920792 * x,
        0.0,
        0.0,
        2.890611442640554 * x * y,
        -3.6563663957157264 * y * z,
        1.1195289977703462 * (2.0 * z * z - x * x - y * y),
        -3.6563663957157264 * x * z,
        1.445305721320277 * (x * x - y * y),
        0.0,
    )


@forward.func_native(
    """
    const int width = sh.shape[1];
    const bool luminous = width == 24;
    const int first[3] = {0, luminous ? 16 : 9, luminous ? 20 : 18};
    const int most[3] = {luminous ? 16 : 9, luminous ? 4 : 9, luminous ? 4 : 9};
    // luminance and two differences of color, or red, green and blue: the value and its seven derivatives
    float parts[7][3];
    for (int n = 0; n < 7; ++n)
        for (int part = 0; part < 3; ++part)
            parts[n][part] = 0.0f;
    for (int corner = 0; corner < 8; ++corner)
        if (rows.c[corner] >= 0)
        {
            const float* row = sh.data + (size_t)rows.c[corner] * width;
            const float weight = weights.c[corner];
            for (int part = 0; part < 3; ++part)
            {
                float value = 0.0f, x = 0.0f, y = 0.0f, z = 0.0f;
                for (int b = 0; b < 16; ++b)
                    if (b < most[part])
                    {
                        const float number = row[first[part] + b];
                        value += basis.c[b] * number;
                        x += basis_x.c[b] * number;
                        y += basis_y.c[b] * number;
                        z += basis_z.c[b] * number;
                    }
                parts[0][part] += weight * value;
                parts[1][part] += by_x.c[corner] * value;
                parts[2][part] += by_y.c[corner] * value;
                parts[3][part] += by_z.c[corner] * value;
                parts[4][part] += weight * x;
                parts[5][part] += weight * y;
                parts[6][part] += weight * z;
            }
        }
    ColorSlopes result;
    for (int n = 0; n < 7; ++n)
    {
        const float luminance = parts[n][0], orange = parts[n][1], green = parts[n][2];
        result.data[n][0] = luminous ? luminance + orange - 0.5f * green : luminance;
        result.data[n][1] = luminous ? luminance + green : orange;
        result.data[n][2] = luminous ? luminance - orange - 0.5f * green : green;
    }
    for (int channel = 0; channel < 3; ++channel)
        result.data[0][channel] += 0.5f;
    return result;
""".replace("ColorSlopes", "wp::mat_t<7, 3, wp::float32>")
)
def blended_color_slopes(
    sh: wp.array2d(dtype=wp.float32),
    rows: eight_rows,
    weights: eight_weights,
    by_x: eight_weights,
    by_y: eight_weights,
    by_z: eight_weights,
    basis: vec16,
    basis_x: vec16,
    basis_y: vec16,
    basis_z: vec16,
) -> ColorSlopes:
    """Colour of a blend of eight rows before the clamp at zero, and how it changes with place and direction."""
    ...
