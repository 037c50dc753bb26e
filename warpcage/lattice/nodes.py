"""Build the lists of inside, cut and ring nodes of a lattice, for one level or for a multigrid hierarchy."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import lane_count, launch
from ..kernels.lattice.nodes import RINGS, NodeLevels, classify_columns, list_columns

NO_LIMIT = np.iinfo(np.int32).max


class LatticeNodes:
    """Numbering, codes and lists of the nodes of a CageLattice (see kernels/lattice/nodes.py).

    level_count 1 lists the inside nodes and the rings around them, as the closed forms need; None takes as many levels
    as multigrid has use for. interpolates: inside nodes clear of the cage have sections by whether they are evaluated
    or interpolated, not by colour (one level only).

    Attributes: levels, the kernels' struct; counts: {"inside": (L, 2), "cut": (L,), "rings": (3,)} NumPy ints;
    sections (3 L + 3,) the same in one row; first_node (L + 1,) NumPy ints.
    """

    def __init__(self, lattice, level_count: int | None = None, *, interpolates: bool = False):
        self.lattice, self.interpolates = lattice, interpolates
        self.level_count = lattice.level_count if level_count is None else level_count
        self.section_count = 3 * self.level_count + RINGS
        self._limits = wp.zeros(self.section_count, dtype=int, device=lattice.device)
        self.overflow = lattice.flags[1:2]
        self.narrow = lattice.flags[2:3]  # 1 where a gap is narrower than a cell
        self.fill()

    def fill(self) -> LatticeNodes:
        """List the nodes anew, after the lattice was laid over another pose."""
        self._limits.fill_(NO_LIMIT)
        self.overflow.zero_()
        self.narrow.zero_()
        self.launch_classes(self.sizes)
        self.take_sections(np.diff(self._offsets.numpy()[self._section_entries()].astype(np.int64)))
        self.launch_lists(self.sizes, int(self.sections.sum()))
        return self

    @property
    def first_node(self) -> np.ndarray:
        return self.lattice.first_node[: self.level_count + 1]

    @property
    def sizes(self) -> dict:
        """Nodes of all levels and of those above the finest, columns and entries to scan, of this pose."""
        first_column = self.lattice.first_column
        columns = int(first_column[self.level_count])
        return {
            "nodes": int(self.first_node[-1]),
            "coarse_nodes": int(self.first_node[-1] - self.first_node[1]),
            "columns": columns,
            "entries": 3 * columns + RINGS * int(first_column[1]) + 1,
        }

    def set_limits(self, sections: np.ndarray) -> None:
        """Let lists that are longer than `sections` (sections,) be left out, and flagged in `overflow`."""
        self._limits.assign(sections.astype(np.int32))

    def take_sections(self, sections: np.ndarray) -> None:
        """Note how many nodes each section has."""
        count = self.level_count
        self.sections = sections
        self.starts = np.concatenate([[0], np.cumsum(sections)])
        self.counts = {
            "inside": sections[: 2 * count].reshape(count, 2),
            "cut": sections[2 * count : 3 * count],
            "rings": sections[3 * count :],
        }

    def launch_classes(self, sizes: dict) -> None:
        """Launch what classifies and counts the nodes. sizes: those of this pose, or upper bounds."""
        lattice, device, buffers, count = self.lattice, self.lattice.device, self.lattice.buffers, self.level_count
        arrays = lattice.constants.arrays
        levels = self.levels = NodeLevels()
        levels.shapes = arrays["shapes"][:count]
        levels.first_node = arrays["first_node"][: count + 1]
        levels.first_column = arrays["first_column"][: count + 1]
        levels.codes = buffers.get("codes", sizes["nodes"], int)
        levels.starts = buffers.get("starts", self.section_count + 1, int)
        levels.interpolates = int(self.interpolates)
        counts = buffers.get("column_counts", sizes["entries"], int)
        self._offsets = buffers.get("column_offsets", sizes["entries"], int)
        inputs = [lattice.crossings, lattice.flat_distance, arrays["scales"], lattice.clear_octants, levels]
        items = lane_count(device) * sizes["columns"]
        launch(classify_columns, items, inputs, [self.narrow, counts], device=device)
        wp.utils.array_scan(counts, self._offsets, inclusive=False)

    def launch_lists(self, sizes: dict, room: int) -> None:
        """Launch what writes the lists, of at most `room` nodes."""
        self.levels.nodes = self.lattice.buffers.get("nodes", room, int)
        device = self.lattice.device
        inputs = [self.levels, self._offsets, self._limits, self.overflow]
        launch(list_columns, lane_count(device) * sizes["columns"], inputs, device=device)

    def _section_entries(self) -> np.ndarray:
        """Entries of the scanned counts at which the sections begin, and the last one's end."""
        first = self.lattice.first_column[: self.level_count + 1]
        width, columns = np.diff(first), first[-1]
        inside = np.stack([2 * first[:-1], 2 * first[:-1] + width], axis=1).reshape(-1)
        return np.concatenate([inside, 2 * columns + first[:-1], 3 * columns + np.arange(RINGS + 1) * width[0]])
