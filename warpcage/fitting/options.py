"""Options of a fit: defaults, ranges, and what each quality sets."""

from __future__ import annotations

import dataclasses
import inspect
import os
import textwrap
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core import spec
from ..core.names import QUALITIES, Quality, checked_choice
from ..core.reports import Progress
from ..errors import InputError
from ..field.io.field_file import MAX_LAYER_SIDE, MAX_LAYERS, MAX_OUTER_SIDE
from .memory import memory_size

MAX_LEVELS = 6

#: Ends of the range of numbers that must be positive, and of factors that may be zero.
SMALLEST, LARGEST = 1e-9, 1e9
LARGEST_FACTOR, LARGEST_WEIGHT, LARGEST_RAYS = 1e6, 1e3, 1e12


def option(default: object, text: str, values: spec.Values | None = None) -> Any:
    return spec.option(default, values or spec.Values(spec.anything), text)


def whole(default: int | None, low: int, high: int, text: str) -> Any:
    return option(default, text, spec.whole(low, high))


def number(default: float | None, low: float, high: float, text: str) -> Any:
    return option(default, text, spec.number(low, high))


def positive(default: float | None, text: str) -> Any:
    return number(default, SMALLEST, LARGEST, text)


def weight(default: float, text: str) -> Any:
    return number(default, 0.0, LARGEST_WEIGHT, text)


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """Options of `fit` and `FieldOptimizer`.

    Lengths are relative to the scene, so that the defaults suit objects of any size. None can be chosen where it is the
    default.
    """

    resolution: int | None = whole(
        None,
        8,
        2048,
        "Voxels along the longest side of the last level. None follows the size of a pixel at the object.",
    )
    max_resolution: int = whole(512, 8, 2048, "Most voxels along the longest side where `resolution` is None.")
    footprint: float = positive(
        0.7, "Side of a voxel over the width of a pixel at the object, where `resolution` is None."
    )
    levels: int = whole(
        3,
        1,
        MAX_LEVELS,
        "Levels of the fit. The resolution doubles from each to the next. A fit adds levels if it "
        "has to start coarser, and has fewer where the first would have less than 2 voxels along its longest side.",
    )
    level_growth: float | None = positive(
        None,
        "Rays of a level over the rays of the level before. None is 2.6, and 1.25 where an OuterField is fitted too.",
    )
    epochs: float = positive(11.0, "Passes over the pixels that see the object.")
    most_rays: float = number(
        5e8,
        1.0,
        LARGEST_RAYS,
        "Most rays of a fit: where there are many pixels there are fewer `epochs`. There is no such limit where "
        "`epochs` is given.",
    )
    least_steps: int = whole(
        600,
        0,
        2**24,
        "Smallest number of steps. It is 0 where `epochs` is given. A pass over few pixels takes few steps.",
    )
    batch_rays: int | None = whole(
        None, 1, 2**24, "Rays per batch. None follows the number of pixels, so that there are enough steps."
    )
    tile_size: int = whole(
        2, 1, 64, "Side in pixels of the square tiles that make up a batch. Pixels of a tile share voxels."
    )
    rate_density: float = positive(0.083, "First learning rate of density, in optical depth per voxel of the level.")
    rate_density_end: float = positive(0.0042, "Last learning rate of density.")
    rate_sh: float = positive(3e-2, "First learning rate of the SH coefficients.")
    rate_sh_end: float = positive(1.5e-3, "Last learning rate of the SH coefficients.")
    decay_power: float = positive(
        2.0, "Rates fall with this power of the share of steps done. Above 1 they fall slowly first, then fast."
    )
    directional: float | None = number(
        None,
        SMALLEST,
        LARGEST,
        "First learning rate of the coefficients of degree 1 over the rate of the "
        "constant ones. None follows the number of steps.",
    )
    directional_end: float | None = number(
        None, SMALLEST, LARGEST, "The same at the end. None is 0.7, or `directional` if that is more."
    )
    degree_falloff: float = number(
        0.5,
        SMALLEST,
        1.0,
        "Learning rate of the SH coefficients of degree 2 over that of degree 1, and of degree 3 over degree 2.",
    )
    beta: float = number(0.95, 0.0, 1.0 - 1e-6, "Decay of RMSProp's second moments per step.")
    scarcity: float | None = number(
        None,
        0.0,
        LARGEST_FACTOR,
        "Factor that stands for few views: it raises the total variation and `shrink_sh`. "
        "None follows the number of rays that see a voxel.",
    )
    variation_density: float = weight(
        3e-6, "Weight of the total variation of density (per half of the box) per voxel of the box."
    )
    variation_sh: float = weight(6e-4, "Weight of the total variation of the SH coefficients per voxel of the box.")
    variation_high_degree: float = number(
        5.0,
        0.0,
        LARGEST_FACTOR,
        "Factor on that weight for the coefficients of degree 2 and 3: how a surface reflects changes less from place "
        "to place than its colour.",
    )
    variation: float | None = number(
        None,
        0.0,
        LARGEST_FACTOR,
        "Factor on both total variations. None follows the scarcity, and is at least 30 "
        "(density) and 15 (SH) with layers behind the field or with opacity from mask files.",
    )
    variation_views: float = number(
        48.0,
        0.0,
        LARGEST_FACTOR,
        "With an outer field: from the second level on the total variation of a voxel that fewer than so many pictures "
        "show grows by powers of how many times fewer they are, 32 at most; `variation` then has no least values. 0 "
        "treats voxels alike.",
    )
    shrink_sh: float = weight(
        0.06,
        "Decay of the coefficients that depend on direction, relative to a step of `rate_sh`, where views are scarce.",
    )
    variation_share: float = number(
        0.125, 1e-6, 1.0, "Share of the voxels that get a gradient of the total variation in one step."
    )
    prune_weight: float = weight(
        0.13,
        "A voxel is removed after a level if its largest rendering weight is below this over the resolution; one of "
        "the next level also if it is below 0.6 of `keep_weight`.",
    )
    keep_weight: float = number(
        0.01,
        0.0,
        1.0,
        "Late in the last level and at the end, a voxel stays if its own largest rendering weight or "
        "that of a neighbour reaches this.",
    )
    keep_at: float = number(0.4, 0.0, 1.0, "Share of the last level's steps after which `keep_weight` is first used.")
    supersampling: int = whole(
        1, 1, 2, "Rays along each side of a pixel, in the last level and in renders of the field."
    )
    view_share: float = number(0.1, 0.0, 1.0, "Voxels that fewer than this share of the cameras see are left empty.")
    background: str = option(
        "auto",
        'What is behind the field. "random": random colours that supervise opacity, for images with alpha. '
        '"outer": an OuterField around the box, for whole images. "layers": a LayeredBackground behind it, for whole '
        'or split images. "constant": the colour of the scene. '
        '"auto": "random" for images with alpha, with layers where masks split them; "outer" for whole images, but '
        '"constant" where their border shows the colour of the scene alone.',
    )
    opacity_share: float = number(
        0.4,
        0.0,
        1.0,
        "Share of the steps after which random colours supervise opacity less often, for images with alpha: most of "
        "the steps then compare with the images as they are.",
    )
    background_layers: int = whole(16, 2, MAX_LAYERS, "Layers behind the field.")
    background_side: int | None = whole(
        None, 2, MAX_LAYER_SIDE, "Cells along the edge of a layer. None follows the pixels of the images."
    )
    max_background_side: int = whole(
        512, 2, MAX_LAYER_SIDE, "Most cells along the edge of a layer where `background_side` is None."
    )
    background_detail: float = positive(0.25, "Cells per pixel where `background_side` is None.")
    rate_background: float = positive(0.2, "First learning rate of the layers' colours and optical depths.")
    rate_background_end: float = positive(0.01, "Last learning rate of the layers.")
    variation_background: float = weight(0.03, "Weight of the total variation of the layers' colours.")
    variation_background_depth: float = weight(0.03, "Weight of the total variation of the layers' optical depths.")
    outer_resolution: int | None = whole(
        None,
        8,
        MAX_OUTER_SIDE,
        "Voxels along each side of the contracted space around the box. None is the field's resolution, at most "
        "`max_outer_resolution`, and up to half as many again where many rays see a voxel.",
    )
    max_outer_resolution: int = whole(
        512,
        8,
        MAX_OUTER_SIDE,
        "Most voxels along each side of contracted space where `outer_resolution` is None and rays are not many.",
    )
    rate_outer: float = positive(
        0.06, "First learning rate of the outer field's colours; up to twice that where it is finer than the box."
    )
    rate_outer_end: float = positive(0.003, "Last learning rate of the outer field's colours.")
    rate_outer_density: float = positive(0.083, "The same of its density, in optical depth per voxel of the level.")
    rate_outer_density_end: float = positive(0.0042, "Last learning rate of the outer field's density.")
    variation_outer: float = weight(0.03, "Weight of the total variation of the outer field's colours.")
    variation_outer_density: float = weight(1e-4, "Weight of the total variation of the outer field's density.")
    variation_outer_views: float = number(
        12.0, 0.0, LARGEST_FACTOR, "As `variation_views`, for the voxels of the outer field."
    )
    front_opacity: float = weight(
        0.01, "Weight of the opacity of what an outer field holds between the cameras and the box, mean over the rays."
    )
    sky_follows: float = weight(
        0.1,
        "Weight of a loss by which the sky of an outer field follows what is seen behind the box, relative to the "
        "photometric one. Views that look where no training view did see the sky.",
    )
    refine_cameras: bool | Literal["auto"] = option(
        False,
        "Whether poses, focal lengths and the exposure of each picture are refined with the field. 'auto' refines them "
        "where two halves of the rays say alike that cameras are off, by enough pixels in the median that it pays.",
    )
    max_memory: int | str | None = option(
        None,
        'Memory that the fit may take on its device, images included, in bytes or as text such as "4GB". None '
        "is most of what is free. Where memory is short, images are kept at 8 bits per channel instead of 16 if that "
        "leaves room for more voxels, and the last levels have larger voxels.",
    )


