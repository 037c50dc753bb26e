"""Options of a fit of splats: defaults, ranges, and what each quality sets."""

from __future__ import annotations

import dataclasses
from typing import Any

from numpy.typing import ArrayLike

from ...core.checks import checked_flag
from ...core.names import QUALITIES, checked_choice
from ...errors import InputError
from ..options import FitCall, checked_fields, number, option, positive, weight, whole, with_arguments
from .start import STARTS


@with_arguments
@dataclasses.dataclass(frozen=True)
class SplatFitOptions:
    """Options of `fit` with representation="splats".

    Rates of centers, the noise and the weight of scales are relative to the distance of the cameras from what they look
    at, so that the defaults suit scenes of any size. None can be chosen where it is the default.
    """

    steps: int = whole(12000, 1, 10**7, "Steps, a picture each.")
    most_splats: int = whole(600_000, 1, 50_000_000, "Splats at the end, where the pictures allow so many.")
    pixels_per_splat: float = positive(40.0, "Pixels of all pictures for each splat, at least.")
    degree: int = whole(3, 0, 3, "Degree of the harmonics.")
    degree_every: float = number(1 / 12, 0.0, 1.0, "Share of the steps after which the harmonics get another degree.")
    coarse_until: float = number(
        0.35, 0.0, 1.0, "Share of the steps that see smaller pictures: of a quarter of the side at first, then half."
    )
    start: str = option(
        "auto",
        'Where splats begin. "points": at those of the capture alone. "voxels": on the surface of a quick fit of '
        'voxels. "random": inside the silhouettes, or at places that several views see. "auto": at points where the '
        "scene has them and at places where pictures have none, inside silhouettes where images have alpha, otherwise "
        "voxels.",
    )
    start_scale: float = positive(0.3, "Scale of a splat at first over the distance of its neighbours.")
    start_opacity: float = number(0.5, 0.01, 0.99, "Opacity of a splat at first.")
    grow_from: float = number(0.02, 0.0, 1.0, "Share of the steps before splats are first added.")
    grow_until: float = number(0.6, 0.0, 1.0, "Share of the steps after which all splats are there.")
    revive_until: float = number(0.85, 0.0, 1.0, "Share of the steps after which dead splats stay dead.")
    grow_every: int = whole(100, 1, 10**6, "Steps from one growth to the next.")
    growth: float | None = number(
        None, 1.0, 10.0, "Factor of a growth. None adds as many each time as it takes to be done in time."
    )
    rate_centers: float = positive(1.6e-4, "First learning rate of centers, of the size of the scene.")
    rate_centers_end: float = positive(4e-6, "Last learning rate of centers.")
    rate_log_scales: float = positive(5e-3, "Learning rate of the logarithms of scales.")
    rate_quaternions: float = positive(1e-3, "Learning rate of rotations.")
    rate_logits: float = positive(5e-2, "Learning rate of the logits of opacities.")
    rate_colors: float = positive(2.5e-3, "Learning rate of the harmonics of degree 0.")
    rate_harmonics: float = positive(1.25e-4, "Learning rate of the other harmonics.")
    exposure: bool | None = option(
        None,
        "Whether three gains and three offsets of each picture are learnt with the splats, for pictures of changing "
        "exposure or white balance; their means over all pictures stay 1 and 0. None: no.",
    )
    exposure_from: float = number(0.07, 0.0, 1.0, "Share of the steps before exposures are learnt.")
    rate_exposure: float = positive(
        5e-3, "Learning rate of the logarithms of gains, and of offsets, in the steps that see the picture."
    )
    last: float = number(0.2, 1e-6, 1.0, "Share of the rates, but those of centers, that is left at the end.")
    fall_from: float = number(0.8, 0.0, 1.0, "Share of the steps after which those rates fall.")
    noise: float = number(5e5, 0.0, 1e9, "How far splats of almost no opacity wander, relative to the rate of centers.")
    opacity_weight: float = weight(0.01, "Weight of the mean opacity in the loss.")
    scale_weight: float = weight(0.01, "Weight of the mean scale in the loss.")
    settle_from: float = number(0.9, 0.0, 1.0, "Share of the steps after which noise and those two weights are gone.")
    ssim: float = number(0.2, 0.0, 1.0, "Share of the loss that is structural dissimilarity; the rest is L1.")
    every_value: bool = option(False, "Whether values that a picture does not see step too, as Adam is written.")
    largest_scale: float | None = number(
        None, 1e-6, 1e6, "Largest scale of a splat, of the distance of the cameras. None sets no limit."
    )
    most_elongation: float | None = number(
        None, 1.0, 1e6, "How much longer than its middle axis the longest axis of a splat is at no loss. None: any."
    )
    elongation_weight: float = weight(0.01, "Weight in the loss of the mean of what is longer.")
    least_scale: float = number(
        0.0,
        0.0,
        10.0,
        "Least scale of a splat along an axis, pixels of the nearest picture that has it, found anew every 100 steps; "
        "0.447 as in Mip-Splatting. 0 sets no limit.",
    )
    antialias: bool = option(False, "Whether splats are weakened where the blur makes them larger (Mip-Splatting).")
    background: str = option(
        "auto",
        'What is behind the splats. "random": random colours, so that what is opaque in the images becomes opaque. '
        '"constant": the colour of the scene. "black". "auto": "random".',
    )
    max_memory: int | str | None = option(
        None,
        'Memory that the fit may take on its device, images included, in bytes or as text such as "4GB". None is most '
        "of what is free. Where memory is short, there are fewer splats.",
    )


_FAST = {"steps": 5000, "most_splats": 300_000}
_HIGH = {"steps": 30000, "most_splats": 1_000_000}

#: What each quality sets in place of the defaults.
SET_BY_QUALITY: dict[str, dict[str, Any]] = dict(zip(QUALITIES, (_FAST, {}, _HIGH), strict=True))

#: What may be behind the splats.
BACKGROUNDS = ("auto", "random", "constant", "black")


def checked_splat_options(options: dict) -> SplatFitOptions:
    """The options of a caller, `quality` and fields of SplatFitOptions by name, checked; `max_memory` in bytes."""
    for name in ("every_value", "antialias"):
        checked_flag(options.get(name, False), name)
    if not isinstance(options.get("exposure"), bool | None):
        raise InputError(f"exposure must be True, False or None, got {options['exposure']!r}")
    checked = checked_fields(SplatFitOptions, SET_BY_QUALITY, options)
    checked_choice(checked.background, "background", BACKGROUNDS)
    checked_choice(checked.start, "start", STARTS)
    return checked


class SplatFitNames(FitCall, total=False):
    """What a `fit` of splats takes by name, for type checkers: the fields of SplatFitOptions too."""

    weights: ArrayLike | None
    steps: int
    most_splats: int
    pixels_per_splat: float
    degree: int
    degree_every: float
    coarse_until: float
    start: str
    start_scale: float
    start_opacity: float
    grow_from: float
    grow_until: float
    revive_until: float
    grow_every: int
    growth: float | None
    rate_centers: float
    rate_centers_end: float
    rate_log_scales: float
    rate_quaternions: float
    rate_logits: float
    rate_colors: float
    rate_harmonics: float
    exposure: bool | None
    exposure_from: float
    rate_exposure: float
    last: float
    fall_from: float
    noise: float
    opacity_weight: float
    scale_weight: float
    settle_from: float
    ssim: float
    every_value: bool
    largest_scale: float | None
    most_elongation: float | None
    elongation_weight: float
    least_scale: float
    antialias: bool
    background: str
    max_memory: int | str | None
