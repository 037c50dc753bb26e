"""What a fit plans before it starts: grid, levels, batches and rates."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ..scene.scene import Scene
from .options import MAX_LEVELS, FitOptions

#: Pictures that were taken are fewer and less exact than rendered ones: so much more total variation suits them.
CAPTURED_VARIATION = 30.0

#: Rays of a batch that is made smaller for the sake of more steps, at least.
SMALLEST_BATCH = 4096

#: Without silhouettes, fine voxels turn to fog before the cameras unless a coarse fit has told them where matter is.
COARSE_SIDE = 24


@dataclasses.dataclass(frozen=True)
class GridPlan:
    """The grid of a fit: cubic voxels that halve from level to level.

    levels: how many. bounds: (2, 3) float64, world units, grown around the object's box to whole voxels. shapes: of
    each level, (nx, ny, nz) voxels. scarcity: see fit_defaults. variation: weights of the total variation of density
    and of SH.
    """

    levels: int
    bounds: np.ndarray
    shapes: list[tuple[int, int, int]]
    scarcity: float
    variation: tuple[float, float]


def plan_grid(scene: Scene, options: FitOptions, box: np.ndarray, layered: bool) -> GridPlan:
    """The grid over an object's box (2, 3), world units. layered: background layers are fitted too; without
    silhouettes there are then as many more levels as the first needs to have COARSE_SIDE voxels a side at most."""
    extent = box[1] - box[0]
    longest = float(extent.max())
    resolution = options.resolution
    if resolution is None:
        pixel = pixel_size(scene.cameras, box.mean(axis=0))
        resolution = int(np.clip(math.ceil(longest / (options.footprint * pixel)), 32, options.max_resolution))
    levels = options.levels
    if layered and scene.alphas is None:
        needed = 1 + math.ceil(math.log2(max(1.0, resolution / COARSE_SIDE)))
        levels = max(levels, min(needed, MAX_LEVELS))
    unit = 2 ** (levels - 1)
    voxel = longest / resolution
    shape = np.maximum(1, np.ceil(extent / voxel / unit - 1e-6).astype(int)) * unit
    scarce = options.scarcity
    if scarce is None:
        scarce = scarcity(scene.cameras, box.mean(axis=0), voxel, options.supersampling)
    factors = scarce**DENSITY_POWER, scarce**SH_POWER
    if options.variation is not None:
        factors = options.variation, options.variation
    elif layered or scene.captured:
        factors = tuple(max(CAPTURED_VARIATION, factor) for factor in factors)
    half = 0.5 * shape * voxel
    return GridPlan(
        levels=levels,
        bounds=np.stack([box.mean(axis=0) - half, box.mean(axis=0) + half]),
        shapes=[tuple(int(n) for n in shape // 2 ** (levels - 1 - i)) for i in range(levels)],
        scarcity=scarce,
        variation=(options.variation_density * factors[0], options.variation_sh * factors[1]),
    )


def plan_batches(options: FitOptions, pixels: int, active_tiles: int) -> tuple[int, list[int]]:
    """Tiles of a batch, and the steps of each level. pixels: of all pictures; active_tiles: those that see the grid."""
    batch = options.batch_rays
    if batch is None:
        batch = np.clip(pixels // 128, 4096, 65536)
        if options.least_steps:
            active_pixels = active_tiles * options.tile_size**2
            batch = min(batch, max(SMALLEST_BATCH, options.epochs * active_pixels / options.least_steps))
    batch_tiles = min(max(1, int(batch) // options.tile_size**2), active_tiles)
    shares = options.level_growth ** np.arange(options.levels)
    shares = shares / shares.sum()
    steps = max(options.epochs * active_tiles / batch_tiles, options.least_steps)
    return batch_tiles, [max(1, round(float(share) * steps)) for share in shares]


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
