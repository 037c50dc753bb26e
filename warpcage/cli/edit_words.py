"""Edits in words: `--edit CAGE:POSED:keep`, and edits files, which hold the same as JSON."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import pathlib
import re
from typing import Any

from ..cage.pose_file import is_preset
from ..core.checks import checked_number, listed, warn_caller
from ..core.files import PathLike, atomic_path, read_json, require_file
from ..core.names import edit_fields, edit_words
from ..errors import InputError
from .arguments.options import CAGE_ENDINGS, positive_float

FORMAT, VERSION = "warpcage edits", 1

#: How an edit is written in one word.
EDIT_SHAPE = "CAGE:POSED, CAGE:POSED:keep, CAGE:POSED:falloff=WIDTH or CAGE:remove"

#: Words after the cages.
_LAST_WORD = re.compile(r"(keep|remove)|(falloff|fragments|crumbs|held|object)=([^:]*)")

#: A word that is none of them, after a posed cage: only glTF and pose files hold things with names.
_SLIP = re.compile(r".+\.(?:obj|ply|off):([^:/\\]+)", re.IGNORECASE | re.DOTALL)

#: The cage is what goes up to the first ending of a cage file that a colon or the end follows: so the colon of a
#: Windows drive (C:\cage.obj) separates nothing.
_CAGE = re.compile(rf"(.+?(?:{'|'.join(map(re.escape, CAGE_ENDINGS))}))(?::(.*))?", re.IGNORECASE | re.DOTALL)


@dataclasses.dataclass(frozen=True)
class EditWords:
    """One edit as it is written."""

    cage: str  # file of the cage at rest
    posed: str | None = None  # a cage file, a keyframe of a pose file, or a preset; None for an edit that removes
    keep: bool = False  # leave a copy where it was
    remove: bool = False  # draw nothing in its place
    falloff: float | None = None  # width of the band in which the edit fades to rest, world units
    held: str = "cut"  # the walls that it fades towards: "cut", "still", or numbers of faces between commas
    fragments: float | None = None  # size of the fragments that go with the part, world units
    up: str | None = None  # axis that points up in its cage files; None is that of the format or of --cage-up
    object: str | None = None  # the object of its file that is the cage; None is the only one, or that of --cage-object

    def __post_init__(self) -> None:
        if self.keep and self.remove:
            raise InputError("keep and remove do not go together: choose one")
        if self.remove and self.posed is not None:
            raise InputError(f"what is removed needs no pose, got {self.posed!r}")
        if self.remove and (self.falloff is not None or self.held != "cut"):
            raise InputError("what is removed has no band in which it fades to rest: leave falloff and held out")
        if not self.remove and self.posed is None:
            raise InputError(f"there is no posed cage: write {EDIT_SHAPE}")
        for name in ("falloff", "fragments"):
            value = getattr(self, name)
            if value is not None and checked_number(value, name) < 0.0:
                raise InputError(f"{name} must be 0 or more, got {value:g}")
        _ = self.walls  # refuses others
        if self.up not in (None, "y", "z"):
            raise InputError(f"up must be 'y' or 'z', got {self.up!r}")

    @property
    def walls(self) -> str | tuple[int, ...]:
        """`held` as a CageEdit takes it. Raises ValueError for other words."""
        if self.held in ("cut", "still"):
            return self.held
        try:
            return tuple(int(number) for number in self.held.split(","))
        except ValueError:
            raise InputError(
                f"held must be cut, still, or numbers of faces such as 4,5,17, got {self.held!r}"
            ) from None

    def __str__(self) -> str:
        fragments = f", fragments below {self.fragments:g} go too" if self.fragments else ""
        if self.remove:
            return f"{self.cage}: removed{fragments}"
        copy = ", the source stays (a copy)" if self.keep else ""
        walls = "" if self.held == "cut" else f" (held={self.held})"
        fades = f", fades to rest over {self.falloff:g}{walls}" if self.falloff else ""
        return f"{self.cage} -> {self.posed}{copy}{fades}{fragments}"


def parse_edit(text: str) -> EditWords:
    """An edit of --edit: CAGE:POSED, then ":keep", ":remove", ":falloff=WIDTH", ":held=WALLS", ":fragments=SIZE",
    ":object=NAME"."""
    found = _CAGE.fullmatch(text)
    if found is None:
        raise InputError(f"--edit {text!r} names no cage file ({' '.join(CAGE_ENDINGS)}): write {EDIT_SHAPE}")
    cage, rest = found[1], found[2]
    words: dict[str, Any] = {}
    while rest is not None:
        before, _, last = rest.rpartition(":")
        word = _LAST_WORD.fullmatch(last)
        if word is None or pathlib.Path(rest).exists():
            break
        name = word[1] or word[2]
        if name == "crumbs":
            warn_caller("crumbs= is called fragments= now: the next version knows that name alone")
            name = "fragments"
        words[name] = word[3] if word[2] else True
        rest = before or None
    try:
        if rest is not None and (slip := _SLIP.fullmatch(rest)) and not pathlib.Path(rest).exists():
            raise InputError(
                f"{slip[1]!r} is no word of an edit, only keep, remove, falloff=, held=, fragments= and object="
            )
        words |= {name: positive_float(words[name]) for name in ("falloff", "fragments") if name in words}
        return EditWords(cage, rest or None, **words)
    except (ValueError, argparse.ArgumentTypeError) as error:
        raise InputError(f"--edit {text!r}: {error}") from None


def read_edits_file(path: PathLike) -> list[EditWords]:
    """The edits of an edits file in their order; paths, relative to its folder there, as this process opens them."""
    path = require_file(path, "edits file")
    try:
        content = read_edits_json(path)
        if content.get("format") != FORMAT:
            raise InputError(f"its format is {str(content.get('format'))[:40]!r}, not {FORMAT!r}")
        version, edits = content.get("version"), content.get("edits")
        if type(version) is not int or version < 1:
            raise InputError(f"its version must be a whole number from 1, got {str(version)[:40]!r}")
        if version > VERSION:
            raise InputError(f"its version is {version}, this warpcage reads up to {VERSION}: upgrade")
        if not isinstance(edits, list) or not edits:
            raise InputError("its edits must be a list of at least one edit")
        return [_words(edit, number, path.parent) for number, edit in enumerate(edits, 1)]
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def read_edits_json(path: pathlib.Path) -> dict[str, Any]:
    """What a JSON file holds. Raises ValueError where it is no JSON object."""
    return read_json(path, "edits file")


def write_edits_file(path: PathLike, edits: list[EditWords]) -> None:
    """Write an edits file, whole or not at all; paths are kept relative to its folder where there is a way."""
    folder = pathlib.Path(path).absolute().parent
    content = {"format": FORMAT, "version": VERSION, "edits": [_json(edit, folder) for edit in edits]}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _words(edit: Any, number: int, folder: pathlib.Path) -> EditWords:
    """One edit of a file."""
    try:
        if not isinstance(edit, dict):
            raise InputError(f"it must be an object with a cage, got {type(edit).__name__}")
        known = edit_words({field.name: field for field in dataclasses.fields(EditWords)})
        # what a later version adds has a higher version: an unknown word is a slip, and would be lost in silence
        if unknown := [name for name in edit if name not in known]:
            raise InputError(f"it has no {unknown[0]!r}, only {listed(known)}")
        given = {name: value for name, value in edit.items() if value is not None}
        for name, value in given.items():
            _require_kind(name, value, known[name].type)
        if "cage" not in given:
            raise InputError("it names no cage")
        words = EditWords(**edit_fields(given))
    except ValueError as error:
        raise InputError(f"edit {number}: {error}") from None
    posed = words.posed
    if posed is not None and not is_preset(posed):
        posed = os.path.join(folder, posed)
    return dataclasses.replace(words, cage=os.path.join(folder, words.cage), posed=posed)


def _require_kind(name: str, value: Any, kind: Any) -> None:
    """Raise ValueError where a value of a file is of another kind."""
    if "bool" in str(kind):
        good, wanted = isinstance(value, bool), "true or false"
    elif "float" in str(kind):
        checked_number(value, name)
        return
    else:
        good, wanted = isinstance(value, str) and bool(value), "a text"
    if not good:
        raise InputError(f"{name} must be {wanted}, got {str(value)[:40]!r}")


def _json(edit: EditWords, folder: pathlib.Path) -> dict[str, Any]:
    """An edit as JSON takes it: what differs from the default."""
    posed = edit.posed
    if posed is not None and not is_preset(posed):
        posed = _relative(posed, folder)
    content = dataclasses.asdict(dataclasses.replace(edit, cage=_relative(edit.cage, folder), posed=posed))
    defaults = {field.name: field.default for field in dataclasses.fields(EditWords)}
    return edit_words({name: value for name, value in content.items() if value != defaults[name]})


def _relative(path: str, folder: pathlib.Path) -> str:
    """A path from a folder, with slashes, so that both can be moved together and read on any system."""
    try:
        return pathlib.PurePath(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return os.path.abspath(path)
