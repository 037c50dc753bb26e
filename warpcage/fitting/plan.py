"""What a fit plans before it starts: grid, levels, batches and rates."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ..scene.scene import Scene
from ..view.camera import Camera
from .options import MAX_LEVELS, FitOptions

#: Factors on the total variations of density and of SH, at least, for pictures that were taken: they are fewer and
#: less exact than rendered ones.
CAPTURED_VARIATION, CAPTURED_SH_VARIATION = 30.0, 15.0

#: Least rays of a batch that is made smaller for the sake of more steps.
SMALLEST_BATCH = 4096

#: Least and most rays of a batch that follows the number of pixels, and pixels per ray of it.
BATCH_RAYS, BATCH_SHARE = (4096, 131072), 128

#: A step of the optimiser takes as long for a small batch as for a large one. Batches of more than LARGE_BATCH rays are
#: worth it where there are this many steps nonetheless.
LARGE_BATCH, ENOUGH_STEPS = 65536, 1200

#: Least voxels along the longest side that the pixels ask for.
SMALLEST_RESOLUTION = 32

#: Without silhouettes, fine voxels turn to fog before the cameras unless a coarse fit has told them where matter is.
COARSE_SIDE = 24

#: Rays per voxel from which on the regularisers of FitOptions hold as they are: 87 views of 800x800 at 512 voxels along
#: the longest side, or at 720 with four rays per pixel.
PLENTY = 160.0

#: How the weights of the total variations follow the scarcity; measured (benchmarks/NOTES-fit-scenes.md).
DENSITY_POWER, SH_POWER = 1.8, 1.0

#: Regularisers grow by this factor at most: no smoothing finds what no view tells.
MOST_SCARCE = 32.0

#: Directional coefficients step more slowly than the constant ones, so that they come about as far in a long fit as in
#: one of this many steps; at least by this factor.
DIRECTIONAL_STEPS, LEAST_DIRECTIONAL = 250.0, 0.15

#: Late in a fit, when the surface has settled, they may go faster: they no longer stand for wrong geometry.
LATE_DIRECTIONAL = 0.7


@dataclasses.dataclass(frozen=True)
class GridPlan:
    """The grid of a fit: cubic voxels that halve from level to level."""

    levels: int
    # (2, 3) float64, world units: the object's box, grown to whole voxels
    bounds: np.ndarray
    # (nx, ny, nz) voxels of each level
    shapes: list[tuple[int, ...]]
    # how few rays see a voxel, see `scarcity`
    scarcity: float
    # weights of the total variation of density, of SH coefficients of degree 0 and 1, and of degree 2 and 3
    variation: tuple[float, float, float]


def plan_grid(scene: Scene, options: FitOptions, box: np.ndarray, layered: bool) -> GridPlan:
    """The grid over the box (2, 3) of an object; layered: whether layers or an outer field are fitted too."""
    extent = box[1] - box[0]
    longest = float(extent.max())
    resolution = options.resolution
    if resolution is None:
        voxels = math.ceil(longest / (options.footprint * pixel_size(scene.cameras, box.mean(axis=0))))
        resolution = int(np.clip(voxels, SMALLEST_RESOLUTION, options.max_resolution))
    levels = options.levels
    # without silhouettes, as many more levels as it takes for the first to be coarse
    if layered and scene.alphas is None:
        needed = 1 + math.ceil(math.log2(max(1.0, resolution / COARSE_SIDE)))
        levels = max(levels, min(needed, MAX_LEVELS))
    unit = 2 ** (levels - 1)
    voxel = longest / resolution
    shape = np.maximum(1, np.ceil(extent / voxel / unit - 1e-6).astype(int)) * unit
    scarce = options.scarcity
    if scarce is None:
        scarce = scarcity(scene.cameras, box.mean(axis=0), voxel, options.supersampling)
    half = 0.5 * shape * voxel
    return GridPlan(
        levels=levels,
        bounds=np.stack([box.mean(axis=0) - half, box.mean(axis=0) + half]),
        shapes=[tuple(int(n) for n in shape // 2 ** (levels - 1 - i)) for i in range(levels)],
        scarcity=scarce,
        variation=_variation(options, scarce, layered or scene.captured),
    )


def _variation(options: FitOptions, scarce: float, captured: bool) -> tuple[float, float, float]:
    """Weights of the total variation of density, of SH coefficients of degree 0 and 1, and of degree 2 and 3."""
    if options.variation is not None:
        factors = options.variation, options.variation
    else:
        least = (CAPTURED_VARIATION, CAPTURED_SH_VARIATION) if captured else (0.0, 0.0)
        factors = max(least[0], scarce**DENSITY_POWER), max(least[1], scarce**SH_POWER)
    sh = options.variation_sh * factors[1]
    return options.variation_density * factors[0], sh, sh * options.variation_high_degree


def plan_batches(options: FitOptions, pixels: int, active_tiles: int) -> tuple[int, list[int]]:
    """Tiles per batch, and the steps of each level; pixels: of all pictures, active_tiles: those that see the grid."""
    batch, active_pixels = options.batch_rays, active_tiles * options.tile_size**2
    if batch is None:
        batch = np.clip(pixels // BATCH_SHARE, *BATCH_RAYS)
        if batch > LARGE_BATCH:
            batch = min(batch, max(LARGE_BATCH, options.epochs * active_pixels / ENOUGH_STEPS))
        if options.least_steps:
            batch = min(batch, max(SMALLEST_BATCH, options.epochs * active_pixels / options.least_steps))
    batch_tiles = min(max(1, int(batch) // options.tile_size**2), active_tiles)
    shares = options.level_growth ** np.arange(options.levels)
    shares = shares / shares.sum()
    steps = max(options.epochs * active_tiles / batch_tiles, options.least_steps)
    return batch_tiles, [max(1, round(float(share) * steps)) for share in shares]


def pixel_size(cameras: list[Camera], centre: np.ndarray) -> float:
    """Median over the views of the width of a pixel at `centre` (3,), world units."""
    return float(np.median([np.linalg.norm(camera.centre - centre) / camera.fx for camera in cameras]))


def scarcity(cameras: list[Camera], centre: np.ndarray, voxel: float, supersampling: int = 1) -> float:
    """How few rays see a voxel, relative to PLENTY: 1 where there are as many or more, 2 where there are half as many.
    centre: (3,) of the object, voxel: side of one of the last level, world units."""
    # A prior has to be weighed against the evidence, and the photometric loss is a mean. Where fewer pixels show each
    # voxel, the weight of the total variation must grow as much, or the field matches these views and little else.
    seen = len(cameras) * (supersampling * voxel / pixel_size(cameras, centre)) ** 2
    return float(np.clip(PLENTY / max(seen, 1e-9), 1.0, MOST_SCARCE))


def directional_rate(steps: int) -> float:
    """Learning rate of the coefficients that depend on direction over that of the constant ones, at most 1."""
    # In a long fit fast ones learn what is particular to each view; in a short one slow ones do not get anywhere.
    return float(np.clip(DIRECTIONAL_STEPS / max(steps, 1), LEAST_DIRECTIONAL, 1.0))
