"""How well the views of a scene observe a grid, from which a fit's regularisers follow."""

from __future__ import annotations

import numpy as np

#: Rays a voxel from which on FitOptions' regularisers hold as they stand: 87 views of 800x800, 512 voxels a side, or
#: 720 of them and four rays a pixel.
PLENTY = 160.0

#: How the variations' weights follow the scarcity; measured (benchmarks/NOTES-fit-scenes.md).
DENSITY_POWER, SH_POWER = 1.8, 1.0

#: Directional coefficients step so much slower than the constant ones that they come about as far in a long fit as in
#: one of this many steps; at least by this factor.
DIRECTIONAL_STEPS, LEAST_DIRECTIONAL = 250.0, 0.15

#: Regularisers grow at most by this much: what no view tells, no smoothing finds.
MOST_SCARCE = 32.0


def pixel_size(cameras, centre) -> float:
    """Median over the views of the width of a pixel at `centre` (3,), world units."""
    return float(np.median([np.linalg.norm(camera.centre - centre) / camera.fx for camera in cameras]))


def scarcity(cameras, centre, voxel: float, supersampling: int = 1) -> float:
    """How few rays see a voxel, against PLENTY: 1 where there are as many, 2 where there are half of them.

    A prior weighs against the evidence, and the photometric loss is a mean: where the views show each voxel by fewer
    pixels, the variation's weight must grow by as much, or the field matches these views and little else.
    voxel: side of a voxel of the last level, world units. supersampling: rays a side of a pixel.
    """
    seen = len(cameras) * (supersampling * voxel / pixel_size(cameras, centre)) ** 2
    return float(np.clip(PLENTY / max(seen, 1e-9), 1.0, MOST_SCARCE))


def directional_rate(steps: int) -> float:
    """Rate of the coefficients that tell directions apart over that of the constant ones, in a fit of `steps`.

    In a long fit fast ones learn what each view has of its own; in a short one slow ones do not get anywhere.
    """
    return float(np.clip(DIRECTIONAL_STEPS / max(steps, 1), LEAST_DIRECTIONAL, 1.0))
