"""What a field file holds: plain NumPy arrays, whatever the format."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass
class FieldContents:
    """The parts of a voxel field on the host, as field files read and write them.

    bounds: (2, 3) float64 world units. links: (nx, ny, nz) int32, row of each voxel or -1. density: (rows,) float32 per
    world unit. sh: (rows, 9, 3) float32. weights: (rows,) float32 or None. background, up: (3,) or None for the
    default. supersampling: rays along each side of a pixel, or None. layers: arguments of a LayeredBackground, or None.
    """

    bounds: np.ndarray
    links: np.ndarray
    density: np.ndarray
    sh: np.ndarray
    weights: np.ndarray | None = None
    background: np.ndarray | None = None
    up: np.ndarray | None = None
    supersampling: int | None = None
    layers: dict | None = None

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 middle of the bounds."""
        return self.bounds.mean(axis=0)

    @property
    def voxel_side(self) -> float:
        """Smallest side of a voxel, world units."""
        return float(((self.bounds[1] - self.bounds[0]) / self.links.shape).min())

    def options(self) -> dict:
        """What the file says beside the voxels, by the names of VoxelField's arguments."""
        names = ("weights", "background", "up", "supersampling")
        return {name: value for name in names if (value := getattr(self, name)) is not None}
