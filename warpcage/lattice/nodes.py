"""Lists of inside, cut and ring nodes of a lattice, for a level or a hierarchy, and launches that fill the rings."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import WarpStruct
from ..core.devices import lane_count, launch, octet_items
from ..kernels.lattice.cut_rows import CutRows, describe_rows
from ..kernels.lattice.nodes import RINGS, NodeLevels, classify_columns, list_columns
from ..kernels.lattice.rings import extend_outwards, extend_through_cage
from .buffers import BufferPool
from .lattice import CageLattice
from .sizes import NodeSections, PoseSizes


class LatticeNodes:
    """Numbering, codes and lists of a lattice's nodes (kernels/lattice/nodes.py); level_count None: all of multigrid.
    interpolates: sections of inside nodes are by evaluated or interpolated, not by colour (one level only)."""

    def __init__(self, lattice: CageLattice, level_count: int | None = None, *, interpolates: bool = False):
        self.level_count = lattice.level_count if level_count is None else level_count
        self._lattice, self._interpolates = lattice, interpolates
        section_count = 3 * self.level_count + RINGS
        self.sections = NodeSections(np.zeros(section_count, dtype=np.int64))  # lengths of the lists of the last pose
        self._limits = wp.zeros(section_count, dtype=wp.int32, device=lattice.device)
        self._codes = lattice.buffers.buffer(wp.int32)
        self._starts = lattice.buffers.buffer(wp.int32)
        self._counts = lattice.buffers.buffer(wp.int32)
        self._offsets = lattice.buffers.buffer(wp.int32)
        self._list = lattice.buffers.buffer(wp.int32)
        self.levels = NodeLevels()

    def launch(self, sizes: PoseSizes) -> PoseSizes:
        """Launch what classifies the nodes and lists them, once the lattice is measured; returns sizes with sections.
        Where sizes have no sections yet, this waits until the device has counted them."""
        offsets = self._launch_classes(sizes)
        if sizes.sections is None:
            self.sections = self._counted_sections(offsets)
            sizes = sizes.counted(self.sections)
            self.limit(self.sections)
        self.levels.nodes = self._list.take(sizes.lists.total)
        device = self._lattice.device
        inputs = [self.levels, offsets, self._limits, self._lattice.flags.lists]
        launch(list_columns, lane_count(device) * sizes.level_columns, inputs, device=device)
        return sizes

    def limit(self, sections: NodeSections) -> None:
        """Let all lists be left out, and that be flagged, where one of them is longer than its section here."""
        self._limits.assign(sections.lengths.astype(np.int32))

    def _launch_classes(self, sizes: PoseSizes) -> wp.array:
        """Launch what classifies and counts the nodes; the scanned counts."""
        lattice, count = self._lattice, self.level_count
        constants, device = lattice.constants, lattice.device
        levels = self.levels = NodeLevels()
        levels.shapes = constants.shapes.array[:count]
        levels.first_node = constants.first_node.array[: count + 1]
        levels.first_column = constants.first_column.array[: count + 1]
        levels.codes = self._codes.take(sizes.level_nodes)
        levels.starts = self._starts.take(len(self.sections.lengths) + 1)
        levels.interpolates = int(self._interpolates)
        counts, offsets = self._counts.take(sizes.entries), self._offsets.take(sizes.entries)
        clear = lattice.block_faces.clear_octants
        inputs = [lattice.crossings, lattice.flat_distance, constants.scales.array, clear, levels]
        items = lane_count(device) * sizes.level_columns
        launch(classify_columns, items, inputs, [lattice.flags.narrow, counts], device=device)
        wp.utils.array_scan(counts, offsets, inclusive=False)
        return offsets

    def _counted_sections(self, offsets: wp.array) -> NodeSections:
        """Wait for the lengths of the sections."""
        return NodeSections(np.diff(offsets.numpy()[self._section_entries()].astype(np.int64)))

    def _section_entries(self) -> np.ndarray:
        """Entries of the scanned counts at which the sections begin, and the last one's end."""
        first = self._lattice.layout.first_column[: self.level_count + 1]
        width, columns = np.diff(first), first[-1]
        inside = np.stack([2 * first[:-1], 2 * first[:-1] + width], axis=1).reshape(-1)
        return np.concatenate([inside, 2 * columns + first[:-1], 3 * columns + np.arange(RINGS + 1) * width[0]])


class CutRowTable:
    """Buffers for the description of cut nodes (kernels/lattice/cut_rows.py)."""

    def __init__(self, pool: BufferPool):
        self._links = pool.buffer(wp.int32)
        self._diagonals = pool.buffer(wp.float32)
        self._fractions = pool.buffer(wp.float32)
        self._faces = pool.buffer(wp.int32)
        self._corners = pool.buffer(wp.vec3)

    def describe(self, lattice: CageLattice, levels: WarpStruct, sections: NodeSections) -> WarpStruct:
        """Launch the description of the cut nodes of all listed levels, and return the table that it fills.
        The lattice has crossings and distances; sections are lengths of the lists, or bounds."""
        rows = CutRows()
        rows.links = self._links.take(sections.all_cut)
        rows.diagonals = self._diagonals.take(sections.all_cut)
        rows.fractions = self._fractions.take((sections.all_cut, 6))
        rows.faces = self._faces.take((sections.cut, 6))
        rows.corners = self._corners.take((sections.cut, 6))
        inputs = [lattice.crossings, lattice.flat_distance, lattice.vertices, lattice.faces, levels, rows]
        launch(describe_rows, sections.all_cut, inputs, device=lattice.device)
        return rows


def continue_through_cage(
    lattice: CageLattice,
    levels: WarpStruct,
    rows: WarpStruct,
    sections: NodeSections,
    vertex_values: wp.array,
    values: wp.array,
) -> None:
    """Launch the continuation to ring 0 of a map that is linear on the cage's faces (kernels/lattice/rings.py).
    vertex_values: (v,) vec3, at the cage's vertices; values: (nodes,) vec3, at inside nodes, ring 0 is filled in."""
    inputs = [levels, rows, lattice.faces, vertex_values, values]
    items = octet_items(lattice.device, sections.ring(0))
    launch(extend_through_cage, items, inputs, device=lattice.device)


def continue_outwards(
    ring: int,
    lattice: CageLattice,
    levels: WarpStruct,
    sections: NodeSections,
    vertex_values: wp.array,
    values: wp.array,
) -> None:
    """Launch the continuation of a map to ring 0, 1 or 2 from values alone; rings before it come first.
    vertex_values: (v,) vec3, at the cage's vertices; values: (nodes,) vec3, so far, the ring is filled in."""
    inputs = [ring, lattice.vertices, lattice.faces, levels, vertex_values, lattice.flat_distance]
    launch(extend_outwards, lane_count(lattice.device) * sections.ring(ring), inputs, [values], device=lattice.device)


def continue_to_rings(
    lattice: CageLattice,
    levels: WarpStruct,
    rows: WarpStruct,
    sections: NodeSections,
    vertex_values: wp.array,
    values: wp.array,
) -> None:
    """Launch the continuation of a map that is linear on the cage's faces to all rings.
    vertex_values: (v,) vec3, at the cage's vertices; values: (nodes,) vec3, at inside nodes, rings are filled in."""
    continue_through_cage(lattice, levels, rows, sections, vertex_values, values)
    for ring in range(1, RINGS):
        continue_outwards(ring, lattice, levels, sections, vertex_values, values)
