"""Random poses in the words of items: what they are drawn by, so that whoever makes an item draws its pose."""

from __future__ import annotations

import functools
from typing import Any

from ..cage.random_poses import POSE_MODES, PoseChance
from ..core.checks import shown
from . import words
from .words import Checker, checked_words

#: The word of a pose that is drawn.
RANDOM = "random"


def _pair(value: Any, word: str) -> list[float]:
    return list(words.numbers(value, word, 2))


def _modes(value: Any, word: str) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"{word} must be a list of some of {', '.join(POSE_MODES)}, got {shown(value)}")
    return value


_WORDS: dict[str, Checker] = {
    "seed": words.whole(0),
    "number": words.whole(0),
    "stretch": _pair,
    "reach": _pair,
    "modes": _modes,
}


def drawn_pose(value: Any, word: str) -> dict[str, Any]:
    """The words of a drawn pose, checked, with those that were left out, so that a hash of it is one of the pose.
    value: {"random": {"seed": 0, "number": 12}}; `stretch`, `reach` and `modes` if they are not usual."""
    if set(value) != {RANDOM} or not isinstance(value[RANDOM], dict):
        raise ValueError(f'{word} must be an array, or {{"random": {{"seed": 0, "number": 12}}}}, got {shown(value)}')
    given = checked_words(value[RANDOM], _WORDS, f"{RANDOM!r} of {word}")
    if "number" not in given:
        raise ValueError(f"{RANDOM!r} of {word} needs a 'number', which of the poses of its seed it is")
    bounds = {name: tuple(given[name]) for name in given if name not in ("seed", "number")}
    return {RANDOM: {"seed": given.get("seed", 0), "number": given["number"], **_bounds(**bounds)}}


def drawn_words(chance: PoseChance, number: int) -> dict[str, Any]:
    """The "posed" by which a line of a job file names a random pose: without what is usual."""
    usual, found = _bounds(), _bounds(stretch=chance.stretch, reach=chance.reach, modes=chance.modes)
    own = {name: value for name, value in found.items() if value != usual[name]}
    return {RANDOM: {"seed": chance.seed, "number": number, **own}}


@functools.lru_cache(maxsize=1024)
def _bounds(**words: Any) -> dict[str, list]:
    """Stretch, reach and modes, checked once for all poses that share them."""
    chance = PoseChance(**words)
    return {name: list(getattr(chance, name)) for name in ("stretch", "reach", "modes")}
