"""How well the views of a scene observe a grid, from which a fit's regularisers follow."""

from __future__ import annotations

import numpy as np

#: Pixels a voxel at which FitOptions' regularisers hold as they stand: 87 views of 800x800 on 512 voxels a side.
PLENTY = 160.0

#: How the variations' weights follow the scarcity; measured (benchmarks/NOTES-fit-scenes.md).
DENSITY_POWER, SH_POWER = 4.0 / 3.0, 2.0 / 3.0

#: Regularisers grow at most by this much: what no view tells, no smoothing finds.
MOST_SCARCE = 32.0


def pixel_size(cameras, centre) -> float:
    """Median over the views of the width of a pixel at `centre` (3,), world units."""
    return float(np.median([np.linalg.norm(camera.centre - centre) / camera.fx for camera in cameras]))


def scarcity(cameras, centre, voxel: float) -> float:
    """How few pixels see a voxel, against PLENTY: 1 where there are as many, 2 where there are half of them.

    A prior weighs against the evidence, and the photometric loss is a mean: where the views show each voxel by fewer
    pixels, the variation's weight must grow by as much, or the field matches these views and little else.
    voxel: side of a voxel of the last level, world units.
    """
    seen = len(cameras) * (voxel / pixel_size(cameras, centre)) ** 2
    return float(np.clip(PLENTY / max(seen, 1e-9), 1.0, MOST_SCARCE))
