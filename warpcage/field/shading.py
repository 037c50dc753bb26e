"""Voxels shaded for a camera, so that a march reads colours instead of harmonics."""

from __future__ import annotations

from typing import Any

import warp as wp

from ..core.arrays import empty_array
from ..core.devices import launch
from ..kernels.field import columns
from ..kernels.field.shades import ShadedGrid, shade_rows


class ColumnTable:
    """The rows of a grid told by bits, see kernels/field/columns.

    Args:
        links: (nx, ny, nz) int32, row of each node or -1.

    Attributes:
        blocks: (nx * ny, blocks of a column) vec2i, bits and first row.
        nodes: (rows,) int32 flat index of each row's node.
    """

    def __init__(self, links: wp.array):
        device = links.device
        column_count = links.shape[0] * links.shape[1]
        counts = empty_array(column_count, wp.int32, device)
        launch(columns.count_rows, column_count, [links], [counts], device=device, work=links.shape[2])
        wp.utils.array_scan(counts, counts, inclusive=True)
        self.nodes = empty_array(int(counts[-1:].numpy()[0]), wp.int32, device)
        block_count = -(-(links.shape[2] - 1) // int(columns.BLOCK_NODES))
        self.blocks = empty_array((column_count, block_count), wp.vec2i, device)
        launch(
            columns.mark_blocks,
            column_count,
            [links, counts],
            [self.blocks, self.nodes],
            device=device,
            work=links.shape[2],
        )


def shaded_grid(grid: Any, table: ColumnTable, centre: wp.vec3, step: float) -> Any:
    """The rows of a grid as a camera sees them.

    Args:
        grid: VoxelGrid.
        table: Of its links.
        centre: Of the camera, relative to the grid's origin.
        step: March step, world units.

    Returns:
        A ShadedGrid of kernels/field/shades.py.
    """
    device, rows = grid.links.device, table.nodes.shape[0]
    shaded = ShadedGrid()
    shaded.node_counts, shaded.blocks = wp.vec3i(*grid.links.shape), table.blocks
    shaded.shades = empty_array((rows, 4 if device.is_cpu else 2), wp.uint32, device)
    threads = rows if device.is_cpu else -(-rows // 32) * 32
    launch(shade_rows, threads, [grid, table.nodes, centre, step], [shaded.shades], device=device)
    return shaded
