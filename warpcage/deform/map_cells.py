"""The maps of lattices as polynomials of their cells, which marches for one edit read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from ..core.devices import RepeatedLaunches
from ..kernels.edits.nodes import CELL_WORDS, expand_map_cells
from ..lattice.buffers import BufferPool

#: An array has fewer entries along an axis.
MOST_ENTRIES = 1 << 31

#: Share of a GPU's memory that the polynomials of a lattice's cells may take.
MOST_POLYNOMIALS = 1 / 16


class MapPolynomials:
    """The map of each cell of posed lattices as a polynomial."""

    def __init__(self, edit_count: int, device: wp.Device):
        self._most_bytes = math.inf if device.is_cpu else MOST_POLYNOMIALS * device.total_memory
        pool = BufferPool(device)
        self._polynomials = [pool.buffer(wp.vec4) for _ in range(edit_count)]
        self._launch = RepeatedLaunches(device)

    def expand(self, edits: Sequence[Any]) -> None:
        """Give posed FlatEdits, whose cells are marked, their `polynomials`, where they map anything and there is
        memory."""
        for number, (edit, buffer) in enumerate(zip(edits, self._polynomials, strict=True)):
            words = int(CELL_WORDS) * edit.look.size
            takes = wp.types.type_size_in_bytes(wp.vec4) * words
            if not edit.removes and words < MOST_ENTRIES and takes <= self._most_bytes:
                inputs, polynomials = [edit.nodes, edit.look, edit.node_counts], buffer.take(words)
                self._launch(expand_map_cells, edit.look.size, inputs, [polynomials], number=number)
                edit.polynomials, edit.by_nodes = polynomials, 0


def needs_general_map(edit: Any) -> bool:
    """Whether a FlatEdit has corner values for each side of narrow gaps, or no polynomials: the faster march knows
    polynomials alone."""
    return bool(edit.has_sides or edit.by_nodes)
