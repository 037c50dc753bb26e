"""How an editor's scene is looked at: the view, and the settings of deformation and picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.names import COORDINATES, DENSITIES
from ..view.frame import MAX_SUPERSAMPLING, parse_background
from .checked import RESOLUTIONS, checked_between, checked_choice, checked_flag, checked_triple, checked_whole

SHOWN = ("rgb", "disparity", "alpha", "masks")
MODES = ("pose", "rest")


@dataclasses.dataclass(frozen=True)
class View:
    """Where the person looks from; (3,) world units."""

    eye: tuple[float, float, float]  # centre of projection
    target: tuple[float, float, float]  # in the middle of the picture
    up: tuple[float, float, float]  # unit vector
    fov: float = 40.0  # vertical, degrees


@dataclasses.dataclass(frozen=True)
class Settings:
    """How the scene is deformed and shown."""

    coordinates: str = "harmonic"
    resolution: int = 64  # cells of the map's lattice along the longest side of a cage, in pictures that rest
    density: str = "opacity"  # see `Deformer`
    # a name, three numbers in [0, 1], or None for the field's own
    background: str | tuple[float, float, float] | None = None
    supersampling: int = 1  # rays along each side of a pixel, in pictures that rest
    show: str = "rgb"  # one of SHOWN
    # "pose": the posed cage and the deformed scene; "rest": the cage at rest and the scene as captured
    mode: str = "pose"
    fill: bool = False  # background that no picture showed, in pictures that rest; see `fill_unseen`


def checked_view(content: Any) -> View:
    """A view from eye, target, up and fov of a dictionary, others ignored; its `up` gets the length 1."""
    eye, target, up = (checked_triple(content[name], name) for name in ("eye", "target", "up"))
    length = float(np.linalg.norm(up))
    if not 1e-12 < length < 1e12:
        raise ValueError("a view needs a direction `up` that is not zero")
    if not 1e-12 < np.linalg.norm(np.subtract(eye, target)) < 1e12:
        raise ValueError("a view needs an eye some way from its target")
    forward = np.subtract(target, eye)
    if np.linalg.norm(np.cross(forward, up)) < 1e-6 * np.linalg.norm(forward) * length:
        raise ValueError("a view cannot look along its own `up`")
    x, y, z = (float(value / length) for value in up)
    return View(eye, target, (x, y, z), checked_between(content["fov"], 1.0, 150.0, "fov"))


def checked_settings(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Settings with new values by name, checked."""
    known = {field.name for field in dataclasses.fields(Settings)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise ValueError(f"there is no setting {unknown[0][:40]!r}, only {', '.join(sorted(known))}")
    good: dict[str, Any] = {}
    for name, value in changes.items():
        if name == "background":
            good[name] = _background(value)
        elif name == "fill":
            good[name] = checked_flag(value, name)
        elif name == "resolution":
            good[name] = checked_whole(value, *RESOLUTIONS, name)
        elif name == "supersampling":
            good[name] = checked_whole(value, 1, min(4, MAX_SUPERSAMPLING), name)
        else:
            choices = {"coordinates": COORDINATES, "density": DENSITIES, "show": SHOWN, "mode": MODES}[name]
            good[name] = checked_choice(value, choices, name)
    return dataclasses.replace(settings, **good)


def _background(value: Any) -> str | tuple[float, float, float] | None:
    if value is None:
        return None
    if isinstance(value, str):
        if len(value) == 7 and value[0] == "#":
            try:
                r, g, b = bytes.fromhex(value[1:])
            except ValueError:
                raise ValueError(f"background {value!r} is no colour: #rrggbb") from None
            return r / 255, g / 255, b / 255
        parse_background(value)  # raises ValueError where there is no such name
        return value
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError("background must be a name, #rrggbb, or three numbers in [0, 1]")
    r, g, b = (checked_between(part, 0.0, 1.0, "background") for part in value)
    return r, g, b
