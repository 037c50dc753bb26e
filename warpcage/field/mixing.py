"""Voxel fields that lie on one grid as one field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.memory import require_memory
from ..core.threads import device_turn
from .sparse import harmonics_on_host, stored_harmonics
from .voxel_field import VoxelField

#: Bytes of a place of the grid while it is filled, and of a voxel that is kept.
CELL_BYTES, VOXEL_BYTES = 8, 160

#: Share of a voxel without matter in the colour of one where several meet: it counts where there is no other.
MIN_SHARE = 1e-6


class _Part:
    """A field, and the part of the grid that it stands in."""

    def __init__(self, field: VoxelField, corner: np.ndarray, side: float):
        links = field.host_links()
        begin = np.rint((field.bounds[0] - corner) / side).astype(int)
        self._window = tuple(slice(first, first + count) for first, count in zip(begin, links.shape, strict=True))
        self.filled = links >= 0
        rows = links[self.filled]
        self.density, self.sh = (
            field.stored.density.numpy()[rows],
            harmonics_on_host(stored_harmonics(field.stored))[rows],
        )

    def window(self, values: np.ndarray) -> np.ndarray:
        """Its part of an array of the grid, a view."""
        return values[self._window]


def mixed_field(
    fields: Sequence[VoxelField],
    corner: ArrayLike,  # (3,) lower corner of the grid, world units
    side: float,  # of its voxels
    shape: Sequence[int],
    device: wp.Device,
    **options: Any,  # of VoxelField
) -> VoxelField:
    """Fields whose voxels are some of one grid as one field of it: densities add up, colours are their mean by density.
    Of harmonics of both kinds, those of luminance lose degree 3."""
    need = f"merging in {' x '.join(map(str, shape))} voxels needs {{size}}: give a lower resolution"
    require_memory(CELL_BYTES * int(np.prod(shape, dtype=np.int64)), device, need)
    lower = np.asarray(corner, np.float64)
    with device_turn(device):
        parts = [_Part(field, lower, side) for field in fields]
    links = np.full(tuple(shape), -1, np.int32)
    for part in parts:
        part.window(links)[part.filled] = 0
    filled = links >= 0
    count = int(filled.sum())
    require_memory(VOXEL_BYTES * count, device, f"{count} voxels need {{size}}: give a lower resolution")
    links[filled] = np.arange(count, dtype=np.int32)
    density, sh = _mixed(parts, links, count)
    return VoxelField([lower, lower + side * np.array(shape)], links, density, sh, device=device, **options)


def _mixed(parts: list[_Part], links: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Densities and harmonics of rows in which several fields may meet."""
    alike = len({part.sh.shape[1:] for part in parts}) == 1
    values = [part.sh if alike else _as_rgb(part.sh) for part in parts]
    # where none has matter, the highest: densities below zero shape the surfaces between nodes
    density, highest = np.zeros(count, np.float32), np.full(count, -np.inf, np.float32)
    sh, shares = np.zeros((count, *values[0].shape[1:]), np.float32), np.zeros(count, np.float32)
    for part, own in zip(parts, values, strict=True):
        rows = part.window(links)[part.filled]
        matter = np.maximum(part.density, 0.0)
        density[rows] += matter
        highest[rows] = np.maximum(highest[rows], part.density)
        share = np.maximum(matter, np.float32(MIN_SHARE))
        shares[rows] += share
        sh[rows] += own * share.reshape(-1, *[1] * (own.ndim - 1))
    return np.where(highest > 0.0, density, highest), sh / shares.reshape(-1, *[1] * (sh.ndim - 1))


def _as_rgb(sh: np.ndarray) -> np.ndarray:
    """Harmonics (n, 24) of luminance and differences of colour as (n, 9, 3) of red, green and blue; others as given."""
    if sh.ndim == 3:
        return sh
    luminance = sh[:, :9]
    orange, green = (np.pad(sh[:, begin : begin + 4], ((0, 0), (0, 5))) for begin in (16, 20))
    return np.stack([luminance + orange - green / 2, luminance + green, luminance - orange - green / 2], axis=-1)
