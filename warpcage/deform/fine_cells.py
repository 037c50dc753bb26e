"""Parts of lattice cells that marches may skip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from ..core.arrays import array_view
from ..core.devices import lane_count, launch
from ..kernels.deform.fine_cells import PART_COUNT, PART_SIZE, PART_WORDS, PARTS, mark_parts, spread_parts
from ..lattice.capture import BufferPool

#: Cells that are less than so many voxels wide are not told apart: their parts would be smaller than what they skip.
LEAST_VOXELS = 2.0

#: Lattices of more nodes have more parts than an index counts.
MOST_NODES = (1 << 31) // int(PART_COUNT) - 64


class FineCells:
    """Which parts of the cells of posed lattices may be skipped.

    Args:
        edit_count: Number of edits.
        device: Warp device.
    """

    def __init__(self, edit_count: int, device: wp.Device):
        self._device = device
        pool = BufferPool(device)
        self._words = [pool.buffer(wp.uint32) for _ in range(edit_count)]
        self._looks = pool.buffer(wp.uint64)

    def mark(self, edits: Sequence[Any], grid: Any) -> None:
        """Let the `fine_look` of posed edits tell parts of their cells apart.

        Args:
            edits: The FlatEdits, whose cells are marked.
            grid: VoxelGrid of the field as it is marched.
        """
        lanes = lane_count(self._device)
        for edit, buffer in zip(edits, self._words, strict=True):
            nodes = edit.look.size
            if edit.spacing < LEAST_VOXELS * max(grid.voxel_size) or nodes > MOST_NODES:
                continue
            words, looks = buffer.take(int(PART_WORDS) * nodes), self._looks.take(nodes)
            parts = array_view(words, wp.uint8, int(PART_COUNT) * nodes)
            groups, work = -(-nodes // max(1, lanes // 4)), int(PART_COUNT) / lanes  # an octet of cells for a group
            launch(mark_parts, lanes * groups, [grid, edit], [looks, parts], device=self._device, work=work)
            launch(spread_parts, -(-nodes // lanes) * lanes, [edit, looks], [words], device=self._device)
            edit.parts, edit.part_count, edit.part_size = int(PARTS), int(PART_COUNT), float(PART_SIZE)
            edit.fine_look = parts
