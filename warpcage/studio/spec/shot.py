"""The spec of a shot: how one picture of a scene is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from ...coordinate_kinds import COORDINATE_KINDS, names_where
from ...core.names import (
    BACKGROUNDS,
    COORDINATES,
    DENSITIES,
    FIELD_COORDINATES,
    MAX_SUPERSAMPLING,
    SPLAT_MAPS,
    TRANSPARENT,
    shown,
)
from ...core.spec import (
    Values,
    color,
    defaults_of,
    flag,
    fraction,
    names_of,
    numbers,
    one_of,
    option,
    options_of,
    plain,
    positive,
    whole,
)
from ...errors import InputError

#: Groups of options, which are those of flags and of the page's panels too.
DEFORMATION, PICTURE = "deformation", "picture"

#: Where there is no lattice, as files and flags have it.
PRECISE = "precise"

PRECISE_KINDS = " and ".join(names_where("is_precise"))

COLORS = f"{', '.join(BACKGROUNDS)}, or three numbers in [0, 1] such as 0.2,0.3,0.4"


def _cells(value: Any, name: str) -> int | str:
    if value == PRECISE:
        return value
    if type(value) is not int or value < 1:
        raise InputError(
            f'{name} must be a whole number of lattice cells, at least 1, or "{PRECISE}" ({PRECISE_KINDS} only), got '
            f"{shown(value)}"
        )
    return value


def _range(value: Any, name: str) -> tuple[float, float]:
    low, high = numbers(value, name, 2)
    if high < low:
        raise InputError(f"{name} must be [low, high], got [{low:g}, {high:g}]")
    return low, high


@dataclasses.dataclass(frozen=True)
class ShotSpec:
    """How a picture of a scene is made. A new option takes a field here, and one of the same name in `RenderOptions`
    (or `Deformer`), which renders by it."""

    background: Any = option(
        None,
        color(transparent=True),
        f"{COLORS}; {TRANSPARENT}: none, for file formats with an alpha channel",
        flag="--background COLOUR",
        default_help="the field's own",
        group=PICTURE,
        label="Background",
    )
    supersampling: int | None = option(
        None,
        whole(1, MAX_SUPERSAMPLING),
        "rays along each side of a pixel, 1 to 8: more are smoother and slower",
        flag="--supersampling N",
        default_help="that of the field",
        group=PICTURE,
        label="Samples",
    )
    antialias: bool | None = option(
        None,
        flag(),
        "splats only: antialiasing of Mip-Splatting, for files trained with it; distant splats of other files become "
        "too thin",
        flag="--antialias",
        default_help="as the file says",
        group=PICTURE,
    )
    disparity_scale: tuple[float, float] | None = option(
        None, Values(_range), "low and high disparity of pictures of depth", default_help="those of the picture"
    )
    scene_scale: float = option(
        1.0,
        positive()._replace(convert=lambda text: float(fraction().parse(text))),
        "undo a scaling: the factor by which the positions of a scene were multiplied before its field was fitted, 2/3 "
        "for Plenoxels checkpoints of NeRF-synthetic scenes",
        flag="--scene-scale FACTOR",
        default_help="1",
    )
    coordinates: str = option(
        FIELD_COORDINATES,
        one_of(*COORDINATES),
        "kind of cage coordinates",
        flag="--coordinates",
        group=DEFORMATION,
        label="Deformation",
        labels={kind.name: (kind.label, kind.help) for kind in COORDINATE_KINDS.values()},
    )
    resolution: int | str | None = option(
        None,
        Values(_cells, {"type": "integer", "minimum": 1}, lambda text: text if text == PRECISE else int(text)),
        f'lattice cells along the longest side of the cage, or "{PRECISE}" to evaluate the coordinates at every sample '
        f"({PRECISE_KINDS} only)",
        flag="--resolution N",
        default_help="by the picture's size, a cell for 5 pixels, 64 to 128",
        group=DEFORMATION,
        label="Resolution",
    )
    density: str = option(
        "opacity",
        one_of(*DENSITIES),
        "what parts keep when they are scaled. opacity: their opacity; paper: their density, as in the paper "
        "(Deforming Radiance Fields with Cages)",
        flag="--density",
        group=DEFORMATION,
        label="Density",
        labels={"opacity": ("Keep opacity",), "paper": ("More opaque as they grow",)},
    )
    map: str | None = option(
        None,
        one_of(*SPLAT_MAPS),
        "splats only. forward: move them by the coordinates of the cage at rest; backward: put them where voxels under "
        "the same cage would go",
        flag="--map",
        default_help="forward",
        group=DEFORMATION,
    )
    fill: bool = option(
        False,
        flag(),
        "continue the surroundings smoothly over background that an edit uncovers and no picture shows; violet in "
        "masks",
        flag="--fill",
        default_help="leave it as fitted",
        group=PICTURE,
        label="Fill uncovered background",
    )
    overlay: bool = option(
        False, flag(), "draw the cages into the picture", flag="--overlay", default_help="", group=PICTURE
    )

    def check(self, named: Callable[[str], str] = "--{}".format) -> None:
        """Raises ValueError for options that do not go together; named: what a message calls an option."""
        if self.fill and self.background is not None:
            raise InputError(
                f"{named('fill')} continues the field's own background: it cannot be combined with "
                f"{named('background')}"
            )

    def deformer_options(self, cells: int) -> dict[str, Any]:
        """The options of a Deformer by its names; cells: of a lattice whose resolution the spec leaves open."""
        chosen = cells if self.resolution is None else self.resolution
        resolution = None if chosen == PRECISE else int(chosen)
        return {name: getattr(self, name) for name in names_of(ShotSpec, DEFORMATION)} | {"resolution": resolution}

    def item_keys(self, *, deformed: bool) -> dict[str, Any]:
        """The keys of a job's frames: what differs from the defaults, and all of the deformation where there is one."""
        keys = {}
        for name, default in defaults_of(ShotSpec).items():
            value, of_deformation = getattr(self, name), options_of(ShotSpec)[name].group == DEFORMATION
            if value is not None and (deformed if of_deformation else value != default):
                keys[name] = plain(value)
        return keys
