"""The colours of a field's surface, as a viewer sees them who looks straight at it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .voxel_field import VoxelField

#: Where the samples of a surface point lie along its inward normal, in voxels, and how far apart they are.
FIRST, LAST, SPACING = -1.5, 3.0, 0.5


def surface_colors(field: VoxelField, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Colours (n, 3) float32 in [0, 1], sRGB, at surface points (n, 3) with outward unit normals (n, 3).
    The field's background where no sample has matter."""
    # Colours that depend on the direction are those seen along the normal: highlights of other directions are left out.
    voxel = float(np.prod(field.voxel_size) ** (1.0 / 3.0))
    colors, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    through = np.ones(len(points))
    for place in np.arange(FIRST, LAST, SPACING):
        rgb, density = field.sample(points - place * voxel * normals, -normals)
        opacity = through * -np.expm1(-np.asarray(density, np.float64) * SPACING * voxel)
        colors += opacity[:, None] * np.asarray(rgb)
        weights += opacity
        through -= opacity
    shown = np.where(weights[:, None] > 0.0, colors / np.maximum(weights, 1e-12)[:, None], field.background)
    return np.clip(shown, 0.0, 1.0).astype(np.float32)
