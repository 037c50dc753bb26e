"""Launches that continue a map from the inside nodes of a lattice to the rings around them."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import lane_count, launch
from ..kernels.lattice.cut_rows import CutRows, describe_rows
from ..kernels.lattice.nodes import RINGS
from ..kernels.lattice.rings import extend_outwards, extend_through_cage
from .capture import Buffers


def described_rows(lattice, nodes, row_count: int, finest: int, buffers: Buffers | None = None) -> CutRows:
    """Launch the description of the cut nodes of all listed levels (kernels/lattice/cut_rows.py). row_count, finest:
    rows of all levels and of level 0, or upper bounds. buffers: that hold it, the lattice's unless given."""
    buffers = lattice.buffers if buffers is None else buffers
    rows = CutRows()
    rows.links = buffers.get("links", row_count, int)
    rows.diagonals = buffers.get("diagonals", row_count, float)
    rows.fractions = buffers.get("fractions", (row_count, 6), float)
    rows.faces = buffers.get("cut_faces", (finest, 6), int)
    rows.corners = buffers.get("cut_corners", (finest, 6), wp.vec3)
    inputs = [lattice.crossings, lattice.flat_distance, lattice.vertices, lattice.faces, nodes.levels, rows]
    launch(describe_rows, row_count, inputs, device=lattice.device)
    return rows


def launch_rings(solver, sections: np.ndarray, vertex_values: wp.array, values: wp.array) -> None:
    """Launch the continuation of a map that is linear on the cage's faces from inside nodes to the rings around them
    (kernels/lattice/rings.py)."""
    for ring in range(RINGS):
        launch_ring(solver, ring, sections, vertex_values, values)


def launch_ring(solver, ring: int, sections: np.ndarray, vertex_values: wp.array, values: wp.array) -> None:
    """Launch the continuation to one ring; those before it come first."""
    lattice, nodes, device = solver.lattice, solver.nodes, solver.device
    count = int(sections[3 * nodes.level_count + ring])
    if ring == 0:
        inputs = [nodes.levels, solver.rows, lattice.faces, vertex_values, values]
        # an octet of lanes a node, in whole warps
        items = count if device.is_cpu else -(-count // 4) * lane_count(device)
        launch(extend_through_cage, items, inputs, device=device)
    else:
        inputs = [ring, lattice.vertices, lattice.faces, nodes.levels, vertex_values, lattice.flat_distance, values]
        launch(extend_outwards, lane_count(device) * count, inputs, device=device)
