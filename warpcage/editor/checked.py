"""Checks of what pages and session files say: nothing of it is trusted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.checks import checked_number

#: Most vertices of a cage, letters of a name, keys of a timeline and seconds of a film: more is not a person's work.
MAX_VERTICES, MAX_NAME, MAX_KEYS, MAX_SECONDS = 20_000, 100, 5_000, 3_600.0
#: Frames per second that a film may have.
MAX_RATE = 240.0
#: Cells of a lattice along the longest side.
RESOLUTIONS = (8, 512)


def frozen_vertices(vertices: Any, count: int | None = None) -> np.ndarray:
    """Vertices as a document holds them.

    Args:
        vertices: (v, 3) numbers.
        count: How many there must be. None takes any number.

    Returns:
        (v, 3) float64, read-only, an array of its own.

    Raises:
        ValueError: For another shape or number, or values that are not finite.
    """
    array = np.array(vertices, dtype=np.float64)
    if array.ndim != 2 or array.shape[1:] != (3,) or (count is not None and len(array) != count):
        wanted = "(v, 3)" if count is None else f"({count}, 3)"
        raise ValueError(f"vertices must be {wanted} numbers, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("vertices must be finite")
    array.setflags(write=False)
    return array


def checked_name(name: Any) -> str:
    """A name in one line. Raises ValueError for another type, an empty one, or a long one."""
    if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
        raise ValueError(f"a name must be 1 to {MAX_NAME} letters")
    return " ".join(name.split())


def checked_choice(value: Any, choices: Sequence[str], what: str) -> str:
    """A value that is one of some words. Raises ValueError for another one."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{what} must be one of {', '.join(choices)}, got {str(value)[:40]!r}")
    return value


def checked_whole(value: Any, low: int, high: int, what: str) -> int:
    """A whole number in a range. Raises ValueError for another one."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{what} must be a whole number from {low} to {high}, got {str(value)[:40]}")
    return value


def checked_between(value: Any, low: float, high: float, what: str) -> float:
    """A number in a range. Raises ValueError for another one."""
    number = checked_number(value, what)
    if not low <= number <= high:
        raise ValueError(f"{what} must be {low:g} to {high:g}, got {number:g}")
    return number


def checked_vertices(numbers: Any, count: int) -> tuple[int, ...]:
    """Numbers of vertices, ascending, each once.

    Args:
        numbers: A list of whole numbers.
        count: Vertices of the cage.

    Returns:
        The numbers.

    Raises:
        ValueError: For anything but whole numbers below `count`.
    """
    given = checked_items(numbers, MAX_VERTICES, "vertices")
    if not all(type(number) is int and 0 <= number < count for number in given):
        raise ValueError(f"vertices must be whole numbers from 0 to {count - 1}")
    return tuple(sorted(set(given)))


def checked_triple(values: Any, what: str) -> tuple[float, float, float]:
    """Three numbers. Raises ValueError for anything else."""
    if isinstance(values, str | bytes) or len(values) != 3:
        raise ValueError(f"{what} must be three numbers")
    x, y, z = (checked_between(value, -1e12, 1e12, what) for value in values)
    return x, y, z


def checked_items(values: Any, most: int, what: str) -> list[Any]:
    """A list of at most so many items. Raises ValueError for anything else."""
    if not isinstance(values, list | tuple) or len(values) > most:
        raise ValueError(f"{what} must be a list of at most {most}")
    return list(values)
