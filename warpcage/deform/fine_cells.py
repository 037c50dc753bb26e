"""Fine cells of lattices, which marches may skip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from ..core.arrays import array_view
from ..core.devices import RepeatedLaunches, lane_count
from ..kernels.edits.fine_cells import FINE_COUNT, FINE_SIDE, FINE_WORDS, mark_fine_cells, spread_fine_cells
from ..lattice.buffers import BufferPool, SideStream

#: Cells that are less than so many voxels wide are not told apart: fine cells would be smaller than what they skip.
LEAST_VOXELS = 2.0

#: As many factors of two.
FINE_BITS = int(FINE_SIDE).bit_length() - 1

#: Lattices of more nodes have more fine cells than an index counts.
MOST_NODES = (1 << 31) // int(FINE_COUNT) - 64


class FineCells:
    """Which fine cells of posed lattices may be skipped, found on the stream `side`."""

    def __init__(self, edit_count: int, side: SideStream):
        device = side.device
        self._device, self._lanes = device, lane_count(device)
        pool = BufferPool(device)
        self._words = [pool.buffer(wp.uint32) for _ in range(edit_count)]
        self._looks = [pool.buffer(wp.uint64) for _ in range(edit_count)]
        self._side, self._launch = side, RepeatedLaunches(device)

    def begin(self, edits: Sequence[Any], grid: Any, step: float) -> None:
        """Let posed FlatEdits, whose cells are marked, tell their fine cells apart, beside what comes until the side
        stream joins. step: the longest of a march, world units."""
        width = max(grid.voxel_size)
        told = [edit.spacing >= LEAST_VOXELS * width and edit.look.size <= MOST_NODES for edit in edits]
        held = [
            (edit, words.take(int(FINE_WORDS) * edit.look.size), looks.take(edit.look.size))
            for edit, words, looks, is_told in zip(edits, self._words, self._looks, told, strict=True)
            if is_told
        ]
        self._side.mark()  # behind which memory is there, and the tables of cells
        stream = self._side.behind_mark()
        for number, (edit, words, looks) in enumerate(held):
            self._mark(number, edit, grid, step, words, looks, stream)

    def _mark(
        self, number: int, edit: Any, grid: Any, step: float, words: wp.array, looks: wp.array, stream: wp.Stream | None
    ) -> None:
        nodes = looks.size
        fine_look = array_view(words, wp.uint8, int(FINE_COUNT) * nodes)
        groups = -(-nodes // max(1, self._lanes // 4))  # an octet of cells for a group of lanes
        inputs, how = [grid, edit, step], {"number": number, "stream": stream}
        work = int(FINE_COUNT) / self._lanes
        self._launch(mark_fine_cells, self._lanes * groups, inputs, [looks, fine_look], work=work, **how)
        whole_groups = -(-nodes // self._lanes) * self._lanes
        self._launch(spread_fine_cells, whole_groups, [edit, looks], [words], **how)
        tell_fine_cells(edit, FINE_BITS, fine_look)


def tell_fine_cells(edit: Any, bits: int, fine_look: wp.array) -> None:
    """Let a FlatEdit tell fine cells apart, 2^bits along each side of a cell; fine_look: (8^bits * nodes,) uint8."""
    edit.fine_bits, edit.fine_look, side = bits, fine_look, 1 << bits
    edit.last_fine = wp.vec3i(*(side * (count - 1) - 1 for count in edit.node_counts))
    edit.fine_width, edit.fine_size = 1.0 / side, edit.spacing / side
    edit.inverse_fine_size = edit.inverse_spacing * side
