"""Poses by their names: bend:40:x:z, twist:60."""

from __future__ import annotations

import pathlib
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..core.files import PathLike
from ..errors import InputError
from .axes import AXIS_NAMES, axis_of, default_towards, is_axis

if TYPE_CHECKING:
    from .cage import Cage

#: Preset -> the amount that changes nothing, and how many axes it may name.
PRESETS = {"rest": (0.0, 0), "bend": (0.0, 2), "twist": (0.0, 1), "taper": (1.0, 1), "stretch": (1.0, 1),
           "scale": (1.0, 0), "rotate": (0.0, 1), "translate": (0.0, 0)}  # fmt: skip

PRESET_HELP = (
    "rest, bend:DEGREES[:AXIS[:TOWARDS]], twist:DEGREES[:AXIS], taper:FACTOR[:AXIS], "
    "stretch:FACTOR[:AXIS], scale:FACTOR, rotate:DEGREES[:AXIS] or translate:X:Y:Z; "
    f"an AXIS is {AXIS_NAMES}"
)


class Preset:
    """A pose by its name, such as "bend:40:x:z"."""

    def __init__(self, text: str):
        kind, *arguments = text.split(":")
        neutral, axis_count = PRESETS[kind]
        number_count = {"rest": 0, "translate": 3}.get(kind, 1)
        try:
            amount = [float(argument) for argument in arguments[:number_count]]
        except ValueError:
            amount = []
        axes = arguments[number_count:]
        good = len(amount) == number_count and all(abs(number) < float("inf") for number in amount)
        good = good and len(axes) <= axis_count and all(map(is_axis, axes))
        good = good and not any(re.fullmatch("[-+][xyz]", axis) for axis in axes[:1])
        if not good:
            raise InputError(f"pose {text!r} is not a preset: {PRESET_HELP}")
        self.kind, self.amount = kind, tuple(amount)
        self.family = (kind, *axes)  # presets of one family differ in the amount alone
        self.neutral = neutral  # the number that changes nothing

    def at(self, rest: Cage, amount: Sequence[float]) -> Cage:
        """A cage posed by this preset with another amount."""
        kind, *axes = self.family
        named = dict(zip(("axis", "towards"), map(axis_of, axes), strict=False))
        if kind == "rest":
            return rest
        if kind == "bend" and "axis" in named and "towards" not in named:
            named["towards"] = default_towards(rest, named["axis"])
        return getattr(rest, kind)(tuple(amount) if kind == "translate" else float(amount[0]), **named)


def is_preset(text: str, folder: PathLike = "") -> bool:
    """Whether the spec of a pose begins as a preset does and no file of the folder has this name."""
    return text.split(":")[0] in PRESETS and not pathlib.Path(folder, text).exists()
