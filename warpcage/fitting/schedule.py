"""The steps of a fit: how many each level takes, and how far each goes."""

from __future__ import annotations

import dataclasses
import math

from .options import FitOptions
from .plan import LATE_DIRECTIONAL, directional_rate

#: Late in a fit every so many steps random colours supervise opacity still: without, parts of the background's colour
#: may turn to glass.
OPACITY_EVERY = 4

#: Steps from one pass over the SH coefficients that shrinks them to the next.
SHRINK_EVERY = 4

#: Steps of the cameras over a fit, about; and least and most steps of the field from one to the next.
CAMERA_STEPS, CAMERA_EVERY = 200, (4, 16)

#: Cameras first move when the first level is done, and not before this share of all steps: until then the field shows
#: too little. They move last after another share.
CAMERA_START, CAMERA_END = 0.08, 0.95

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

    # turns and shifts
    poses: float
    # focal lengths
    lenses: float
    exposures: float
    # share to which small moves are doubted
    doubt: float = 0.0

    def __bool__(self) -> bool:
        """Whether anything moves."""
        return self.poses > 0


@dataclasses.dataclass(frozen=True)
class Rates:
    """How far one step goes: learning rates."""

    # in optical depth per voxel of the level, as outer_density
    density: float
    # of degree 0 to 3
    sh: tuple[float, float, float, float]
    # factor on the coefficients that depend on direction after the step; 1 leaves them
    directional_kept: float
    # of the layers behind the field
    background: float
    # of the colours of an outer field
    outer: float
    outer_density: float


class Schedule:
    """The steps of a fit and its place among them; level_steps: of each level."""

    def __init__(self, options: FitOptions, level_steps: list[int], scarcity: float):
        # scarcity: see `plan.scarcity`
        self.options, self.scarcity, self.level_steps = options, scarcity, level_steps
        total = self.total_steps
        first = directional_rate(total) if options.directional is None else options.directional
        last = max(first, LATE_DIRECTIONAL) if options.directional_end is None else options.directional_end
        self.directional = first, last
        # steps done, and index of the level that the fit has reached
        self.step_count = self.level = 0

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

    def camera_rates(self) -> CameraRates:
        """How far the cameras go after the next step: nowhere, where none of their steps is due."""
        total, first = self.total_steps, 0 if len(self.level_steps) == 1 else self.level_steps[0]
        first = max(first, math.ceil(CAMERA_START * total))
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
            outer=_log_interpolate(options.rate_outer, options.rate_outer_end, progress),
            outer_density=_log_interpolate(options.rate_outer_density, options.rate_outer_density_end, progress),
        )

    def _directional_kept(self, rate: float) -> float:
        """The decay of the coefficients that depend on direction over SHRINK_EVERY steps, where it is due."""
        if self.scarcity <= 1 or self.step_count % SHRINK_EVERY:
            return 1.0
        return max(0.0, 1.0 - rate * self.options.shrink_sh * (self.scarcity - 1.0)) ** SHRINK_EVERY


def _log_interpolate(start: float, end: float, progress: float) -> float:
    return math.exp((1.0 - progress) * math.log(start) + progress * math.log(end))
