"""The table of cut nodes of a lattice, and launches that continue a map from inside nodes to the rings around them."""

from __future__ import annotations

import warp as wp

from ..core.arrays import WarpStruct
from ..core.devices import lane_count, launch
from ..kernels.lattice.cut_rows import CutRows, describe_rows
from ..kernels.lattice.nodes import RINGS
from ..kernels.lattice.rings import extend_outwards, extend_through_cage
from .capture import BufferPool
from .lattice import CageLattice
from .sizes import NodeSections


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
    count = sections.ring(0)
    # an octet of lanes for each node, in whole warps
    items = count if lattice.device.is_cpu else -(-count // 4) * lane_count(lattice.device)
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
