"""The settings of the editor's page: options of a shot, and what is shown of it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.names import BACKGROUNDS, listed, shown
from ...core.spec import Values, changed, color, defaults_of, one_of, option, options_of, whole
from ...errors import InputError
from .shot import PICTURE, ShotSpec

#: The colour behind a scene: a name, three numbers in [0, 1], or None for the field's own.
Background = str | Sequence[float] | None

#: Cells of a lattice along the longest side, and those that the page offers.
RESOLUTIONS, OFFERED = (8, 512), (16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)

#: Most rays along each side of a pixel.
MAX_SAMPLES = 4


def _page_color(value: Any, name: str) -> Any:
    if isinstance(value, str) and re.fullmatch("#[0-9a-fA-F]{6}", value):
        return tuple(part / 255 for part in bytes.fromhex(value[1:]))
    try:
        return color().check(value, name)
    except ValueError:
        known = ", ".join(BACKGROUNDS)
        raise InputError(
            f"{name} must be one of {known}, #rrggbb, or three numbers in [0, 1], got {shown(value)}"
        ) from None


@dataclasses.dataclass(frozen=True)
class Settings(ShotSpec):
    """How a session's scene is deformed and shown; `resolution` and `supersampling` are those of pictures that rest.
    The page has the options with a label."""

    background: Background = changed(ShotSpec, "background", None, values=Values(_page_color, color().schema))
    supersampling: int = changed(
        ShotSpec,
        "supersampling",
        1,
        values=whole(1, MAX_SAMPLES),
        labels={side: (f"{side * side} per pixel",) for side in range(1, MAX_SAMPLES + 1)},
    )
    resolution: int = changed(
        ShotSpec, "resolution", 64, values=whole(*RESOLUTIONS), labels={cells: (f"{cells} cells",) for cells in OFFERED}
    )
    show: str = option(
        "rgb",
        one_of("rgb", "disparity", "alpha", "masks"),
        "what is shown",
        group=PICTURE,
        label="What is shown",
        labels={
            "rgb": ("Colour", "The scene in colour"),
            "disparity": ("Depth", "How near objects are: near is bright"),
            "alpha": ("Alpha", "How opaque the scene is: white hides the background"),
            "masks": ("Masks", "What is turned inside out, uncovered or empty"),
        },
    )
    mode: str = option(
        "pose",
        one_of("pose", "rest", "place"),
        "pose: the posed cages and the deformed scene; rest: the cages at rest and the scene as captured; place: the "
        "deformed scene, whose objects are moved as wholes",
        label="Mode",
    )

    def to_json(self) -> dict[str, Any]:
        """What the page has of the settings, and a session's file."""
        return {name: getattr(self, name) for name in SETTINGS}


#: The settings by name, in the order of sessions' files.
_ORDER = "coordinates resolution density background supersampling show mode fill".split()
_LABELLED = {name: each for name, each in options_of(Settings).items() if each.label}
SETTINGS = {name: _LABELLED[name] for name in _ORDER} | _LABELLED


def checked_settings(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Settings with new values by name, checked; None is one where it is the default."""
    unknown = sorted(set(changes) - set(SETTINGS))
    if unknown:
        raise InputError(f"there is no setting {unknown[0][:40]!r}, only {listed(sorted(SETTINGS), most=40)}")
    defaults, checked = defaults_of(Settings), {}
    for name, value in changes.items():
        checked[name] = value if value is None is defaults[name] else SETTINGS[name].values.check(value, name)
    return dataclasses.replace(settings, **checked)
