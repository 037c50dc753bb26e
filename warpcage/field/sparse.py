"""Buffers of a sparse voxel grid: rows for the nodes of a mask, and the distances by which a march skips."""

from __future__ import annotations

import warp as wp

from ..core.devices import launch
from ..kernels.field import refine as grid_refine
from ..kernels.field import skip as grid_skip

BASIS_COUNT = 9


def link_mask(mask: wp.array) -> tuple[wp.array, wp.array]:
    """Number the nodes of a mask (nx, ny, nz) uint8.

    Returns links (nx, ny, nz) int32 (row or -1) and nodes (rows,) vec3i, rows in memory order.
    """
    device = mask.device
    counts = _line_counts(mask)
    wp.utils.array_scan(counts, counts, inclusive=True)
    nodes = wp.empty(int(counts[-1:].numpy()[0]), dtype=wp.vec3i, device=device)
    links = wp.empty(mask.shape, dtype=wp.int32, device=device)
    launch(grid_refine.link_nodes, counts.size, [mask, counts], [links, nodes], device=device)
    return links, nodes


def mask_count(mask: wp.array) -> int:
    """Set nodes of a mask (nx, ny, nz) uint8."""
    return int(_line_counts(mask).numpy().sum(dtype="int64"))


def _line_counts(mask: wp.array) -> wp.array:
    counts = wp.empty(mask.shape[0] * mask.shape[1], dtype=wp.int32, device=mask.device)
    launch(grid_refine.count_lines, counts.size, [mask], [counts], device=mask.device)
    return counts


def measure_skip(links: wp.array) -> wp.array:
    """Chebyshev distance of each cell to the nearest cell with a linked node: (nx-1, ny-1, nz-1) uint8."""
    device = links.device
    shape = tuple(n - 1 for n in links.shape)
    distance = wp.empty(shape, dtype=wp.uint8, device=device)
    spread = wp.empty_like(distance)
    launch(grid_skip.mark_cells, distance.size, [links], [distance], device=device)
    for axis in range(3):
        launch(grid_skip.spread_distance, distance.size, [axis, distance], [spread], device=device)
        distance, spread = spread, distance
    return distance
