"""Buffers of a sparse voxel grid: rows for the nodes of a mask, and the distances by which a march skips."""

from __future__ import annotations

import warp as wp

from ..core.arrays import empty_array
from ..core.devices import launch
from ..kernels.field import refine as grid_refine
from ..kernels.field import skip as grid_skip


def link_mask(mask: wp.array) -> tuple[wp.array, wp.array]:
    """Number the set nodes of a mask in memory order.

    Args:
        mask: (nx, ny, nz) uint8.

    Returns:
        Links (nx, ny, nz) int32, the row of each node or -1, and nodes (rows,) vec3i.
    """
    device = mask.device
    counts = _line_counts(mask)
    wp.utils.array_scan(counts, counts, inclusive=True)
    nodes = empty_array(int(counts[-1:].numpy()[0]), wp.vec3i, device)
    links = empty_array(mask.shape, wp.int32, device)
    launch(grid_refine.link_nodes, counts.size, [mask, counts], [links, nodes], device=device)
    return links, nodes


def mask_count(mask: wp.array) -> int:
    """Number of set nodes of a mask.

    Args:
        mask: (nx, ny, nz) uint8.

    Returns:
        The number.
    """
    return int(_line_counts(mask).numpy().sum(dtype="int64"))


def _line_counts(mask: wp.array) -> wp.array:
    """(nx * ny,) int32 set nodes of each line along the last axis."""
    counts = empty_array(mask.shape[0] * mask.shape[1], wp.int32, mask.device)
    launch(grid_refine.count_lines, counts.size, [mask], [counts], device=mask.device)
    return counts


def measure_skip(links: wp.array) -> wp.array:
    """How far each cell is from the nearest cell with a linked node.

    Args:
        links: (nx, ny, nz) int32, row of each node or -1.

    Returns:
        (nx-1, ny-1, nz-1) uint8 Chebyshev distance in cells, 0 in cells with such a node.
    """
    device = links.device
    shape = tuple(n - 1 for n in links.shape)
    distance = empty_array(shape, wp.uint8, device)
    spread = wp.empty_like(distance)
    launch(grid_skip.mark_cells, distance.size, [links], [distance], device=device)
    for axis in range(3):
        launch(grid_skip.spread_distance, distance.size, [axis, distance], [spread], device=device)
        distance, spread = spread, distance
    return distance
