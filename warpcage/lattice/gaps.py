"""Narrow gaps of a cage that a pose opens: the search, and corner values for each side."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from ..core.arrays import WarpStruct
from ..core.devices import lane_count, launch
from ..kernels.lattice.gaps import (
    GAP_JUMP,
    confirm_narrow,
    count_column_sides,
    find_gap_nodes,
    list_column_sides,
    mark_gap_cells,
    mark_narrow_cells,
)
from ..kernels.lattice.side_values import complete_sides, continue_sides, gather_side_status, measure_jumps, place_sides
from ..mesh.faces import face_area
from ..mesh.mesh import ClosedMesh
from .buffers import BufferPool, HostNumbers
from .lattice import CageLattice
from .nodes import CutRowTable
from .sizes import NodeSections, PoseSizes

#: Bytes that the tables take for each node, at most for each square cell of the cage's surface, and in any case.
SIDE_NODE_BYTES, SIDE_SURFACE_BYTES, SIDE_FIXED_BYTES = 5, 700, 1 << 16

#: A jump of the map over less than a cell that is larger than this share of the rest cage's size is reported.
REPORTED_JUMP = 2e-2

#: What the residual of a map stretches over a shallow groove where nothing is open, lengths as shares of both cages'
#: sizes: boxes that are twisted by 60 and 90 degrees make 2 and 3 at the creases of their sides, a slot of 0.6 of 64
#: cells that a pose opens by 0.08 makes 8.
GROOVE_STRETCH = 3.0


def side_bytes(node_count: int, surface: float) -> int:
    """The most bytes on the device that tables of narrow gaps take; surface: area of the cage, cells squared."""
    return int(SIDE_FIXED_BYTES + SIDE_NODE_BYTES * node_count + SIDE_SURFACE_BYTES * surface)


def lattice_side_bytes(lattice: CageLattice) -> int:
    """The same of the cage that a lattice lies over."""
    return side_bytes(lattice.node_count, face_area(lattice.cage) / lattice.spacing**2)


@dataclass(frozen=True, eq=False)
class MapTarget:
    """The values of a map on the cage of a lattice."""

    rest: ClosedMesh
    affine: wp.array  # (4,) vec3 on the device, the affine part of the map; see add_affine
    vertex_values: wp.array  # (v,) vec3, what the map takes at the vertices besides, as a share of the rest cage's size
    steepest: float = GROOVE_STRETCH  # change of these per length of a gap (posed cage's size) that is no jump


@dataclass(frozen=True, eq=False)
class MapNodes:
    """A map at the nodes of a lattice, with all that sides of gaps are made from."""

    levels: WarpStruct
    rows: WarpStruct  # description of the cut nodes
    boundary: wp.array  # (rows of level 0, 6) vec3, the map less its affine part where links cross the cage
    values: wp.array  # (nodes,) vec3, the map
    corrections: wp.array  # (rows of level 0 or more,) vec3 that are in the values next to the cage, or (0,)
    flags: wp.array  # (nodes of rings 0 and 1,) int, 1 at narrow gaps


class MapSides:
    """The tables of a map's cells at narrow gaps, kept from pose to pose."""

    def __init__(self, device: wp.DeviceLike):
        self._device = wp.get_device(device)
        pool = self.buffers = BufferPool(self._device)
        self.rows, self.boundary = CutRowTable(pool), pool.buffer(wp.vec3)  # for maps that describe no cut nodes
        self._index = pool.buffer(wp.int32)
        self._counts, self._offsets = pool.buffer(wp.int32), pool.buffer(wp.int32)
        self._cells, self._masks = pool.buffer(wp.int32), pool.buffer(wp.int32)
        self._table, self._jump = pool.buffer(wp.vec4), pool.buffer(wp.float32)
        self._status = HostNumbers(2, self._device)
        self.index = self._index.take(0)  # `side_index` and `sides` of CageMap
        self.table = self._table.take((0, 8))
        self.length, self.jump = 0, 0.0  # rows, 0 not known yet; largest jump over gaps below a cell, grooves apart

    def launch_marks(self, sizes: PoseSizes, nodes: MapNodes) -> wp.array:
        """Launch what finds the cells at narrow gaps; `boundary` of the nodes need not be there yet.
        Returns (nodes,) int, below 0 for those cells, until `launch`."""
        levels, rows = nodes.levels, nodes.rows
        index = self.index = self._index.take(sizes.nodes)
        index.zero_()
        self._launch(mark_gap_cells, nodes.flags.size, [levels, nodes.flags], [index], threads=1)
        self._launch(mark_narrow_cells, sizes.lists.cut, [levels, rows], [index], threads=1)
        return index

    def launch(
        self, sizes: PoseSizes, lattice: CageLattice, nodes: MapNodes, target: MapTarget, room: int | None
    ) -> None:
        """Launch what fills the tables, behind `launch_marks`, with the affine part in `nodes`; `take` reads what they
        hold. room: rows of the table, at most; None waits until the device has counted them."""
        counts, offsets = self._launch_count(sizes, nodes)
        if room is None:
            room = int(offsets[-1:].numpy()[0] + counts[-1:].numpy()[0])
        self._launch_tables(sizes, lattice, nodes, target, counts, offsets, room)

    def take(self) -> bool:
        """Wait for the tables and note what they hold; False where they had no room."""
        length, jump = self._status.wait()
        self.length, self.jump = int(length), float(jump)
        return self.length <= self.table.shape[0]

    def _launch_count(self, sizes: PoseSizes, nodes: MapNodes) -> tuple[wp.array, wp.array]:
        """Launch what counts the sides of marked cells column by column; counts, and their scan."""
        levels, rows, index = nodes.levels, nodes.rows, self.index
        counts, offsets = self._counts.take(sizes.columns), self._offsets.take(sizes.columns)
        self._launch(count_column_sides, lane_count(self._device) * sizes.columns, [levels, rows], [counts, index])
        wp.utils.array_scan(counts, offsets, inclusive=False)
        return counts, offsets

    def _launch_tables(
        self,
        sizes: PoseSizes,
        lattice: CageLattice,
        nodes: MapNodes,
        target: MapTarget,
        counts: wp.array,
        offsets: wp.array,
        room: int,
    ) -> None:
        """Launch what fills the tables, of at most `room` rows."""
        levels, rows = nodes.levels, nodes.rows
        cells, masks, sides = self._cells.take(room), self._masks.take(room), self._table.take((room, 8))
        self.table = sides
        items = lane_count(self._device) * sizes.columns
        self._launch(list_column_sides, items, [levels, rows, counts, offsets], [self.index, cells, masks])
        table = [counts, offsets, cells, masks]
        values = [target.rest.size, target.affine, nodes.values, nodes.corrections, lattice.flat_distance]
        self._launch(continue_sides, 8 * room, [levels, rows, nodes.boundary, *values, *table], [sides])
        self._launch(complete_sides, room, table[:3], [sides])
        heights = [lattice.constants.scales.array, lattice.vertices, lattice.faces]
        self._launch(place_sides, 4 * room, [levels, rows, *heights, *table], [sides])
        jump = self._jump.take(1)
        jump.zero_()
        steepest = target.steepest / lattice.resolution  # a cell is that share of the cage
        self._launch(measure_jumps, sizes.lists.cut, [levels, rows, nodes.boundary, steepest], [jump], threads=1)
        self._launch(gather_side_status, 1, [counts, offsets, jump], [self._status.array])

    def _launch(self, kernel, count: int, inputs: list, outputs: list, threads: int | None = None) -> None:
        launch(kernel, count, inputs, outputs, device=self._device, threads=threads)


