"""Build the lists of inside, cut and ring nodes of a lattice, for one level or for a multigrid hierarchy."""

from __future__ import annotations

import numpy as np
import warp as wp

from .devices import launch
from .kernels.node_levels import RINGS, NodeLevels, classify_nodes, count_columns, find_starts, list_columns

#: Cells along the longest side at which coarsening ends.
COARSEST_RESOLUTION = 4


class LatticeNodes:
    """Numbering, codes and lists of the nodes of a CageLattice (see kernels/node_levels.py).

    level_count 1 lists the inside nodes and the rings around them, as the closed forms need; None takes as many levels
    as multigrid has use for.

    Attributes: levels, the kernels' struct; counts: {"inside": (L, 2), "cut": (L,), "rings": (4,)} NumPy ints;
    first_node (L + 1,) NumPy ints.
    """

    def __init__(self, lattice, level_count: int | None = None):
        self.lattice = lattice
        if level_count is None:
            level_count = 1
            while lattice.resolution >> level_count >= COARSEST_RESOLUTION:
                level_count += 1
        self.level_count = level_count
        self.fill()

    def fill(self) -> LatticeNodes:
        """List the nodes anew, after the lattice was laid over another pose."""
        lattice, device, buffers, count = self.lattice, self.lattice.device, self.lattice.buffers, self.level_count
        shapes = level_shapes(lattice.shape, count)
        self.first_node = np.concatenate([[0], np.cumsum(shapes.prod(axis=1, dtype=np.int64))])
        first_column = np.concatenate([[0], np.cumsum(shapes[:, 0] * shapes[:, 1])])
        columns = int(first_column[-1])

        levels = self.levels = NodeLevels()
        levels.shapes = self._constant("shapes", shapes, wp.vec3i)
        levels.first_node = self._constant("first_node", self.first_node, int)
        levels.first_column = self._constant("first_column", first_column, int)
        levels.codes = buffers.get("codes", int(self.first_node[-1]), int)
        levels.starts = buffers.get("starts", 3 * count + RINGS + 1, int)
        launch(
            classify_nodes,
            int(self.first_node[-1]),
            [lattice.crossings, lattice.distance, lattice.spacing, levels],
            device=device,
        )
        entries = 3 * columns + RINGS * int(first_column[1]) + 1
        counts = buffers.get("column_counts", entries, int)
        offsets = buffers.get("column_offsets", entries, int)
        launch(count_columns, columns, [levels], [counts], device=device)
        wp.utils.array_scan(counts, offsets, inclusive=False)
        launch(find_starts, 3 * count + RINGS + 1, [levels, offsets], device=device)
        starts = self.starts = levels.starts.numpy().astype(np.int64)
        sizes = np.diff(starts)
        self.counts = {
            "inside": sizes[: 2 * count].reshape(count, 2),
            "cut": sizes[2 * count : 3 * count],
            "rings": sizes[3 * count :],
        }
        levels.nodes = buffers.get("nodes", int(starts[-1]), int)
        launch(list_columns, columns, [levels, offsets], device=device)
        return self

    def _constant(self, name: str, values: np.ndarray, dtype) -> wp.array:
        """A small table on the device, at the same address for every pose."""
        array = self.lattice.buffers.get(name, len(values), dtype)
        array.assign(np.ascontiguousarray(values, dtype=np.int32))
        return array


def level_shapes(shape, level_count: int) -> np.ndarray:
    """(L, 3) node counts: each level keeps every second node and has a last one at or beyond the finer level's."""
    shapes = [np.asarray(shape, dtype=np.int64)]
    for _ in range(level_count - 1):
        shapes.append(shapes[-1] // 2 + 1)
    return np.stack(shapes)
