"""A field of one colour and density at the nodes of a mask: where a fit starts."""

from __future__ import annotations

import warp as wp
from numpy.typing import ArrayLike

from .io.field_file import LUMINANCE_NUMBERS
from .sparse import link_mask
from .voxel_field import VoxelField


def field_from_mask(
    bounds: ArrayLike, mask: wp.array, density: float, *, background: str | ArrayLike, device: wp.DeviceLike
) -> tuple[VoxelField, wp.array]:
    """A grey field of one density at the set nodes of a mask (nx, ny, nz) uint8, and its nodes (rows,) vec3i."""
    links, nodes = link_mask(mask)
    rows = nodes.shape[0]
    field = VoxelField(
        bounds,
        links,
        wp.full(rows, density, dtype=wp.float32, device=device),
        wp.zeros((rows, LUMINANCE_NUMBERS), dtype=wp.float32, device=device),
        background=background,
        device=device,
    )
    return field, nodes
