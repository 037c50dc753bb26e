"""The specs of a scene's pictures, and of a fit to them."""

from __future__ import annotations

import dataclasses
from typing import Any

from ...core.names import QUALITIES, shown
from ...core.spec import Values, changed, color, flag, one_of, option, positive, text, whole
from ...errors import InputError

#: Groups of options.
SCENE, FIT, VOXEL_FIT, SPLAT_FIT = "scene", "fit", "voxels", "splats"


def _masks(value: Any, name: str) -> bool | str:
    if value in ("split", "weights") or isinstance(value, bool):
        return value
    raise InputError(f'{name} must be true, false, "split" or "weights", got {shown(value)}')


@dataclasses.dataclass(frozen=True)
class SceneSpec:
    """Which pictures of a scene are read, and how."""

    split: str = option(
        "train", text(), "which pictures of a scene, such as train or test", flag="--split", group=SCENE
    )
    format: str | None = option(
        None, text(), "scene format", flag="--format NAME", default_help="detected", group=SCENE
    )
    downscale: int = option(
        1, whole(1), "shrink the pictures by averaging N x N pixels", flag="--downscale N", group=SCENE
    )
    masks: bool | str = option(
        True,
        Values(_masks),
        "mask files: true cuts the object out by them, false ignores them, split makes layers of what they cut off, "
        "weights ignores pixels that are black in them",
        group=SCENE,
    )
    cameras: str | None = option(
        None,
        text(),
        "camera file (.json) with a camera for each picture, by its name, instead of those of the scene; `fit "
        "--refine-cameras` writes one",
        flag="--cameras FILE",
        default_help="",
        group=SCENE,
    )
    background: Any = option(None, color(), "colour behind transparent pixels")


@dataclasses.dataclass(frozen=True)
class FitSceneSpec(SceneSpec):
    """Which pictures of a scene a field is fitted to, and how they are read."""

    background: Any = changed(
        SceneSpec,
        "background",
        "white",
        help="colour behind transparent pixels; random, outer, layers, constant and auto are a `background` of "
        "`options`",
    )
    straighten: bool = option(
        False,
        flag(),
        "rotate the scene so that up in its pictures is +z; the field file keeps this rotation, so that the scene's "
        "cameras still match it",
        flag="--straighten",
        default_help="",
    )


@dataclasses.dataclass(frozen=True)
class FitSpec:
    """The options of `warpcage.fit` that are flags; a field of it takes one of the same name in FitOptions or
    SplatFitOptions."""

    quality: str = option(
        "standard",
        one_of(*QUALITIES),
        "detail, at the cost of time: fast takes about half as long; high 3 to 9 times as long, with up to twice the "
        "memory, for about 1 dB where cameras are exact and views many, and for little elsewhere",
        flag="--quality",
        group=FIT,
    )
    seed: int = option(0, whole(0), "random seed", flag="--seed N", group=FIT)
    resolution: int | None = option(
        None,
        whole(1),
        "voxels along the longest side",
        flag="--resolution N",
        default_help="follows the size of a pixel at the object",
        group=VOXEL_FIT,
    )
    max_memory: int | str | None = option(
        None,
        text(),
        "device memory that the fit may take, pictures included, such as 4GB or 800MiB. If it is short, pictures are "
        "kept at 8 bits per channel, and voxels stay larger",
        flag="--max-memory SIZE",
        default_help="most of what is free",
        group=FIT,
    )
    epochs: float | None = option(
        None,
        positive(),
        "passes over the pixels that see the object",
        flag="--epochs N",
        default_help="depends on --quality",
        group=VOXEL_FIT,
    )
    steps: int | None = option(
        None,
        whole(1),
        "splats only: training steps, one picture each",
        flag="--steps N",
        default_help="",
        group=SPLAT_FIT,
    )
    most_splats: int | None = option(
        None, whole(1), "splats only: most of them at the end", flag="--most-splats N", default_help="", group=SPLAT_FIT
    )
    variation: float | None = option(
        None,
        positive(),
        "weight of total variation: higher is smoother",
        flag="--variation FACTOR",
        default_help="chosen from the pictures, at least 30 for density and 15 for colours with masks or surroundings",
        group=VOXEL_FIT,
    )