Options = TypeVar("Options")


def with_arguments(kind: type[Options]) -> type[Options]:
    """Add an `Args:` block to the docstring of a class of options, with the default and the range of each."""
    blocks = ["Args:"]
    for name, each in spec.options_of(kind).items():
        schema, default = each.values.schema, spec.defaults_of(kind)[name]
        numbers = "A whole number" if schema.get("type") == "integer" else "A number"
        span = f" {numbers} from {schema['minimum']:g} to {schema['maximum']:g}." if "maximum" in schema else ""
        text = f"{name}: {each.help}{span} Default: {default}."
        blocks.append(textwrap.fill(text, 116, initial_indent=" " * 4, subsequent_indent=" " * 8))
    kind.__doc__ = f"{inspect.cleandoc(kind.__doc__ or '')}\n\n" + "\n".join(blocks) + "\n"
    return kind


with_arguments(FitOptions)

#: What outer fields alone have.
VIEW_OPTIONS = ("variation_views", "variation_outer_views")

_FAST = {"epochs": 3.1}
_HIGH = {
    "epochs": 22.0,
    "most_rays": 2e9,
    "max_resolution": 720,
    "supersampling": 2,
    "variation_sh": 1.8e-3,
    "decay_power": 3.0,
}

#: What each quality sets in place of the defaults.
_SET_BY_QUALITY: dict[str, dict[str, Any]] = dict(zip(QUALITIES, (_FAST, {}, _HIGH), strict=True))


