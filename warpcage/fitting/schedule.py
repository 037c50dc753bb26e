"""What a fit plans before it starts (grid, levels, batches, rates), how many steps each level takes, and how long."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from ..field.io.field_file import MAX_OUTER_SIDE
from ..scene.scene import Scene
from ..view.camera import Camera
from .options import MAX_LEVELS, FitOptions

#: Factors on the total variations of density and of SH, at least, for pictures that were taken: they are fewer and
#: less exact than rendered ones.
CAPTURED_VARIATION, CAPTURED_SH_VARIATION = 30.0, 15.0

#: Least rays of a batch that is made smaller for the sake of more steps.
SMALLEST_BATCH = 4096

#: Rays of a level over those of the level before: of an object, as Lego loses 0.36 dB by 1.25; and with an outer field,
#: where captures take two thirds of the time and come out no worse.
LEVEL_GROWTH, OUTER_LEVEL_GROWTH = 2.6, 1.25

#: Least and most rays of a batch that follows the number of pixels, and pixels per ray of it.
BATCH_RAYS, BATCH_SHARE = (4096, 131072), 128

#: A step of the optimiser takes as long for a small batch as for a large one. Batches of more than LARGE_BATCH rays are
#: worth it where there are this many steps nonetheless.
LARGE_BATCH, ENOUGH_STEPS = 65536, 1200

#: Least voxels along the longest side that the pixels ask for.
SMALLEST_RESOLUTION = 32

#: Share of `keep_weight` that a voxel of a new level needs: memory is largest until `keep_at`.
MIN_SHARE = 0.6

#: Without silhouettes, fine voxels turn to fog before the cameras unless a coarse fit has found where matter is.
COARSE_SIDE = 24

#: Rays per voxel from which on the regularisers of FitOptions hold as they are: 87 views of 800x800 at 512 voxels along
#: the longest side, or at 720 with four rays per pixel.
RAYS_PER_VOXEL = 160.0

#: Rays of all pictures through a voxel around the box, as far behind the middle as cameras are before it, from which on
#: contracted space has more voxels along a side than the box; and by how much at most.
OUTER_RAYS, MAX_FINER = 1200.0, 1.5

#: Factor on the first rates of an outer field that is finer than the box, at most.
MAX_HASTE = 2.0

#: How the weights of the total variations follow the scarcity; measured (benchmarks/NOTES-fit-scenes.md).
DENSITY_POWER, SH_POWER = 1.8, 1.0

#: Regularisers grow by this factor at most: no smoothing finds what no view shows.
MAX_SCARCE = 32.0

#: Directional coefficients step more slowly than the constant ones, so that they come about as far in a long fit as in
#: one of this many steps; at least by this factor.
DIRECTIONAL_STEPS, MIN_DIRECTIONAL = 250.0, 0.15

#: Late in a fit, when the surface has settled, they may go faster: they no longer stand for wrong geometry.
LATE_DIRECTIONAL = 0.7


@dataclasses.dataclass(frozen=True)
class GridPlan:
    """The grid of a fit: cubic voxels that halve from level to level."""

    levels: int
    bounds: np.ndarray  # (2, 3) float64, world units: the object's box, grown to whole voxels
    shapes: list[tuple[int, ...]]  # (nx, ny, nz) voxels of each level
    scarcity: float  # how few rays see a voxel, see `scarcity`
    variation: tuple[float, float, float]  # of total variation: density, SH coefficients of degree 0 and 1, of 2 and 3
    counted_variation: tuple[float, float, float]  # the same where it follows the views of each voxel


def plan_grid(scene: Scene, options: FitOptions, box: np.ndarray, layered: bool) -> GridPlan:
    """The grid over the box (2, 3) of an object; layered: whether layers or an outer field are fitted too."""
    extent = box[1] - box[0]
    longest = float(extent.max())
    resolution = options.resolution
    if resolution is None:
        voxels = math.ceil(longest / (options.footprint * pixel_size(scene.cameras, box.mean(axis=0))))
        resolution = int(np.clip(voxels, SMALLEST_RESOLUTION, options.max_resolution))
    levels = options.levels
    if layered and scene.alphas is None:  # as many more as it takes for the first to be coarse
        needed = 1 + math.ceil(math.log2(max(1.0, resolution / COARSE_SIDE)))
        levels = max(levels, min(needed, MAX_LEVELS))
    levels = min(levels, int(resolution - 1).bit_length())  # the first has 2 voxels or more along the longest side
    unit = 2 ** (levels - 1)
    voxel = longest / resolution
    shape = np.maximum(2, np.ceil(extent / voxel / unit - 1e-6).astype(int)) * unit
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
        counted_variation=_variation(options, scarce, False),
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


def least_weight(options: FitOptions, side: int) -> float:
    """Rendering weight from which on a voxel of a new level with so many along its longest side is optimised."""
    return max(options.prune_weight / side, MIN_SHARE * options.keep_weight)


def view_factors(views: float) -> np.ndarray:
    """(256, 2) factors on the total variations of density and of colors by the number of views that show a voxel.
    views: the number from which on they are 1."""
    fewer = np.clip(views / np.maximum(np.arange(256), 1), 1.0, MAX_SCARCE)
    return np.stack([fewer**DENSITY_POWER, fewer**SH_POWER], axis=1)


def plan_batches(options: FitOptions, pixels: int, active_tiles: int, has_outer: bool = False) -> tuple[int, list[int]]:
    """Tiles per batch, and the steps of each level; pixels: of all pictures, active_tiles: those that see the grid."""
    growth = options.level_growth
    if growth is None:
        growth = OUTER_LEVEL_GROWTH if has_outer else LEVEL_GROWTH
    batch, active_pixels = options.batch_rays, active_tiles * options.tile_size**2
    epochs = min(options.epochs, options.most_rays / max(active_pixels, 1))
    if batch is None:
        batch = np.clip(pixels // BATCH_SHARE, *BATCH_RAYS)
        if batch > LARGE_BATCH:
            batch = min(batch, max(LARGE_BATCH, epochs * active_pixels / ENOUGH_STEPS))
        if options.least_steps:
            batch = min(batch, max(SMALLEST_BATCH, epochs * active_pixels / options.least_steps))
    batch_tiles = min(max(1, int(batch) // options.tile_size**2), active_tiles)
    shares = growth ** np.arange(options.levels)
    shares = shares / shares.sum()
    steps = max(epochs * active_tiles / batch_tiles, options.least_steps)
    return batch_tiles, [max(1, round(float(share) * steps)) for share in shares]


def pixel_size(cameras: list[Camera], center: np.ndarray) -> float:
    """Median over the views of the width of a pixel at `centre` (3,), world units."""
    return float(np.median([np.linalg.norm(camera.center - center) / camera.fx for camera in cameras]))


def scarcity(cameras: list[Camera], center: np.ndarray, voxel: float, supersampling: int = 1) -> float:
    """How few rays see a voxel, relative to RAYS_PER_VOXEL: 1 where as many or more do, 2 where half as many.
    center: (3,) of the object, voxel: side of one of the last level, world units."""
    # The loss is a mean: where fewer pixels show a voxel the prior must weigh more, or it fits these views alone.
    seen = len(cameras) * (supersampling * voxel / pixel_size(cameras, center)) ** 2
    return float(np.clip(RAYS_PER_VOXEL / max(seen, 1e-9), 1.0, MAX_SCARCE))


def outer_side(scene: Scene, options: FitOptions, grid: GridPlan) -> int:
    """Voxels along each side of contracted space: as fine as the box at its faces, finer where rays suffice."""
    if options.outer_resolution is not None:
        return options.outer_resolution
    side = min(max(grid.shapes[-1]), options.max_outer_resolution)
    # at a distance d behind the middle a voxel is 4 d / side wide, a pixel of a camera as far before it 2 d / fx
    width = 2.0 * float(np.median([camera.fx for camera in scene.cameras])) / side
    finer = np.clip(math.sqrt(len(scene.cameras) * width**2 / OUTER_RAYS), 1.0, MAX_FINER)
    return min(round(finer * side), MAX_OUTER_SIDE)


def directional_rate(steps: int) -> float:
    """Learning rate of the coefficients that depend on direction over that of the constant ones, at most 1."""
    # In a long fit fast ones learn what is particular to each view; in a short one slow ones do not get anywhere.
    return float(np.clip(DIRECTIONAL_STEPS / max(steps, 1), MIN_DIRECTIONAL, 1.0))


#: Late in a fit every so many steps random colours supervise opacity still: without, parts of the background's colour
#: may turn to glass.
OPACITY_EVERY = 4

#: Steps from one pass over the SH coefficients that shrinks them to the next.
SHRINK_EVERY = 16

#: Steps of the cameras over a fit, about; and least and most steps of the field from one to the next.
CAMERA_STEPS, CAMERA_EVERY = 200, (4, 16)

#: Cameras first move when the first level is done, and not before this share of all steps: until then the field shows
#: too little. They move last after another share.
CAMERA_START, CAMERA_END = 0.08, 0.95

#: Cameras are not looked at after fewer steps of the field than this.
MIN_LOOKED = 16

#: Share of a whole step that poses and focal lengths, and exposures, take at first. It falls with this power of the
#: progress to none.
CAMERA_SHARE, EXPOSURE_SHARE, CAMERA_POWER = 0.7, 0.3, 4.0

#: Focal lengths and exposures follow after these shares of the steps that are left then: fields that are not yet whole
#: look like either.
LENS_START, EXPOSURE_START = 0.05, 0.15

#: Small moves are doubted between these shares of those steps, from not at all to wholly.
DOUBT_START, DOUBT_END = 0.15, 0.3


@dataclasses.dataclass(frozen=True)
class CameraRates:
    """Shares of a whole step that cameras take."""

    poses: float  # turns and shifts
    lenses: float  # focal lengths
    exposures: float
    doubt: float = 0.0  # share to which small moves are doubted

    def __bool__(self) -> bool:
        """Whether anything moves."""
        return self.poses > 0


@dataclasses.dataclass(frozen=True)
class Rates:
    """How far one step goes: learning rates."""

    density: float  # in optical depth per voxel of the level, as outer_density
    sh: tuple[float, float, float, float]  # of degree 0 to 3
    directional_kept: float  # factor on the coefficients that depend on direction after the step; 1 leaves them
    background: float  # of the layers behind the field
    outer: float  # of the colours of an outer field
    outer_density: float


class Schedule:
    """The steps of a fit and its place among them; level_steps: of each level."""

    def __init__(self, options: FitOptions, level_steps: list[int], scarcity: float, finer: float = 1.0):
        self.options, self.scarcity, self.level_steps = options, scarcity, level_steps
        # a step has fewer rays for each voxel of an outer field that is finer than the box, by so many times
        self.outer_haste = float(np.clip(finer**2, 1.0, MAX_HASTE))
        total = self.total_steps
        first = directional_rate(total) if options.directional is None else options.directional
        last = max(first, LATE_DIRECTIONAL) if options.directional_end is None else options.directional_end
        self.directional = first, last
        self.step_count = self.level = 0  # steps done, and index of the level that the fit has reached

    @property
    def total_steps(self) -> int:
        """Steps of all levels."""
        return sum(self.level_steps)

    @property
    def is_done(self) -> bool:
        """Whether all steps are done."""
        return self.step_count >= self.total_steps

    @property
    def level_done(self) -> bool:
        """Whether the steps of the level are done."""
        return self.step_count >= sum(self.level_steps[: self.level + 1])

    @property
    def is_last_level(self) -> bool:
        """Whether no level follows."""
        return self.level + 1 == self.options.levels

    @property
    def refines(self) -> bool:
        """Whether the next level begins before the next step."""
        return self.level_done and not self.is_last_level

    @property
    def thins_out(self) -> bool:
        """Whether voxels that no view shows are removed before the next step, late in the last level."""
        left = round((1.0 - self.options.keep_at) * self.level_steps[-1])
        return self.step_count == self.total_steps - left

    @property
    def rays_per_side(self) -> int:
        """Rays along each side of a pixel. Coarse voxels are wider than a part of a pixel: there it is one."""
        return self.options.supersampling if self.is_last_level else 1

    @property
    def supervises_opacity(self) -> bool:
        """Whether random colours are behind the rays of the next step, where the pictures have alpha."""
        early = self.step_count < self.options.opacity_share * self.total_steps
        return early or self.step_count % OPACITY_EVERY == 0

    @property
    def camera_every(self) -> int:
        """Steps of the field from one of the cameras to the next."""
        least, most = CAMERA_EVERY
        return min(max(self.total_steps // CAMERA_STEPS, least), most)

    @property
    def camera_start(self) -> int:
        """Steps before cameras may move: of the first level, or of all but the last where they are looked at first."""
        levels = self.level_steps[:-1] if self.options.refine_cameras == "auto" else self.level_steps[:-1][:1]
        return max(sum(levels), math.ceil(CAMERA_START * self.total_steps))

    @property
    def checks_cameras(self) -> bool:
        """Whether to look after the next step if cameras are off; a field of a few steps would blame them for all."""
        looks = self.options.refine_cameras == "auto" and self.camera_start >= MIN_LOOKED
        return looks and self.step_count + 1 == self.camera_start

    def camera_rates(self) -> CameraRates:
        """How far the cameras go after the next step: nowhere, where none of their steps is due."""
        total, first = self.total_steps, self.camera_start
        progress, since = self.step_count / total, (self.step_count - first) / max(1, total - first)
        if since < 0 or progress > CAMERA_END or self.step_count % self.camera_every:
            return CameraRates(0.0, 0.0, 0.0)
        left = 1.0 - (progress / CAMERA_END) ** CAMERA_POWER
        share = CAMERA_SHARE * left
        return CameraRates(
            poses=share,
            lenses=share if since > LENS_START else 0.0,
            exposures=EXPOSURE_SHARE * left if since > EXPOSURE_START else 0.0,
            doubt=min(max((since - DOUBT_START) / (DOUBT_END - DOUBT_START), 0.0), 1.0),
        )

    def rates(self) -> Rates:
        """How far the next step goes."""
        options = self.options
        share = self.step_count / max(1, self.total_steps - 1)
        progress = share**options.decay_power
        sh = _log_interpolate(options.rate_sh, options.rate_sh_end, progress)
        directional = _log_interpolate(*self.directional, share) * sh
        return Rates(
            density=_log_interpolate(options.rate_density, options.rate_density_end, progress),
            sh=(sh, directional, directional * options.degree_falloff, directional * options.degree_falloff**2),
            directional_kept=self._directional_kept(sh),
            background=_log_interpolate(options.rate_background, options.rate_background_end, progress),
            outer=_log_interpolate(self.outer_haste * options.rate_outer, options.rate_outer_end, progress),
            outer_density=_log_interpolate(
                self.outer_haste * options.rate_outer_density, options.rate_outer_density_end, progress
            ),
        )

    def _directional_kept(self, rate: float) -> float:
        """The decay of the coefficients that depend on direction over SHRINK_EVERY steps, where it is due."""
        if self.scarcity <= 1 or self.step_count % SHRINK_EVERY:
            return 1.0
        return max(0.0, 1.0 - rate * self.options.shrink_sh * (self.scarcity - 1.0)) ** SHRINK_EVERY


#: Steps of the first level by which a fit times itself, at most; its first step compiles kernels and does not count.
TRIAL_STEPS = 24

#: A step goes with this power of the voxels along the longest side, measured (benchmarks/NOTES-fit.md).
CPU_POWER, GPU_POWER = 1.1, 0.65

#: Voxels of the last level for each square of its longest side, before those that no view shows go: where what is
#: around the box is fitted too, and of an object alone; measured likewise.
PLACE_ROWS, OBJECT_ROWS = 100.0, 29.0

#: Seconds that a fit on a CPU may take before a quicker one is named, and the most by which its pictures are shrunk.
PATIENCE, MAX_SHRUNK = 600.0, 16


class Pace:
    """How long a fit will take, by what the steps of its levels took so far.
    sides: voxels along the longest side of each level; has_around: whether what is around the box is fitted too."""

    def __init__(self, schedule: Schedule, sides: list[int], has_around: bool, device: wp.Device):
        self.schedule, self.sides, self.device = schedule, sides, device
        self.rows = round((PLACE_ROWS if has_around else OBJECT_ROWS) * sides[-1] ** 2)  # of the last level, about
        self.is_known = False  # whether enough steps were timed
        self._taken: list[list[float]] = [[] for _ in sides]  # seconds of the steps of each level

    def time(self, step: Callable[[], None]) -> bool:
        """Take a step, and time it; True for the one from which on `left` is known."""
        begin = time.perf_counter()
        step()
        level = self.schedule.level
        taken, trial = self._taken[level], min(TRIAL_STEPS, self.schedule.level_steps[level])
        is_last = not self.is_known and len(taken) + 1 >= max(trial, 2)
        if not taken or is_last:  # what was launched is not done
            wp.synchronize_device(self.device)
        taken.append(time.perf_counter() - begin)
        self.is_known |= is_last
        return is_last

    def left(self) -> float:
        """Seconds until the last step is done, at the pace so far."""
        seconds, done = 0.0, self.schedule.step_count
        for level, steps in enumerate(self.schedule.level_steps):
            seconds += max(steps - done, 0) * self._step_seconds(level)
            done = max(done - steps, 0)
        return seconds

    def _step_seconds(self, level: int) -> float:
        """Seconds of a step of a level."""
        counted = [each for each, taken in enumerate(self._taken) if len(taken) > 1]
        known = max((each for each in counted if each <= level), default=counted[0])
        measured = float(np.mean(self._taken[known][1:]))  # the first compiles, or makes the level
        last, power = len(self.sides) - 1, CPU_POWER if self.device.is_cpu else GPU_POWER
        rays = self.schedule.options.supersampling ** (2 * ((level == last) - (known == last)))
        return measured * rays * (self.sides[level] / self.sides[known]) ** power

    def quicker(self, seconds: float, rays: float, pixels: int, fast: FitOptions) -> tuple[int, float] | None:
        """By what to shrink pictures so that a fit on a CPU takes PATIENCE at most by the options `fast`, and how long;
        None where it does as it is, in `seconds`, or none would. rays: of all steps; pixels: of all pictures."""
        if not self.device.is_cpu or seconds <= PATIENCE:
            return None
        rays *= self.schedule.options.supersampling**2
        for factor in range(1, MAX_SHRUNK + 1):
            fewer = max(fast.epochs * pixels / factor**2, fast.least_steps * SMALLEST_BATCH) / rays
            if (shorter := seconds * fewer * factor**-CPU_POWER) <= PATIENCE:
                return factor, shorter
        return None


def _log_interpolate(start: float, end: float, progress: float) -> float:
    return math.exp((1.0 - progress) * math.log(start) + progress * math.log(end))
