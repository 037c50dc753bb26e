"""What each step of a fit of splats does, as a table that the device reads by itself."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from ...kernels.fitting.splat_step import SplatStep
from .options import SplatFitOptions

#: Adam's decays, and what keeps steps small where slopes are nothing: those are of the mean over a picture, 1e-9 small.
BETAS, EPSILON = (0.9, 0.999), 1e-15

#: Largest logarithm of a scale where none is asked for.
NO_LIMIT = 30.0

#: Shares of the side of pictures, coarsest first, and how the steps on smaller ones are shared among those.
COARSE = ((4, 1 / 3), (2, 2 / 3))

#: Sides of a picture below which it is not made smaller, pixels.
SMALLEST_SIDE = 64


@dataclasses.dataclass(frozen=True)
class Stage:
    """Steps that see pictures of one size."""

    shrinkage: int  # pixels of the scene's along each side of one of these
    begin: int  # first step


class SplatSchedule:
    """Rates, pictures and growth of all steps of a fit."""

    def __init__(
        self,
        options: SplatFitOptions,
        views: int,
        size: tuple[int, int],  # width and height of a picture
        extent: float,  # of the scene in units of the fit
        background: np.ndarray | None,  # (3,), or None for random ones
        seed: int,
    ):
        self.options, self.total_steps = options, options.steps
        self.extent = extent
        random = np.random.default_rng(seed)
        turns = -(-self.total_steps // views)
        self.views = np.concatenate([random.permutation(views) for _ in range(turns)])[: self.total_steps]
        self.seeds = random.integers(2**31, size=self.total_steps)
        if background is None:
            self.backgrounds = random.random((self.total_steps, 3))
        else:
            self.backgrounds = np.broadcast_to(np.asarray(background, np.float64), (self.total_steps, 3))
        self.stages = self._stages(min(size))

    def _stages(self, side: int) -> list[Stage]:
        coarse = [(shrinkage, share) for shrinkage, share in COARSE if side >= shrinkage * SMALLEST_SIDE]
        until = round(self.options.coarse_until * self.total_steps)
        stages, begin = [], 0
        for shrinkage, share in coarse if until else []:
            stages.append(Stage(shrinkage, begin))
            begin += round(share / sum(each for _, each in coarse) * until)
        return [*stages, Stage(1, begin)]

    def degree(self, step: int) -> int:
        """Degree of the harmonics that are used at a step."""
        every = self.options.degree_every * self.total_steps
        return self.options.degree if every < 1.0 else min(self.options.degree, int(step / every))

    def shrinkage(self, step: int) -> int:
        """How much smaller than the scene's the pictures of a step are."""
        return [stage for stage in self.stages if stage.begin <= step][-1].shrinkage

    def revives(self, step: int) -> bool:
        """Whether dead splats begin anew before a step."""
        options, total = self.options, self.total_steps
        return (
            step > options.grow_from * total and step < options.revive_until * total and step % options.grow_every == 0
        )

    def count_after(self, step: int, count: int, first: int, most: int) -> int:
        """Splats after the growth before a step: `count` now, `first` at the beginning, `most` at the end."""
        options, total = self.options, self.total_steps
        if options.growth is not None:
            return min(most, int(options.growth * count))
        begin, end = options.grow_from * total, options.grow_until * total
        share = min(max((step - begin) / max(end - begin, 1.0), 0.0), 1.0)
        return min(most, max(count, round(first + (most - first) * share)))

    def table(self, counts: np.ndarray, device: wp.Device) -> wp.array:
        """(steps,) SplatStep; counts: (steps,) splats of each step."""
        step_type: Any = SplatStep
        rows = np.zeros(self.total_steps, dtype=step_type.numpy_dtype())
        step = np.arange(self.total_steps)
        share = step / max(self.total_steps - 1, 1)
        options = self.options
        fall = np.clip((share - options.fall_from) / max(1.0 - options.fall_from, 1e-9), 0.0, 1.0)
        fall = options.last**fall
        centers = options.rate_centers * (options.rate_centers_end / options.rate_centers) ** share * self.extent
        settles = (share < options.settle_from).astype(np.float64)
        columns: dict[str, Any] = {
            "view": self.views,
            "seed": self.seeds,
            "every": int(options.every_value),
            "background": self.backgrounds,
            "rate_centers": centers,
            "rate_log_scales": fall * options.rate_log_scales,
            "rate_quaternions": fall * options.rate_quaternions,
            "rate_logits": fall * options.rate_logits,
            "rate_colors": fall * options.rate_colors,
            "rate_harmonics": fall * options.rate_harmonics,
            "rate_exposure": fall
            * options.rate_exposure
            * (options.exposure is True)
            * (share >= options.exposure_from),
            "beta1": BETAS[0],
            "beta2": BETAS[1],
            "epsilon": EPSILON,
            "mean_factor": 1.0 / (1.0 - BETAS[0] ** (step + 1.0)),
            "root_factor": 1.0 / np.sqrt(1.0 - BETAS[1] ** (step + 1.0)),
            "opacity_weight": settles * options.opacity_weight / counts,
            "scale_weight": settles * options.scale_weight / (3.0 * counts),
            "noise": settles * options.noise * centers,
            "most_log_scale": NO_LIMIT if options.largest_scale is None else np.log(options.largest_scale),
            "most_elongation": options.most_elongation or 0.0,
            "elongation_weight": options.elongation_weight / counts,
        }
        for name, values in columns.items():
            rows[name] = values  # pyright: ignore[reportCallIssue, reportArgumentType]
        return wp.array(rows, dtype=SplatStep, device=device)
