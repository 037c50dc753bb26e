"""Edits of frames, in the words of items."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from ..core.checks import shown
from ..core.names import FRAGMENTS_WORD, edit_fields, edit_words
from . import words
from .words import Checker, checked_words, drawn_pose, one_of, plain, text


def _cage(value: Any, word: str) -> Any:
    if isinstance(value, dict):
        if set(value) != {"vertices", "faces"}:
            raise ValueError(f'{word} must be a cage file, or "vertices" and "faces", got {shown(value)}')
        return {name: _array(each, f"{name!r} of {word}") for name, each in value.items()}
    return text(value, word)


def _array(value: Any, word: str) -> Any:
    if isinstance(value, list) and value:
        return value
    if isinstance(value, str) and value:
        return text(value, word)
    raise ValueError(f'{word} must be an array: "file.npy", "file.npy#17" or a list of [x, y, z], got {shown(value)}')


def _posed(value: Any, word: str) -> Any:
    return drawn_pose(value, word) if isinstance(value, dict) else _array(value, word)


def _held(value: Any, word: str) -> Any:
    if value in ("cut", "still"):
        return value
    if isinstance(value, str):
        try:
            value = [int(part) for part in value.split(",")]
        except ValueError:
            value = None
    if isinstance(value, list | tuple) and value and all(type(each) is int and each >= 0 for each in value):
        return tuple(value)
    raise ValueError(f'{word} must be "cut", "still", or numbers of faces such as [4, 5, 17], got {shown(value)}')


EDIT_WORDS: dict[str, Checker] = {
    "cage": _cage,
    "posed": _posed,
    "keep": words.truth,
    "remove": words.truth,
    "falloff": words.not_negative,
    "held": _held,
    FRAGMENTS_WORD: words.not_negative,
    "up": one_of("y", "z"),
    "object": text,
}


@dataclasses.dataclass(frozen=True)
class EditWords:
    """One edit of a frame, with the words of `warpcage.CageEdit`."""

    cage: Any  # at rest: a file, or "vertices" and "faces"
    posed: Any = None  # file, keyframe ("poses.json#wave"), array, or what a random pose is drawn by; None removes
    keep: bool = False  # keep: leave a copy where it was; remove: draw nothing in its place
    remove: bool = False
    falloff: float = 0.0  # width of the band in which the edit fades to rest, world units
    held: str | tuple[int, ...] = "cut"  # the walls that it fades towards: "cut", "still", or numbers of faces
    fragments: float = 0.0  # size of the fragments that go with the part, world units
    up: str | None = None  # axis that points up in its cage files; None finds it
    object: str | None = None  # the object of its file that is the cage; None is the only one

    def __post_init__(self) -> None:
        if self.keep and self.remove:
            raise ValueError("'keep' and 'remove' do not go together: choose one")
        if self.remove and self.posed is not None:
            raise ValueError("what is removed needs no 'posed'")
        if self.remove and (self.falloff or self.held != "cut"):
            raise ValueError("what is removed has no band in which it fades to rest: leave 'falloff' and 'held' out")
        if not self.remove and self.posed is None:
            raise ValueError("'cage' needs 'posed', the same cage posed, or \"remove\": true")
        if self.held != "cut" and not self.falloff:
            raise ValueError("'held' names the walls that an edit fades towards: give it a 'falloff' too")

    @classmethod
    def from_json(cls, entry: Any, what: str) -> EditWords:
        """An edit from JSON; what: how messages call it. Raises ValueError for words that cannot be."""
        if not isinstance(entry, Mapping):
            raise ValueError(f"{what} must be an object with a cage, got {shown(entry)}")
        given = checked_words(entry, EDIT_WORDS, what)
        if "cage" not in given:
            raise ValueError(f"{what} needs a 'cage'")
        return cls(**edit_fields(given))

    def to_json(self) -> dict[str, Any]:
        """The edit as JSON: what differs from the default."""
        fields = ((field.name, getattr(self, field.name), field.default) for field in dataclasses.fields(self))
        return edit_words({name: plain(value) for name, value, default in fields if value != default})

    @property
    def is_drawn(self) -> bool:
        """Whether its pose is drawn by whoever makes it."""
        return isinstance(self.posed, dict)

    @property
    def rest(self) -> dict[str, Any]:
        """The edit without its pose."""
        return {name: value for name, value in self.to_json().items() if name != "posed"}
