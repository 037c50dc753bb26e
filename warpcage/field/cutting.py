"""Some voxels of a field by themselves: as a field of their own, or tinted in a view."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..view.camera import Camera
from .sparse import harmonics_on_host
from .voxel_field import VoxelField

#: The harmonic of degree 0, the same in all directions.
SH_MEAN = 0.28209479177387814

#: Optical depth of a voxel that counts as empty.
RIM_DEPTH = 0.01

#: The tint of what is chosen: its colour and how much of it.
TINT, TINT_SHARE = (0.1, 0.9, 0.2), 0.55


def cut_out(field: VoxelField, mask: np.ndarray) -> VoxelField:
    """A field of the voxels of a mask (nx, ny, nz) bool alone, before the field's colour.
    Its box ends a voxel beyond them, so that views show that large; density falls to zero over this voxel."""
    from scipy.ndimage import binary_dilation

    if not mask.any():
        raise ValueError("nothing is chosen that could be cut out")
    links = field.grid.links.numpy()
    grown = np.asarray(binary_dilation(mask, np.ones((3, 3, 3), bool)))
    ends = [np.flatnonzero(grown.any(axis=others))[[0, -1]] + (0, 1) for others in ((1, 2), (0, 2), (0, 1))]
    block = tuple(slice(*each) for each in ends)
    links, mask = links[block], mask[block]
    kept = grown[block] & (links >= 0)
    rows, inside = links[kept], mask[kept]
    bounds = field.bounds[0] + np.transpose(ends) * field.voxel_size
    density = field.grid.density.numpy()[rows]
    density = np.where(inside, density, np.minimum(density, 0.0)).astype(np.float32)
    new = np.full(links.shape, -1, np.int32)
    new[kept] = np.arange(len(rows), dtype=np.int32)
    weights = None if field.weights is None else np.where(inside, field.weights.numpy()[rows], np.float32(0.0))
    options = {**field.view_options(), "background_model": None}
    sh = harmonics_on_host(field.grid.sh)[rows]
    return VoxelField(bounds, new, density, sh, weights=weights, device=field.device, **options)


def tinted_view(
    field: VoxelField, mask: np.ndarray, camera: Camera, *, color: ArrayLike = TINT, strength: float = TINT_SHARE
) -> np.ndarray:
    """A view (h, w, 3) float32 in [0, 1], the voxels of a mask (nx, ny, nz) bool tinted as far as they are seen.
    strength: share of the tint where nothing else is seen, 0 to 1."""
    from scipy.ndimage import binary_dilation

    links = field.grid.links.numpy()
    rows = np.zeros(field.voxel_count, bool)
    # a surface lies between voxels that are chosen and empty ones, which are the chosen matter's rim
    rim = links[np.asarray(binary_dilation(mask, np.ones((3, 3, 3), bool))) & (links >= 0)]
    rows[rim] = field.grid.density.numpy()[rim] * field.voxel_size.max() < RIM_DEPTH
    rows[links[mask & (links >= 0)]] = True
    shown = np.zeros((field.voxel_count, 9, 3), np.float32)
    shown[:, 0] = np.where(rows, 0.5, -0.5)[:, None] / SH_MEAN
    # the same matter, white where it is chosen: what a pixel shows of it is the chosen share of its light
    white = VoxelField(
        field.bounds, links, field.grid.density, shown, background="black", up=field.up, device=field.device
    )
    supersampling = field.supersampling
    share = strength * white.render(camera, supersampling=supersampling).rgb[..., :1].clip(0.0, 1.0)
    picture = np.clip(field.render(camera).rgb, 0.0, 1.0)
    return (picture * (1.0 - share) + share * np.asarray(color, np.float32)).astype(np.float32)
