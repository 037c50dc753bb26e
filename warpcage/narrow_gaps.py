"""The search for narrow gaps of a cage that a pose opens."""

from __future__ import annotations

import numpy as np
import warp as wp

from .devices import launch
from .kernels.harmonic_rows import CutRows
from .kernels.narrow_gaps import GAP_JUMP, confirm_narrow, find_gap_nodes


class GapFlags:
    """Which outside nodes next to the inside lie at gaps narrower than about two cells over which the map jumps.

    solver: whose nodes are listed and whose values are the remainder of a map. Attributes: flags, one int for each node
    of rings 0 and 1; count (1,), above zero where any is set (on a CPU not how many: see `total`).
    """

    def __init__(self, solver):
        self.solver, self.device = solver, solver.lattice.device
        self.count = solver.lattice.flags[3:4]

    def search(self, sections: np.ndarray, rows: CutRows | None, values: wp.array, least: float = GAP_JUMP) -> None:
        """Clear the count, and launch."""
        self.count.zero_()
        self.launch(sections, rows, values, least)

    def launch(self, sections: np.ndarray, rows: CutRows | None, values: wp.array, least: float = GAP_JUMP) -> None:
        """Launch the search, the count being zero. sections: nodes of each list, or upper bounds; rows: without them, a
        gap that is narrower than a cell is seen by `nodes.narrow` alone; values: of which a difference above `least`
        between inside nodes makes a gap."""
        nodes = self.solver.nodes
        levels, level_count, crossings = nodes.levels, nodes.level_count, nodes.lattice.crossings
        items = int(sections[3 * level_count : 3 * level_count + 2].sum())
        self.flags = nodes.lattice.buffers.get("gap_flags", items, int)
        cut = int(sections[2 * level_count])
        launch(confirm_narrow, cut, [crossings, levels, values], [nodes.narrow], device=self.device)
        inputs = [levels, CutRows() if rows is None else rows, values, float(least)]
        launch(find_gap_nodes, items, inputs, [self.flags, self.count], device=self.device)

    def found(self) -> bool:
        """Whether there are any, also such that hold no node; waits for the device."""
        return int(self.count.numpy()[0]) > 0 or int(self.solver.nodes.narrow.numpy()[0]) == 2

    def total(self) -> int:
        """How many nodes are flagged."""
        return int(self.flags.numpy().sum())
