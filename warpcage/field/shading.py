"""What marches read of a field instead of its own arrays: columns, packed rows, and voxels shaded for a camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import warp as wp

from ..core.arrays import empty_array
from ..core.devices import RepeatedLaunch, half_texture, launch
from ..kernels.core.texels import clear_half_texels
from ..kernels.field import columns
from ..kernels.field.densities import lay_densities
from ..kernels.field.rows import RowTable, pack_rows
from ..kernels.field.shades import ShadedGrid, shade_rows

#: 32-bit words of a packed row (kernels/field/rows), and of a shade (kernels/field/shades) on CUDA and on a CPU.
PACKED_WORDS = 8
CUDA_SHADE_WORDS, CPU_SHADE_WORDS = 2, 4

#: Rows that work together on CUDA.
WARP_LANES = 32


class ColumnTable:
    """The rows of a grid told by bits, see kernels/field/columns; links (nx, ny, nz) int32, row of each node or -1."""

    def __init__(self, links: wp.array):
        device = links.device
        column_count = links.shape[0] * links.shape[1]
        counts = empty_array(column_count, wp.int32, device)
        launch(columns.count_rows, column_count, [links], [counts], device=device, work=links.shape[2])
        wp.utils.array_scan(counts, counts, inclusive=True)
        row_count = int(counts[-1:].numpy()[0])
        # flat index of each row's node
        self.nodes = empty_array(row_count, wp.int32, device)
        order = empty_array(row_count, wp.int32, device)
        block_count = -(-(links.shape[2] - 1) // int(columns.BLOCK_NODES))
        self.columns = columns.Columns()
        self.columns.node_counts = wp.vec3i(*links.shape)
        self.columns.blocks = empty_array((column_count, block_count), wp.vec2i, device)
        launch(
            columns.mark_blocks,
            column_count,
            [links, counts],
            [self.columns.blocks, self.nodes, order],
            device=device,
            work=links.shape[2],
        )
        unsorted = wp.zeros(1, dtype=wp.int32, device=device)
        launch(columns.find_unsorted, row_count, [order], [unsorted], device=device)
        if unsorted.numpy()[0]:
            self.columns.order = order
        # nodes of the grid
        self.node_count, self._laid, self._packed = math.prod(links.shape), None, None
        self._device = wp.get_device(device)
        self._kept: dict[str, tuple[int, Any]] = {}
        self._shaded: Any = None
        # launches the kernel of that name
        self.shade_rows = RepeatedLaunch(shade_rows, device)

    def laid_densities(self) -> wp.array:
        """(nodes,) float16, one for each node of the grid, made when it is first asked for; 0 without a row."""
        if self._laid is None:
            self._laid = empty_array(self.node_count, wp.float16, self.nodes.device)
            self._laid.zero_()
        return self._laid

    def row_shades(self) -> wp.array:
        """(rows, words) uint32 for shades of rows, not set yet."""
        # That of the frame before on a CUDA stream, whose frames follow each other, as CUDA takes longer to hand out as
        # much memory than to fill it. A new one for frames of other streams, and on a CPU, whose threads may render at
        # a time.
        return self._of_stream("rows", self._new_row_shades)

    def _new_row_shades(self) -> wp.array:
        return empty_array((self.nodes.shape[0], shade_words(self._device)), wp.uint32, self._device)

    def shaded(self, centre: wp.vec3, step: float) -> Any:
        """A ShadedGrid of kernels/field/shades that is to be filled for a camera, centre relative to the grid's origin.
        On CUDA the same for all cameras, whose frames take turns."""
        shaded = self._shaded
        if shaded is None:
            shaded = ShadedGrid()
            shaded.columns = self.columns
            if self._device.is_cuda:
                self._shaded = shaded
        shaded.centre, shaded.step = centre, step
        return shaded

    def shade_texture(self, layers: int) -> wp.Texture3D:
        """A texture of four halves, (layers * nx, ny, nz), on CUDA for shades at the nodes of rows; 0 at others.
        Kept as `row_shades` is."""
        return self._of_stream(f"{layers} layers", lambda: self._new_texture(layers))

    def _new_texture(self, layers: int) -> wp.Texture3D:
        nx, ny, nz = tuple(self.columns.node_counts)
        texture = half_texture((layers * nx, ny, nz), self._device)
        for layer in range(layers):  # one by one, as all together may be more than an index counts
            inputs = [wp.uint64(texture.cuda_surface), nz, ny, layer * nx]
            launch(clear_half_texels, self.node_count, inputs, device=self._device)
        return texture

    def _of_stream(self, name: str, make: Callable[[], Any]) -> Any:
        """What the frames of the stream that asked first keep; made anew for others."""
        if self._device.is_cpu:
            return make()
        stream = int(self._device.stream.cuda_stream or 0)
        if name not in self._kept:
            self._kept[name] = stream, make()
        owner, kept = self._kept[name]
        return kept if owner == stream else make()

    def packed_rows(self) -> wp.array:
        """(rows, PACKED_WORDS) uint32, made when it is first asked for."""
        # Kept, as CUDA takes longer to hand out as much memory than to fill it. Frames that pack rows on several
        # streams at a time write the same into it.
        if self._packed is None:
            self._packed = empty_array((self.nodes.shape[0], PACKED_WORDS), wp.uint32, self.nodes.device)
        return self._packed


def shade_words(device: wp.Device) -> int:
    """32-bit words of a shade (kernels/field/shades)."""
    return CPU_SHADE_WORDS if device.is_cpu else CUDA_SHADE_WORDS


def whole_warps(rows: int, device: wp.Device) -> int:
    """Threads of a kernel whose rows work together: rounded up on CUDA."""
    return rows if device.is_cpu else -(-rows // WARP_LANES) * WARP_LANES


def row_table(grid: Any, table: ColumnTable) -> Any:
    """The rows of a grid as a march reads them: a RowTable of the values that the grid has now."""
    device, rows = grid.links.device, table.nodes.shape[0]
    result = RowTable()
    result.columns, result.unit = table.columns, 1.0 / min(grid.voxel_size)
    if not device.is_cpu:
        result.laid = table.laid_densities()
        inputs = [grid.density, table.columns.order, table.nodes, 1.0 / result.unit]
        launch(lay_densities, rows, inputs, [result.laid], device=device)
        result.packed = table.packed_rows()
        launch(pack_rows, whole_warps(rows, device), [grid, table.columns], [result.packed], device=device)
    return result


def shaded_grid(grid: Any, table: ColumnTable, centre: wp.vec3, step: float) -> Any:
    """The rows of a grid as a camera sees them: a ShadedGrid of the values that the grid has now.
    centre: of the camera, relative to the grid's origin; step: world units."""
    shaded = table.shaded(centre, step)
    shades = table.row_shades()
    if shaded.shades is not shades:
        shaded.shades = shades
    table.shade_rows(whole_warps(table.nodes.shape[0], grid.links.device), [grid, table.nodes, shaded])
    return shaded
