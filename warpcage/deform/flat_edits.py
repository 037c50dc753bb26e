"""Posed edits with flat arrays, as marches read them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import warp as wp

from ..core.arrays import empty_array
from ..kernels.edits.cell_tables import join_cell_tables, join_nodes
from ..kernels.edits.structs import CELL_OUTSIDE, FlatEdit
from ..lattice.buffers import Buffer
from .edit_lattices import has_sides
from .fine_cells import tell_fine_cells


def flat_edit(edit: Any, look: Buffer, nodes: Buffer) -> Any:
    """The FlatEdit of a posed LatticeEdit, perhaps without the sides of narrow gaps, its arrays still to be filled.
    look: of uint8, for the table of cells; nodes: of vec4. `tell_sides` and `join_tables` come after."""
    node_count = edit.deformed.distance.size
    flat = FlatEdit()
    flat.lower, flat.inverse_spacing = edit.deformed.lower, edit.deformed.inverse_spacing
    flat.spacing = 1.0 / edit.deformed.inverse_spacing
    flat.node_counts = wp.vec3i(*edit.deformed.distance.shape)
    flat.look, flat.nodes = look.take(node_count), nodes.take(node_count)
    tell_fine_cells(flat, 0, flat.look)
    flat.rest = edit.rest
    flat.by_nodes = int(not edit.removes)  # until there are polynomials
    flat.tolerance, flat.slack = edit.tolerance, edit.slack
    flat.keeps_source, flat.removes, flat.crumbs = edit.keeps_source, edit.removes, edit.crumbs
    flat.all_outside = int(CELL_OUTSIDE) if edit.removes else 0
    flat.carried_below = -math.inf if edit.removes else 0.0
    return flat


def tell_sides(flat: Any, edit: Any) -> None:
    """Let a FlatEdit have the sides of narrow gaps of its posed LatticeEdit."""
    flat.has_sides = int(has_sides(edit.deformed))
    if flat.has_sides:
        flat.side_index, flat.sides = edit.deformed.side_index, edit.deformed.sides


def join_tables(flat: Any, edit: Any, skip: wp.array, launch: Callable[..., None]) -> None:
    """Launch what fills the arrays of a FlatEdit, of a posed LatticeEdit, by RepeatedLaunches.
    skip: (nx-1, ny-1, nz-1) uint8, how far each cell is from the nearest that may hold anything."""
    count = flat.nodes.size
    launch(join_cell_tables, count, [edit.cells, skip, flat.node_counts], [flat.look])
    positions = empty_array(0, wp.vec3, skip.device) if edit.removes else edit.deformed.positions.flatten()
    launch(join_nodes, count, [positions, edit.deformed.distance.flatten()], [flat.nodes])


def lattice_box(flat: Any) -> list[list[float]]:
    """Lower and upper corner, (3,) each, of a FlatEdit's lattice over its posed cage, relative to the edits' origin."""
    lower, counts, spacing = tuple(flat.lower), tuple(flat.node_counts), 1.0 / flat.inverse_spacing
    return [list(lower), [low + (count - 1) * spacing for low, count in zip(lower, counts, strict=True)]]
