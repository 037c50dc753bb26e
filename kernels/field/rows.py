"""Colour of a sparse voxel grid at a place, with few reads: field/grid for marches that are to be fast."""

# On CUDA a row's harmonics are two reads of 16 bytes: three constant terms as halves, the others in 8 bits, in units of
# the largest; the basis is rounded alike: four products are one instruction. Of six uint32s of four numbers two are for
# each of red, green and blue, or four for luminance, one for each difference (field/harmonics). CPUs read the grid's.

import warp as wp

from ..core.gradients import forward
from ..core.variants import native_source
from .columns import Columns
from .grid import VoxelGrid
from .harmonics import vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})


@wp.struct
class RowTable:
    """A grid's rows as a march reads them."""

    columns: Columns
    packed: wp.array2d(dtype=wp.uint32)  # (rows, 8) on CUDA, else none
    laid: wp.array(dtype=wp.float16)  # (nodes,) density of each node in units, 0 without a row; on CUDA, else none
    unit: float  # of laid densities


@forward.func_native(native_source(__file__, "cpp/row_color.h"))
def row_color(
    sh: wp.array2d(dtype=wp.float32),
    packed: wp.array2d(dtype=wp.uint32),
    columns: Columns,
    i: wp.int32,
    j: wp.int32,
    k: wp.int32,
    offset: wp.vec3,
    basis: vec16,
) -> wp.vec3:
    """SH colour before the clamp at zero, at a place, 0 to 1, in the cell above node (i, j, k)."""
    ...


@forward.func_native(native_source(__file__, "cpp/write_packed.h"))
def write_packed(
    sh: wp.array2d(dtype=wp.float32),
    halves: wp.array2d(dtype=wp.float16),
    row: wp.int32,
    packed: wp.array2d(dtype=wp.uint32),
    target: wp.int32,
):
    """Pack a row; -1 is no target; `sh` and `halves` of VoxelGrid. All lanes, in blocks of at most 128 threads."""
    ...


@wp.kernel
def pack_rows(first: int, grid: VoxelGrid, columns: Columns, packed: wp.array2d(dtype=wp.uint32)):
    """One thread per row, their number rounded up to whole warps, on CUDA."""
    item = first + wp.tid()
    row = wp.min(item, packed.shape[0] - 1)
    target = wp.where(item < packed.shape[0], item, -1)
    if columns.order.shape[0] > 0:
        row = columns.order[row]
    write_packed(grid.sh, grid.halves, row, packed, target)
