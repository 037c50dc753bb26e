"""Matter at a place of a field, for the marches through a field that edits deform: of its rows, or of voxels that were
shaded for the camera.

Both are asked early, while the march waits for something else: of rows the density, whose colours are looked up only
where enough weighs, and shades, which hold both.
Needs: deform/laid_shades, field/densities, field/grid, field/harmonics, field/render, field/rows.
"""

import warp as wp

from ..field.densities import early_density, late_density
from ..field.grid import VoxelGrid
from ..field.harmonics import sh_basis
from ..field.render import PENDING_WEIGHT
from ..field.rows import RowTable, row_colour
from .laid_shades import LaidShades, laid_shade

wp.set_module_options({"enable_backward": False})


@wp.func
def early_matter(table: RowTable, i: int, j: int, k: int, offset: wp.vec3, at: wp.vec3, layer: int):
    """What is asked of a place `at` in node coordinates, 0 to 1 in the cell above node (i, j, k), before it is known
    whether that holds anything. layer: of deform/laid_shades."""
    sigma = early_density(table.laid, table.unit, table.columns, i, j, k, offset)
    return wp.vec4(0.0, 0.0, 0.0, sigma)


@wp.func
def early_matter(  # noqa: F811 (a Warp overload)
    table: LaidShades, i: int, j: int, k: int, offset: wp.vec3, at: wp.vec3, layer: int
):
    return laid_shade(table, at, layer)


@wp.func
def late_matter(table: RowTable, grid: VoxelGrid, early: wp.vec4, step: float, i: int, j: int, k: int, offset: wp.vec3):
    """Colour, if it comes with the rest, and optical depth of a step at such a place, in a cell that may hold
    something."""
    sigma = late_density(early[3], grid.density, table.columns, i, j, k, offset)
    return wp.vec4(0.0, 0.0, 0.0, sigma * step)


@wp.func
def late_matter(  # noqa: F811
    table: LaidShades, grid: VoxelGrid, early: wp.vec4, step: float, i: int, j: int, k: int, offset: wp.vec3
):
    return early


@wp.func
def least_pending(table: RowTable):
    """Samples wait for the colour of the next one until they weigh more than this together."""
    return PENDING_WEIGHT


@wp.func
def least_pending(table: LaidShades):  # noqa: F811
    return 0.0


@wp.func
def matter_colour(
    table: RowTable,
    grid: VoxelGrid,
    matter: wp.vec4,
    i: int,
    j: int,
    k: int,
    offset: wp.vec3,
    slope: wp.vec3,
    direction: wp.vec3,
):
    """Colour before the clamp at zero, at such a place, seen along `slope`, or `direction` where that is nought."""
    length = wp.length(slope)
    along = wp.where(length > 1.0e-6, slope / length, direction)
    return row_colour(grid.sh, table.packed, table.columns, i, j, k, offset, sh_basis(along))


@wp.func
def matter_colour(  # noqa: F811
    table: LaidShades,
    grid: VoxelGrid,
    matter: wp.vec4,
    i: int,
    j: int,
    k: int,
    offset: wp.vec3,
    slope: wp.vec3,
    direction: wp.vec3,
):
    return wp.vec3(matter[0] + 0.5, matter[1] + 0.5, matter[2] + 0.5)
