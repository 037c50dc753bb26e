"""What a fit may be told, and what it is told for a quality."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..field.files.layers import MAX_LAYERS, MAX_SIDE
from .memory import memory_size

MAX_LEVELS = 6


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """What `fit` may be told. Lengths are relative to the scene, so that the defaults suit objects of any size."""

    resolution: int | None = None  #: voxels along the longest side at the end; None follows the images' pixel footprint
    max_resolution: int = 512
    footprint: float = 0.7  #: voxel side over a pixel's footprint at the object, where resolution is None
    levels: int = 3  #: the resolution doubles from level to level; more where a fit has to start coarse
    level_growth: float = 2.2  #: each level gets this many times the rays of the one before
    epochs: float = 8.0  #: passes over the pixels that see the object
    least_steps: int = 600  #: steps that a fit takes even so, where `epochs` is not given: few pixels are soon through
    batch_rays: int | None = None  #: None follows the number of pixels, so that there are steps enough
    tile_size: int = 2  #: a batch is made of square tiles of this many pixels, neighbours share voxels
    rate_density: float = 0.25  #: first learning rate, in optical depth a voxel of the level
    rate_density_end: float = 0.0125
    rate_sh: float = 3e-2
    rate_sh_end: float = 1.5e-3
    decay_power: float = 2.0  #: rates fall with this power of the share of steps done: slowly first, fast at the end
    directional: float | None = None  #: rate of the coefficients that tell directions apart, over that of the constant
    #: ones; None follows the number of steps (see fit_defaults)
    beta: float = 0.95  #: RMSProp's decay
    scarcity: float | None = None  #: factor of the variations and the shrinkage; None follows how few pixels see a
    #: voxel (see fit_defaults)
    variation_density: float = 3e-6  #: total variation of density (per half extent) a voxel of the box
    variation_sh: float = 3e-4
    variation: float | None = None  #: factor on both; None is what the number of pixels that see a voxel asks for, and
    #: fit_plan.CAPTURED_VARIATION at least with layers behind the field or where opacity comes from mask files
    shrink_sh: float = 0.06  #: decay of SH of degree 1 and up, relative to a step of rate_sh, where views are scarce
    variation_share: float = 0.125  #: of the voxels that get their variation gradient in one step
    prune_weight: float = 0.13  #: largest rendering weight under which a voxel goes, times 1 / resolution
    keep_weight: float = 0.01  #: late in the last level and at the end, a voxel stays where it or a neighbour reaches
    #: this rendering weight
    keep_at: float = 0.4  #: share of the last level's steps after which that happens first
    supersampling: int = 1  #: rays a side of a pixel in the last level, and in renders of the field: 1 or 2
    view_share: float = 0.1  #: voxels that fewer of the cameras see than this share of them are left empty
    background: str = "auto"  #: behind the field: "random" colours that supervise opacity where the images have alpha,
    #: "layers" (see LayeredBackground) for whole or split pictures, the scene's "constant" colour, or what suits
    background_layers: int = 16
    background_side: int | None = None  #: cells along a layer's edge; None follows the images' pixels
    max_background_side: int = 512
    background_detail: float = 0.25  #: cells a pixel, where background_side is None
    rate_background: float = 0.2  #: learning rates of the layers' colours and optical depths
    rate_background_end: float = 0.01
    variation_background: float = 0.03  #: total variation of the layers' colours
    variation_background_depth: float = 0.03
    max_memory: int | str | None = None  #: bytes, or "4GB", that the fit may take on its device, images included; None

    #: is most of what is free. Where it is short the images are kept at 8 bits a channel instead of 16, if that leaves
    #: room for more voxels, and the last levels are refined less far


#: What `quality` stands for, over the defaults.
QUALITIES = {
    "fast": {"epochs": 4.0},
    "standard": {},
    "high": {"epochs": 16.0, "max_resolution": 720, "supersampling": 2},
}

#: name -> smallest, largest, kind, whether None will do
OPTION_RANGES = {
    "resolution": (8, 2048, int, True),
    "max_resolution": (8, 2048, int, False),
    "levels": (1, MAX_LEVELS, int, False),
    "least_steps": (0, 2**24, int, False),
    "batch_rays": (1, 2**24, int, True),
    "tile_size": (1, 64, int, False),
    "directional": (1e-9, 1e9, float, True),
    "scarcity": (0.0, 1e6, float, True),
    "variation": (0.0, 1e6, float, True),
    "variation_density": (0.0, 1e3, float, False),
    "variation_sh": (0.0, 1e3, float, False),
    "shrink_sh": (0.0, 1e3, float, False),
    "variation_share": (1e-6, 1.0, float, False),
    "prune_weight": (0.0, 1e3, float, False),
    "keep_weight": (0.0, 1.0, float, False),
    "keep_at": (0.0, 1.0, float, False),
    "supersampling": (1, 2, int, False),
    "view_share": (0.0, 1.0, float, False),
    "background_layers": (2, MAX_LAYERS, int, False),
    "background_side": (2, MAX_SIDE, int, True),
    "max_background_side": (2, MAX_SIDE, int, False),
    "variation_background": (0.0, 1e3, float, False),
    "variation_background_depth": (0.0, 1e3, float, False),
    "beta": (0.0, 1.0 - 1e-6, float, False),
    **{
        name: (1e-9, 1e9, float, False)
        for name in (
            "footprint",
            "level_growth",
            "epochs",
            "rate_density",
            "rate_density_end",
            "rate_sh",
            "rate_sh_end",
            "decay_power",
            "background_detail",
            "rate_background",
            "rate_background_end",
        )
    },
}


def checked_seed(seed) -> int:
    """Raises ValueError for a seed that is no whole number of at least 0."""
    if not (isinstance(seed, (int, np.integer)) and seed >= 0):
        raise ValueError(f"the seed must be a whole number of at least 0, got {seed!r}")
    return int(seed)


def checked_options(options: dict) -> FitOptions:
    """FitOptions of a quality and of fields by name. Raises ValueError for what is not known or out of range."""
    options = dict(options)
    names = {field.name for field in dataclasses.fields(FitOptions)} | {"quality"}
    unknown = sorted(set(options) - names)
    if unknown:
        raise ValueError(f"fit has no option {unknown[0]!r}; it has {', '.join(sorted(names))}")
    quality = options.pop("quality", "standard")
    if quality not in QUALITIES:
        raise ValueError(f"quality {quality!r} is not known: {', '.join(QUALITIES)}")
    if "epochs" in options:
        options.setdefault("least_steps", 0)
    if options.get("max_memory") is not None:
        options["max_memory"] = memory_size(options["max_memory"])
    checked = FitOptions(**{**QUALITIES[quality], **options})
    for name, (low, high, kind, optional) in OPTION_RANGES.items():
        value = getattr(checked, name)
        if value is None and optional:
            continue
        wanted = (int, np.integer) if kind is int else (int, float, np.integer, np.floating)
        if not isinstance(value, wanted) or isinstance(value, bool) or not low <= value <= high:
            what = "a whole number" if kind is int else "a number"
            raise ValueError(f"{name} must be {what} from {low:g} to {high:g}, got {value!r}")
    return checked
