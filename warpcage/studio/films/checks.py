"""Checks of what a page, a session's file or a program says: each gives the value as a document holds it."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Iterable
from typing import Any, NoReturn

import numpy as np

from ...core.checks import checked_number, checked_whole
from ...core.names import PLANES, checked_choice
from ...errors import InputError

#: Most vertices of a cage, letters of a name, keys of a timeline and seconds of a film: more is not a person's work.
MAX_VERTICES, MAX_NAME, MAX_KEYS, MAX_SECONDS = 20_000, 100, 5_000, 3_600.0

#: Most objects of a scene.
MAX_OBJECTS = 32

#: Frames per second that a film may have.
MAX_RATE = 240.0

#: Largest number of a place, world units, either way from zero: its squares and cubes can be held in float32 too.
MAX_PLACE = 1e12

#: Largest number of an edit or a key: a message holds it in 32 bits. New ones are given up to half of it.
MAX_ID = 2**32 - 1

#: Letters of an error's line, and places of a stroke of the brush.
MAX_LINE, MAX_PLACES = 500, 64


#: What the page calls what a step changes, where a document has another name for it.
CHANGED = {
    "visible": "visibility",
    "locked": "lock",
    "place": "position",
    "falloff": "fade",
    "held": "fade at sides",
    "fragments": "loose pieces",
    "supersampling": "samples",
    "show": "what is shown",
    "fps": "frame rate",
    "loop": "end",
}


def changed_names(changes: Iterable[str]) -> str:
    """What a step changes, as the page names it."""
    return ", ".join(CHANGED.get(name, name) for name in changes)


def frozen_vertices(vertices: Any, count: int | None = None) -> np.ndarray:
    """Vertices (v, 3), an array or lists of numbers, as a document holds them: float64, read-only, an array of its own.
    `count`: how many there must be; None takes any number."""
    if not isinstance(vertices, np.ndarray):
        if not isinstance(vertices, list | tuple) or not all(map(_is_row, vertices)):
            raise InputError("vertices must be a list of three numbers each")
    try:
        array = np.array(vertices, dtype=np.float64)
    except OverflowError:
        raise InputError("vertices must be finite") from None
    if array.ndim != 2 or array.shape[1:] != (3,) or (count is not None and len(array) != count):
        wanted = "(v, 3)" if count is None else f"({count}, 3)"
        raise InputError(f"vertices must be {wanted} numbers, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise InputError("vertices must be finite")
    if array.size and np.abs(array).max() > MAX_PLACE:
        raise InputError(f"vertices must be within {MAX_PLACE:g} of zero")
    array.setflags(write=False)
    return array


def checked_name(name: Any) -> str:
    """A name in one line. Raises ValueError for another type, an empty one, a long one, or what cannot be printed."""
    if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
        raise InputError(f"a name must be 1 to {MAX_NAME} letters")
    name = " ".join(name.split())
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
        raise InputError("a name must be letters that can be printed")
    return name


def checked_id(value: Any, what: str) -> int:
    """The number of an edit, a key or a job. Raises ValueError for anything else; True is no number."""
    return checked_whole(value, what, 1, MAX_ID)


def checked_vertices(numbers: Any, count: int) -> tuple[int, ...]:
    """Numbers of vertices of a cage that has `count`, ascending, each once."""
    given = checked_items(numbers, MAX_VERTICES, "vertices")
    if not all(type(number) is int and 0 <= number < count for number in given):
        raise InputError(f"vertices must be whole numbers from 0 to {count - 1}")
    return tuple(sorted(set(given)))


def checked_triple(values: Any, what: str) -> tuple[float, float, float]:
    """Three numbers. Raises ValueError for anything else."""
    if not isinstance(values, list | tuple) or len(values) != 3:
        raise InputError(f"{what} must be three numbers")
    x, y, z = (checked_number(value, what, -MAX_PLACE, MAX_PLACE) for value in values)
    return x, y, z


def checked_items(values: Any, most: int, what: str) -> list[Any]:
    """A list of at most so many items. Raises ValueError for anything else."""
    if not isinstance(values, list | tuple | np.ndarray) or len(values) > most:
        raise InputError(f"{what} must be a list of at most {most}")
    return list(values)


def checked_click(content: Any) -> tuple[list[tuple[float, float]], float, str | None]:
    """Where a person clicked or painted: places (shares of the picture across and down), its aspect, and the plane."""
    if not isinstance(content, dict):
        raise InputError("click must hold across, down, aspect and plane")
    given = content.get("places", [[content.get("across"), content.get("down")]])
    places = []
    for place in checked_items(given, MAX_PLACES, "places"):
        if len(checked_items(place, 2, "a place")) != 2:
            raise InputError("a place in the picture must be two numbers, across and down")
        across, down = place
        places.append((checked_number(across, "across", 0.0, 1.0), checked_number(down, "down", 0.0, 1.0)))
    aspect = checked_number(content.get("aspect"), "aspect", 0.05, 20.0)
    plane = checked_choice(content.get("plane"), "plane", (*PLANES, "none"))
    return places, aspect, None if plane == "none" else plane


def parsed_json(text: str) -> Any:
    """What a text in JSON says; NaN and Infinity, which Python writes, are no JSON."""
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError:
        raise InputError("lists within lists within lists go too deep") from None


def _is_row(row: Any) -> bool:
    return isinstance(row, list | tuple | np.ndarray) and not any(
        isinstance(x, bool | str | list | dict | None) for x in row
    )


def _refuse_constant(name: str) -> NoReturn:
    raise InputError(f"{name} is no number in JSON")
