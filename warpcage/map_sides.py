"""The corner values of each side of narrow gaps of a cage, for the cells of a harmonic map that need them."""

from __future__ import annotations

import numpy as np
import warp as wp

from .devices import launch
from .kernels.harmonic_rows import CutRows
from .kernels.map_sides import count_cell_sides, fill_sides, find_gap_nodes, list_cell_sides, mark_gap_cells


class GapFlags:
    """Which outside nodes next to the inside lie at gaps narrower than about two cells.

    solver: whose nodes are listed, and whose `rows` are described where it has any. Attributes: flags, one int for each
    node of rings 0 and 1; count (1,), above zero where any is set (on a CPU not how many: see `total`).
    """

    def __init__(self, solver):
        self.solver, self.device = solver, solver.lattice.device
        self.count = wp.zeros(1, dtype=int, device=self.device)

    def launch(self, sections: np.ndarray) -> None:
        """Launch the search. sections: nodes of each list, or upper bounds."""
        nodes = self.solver.nodes
        rows = getattr(self.solver, "rows", None) or CutRows()
        items = int(sections[3 * nodes.level_count : 3 * nodes.level_count + 2].sum())
        self.flags = nodes.lattice.buffers.get("gap_flags", items, int)
        self.count.zero_()
        launch(find_gap_nodes, items, [nodes.levels, rows], [self.flags, self.count], device=self.device)

    def total(self) -> int:
        """How many nodes are flagged."""
        return int(self.flags.numpy().sum())


def build_sides(solver, gaps: GapFlags, vertex_values: wp.array, scale: float, affine: wp.array):
    """side_index and sides of CageMap for the map in solver.values: scale times vertex_values plus an affine part."""
    lattice, nodes, device = solver.lattice, solver.nodes, solver.device
    levels, rows, count = nodes.levels, solver.rows, lattice.node_count
    side_index = lattice.buffers.get("side_index", count, int)
    side_index.zero_()
    launch(mark_gap_cells, gaps.flags.size, [levels, gaps.flags], [side_index], device=device, threads=1)
    counts = wp.empty(count, dtype=int, device=device)
    launch(count_cell_sides, count, [levels, rows, side_index], [counts], device=device)
    offsets = wp.empty(count, dtype=int, device=device)
    wp.utils.array_scan(counts, offsets, inclusive=False)
    total = int(offsets[-1:].numpy()[0] + counts[-1:].numpy()[0])
    cells, masks = (wp.empty(total, dtype=int, device=device) for _ in range(2))
    launch(
        list_cell_sides,
        count,
        [levels, rows, offsets, counts],
        [side_index, cells, masks],
        device=device,
    )
    sides = wp.empty((total, 8), dtype=wp.vec4, device=device)
    inputs = [levels, rows, lattice.faces, vertex_values, scale, affine, solver.values, lattice.flat_distance]
    launch(fill_sides, total, [*inputs, cells, masks], [sides], device=device)
    return side_index, sides
