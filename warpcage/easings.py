"""The easings between keys of films: one row for each, which gives its name, its label and its function."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from .errors import InputError

#: An easing by its name, or a curve whose numbers are those of CSS's cubic-bezier (`core.checks.checked_easing`).
Easing: TypeAlias = str | Mapping[str, Sequence[float]]

#: Most steps to the parameter of a curve at a time: half an interval each, at worst.
MAX_STEPS = 100


@dataclass(frozen=True)
class EasingKind:
    """How the motion from a key to the next one goes."""

    # A new easing takes a row of EASING_KINDS, a row in the table of docs/films.md, and a test.

    label: str  # in menus
    # The eased share of the way at a share of the time, 0 to 1; None: `view.motion.value_at` computes it from more keys
    eased: Callable[[float], float] | None
    # x1, y1, x2, y2 of the curve that it is, or is near to: the editor's custom curve begins with it
    curve: tuple[float, float, float, float] = (1 / 3, 0.0, 2 / 3, 1.0)


def _bounced(share: float) -> float:
    """Parabolas of one gravity: a fall, and three bounces of 1/4, 1/16 and 1/64 of its height."""
    time = 2.75 * share
    middle, half = next(each for each in _BOUNCES if time <= sum(each))
    return 1.0 - half * half + (time - middle) ** 2


#: Of the fall and its bounces: the middle, and half of the time that each takes, of times in which the fall takes 1.
_BOUNCES = ((0.0, 1.0), (1.5, 0.5), (2.25, 0.25), (2.625, 0.125))

#: All easings by name, in the order of menus and help. Functions as Penner (2002) has them; elastic ones end at 1.
EASING_KINDS = {
    "smooth": EasingKind("Smooth", None),
    "linear": EasingKind("Linear", lambda share: share, (1 / 3, 1 / 3, 2 / 3, 2 / 3)),
    "hold": EasingKind("Hold", None),
    "ease-in": EasingKind("Ease in", lambda share: share * share, (1 / 3, 0.0, 2 / 3, 1 / 3)),
    "ease-out": EasingKind("Ease out", lambda share: share * (2.0 - share), (1 / 3, 2 / 3, 2 / 3, 1.0)),
    "ease-in-out": EasingKind(
        "Ease in and out", lambda share: 2.0 * share * share if share < 0.5 else 1.0 - 2.0 * (1.0 - share) ** 2
    ),
    "bounce": EasingKind("Bounce", _bounced),
    "elastic": EasingKind("Elastic", lambda share: 1.0 - 2.0 ** (-10.0 * share) * math.cos(6.5 * math.pi * share)),
}


def eased_share(easing: Easing, share: float) -> float:
    """The eased share of the way at a share of the time, 0 to 1; `easing`: any but smooth and hold."""
    if isinstance(easing, str):
        eased = EASING_KINDS[easing].eased
        if eased is None:
            raise InputError(f"{easing} depends on more keys: see value_at")
        return eased(share)
    x1, y1, x2, y2 = easing["bezier"]
    return _curved(x1, y1, x2, y2, share)


def _curved(x1: float, y1: float, x2: float, y2: float, share: float) -> float:
    """The height of the cubic from (0, 0) by (x1, y1) and (x2, y2) to (1, 1) above a share of the time."""
    # Newton's method from the share itself, with bisection where a step leaves the bracket or the slope is 0 (x1 = 1,
    # x2 = 0, in the middle). x rises with its parameter, as x1 and x2 are 0 to 1.
    low, high, place = 0.0, 1.0, share
    for _ in range(MAX_STEPS):
        error = _cubic(x1, x2, place) - share
        low, high = (low, place) if error > 0.0 else (place, high)
        slope = 3.0 * ((1.0 - place) ** 2 * x1 + 2.0 * (1.0 - place) * place * (x2 - x1) + place * place * (1.0 - x2))
        following = place - error / slope if slope > 0.0 else low
        if not low < following < high:
            following = 0.5 * (low + high)
        if error == 0.0 or following == place:
            break
        place = following
    return _cubic(y1, y2, place)


def _cubic(first: float, second: float, place: float) -> float:
    """A coordinate of the cubic by two handles, at a parameter from 0 to 1."""
    rest = 1.0 - place
    return 3.0 * rest * place * (rest * first + place * second) + place**3
