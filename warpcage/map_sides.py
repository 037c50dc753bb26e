"""The corner values of each side of narrow gaps of a cage, for the cells of a map that need them."""

from __future__ import annotations

import numpy as np
import warp as wp

from .devices import lane_count, launch
from .kernels.harmonic_rows import CutRows, describe_rows
from .kernels.map_extension import extend_outwards, extend_through_cage
from .kernels.map_sides import (
    GAP_JUMP,
    confirm_narrow,
    count_column_sides,
    fill_sides,
    find_gap_nodes,
    list_column_sides,
    mark_gap_cells,
    mark_narrow_cells,
    measure_jumps,
    set_boundary_values,
)
from .kernels.node_levels import RINGS

#: Buffers of the tables, and what they take: of each node, and at most of each square cell of the cage's surface.
SIDE_BUFFERS = ("side_index", "side_counts", "side_offsets", "side_cells", "side_masks", "sides", "jumps", "boundary")
SIDE_NODE_BYTES, SIDE_SURFACE_BYTES, SIDE_FIXED_BYTES = 5, 700, 1 << 16

#: A jump of the map over less than a cell that is larger than this share of the rest cage's size is reported.
REPORTED_JUMP = 2e-2


def described_rows(lattice, nodes, row_count: int, finest: int) -> CutRows:
    """Launch the description of the cut nodes of all listed levels (kernels/harmonic_rows.py). row_count, finest: rows
    of all levels and of level 0, or upper bounds."""
    buffers = lattice.buffers
    rows = CutRows()
    rows.links = buffers.get("links", row_count, int)
    rows.diagonals = buffers.get("diagonals", row_count, float)
    rows.fractions = buffers.get("fractions", (row_count, 6), float)
    rows.faces = buffers.get("cut_faces", (finest, 6), int)
    rows.corners = buffers.get("cut_corners", (finest, 6), wp.vec3)
    inputs = [lattice.crossings, lattice.flat_distance, lattice.vertices, lattice.faces, nodes.levels, rows]
    launch(describe_rows, row_count, inputs, device=lattice.device)
    return rows


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
        gap that is narrower than a cell is seen by `nodes.narrow` alone; values: of which a difference between inside nodes
        above `least` makes a gap."""
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


def side_bytes(node_count: int, surface: float) -> int:
    """The most that the tables take. surface: area of the cage, cells squared."""
    return int(SIDE_FIXED_BYTES + SIDE_NODE_BYTES * node_count + SIDE_SURFACE_BYTES * surface)


class MapSides:
    """The tables of a map's cells at narrow gaps.

    solver: after its solution, with `rows`. boundary (rows of level 0, 6): the map's remainder
    where links cross the cage. scale, affine: its positions are scale times the remainder plus an affine part.

    Attributes: index and table, side_index and sides of CageMap; jump, the largest that the remainder makes over
    a gap narrower than a cell.
    """

    def __init__(self, solver, boundary: wp.array, scale: float, affine: wp.array):
        self.device, buffers = solver.device, solver.lattice.buffers
        lattice, nodes, rows = solver.lattice, solver.nodes, solver.rows
        levels, cut_count = nodes.levels, boundary.shape[0]
        columns = lattice.shape[0] * lattice.shape[1]
        # where there are sides at all, all gaps get theirs
        solver.gaps.search(nodes.sections, rows, solver.values, 0.0)
        self.index = buffers.get("side_index", lattice.node_count, int)
        self.index.zero_()
        flags = solver.gaps.flags
        self._launch(mark_gap_cells, flags.size, [levels, flags], [self.index], threads=1)
        self._launch(mark_narrow_cells, cut_count, [levels, rows], [self.index], threads=1)
        counts, offsets = (buffers.get(name, columns, int) for name in ("side_counts", "side_offsets"))
        self._launch(count_column_sides, columns, [levels, rows, self.index], [counts])
        wp.utils.array_scan(counts, offsets, inclusive=False)
        total = int(offsets[-1:].numpy()[0] + counts[-1:].numpy()[0])
        cells, masks = (buffers.get(name, total, int) for name in ("side_cells", "side_masks"))
        self._launch(list_column_sides, columns, [levels, rows, offsets], [self.index, cells, masks])
        self.table = buffers.get("sides", (total, 8), wp.vec4)
        inputs = [levels, rows, boundary, scale, affine, solver.values, lattice.flat_distance, cells, masks]
        self._launch(fill_sides, total, inputs, [self.table])
        jumps = buffers.get("jumps", cut_count, float)
        self._launch(measure_jumps, cut_count, [levels, rows, boundary], [jumps])
        self.jump = float(jumps.numpy().max()) if cut_count else 0.0

    def _launch(self, kernel, count: int, inputs, outputs, threads: int | None = None) -> None:
        launch(kernel, count, inputs, outputs, device=self.device, threads=threads)


def boundary_buffer(solver) -> wp.array:
    """(rows of level 0, 6) vec3, to be filled with the map's remainder where links cross the cage."""
    return solver.lattice.buffers.get("boundary", (int(solver.nodes.counts["cut"][0]), 6), wp.vec3)


def launch_rings(solver, sections: np.ndarray, vertex_values: wp.array, values: wp.array) -> None:
    """Launch the continuation of a map that is linear on the cage's faces from inside nodes to the rings around them
    (kernels/map_extension.py)."""
    lattice, nodes = solver.lattice, solver.nodes
    rings = sections[3 * nodes.level_count :]
    inputs = [nodes.levels, solver.rows, lattice.faces, vertex_values, values]
    # an octet of lanes a node, in whole warps
    items = int(rings[0]) if solver.device.is_cpu else -(-int(rings[0]) // 4) * lane_count(solver.device)
    launch(extend_through_cage, items, inputs, device=solver.device)
    for ring in range(1, RINGS):
        inputs = [ring, lattice.vertices, lattice.faces, nodes.levels, vertex_values, lattice.flat_distance, values]
        launch(extend_outwards, lane_count(solver.device) * int(rings[ring]), inputs, device=solver.device)


def linear_boundary(solver, vertex_values: wp.array) -> wp.array:
    """The same of a map that is linear on the cage's faces."""
    boundary = boundary_buffer(solver)
    inputs = [solver.rows, solver.lattice.faces, vertex_values]
    launch(set_boundary_values, boundary.shape[0], inputs, [boundary], device=solver.device)
    return boundary
