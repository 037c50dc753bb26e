"""Matter at a place of a field, for marches through a field that edits deform: of its rows, or of voxels that were
shaded for the camera."""

# Of rows the density is asked first, and their colours only where enough weighs; shades hold both.

import warp as wp

from ..core.entries import cell_byte
from ..field.densities import early_density, late_density
from ..field.grid import VoxelGrid
from ..field.harmonics import sh_basis
from ..field.rows import RowTable, row_colour
from .laid_shades import LaidShades, laid_shade

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def is_cell(grid: VoxelGrid, i: int, j: int, k: int):
    """Whether there is a cell above node (i, j, k)."""
    low = i >= 0 and j >= 0 and k >= 0
    return low and i < grid.skip.shape[0] and j < grid.skip.shape[1] and k < grid.skip.shape[2]


@wp.func
def empty_at(grid: VoxelGrid, g: wp.vec3):
    """Distance in cells from node coordinates g to the nearest that holds anything, 0 there; 1 outside the grid."""
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    if not is_cell(grid, i, j, k):
        return int(1)
    return cell_byte(grid.skip, i, j, k)


@wp.func
def matter_at(table: RowTable, grid: VoxelGrid, g: wp.vec3, layer: int, step: float):
    """Colour, if it comes with the rest, and optical depth of a step at node coordinates g; 0 where there is nothing.
    layer: of deform/laid_shades."""
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    if not is_cell(grid, i, j, k):
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    offset = g - wp.vec3(float(i), float(j), float(k))
    early = early_density(table.laid, table.unit, table.columns, i, j, k, offset)
    if cell_byte(grid.skip, i, j, k) > 0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    sigma = late_density(early, grid.density, table.columns, i, j, k, offset)
    return wp.vec4(0.0, 0.0, 0.0, sigma * step)


@wp.func
def matter_at(table: LaidShades, grid: VoxelGrid, g: wp.vec3, layer: int, step: float):  # noqa: F811 (a Warp overload)
    low = g[0] >= 0.0 and g[1] >= 0.0 and g[2] >= 0.0
    if not (low and g[0] < table.cells[0] and g[1] < table.cells[1] and g[2] < table.cells[2]):
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    return laid_shade(table, g, layer)


@wp.func
def matter_colour(table: RowTable, grid: VoxelGrid, g: wp.vec3, slope: wp.vec3, direction: wp.vec3):
    """Colour before the clamp at zero, at node coordinates g, seen along `slope`, or `direction` where that is nought.
    Neither has a length of its own."""
    length = wp.length(slope)
    along = wp.where(length > 1.0e-6, slope / length, wp.normalize(direction))
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    offset = g - wp.vec3(float(i), float(j), float(k))
    return row_colour(grid.sh, table.packed, table.columns, i, j, k, offset, sh_basis(along))
