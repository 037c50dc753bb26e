"""Edits that cannot meet each other, rendered one after the other by the march for one edit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..kernels.deform.ray_parts import ScenePart
from ..kernels.deform.render_cpu import render_edit_tiles
from ..kernels.deform.render_part import render_edit_part
from ..kernels.deform.render_part_sides import render_edit_part_with_sides
from ..view.camera import TILE_SIZE
from .edits import MarchedView, PosedEdits


def render_parts(edits: PosedEdits, view: MarchedView, parts: Sequence[tuple[Any, np.ndarray]], by_tiles: bool) -> None:
    """March a view through edits that are apart, a launch for each; rays keep their state in between.

    Args:
        edits: The edits.
        view: The view.
        parts: The FlatEdit of each edit and the box (2, 3) of what it has to do with, half a step more, relative to the
            edits' origin; front to back. What is behind the last box goes with it.
        by_tiles: Whether the rays of a tile go side by side, on a CPU alone.
    """
    rays = view.pinhole.width * view.pinhole.height
    # the view's own: it is freed once the last launch is through
    states = empty_array(3 * rays if len(parts) > 1 else 0, wp.vec4, view.field.device)
    tables = [view.field.marching.cells(view.grid)] if by_tiles else []
    for number, (flat, box) in enumerate(parts):
        part = ScenePart()
        part.lower, part.upper = (wp.vec3(*corner) for corner in box.tolist())
        part.is_first, part.is_last = int(number == 0), int(number == len(parts) - 1)
        part.rays, part.states = rays, states
        kernel = render_edit_part_with_sides if flat.has_sides else render_edit_part
        if by_tiles:
            kernel = render_edit_tiles  # which takes both
        edits.march(view, kernel, [*tables, flat, part], TILE_SIZE if by_tiles else 1)