class GapFlags:
    """Which outside nodes next to the inside lie at gaps narrower than about two cells over which a map jumps."""

    def __init__(self, lattice: CageLattice):
        self._device, self._narrow = lattice.device, lattice.flags.narrow
        self._flags = lattice.buffers.buffer(wp.int32)
        self.count = lattice.flags.gaps  # (1,) int, above zero where any is set (on a CPU not how many: see `total`)
        self.flags = self._flags.take(0)  # one int for each node of rings 0 and 1

    def search(
        self,
        lattice: CageLattice,
        levels: WarpStruct,
        rows: WarpStruct,
        sections: NodeSections,
        values: wp.array,
        least: float = GAP_JUMP,
    ) -> wp.array:
        """Launch the search, the count being zero, in the residual (nodes,) vec3 of a map; returns the flags.
        least: a difference between inside nodes above it makes a gap, as a share of the rest cage's size."""
        # Without rows, a gap that is narrower than a cell is seen by the lattice's flag alone.
        self.flags = self._flags.take(sections.near_rings)
        inputs = [lattice.crossings, levels, values]
        launch(confirm_narrow, sections.cut, inputs, [self._narrow], device=self._device)
        inputs = [levels, rows, values, float(least)]
        launch(find_gap_nodes, sections.near_rings, inputs, [self.flags, self.count], device=self._device)
        return self.flags

    def found(self) -> bool:
        """Whether there are narrow gaps, with or without nodes in them; waits for the device."""
        return int(self.count.numpy()[0]) > 0 or int(self._narrow.numpy()[0]) == 2

    def total(self) -> int:
        """The number of flagged nodes; waits for the device."""
        return int(self.flags.numpy().sum())
