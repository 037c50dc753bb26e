"""Narrow gaps of a cage that a pose opens: the search, and corner values for each side."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import lane_count, launch
from ..kernels.lattice.cut_rows import CutRows
from ..kernels.lattice.gap_sides import count_column_sides, list_column_sides, mark_gap_cells, mark_narrow_cells
from ..kernels.lattice.narrow_gaps import GAP_JUMP, confirm_narrow, find_gap_nodes
from ..kernels.lattice.side_values import (
    complete_sides,
    continue_sides,
    gather_side_status,
    measure_jumps,
    place_sides,
    set_boundary_values,
)
from .capture import Buffers

#: Bytes that the tables take of each node, at most of each square cell of the cage's surface, and some that all share.
SIDE_NODE_BYTES, SIDE_SURFACE_BYTES, SIDE_FIXED_BYTES = 5, 700, 1 << 16

#: A jump of the map over less than a cell that is larger than this share of the rest cage's size is reported.
REPORTED_JUMP = 2e-2


def side_bytes(node_count: int, surface: float) -> int:
    """The most that the tables take. surface: area of the cage, cells squared."""
    return int(SIDE_FIXED_BYTES + SIDE_NODE_BYTES * node_count + SIDE_SURFACE_BYTES * surface)


class MapSides:
    """The tables of a map's cells at narrow gaps, kept from pose to pose.

    solver: whose maps, to the cage `rest`, have the gaps. constants: the arrays of the lattice's map_constants.

    Attributes: index and table, side_index and sides of CageMap; jump, the largest that the remainder makes over
    a gap narrower than a cell; buffers, all that is held on the device.
    """

    def __init__(self, solver, rest, constants: dict):
        self.solver, self.device, self._rest, self._constants = solver, solver.device, rest, constants
        self.buffers = Buffers(self.device)
        # written by the device where the host reads it
        self._host_status = wp.zeros(2, dtype=float, device="cpu", pinned=self.device.is_cuda)
        self._status = wp.array(ptr=self._host_status.ptr, dtype=float, shape=2, device=self.device)
        self.jump, self.length = 0.0, 0

    def find(self) -> None:
        """Fill the tables of the map that the solver's values hold, affine part included. Waits twice."""
        nodes, lattice = self.solver.nodes, self.solver.lattice
        self._launch_count(lattice.node_count, lattice.shape[0] * lattice.shape[1], nodes.sections)
        self.length = int(self._offsets[-1:].numpy()[0] + self._counts[-1:].numpy()[0])
        self._launch_tables(self.length)
        self.take()

    def launch(self, node_count: int, column_count: int, sections: np.ndarray, room: int) -> None:
        """Launch the same, for a CUDA graph: counts of this pose or upper bounds, and `room`, rows of the table. `take`
        tells whether that was enough."""
        self._launch_count(node_count, column_count, sections)
        self._launch_tables(room)

    def take(self) -> bool:
        """Wait for the tables and note what they hold; False where they had no room."""
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
        status = self._host_status.numpy()
        self.length, self.jump = int(status[0]), float(status[1])
        return self.length <= self.table.shape[0]

    def _launch_count(self, node_count: int, column_count: int, sections: np.ndarray) -> None:
        """Launch what finds the cells and how long the table will be."""
        solver, buffers = self.solver, self.buffers
        levels, cut = solver.nodes.levels, solver.nodes.level_count * 2
        self._cut_count = int(sections[cut])
        self._boundary = buffers.get("boundary", (self._cut_count, 6), wp.vec3)
        face_values = solver.face_values(self._rest, self._constants["affine"])
        values = self._constants["vertex_values"]
        solver.launch_boundary(self._cut_count, values, face_values, buffers, self._boundary)
        # where there are sides at all, all gaps get theirs
        solver.gaps.search(sections, solver.rows, solver.values, 0.0)
        self.index = buffers.get("side_index", node_count, int)
        self.index.zero_()
        flags = solver.gaps.flags
        self._launch(mark_gap_cells, flags.size, [levels, flags], [self.index], threads=1)
        self._launch(mark_narrow_cells, self._cut_count, [levels, solver.rows], [self.index], threads=1)
        self._counts, self._offsets = (buffers.get(name, column_count, int) for name in ("counts", "offsets"))
        items = lane_count(self.device) * column_count
        self._launch(count_column_sides, items, [levels, solver.rows], [self._counts, self.index])
        wp.utils.array_scan(self._counts, self._offsets, inclusive=False)

    def _launch_tables(self, room: int) -> None:
        """Launch what fills the tables, of at most `room` rows."""
        solver, buffers = self.solver, self.buffers
        lattice, levels, rows = solver.lattice, solver.nodes.levels, solver.rows
        cells, masks = (buffers.get(name, room, int) for name in ("cells", "masks"))
        self.table = buffers.get("sides", (room, 8), wp.vec4)
        items = lane_count(self.device) * self._counts.size
        inputs = [levels, rows, self._counts, self._offsets]
        self._launch(list_column_sides, items, inputs, [self.index, cells, masks])
        table = [self._counts, self._offsets, cells, masks]
        values = [self._rest.size, self._constants["affine"], solver.values, solver.corrections, lattice.flat_distance]
        self._launch(continue_sides, 8 * room, [levels, rows, self._boundary, *values, *table], [self.table])
        self._launch(complete_sides, room, table[:3], [self.table])
        heights = [lattice.constants.arrays["scales"], lattice.vertices, lattice.faces]
        self._launch(place_sides, 4 * room, [levels, rows, *heights, *table], [self.table])
        jump = buffers.get("jump", 1, float)
        jump.zero_()
        self._launch(measure_jumps, self._cut_count, [levels, rows, self._boundary], [jump], threads=1)
        self._launch(gather_side_status, 1, [self._counts, self._offsets, jump], [self._status])

    def _launch(self, kernel, count: int, inputs, outputs, threads: int | None = None) -> None:
        launch(kernel, count, inputs, outputs, device=self.device, threads=threads)


def launch_linear_boundary(solver, cut_count: int, vertex_values: wp.array, boundary: wp.array) -> None:
    """Launch the values (rows of level 0, 6) vec3 of a map that is linear on the cage's faces, where links cross it.
    cut_count: rows, or an upper bound."""
    inputs = [solver.nodes.levels, solver.rows, solver.lattice.faces, vertex_values]
    launch(set_boundary_values, cut_count, inputs, [boundary], device=solver.device)


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
