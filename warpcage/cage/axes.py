"""Names of directions: world axes, a scene's up, a cage's own axes, and vectors."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from ..errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .cage import Cage

#: The names, for messages.
AXIS_NAMES = "x, y, z, -x, up, long, middle, short, or a direction such as 0,0.2,1"

_NAMED = re.compile("[-+]?([xyz]|up|long|middle|short)")

#: An axis as the methods of Cage take it.
Axis = str | tuple[float, float, float]


def is_axis(text: str) -> bool:
    """Whether a text names a direction or is a vector."""
    return bool(_NAMED.fullmatch(text)) or _vector(text) is not None


def with_up(text: str, up: Sequence[float] | None) -> str:
    """The spec of a pose ("twist:40:up"), or a direction, with "up" as numbers; `up` (3,), None if it is unknown."""
    parts = text.split(":")
    if not {"up", "-up", "+up"} & set(parts):
        return text
    if up is None:
        raise InputError(f"{text!r} needs --up or --object: they say what is up")

    def resolved(part: str) -> str:
        sign = -1.0 if part[0] == "-" else 1.0
        return ",".join(repr(sign * float(value)) for value in up) if part.lstrip("+-") == "up" else part

    return ":".join(map(resolved, parts))


def axis_of(text: str) -> Axis:
    """A direction as the methods of Cage take it: its name, or a vector."""
    found = _vector(text)
    return text if found is None else found


def default_towards(cage: Cage, axis: Axis) -> str:
    """Where a bend along an axis goes unless something else is said: "x", or "z" where the axis lies along x."""
    from ..mesh.mesh import own_axis
    from .poses import direction

    along = direction(own_axis(cage, axis) if isinstance(axis, str) else axis)
    return "z" if abs(along[0]) > 0.9 else "x"


def _vector(text: str) -> tuple[float, float, float] | None:
    """Three finite numbers between commas, not all zero; None for other texts."""
    try:
        x, y, z = (float(number) for number in text.split(","))
    except ValueError:
        return None
    finite = all(abs(value) < float("inf") for value in (x, y, z))
    return (x, y, z) if finite and (x, y, z) != (0.0, 0.0, 0.0) else None
