"""Sparse voxel grid: trilinear density and spherical-harmonic colour at arbitrary points."""

# Model: Fridovich-Keil and Yu et al., "Plenoxels: Radiance Fields without Neural Networks" (CVPR 2022), section 3.
# density(x) = max(0, trilinear sigma), colour(x, d) = max(0, trilinear SH . Y(d) + 0.5), with one of two kinds of rows
# of SH numbers (field/harmonics). Values live at nodes; node (i, j, k) lies at lower + (i, j, k) * voxel_size. Nodes
# without a row hold zero. Positions are world units relative to any origin that the caller keeps to (warpcage: the
# field's centre, so that float32 suffices).

import warp as wp

from .harmonics import COLOUR_OF_ROW, sh_basis, vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
eight_rows = wp.types.vector(length=8, dtype=wp.int32)
eight_weights = wp.types.vector(length=8, dtype=wp.float32)

#: C++ of several functions: numbers of eight rows, each in its weight, added up. Both widths are known while compiling.
BLENDED_ROW = """
    const int width = sh.shape[1];
    float c[27];
    for (int n = 0; n < 27; ++n)
        c[n] = 0.0f;
    for (int corner = 0; corner < 8; ++corner)
        if (rows.c[corner] >= 0)
        {
            const float weight = weights.c[corner];
            const float* row = sh.data + (size_t)rows.c[corner] * width;
            if (width == 24)
                for (int n = 0; n < 24; ++n)
                    c[n] += weight * row[n];
            else
                for (int n = 0; n < 27; ++n)
                    c[n] += weight * row[n];
        }
"""


@wp.struct
class VoxelGrid:
    lower: wp.vec3  # position of node (0, 0, 0)
    voxel_size: wp.vec3
    inverse_voxel_size: wp.vec3
    links: wp.array3d(dtype=wp.int32)  # row of a node, or -1
    skip: wp.array3d(dtype=wp.uint8)  # cell -> Chebyshev distance in cells to the nearest that holds anything, 0 there
    density: wp.array(dtype=wp.float32)  # (rows,) per world unit
    sh: wp.array2d(dtype=wp.float32)  # (rows, 24 or 27) numbers of field/harmonics, without gaps


@wp.struct
class CellSample:
    """Rows and trilinear weights of the eight nodes of the cell around a point; corner c is at (c&4, c&2, c&1)."""

    rows: eight_rows
    weights: eight_weights


@wp.func
def grid_position(grid: VoxelGrid, x: wp.vec3):
    """Node coordinates (voxel units) of a point."""
    return wp.cw_mul(x - grid.lower, grid.inverse_voxel_size)


@wp.func
def cell_sample(grid: VoxelGrid, g: wp.vec3):
    """Rows and weights around node coordinates g; all rows are -1 outside the grid."""
    result = CellSample()
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    inside = (
        i >= 0
        and j >= 0
        and k >= 0
        and i < grid.links.shape[0] - 1
        and j < grid.links.shape[1] - 1
        and k < grid.links.shape[2] - 1
    )
    fx = g[0] - float(i)
    fy = g[1] - float(j)
    fz = g[2] - float(k)
    for c in range(8):
        di = c >> 2
        dj = (c >> 1) & 1
        dk = c & 1
        row = int(-1)
        if inside:
            row = grid.links[i + di, j + dj, k + dk]
        wx = wp.where(di == 1, fx, 1.0 - fx)
        wy = wp.where(dj == 1, fy, 1.0 - fy)
        wz = wp.where(dk == 1, fz, 1.0 - fz)
        result.rows[c] = row
        result.weights[c] = wx * wy * wz
    return result


@wp.func
def cell_density(grid: VoxelGrid, cell: CellSample):
    """Trilinear density before the ReLU."""
    sigma = float(0.0)
    for c in range(8):
        if cell.rows[c] >= 0:
            sigma += cell.weights[c] * grid.density[cell.rows[c]]
    return sigma


@wp.func_native(
    BLENDED_ROW
    + COLOUR_OF_ROW
    + """
    return wp::vec_t<3, wp::float32>(red + 0.5f, green + 0.5f, blue + 0.5f);
"""
)
def blended_colour(sh: wp.array2d(dtype=wp.float32), rows: eight_rows, weights: eight_weights, basis: vec16) -> wp.vec3:
    """basis . (sum of weight times row) + 0.5."""
    ...


@wp.func
def cell_colour(grid: VoxelGrid, cell: CellSample, basis: vec16):
    """SH colour before the clamp at zero."""
    return blended_colour(grid.sh, cell.rows, cell.weights, basis)


@wp.func
def empty_distance(grid: VoxelGrid, g: wp.vec3):
    """Chebyshev distance in cells from the cell of g to the nearest cell that holds anything; 1 outside the grid."""
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    if i < 0 or j < 0 or k < 0 or i >= grid.skip.shape[0] or j >= grid.skip.shape[1] or k >= grid.skip.shape[2]:
        return int(1)
    return int(grid.skip[i, j, k])


@wp.func
def sample_density(grid: VoxelGrid, x: wp.vec3):
    """Density at a point, zero outside the grid."""
    return wp.max(cell_density(grid, cell_sample(grid, grid_position(grid, x))), 0.0)


@wp.func
def sample_colour(grid: VoxelGrid, x: wp.vec3, direction: wp.vec3):
    """Colour at a point seen along a unit direction (from the camera into the scene)."""
    colour = cell_colour(grid, cell_sample(grid, grid_position(grid, x)), sh_basis(direction))
    return wp.max(colour, wp.vec3(0.0, 0.0, 0.0))


@wp.kernel
def sample_field(
    first: int,
    grid: VoxelGrid,
    origin: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    rgb: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=wp.float32),
):
    """Colour and density at points (n,) seen along directions (n,) of any length. origin: the grid's origin among the
    points."""
    n = first + wp.tid()
    cell = cell_sample(grid, grid_position(grid, points[n] - origin))
    basis = sh_basis(wp.normalize(directions[n]))
    rgb[n] = wp.max(cell_colour(grid, cell, basis), wp.vec3(0.0, 0.0, 0.0))
    density[n] = wp.max(cell_density(grid, cell), 0.0)
