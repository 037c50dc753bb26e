"""Edits that cannot meet each other, rendered one after the other by the march for one edit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view
from ..kernels.render.march_cpu import render_edit_tiles
from ..kernels.render.rays import ScenePart
from ..kernels.view.rays import TILE_SIZE
from ..lattice.buffers import BufferPool
from .tables import needs_general_map
from .view import PosedEdits, ViewRequest

#: One of the three arrays that hold the state of rays takes so much for a ray.
STATE_BYTES = wp.types.type_size_in_bytes(wp.vec4)


class PartsInTurn:
    """Marches views through edits that are apart, a launch for each; rays keep their state in between."""

    def __init__(self, device: wp.Device):
        self.rays = BufferPool(device).buffer(wp.vec4)  # kept: CUDA hands out memory slower than it fills it
        self._block: wp.array | None = None
        self._parts: list[tuple[list[list[float]], Any]] = []

    def render(
        self,
        edits: PosedEdits,
        view: ViewRequest,
        parts: Sequence[tuple[Any, np.ndarray]],
        kernels: Sequence[Any],
        orders: Sequence[Any],
        begins: Sequence[wp.array | None],
    ) -> None:
        """March a view through parts: each edit's EditData and box (2, 3), from the edits' origin, front to back.
        kernels: for edits whose map is by polynomials alone, and for any; begins: None where the kernels do not ask."""
        # A box is of what its edit has to do with, half a step more. What is behind the last one goes with it.
        structs = self._scene_parts([box.tolist() for _, box in parts], view.pinhole.width * view.pinhole.height)
        by_tiles = render_edit_tiles in kernels
        tables = [view.field.marching.cells(view.grid)] if by_tiles else []
        for number, ((flat, _), struct, order) in enumerate(zip(parts, structs, orders, strict=True)):
            scene = [*tables, flat, struct]
            rays = TILE_SIZE if by_tiles else 1
            edits.march(view, kernels[needs_general_map(flat)], scene, rays, order, begins[number], number)

    def _scene_parts(self, boxes: list[list[list[float]]], rays: int) -> list[Any]:
        """The ScenePart of each box, with arrays for as many rays; those of the view before where it has the same."""
        block = self.rays.take((3, rays)) if len(boxes) > 1 else None
        if block is not self._block or len(boxes) != len(self._parts):
            self._block, self._parts = block, [([], None) for _ in boxes]
        for number, box in enumerate(boxes):
            if self._parts[number][0] != box:
                self._parts[number] = box, scene_part(box, number == 0, number == len(boxes) - 1, block)
        return [part for _, part in self._parts]


def scene_part(box: list[list[float]], is_first: bool, is_last: bool, states: wp.array | None) -> Any:
    """The ScenePart of a box: its lower and upper corner, (3,) each, relative to the edits' origin.
    states: (3, rays) vec4 in which rays keep their state, not set yet; None for the first and only part."""
    part = ScenePart()
    part.lower, part.upper = (wp.vec3(*corner) for corner in box)
    part.is_first, part.is_last = int(is_first), int(is_last)
    if states is not None:
        rays = states.shape[1]
        for row, name in enumerate(("progress", "colors", "masks")):
            setattr(part, name, array_view(states, wp.vec4, rays, offset=row * rays * STATE_BYTES))
    return part