def checked_options(options: dict) -> FitOptions:
    """The options of a caller, `quality` and fields of FitOptions by name, checked; `max_memory` in bytes."""
    if "epochs" in options:
        options = {"least_steps": 0, "most_rays": LARGEST_RAYS, **options}
    refined = options.get("refine_cameras", False)
    if isinstance(refined, np.bool_):
        options = {**options, "refine_cameras": bool(refined)}
    elif not isinstance(refined, bool) and refined != "auto":
        raise InputError(f"refine_cameras must be True, False or 'auto', got {refined!r}")
    return checked_fields(FitOptions, _SET_BY_QUALITY, options)


def checked_fields(kind: type[Options], by_quality: dict[str, dict[str, Any]], options: dict) -> Options:
    """Options of a kind from `quality`, by what each sets, and fields by name, which have priority; checked."""
    options = dict(options)
    names = {*spec.options_of(kind), "quality"}
    unknown = sorted(set(options) - names)
    if unknown:
        raise InputError(f"fit has no option {unknown[0]!r}; it has {', '.join(sorted(names))}")
    quality = options.pop("quality", "standard")
    checked_choice(quality, "quality", QUALITIES)
    if options.get("max_memory") is not None:
        options["max_memory"] = memory_size(options["max_memory"])
    checked = kind(**{**by_quality[quality], **options})
    for name, check in spec.checkers(kind).items():
        value = getattr(checked, name)
        if value is not None or spec.defaults_of(kind)[name] is not None:
            check(value, name)
    return checked


class FitCall(TypedDict, total=False):
    """What every `fit` takes by name, for type checkers."""

    quality: Quality
    device: wp.DeviceLike
    seed: int
    progress: bool | Progress
    checkpoint: str | os.PathLike[str] | None
    checkpoint_seconds: float
    preview: str | os.PathLike[str] | None
    preview_seconds: float


class FitNames(FitCall, total=False):
    """What a `fit` of voxels takes by name, for type checkers: the fields of FitOptions too."""

    bounds: ArrayLike | None
    resolution: int | None
    max_resolution: int
    footprint: float
    levels: int
    level_growth: float | None
    epochs: float
    most_rays: float
    least_steps: int
    batch_rays: int | None
    tile_size: int
    rate_density: float
    rate_density_end: float
    rate_sh: float
    rate_sh_end: float
    decay_power: float
    directional: float | None
    directional_end: float | None
    degree_falloff: float
    beta: float
    scarcity: float | None
    variation_density: float
    variation_sh: float
    variation_high_degree: float
    variation: float | None
    variation_views: float
    shrink_sh: float
    variation_share: float
    prune_weight: float
    keep_weight: float
    keep_at: float
    supersampling: int
    view_share: float
    background: str
    opacity_share: float
    background_layers: int
    background_side: int | None
    max_background_side: int
    background_detail: float
    rate_background: float
    rate_background_end: float
    variation_background: float
    variation_background_depth: float
    outer_resolution: int | None
    max_outer_resolution: int
    rate_outer: float
    rate_outer_end: float
    rate_outer_density: float
    rate_outer_density_end: float
    variation_outer: float
    variation_outer_density: float
    variation_outer_views: float
    front_opacity: float
    sky_follows: float
    refine_cameras: bool | Literal["auto"]
    max_memory: int | str | None
