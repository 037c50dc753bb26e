"""Edits that cannot meet each other, rendered one after the other by the march for one edit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view
from ..kernels.deform.ray_parts import ScenePart
from ..kernels.deform.render_cpu import render_edit_tiles
from ..lattice.capture import Buffer
from ..view.camera import TILE_SIZE
from .edits import MarchedView, PosedEdits

#: One of the three arrays that hold the state of rays takes so much for a ray.
STATE_BYTES = wp.types.type_size_in_bytes(wp.vec4)


def render_parts(
    edits: PosedEdits,
    view: MarchedView,
    parts: Sequence[tuple[Any, np.ndarray]],
    kernels: Sequence[Any],
    rays: Buffer,
    orders: Sequence[Any],
) -> None:
    """March a view through edits that are apart, a launch for each; rays keep their state in between.

    Args:
        edits: The edits.
        view: The view.
        parts: The FlatEdit of each edit and the box (2, 3) of what it has to do with, half a step more, relative to the
            edits' origin; front to back. What is behind the last box goes with it.
        kernels: That for an edit whose map has no narrow gaps, and that for one whose map has.
        rays: Of vec4, for the states of rays.
        orders: The TileOrder of each launch.
    """
    states = ray_states(view.pinhole.width * view.pinhole.height, rays) if len(parts) > 1 else {}
    by_tiles = render_edit_tiles in kernels
    tables = [view.field.marching.cells(view.grid)] if by_tiles else []
    for number, ((flat, box), order) in enumerate(zip(parts, orders, strict=True)):
        part = ScenePart()
        part.lower, part.upper = (wp.vec3(*corner) for corner in box.tolist())
        part.is_first, part.is_last = int(number == 0), int(number == len(parts) - 1)
        for name, array in states.items():
            setattr(part, name, array)
        kernel = kernels[int(flat.has_sides)]
        edits.march(view, kernel, [*tables, flat, part], TILE_SIZE if by_tiles else 1, order)


def ray_states(rays: int, buffer: Buffer) -> dict[str, wp.array]:
    """The arrays in which the rays of a picture keep their state from part to part.

    Args:
        rays: Their number, as many as an array holds or fewer.
        buffer: Of vec4, in which they lie: kept, as CUDA takes longer to hand out as much memory than to fill it.

    Returns:
        (rays,) vec4 each by their names in ScenePart, not set yet.
    """
    block = buffer.take((3, rays))
    return {
        name: array_view(block, wp.vec4, rays, offset=row * rays * STATE_BYTES)
        for row, name in enumerate(("progress", "colours", "masks"))
    }
