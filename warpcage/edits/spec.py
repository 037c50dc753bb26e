"""Specs in files: checks of JSON values, the spec of an edit, and references to poses."""

from __future__ import annotations

import dataclasses
import functools
import json
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, get_type_hints

from ..cage.random_poses import POSE_MODES, RandomPoseOptions
from ..core.checks import checked_flag, checked_number, checked_whole, listed, shown
from ..core.names import BACKGROUNDS, TRANSPARENT, checked_choice, renamed_keys
from ..errors import InputError

#: Takes a JSON value and its name in messages; returns the checked value.
Checker = Callable[[Any, str], Any]

#: Names of items and outputs: parts between slashes, none of which is hidden or leads up.
_PART = re.compile(r"\w[\w.\-]*")

_NAME = re.compile(r"\w[\w.\-]*(?:/\w[\w.\-]*)*", re.ASCII)

#: A file, and a part of its content.
_PLACE = re.compile(r"(.+\.(npy|json|glb|gltf))#(.+)", re.IGNORECASE | re.DOTALL)

#: Longest part of such a name in bytes, which leaves room for a temporary name, and longest name.
MAX_PART, MAX_SAFE_NAME = 200, 1000


def safe_name(value: Any, name: str) -> str:
    """A name below a folder: letters, digits, `_`, `-` and `.` between slashes."""
    if isinstance(value, str) and len(value) <= MAX_PART and _NAME.fullmatch(value):
        return value  # as nearly all are
    parts = value.split("/") if isinstance(value, str) else [""]
    good = all(_PART.fullmatch(part) and len(part.encode("utf-8", "replace")) <= MAX_PART for part in parts)
    if not good or len(value) > MAX_SAFE_NAME:
        raise InputError(
            f'{name} must be a relative name of letters, digits, "_", "-" and ".", with "/" between folders, '
            f'such as "shot/frame_0001", got {shown(value)}'
        )
    return value


def text(value: Any, name: str) -> str:
    """A text that can name a file."""
    try:
        if isinstance(value, str) and value.strip() and "\0" not in value and value.encode():
            return value
    except UnicodeEncodeError:
        pass
    raise InputError(f"{name} must be a text, got {shown(value)}")


def numbers(value: Any, name: str, count: int) -> tuple[float, ...]:
    """As many finite numbers."""
    if not isinstance(value, list | tuple) or len(value) != count:
        raise InputError(f"{name} must be {count} numbers, got {shown(value)}")
    return tuple(checked_number(each, name) for each in value)


def background(value: Any, name: str) -> Any:
    """The colour behind a picture, or none."""
    if isinstance(value, str) and value in (*BACKGROUNDS, TRANSPARENT):
        return value
    if isinstance(value, list | tuple):
        color = numbers(value, name, 3)
        if min(color) >= 0.0 and max(color) <= 1.0:
            return color
    known = ", ".join((*BACKGROUNDS, TRANSPARENT))
    raise InputError(f"{name} must be one of {known}, or three numbers in [0, 1], got {shown(value)}")


def color(value: Any, name: str) -> Any:
    """A colour."""
    if value == TRANSPARENT:
        raise InputError(f"{name} must be a colour, got {value!r}")
    return background(value, name)


not_negative: Checker = functools.partial(checked_number, minimum=0.0)


def one_of(*names: str) -> Checker:
    """A checker of names."""
    return functools.partial(checked_choice, choices=names)


def whole(minimum: int, maximum: int | None = None) -> Checker:
    """A checker of whole numbers in a range."""
    return functools.partial(checked_whole, minimum=minimum, maximum=maximum)


def anything(value: Any, name: str) -> Any:
    """Any JSON."""
    return value


def checked_keys(entry: Mapping[str, Any], known: Mapping[str, Checker], what: str) -> dict[str, Any]:
    """The values of a JSON object by key, each checked; null is a key that was left out."""
    if not isinstance(entry, Mapping):
        raise InputError(f"{what} must be an object, got {shown(entry)}")
    unknown = next((key for key in entry if key not in known), None)
    if unknown is not None:
        raise InputError(f"{what} has no {shown(unknown)}, only {listed(known, most=40)}")
    return {key: known[key](value, repr(key)) for key, value in entry.items() if value is not None}


def split_reference(reference: str) -> tuple[str, str]:
    """The file and the place of a reference "file#place" to a .npy, .json or glTF file; "" for all of the file."""
    found = _PLACE.fullmatch(reference)
    return (found[1], found[3]) if found else (reference, "")


def plain(value: Any) -> Any:
    """A value as JSON takes it."""
    if hasattr(value, "to_json"):
        return value.to_json()
    return [plain(each) for each in value] if isinstance(value, tuple) else value


def canonical(value: Any) -> str:
    """The canonical text of a JSON value: sorted keys and no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)


#: The key of a pose that is drawn at random.
RANDOM = "random"


def _pair(value: Any, name: str) -> list[float]:
    return list(numbers(value, name, 2))


def _modes(value: Any, name: str) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise InputError(f"{name} must be a list of some of {', '.join(POSE_MODES)}, got {shown(value)}")
    return value


_RANDOM: dict[str, Checker] = {"seed": whole(0), "number": whole(0), "stretch": _pair, "reach": _pair, "modes": _modes}


def drawn_pose(value: Any, name: str) -> dict[str, Any]:
    """The spec of a random pose, checked, with its defaults, so that equal poses have equal hashes.
    value: {"random": {"seed": 0, "number": 12}}, and `stretch`, `reach` and `modes` that are not the default."""
    if set(value) != {RANDOM} or not isinstance(value[RANDOM], dict):
        raise InputError(f'{name} must be an array, or {{"random": {{"seed": 0, "number": 12}}}}, got {shown(value)}')
    given = checked_keys(value[RANDOM], _RANDOM, f"{RANDOM!r} of {name}")
    if "number" not in given:
        raise InputError(f"{RANDOM!r} of {name} needs a 'number', which of the poses of its seed it is")
    bounds = {name: tuple(given[name]) for name in given if name not in ("seed", "number")}
    return {RANDOM: {"seed": given.get("seed", 0), "number": given["number"], **_bounds(**bounds)}}


def drawn_pose_spec(chance: RandomPoseOptions, number: int) -> dict[str, Any]:
    """The "posed" by which a line of a job file names a random pose: without defaults."""
    defaults, found = _bounds(), _bounds(stretch=chance.stretch, reach=chance.reach, modes=chance.modes)
    changed = {name: value for name, value in found.items() if value != defaults[name]}
    return {RANDOM: {"seed": chance.seed, "number": number, **changed}}


@functools.lru_cache(maxsize=1024)
def _bounds(**options: Any) -> dict[str, list]:
    """Stretch, reach and modes, checked once for all poses that share them."""
    chance = RandomPoseOptions(**options)
    return {name: list(getattr(chance, name)) for name in ("stretch", "reach", "modes")}


def _cage(value: Any, name: str) -> Any:
    if isinstance(value, dict):
        if set(value) != {"vertices", "faces"}:
            raise InputError(f'{name} must be a cage file, or "vertices" and "faces", got {shown(value)}')
        return {name: _array(each, f"{name!r} of {name}") for name, each in value.items()}
    return text(value, name)


def _array(value: Any, name: str) -> Any:
    if isinstance(value, list) and value:
        return value
    if isinstance(value, str) and value:
        return text(value, name)
    raise InputError(f'{name} must be an array: "file.npy", "file.npy#17" or a list of [x, y, z], got {shown(value)}')


def _posed(value: Any, name: str) -> Any:
    return drawn_pose(value, name) if isinstance(value, dict) else _array(value, name)


def held_walls(value: Any, name: str) -> str | tuple[int, ...]:
    """The walls that an edit fades towards: "cut", "still", or numbers of faces, in a list or between commas."""
    if value in ("cut", "still"):
        return value
    if isinstance(value, str):
        try:
            value = [int(part) for part in value.split(",")]
        except ValueError:
            value = None
    if isinstance(value, list | tuple) and value and all(type(each) is int and each >= 0 for each in value):
        return tuple(value)
    raise InputError(f'{name} must be "cut", "still", or numbers of faces such as [4, 5, 17], got {shown(value)}')


@dataclasses.dataclass(frozen=True)
class EditSpec:
    """One edit with the names of `warpcage.CageEdit`, in job files, edits files and --edit."""

    cage: Annotated[Any, _cage]  # at rest: a file, or "vertices" and "faces"
    posed: Annotated[Any, _posed] = None  # file, keyframe ("poses.json#wave"), array, or what draws it; None removes
    keep: Annotated[bool, checked_flag] = False  # keep: leave a copy where it was; remove: draw nothing in its place
    remove: Annotated[bool, checked_flag] = False
    falloff: Annotated[float | None, not_negative] = None  # width of the band in which it fades to rest, world units
    held: Annotated[str | tuple[int, ...], held_walls] = "cut"  # walls that it fades towards: "cut", "still", or faces
    fragments: Annotated[float | None, not_negative] = None  # size of what goes with the part too, world units
    up: Annotated[str | None, one_of("y", "z")] = None  # axis that points up in its cage files; None finds it
    object: Annotated[str | None, text] = None  # the object of its file that is the cage; None is the only one

    def __post_init__(self) -> None:
        if self.keep and self.remove:
            raise InputError("'keep' and 'remove' do not go together: choose one")
        if self.remove and self.posed is not None:
            raise InputError("'remove' needs no 'posed': leave it out")
        if self.remove and (self.falloff or self.held != "cut"):
            raise InputError("'remove' goes without 'falloff' and 'held': leave them out")
        if not self.remove and self.posed is None:
            raise InputError("'cage' needs 'posed', the same cage posed, or \"remove\": true")

    def __str__(self) -> str:
        fragments = f", fragments below {self.fragments:g} go too" if self.fragments else ""
        if self.remove:
            return f"{self.cage}: removed{fragments}"
        copy = ", the source stays (a copy)" if self.keep else ""
        walls = "" if self.held == "cut" else f" (held={self.held_text})"
        fades = f", fades to rest over {self.falloff:g}{walls}" if self.falloff else ""
        return f"{self.cage} -> {self.posed}{copy}{fades}{fragments}"

    @property
    def held_text(self) -> str:
        """`held` as text: numbers of faces between commas."""
        return self.held if isinstance(self.held, str) else ",".join(map(str, self.held))

    @classmethod
    def from_json(cls, entry: Any, what: str) -> EditSpec:
        """An edit from JSON; what: its name in messages. Raises ValueError for keys and values that cannot be."""
        try:
            if not isinstance(entry, Mapping):
                raise InputError(f"it must be an object with a cage, got {shown(entry)}")
            given = checked_keys(renamed_keys(entry), EDIT_KEYS, "it")
            if "cage" not in given:
                raise InputError("it names no cage")
            return cls(**given)
        except ValueError as error:
            raise InputError(f"{what}: {error}") from None

    def to_json(self) -> dict[str, Any]:
        """The edit as JSON: what differs from the default; a width of 0 is the same as None."""
        fields = ((field.name, getattr(self, field.name), field.default) for field in dataclasses.fields(self))
        return {name: plain(value) for name, value, default in fields if value not in (default, 0.0)}

    @property
    def is_drawn(self) -> bool:
        """Whether its pose is drawn at random."""
        return isinstance(self.posed, dict)

    @property
    def rest(self) -> dict[str, Any]:
        """The edit without its pose."""
        return {name: value for name, value in self.to_json().items() if name != "posed"}


def checkers(fields: type) -> dict[str, Checker]:
    """The checker of each field of a class, from its annotation."""
    hints = get_type_hints(fields, include_extras=True).items()
    return {name: hint.__metadata__[0] for name, hint in hints if hasattr(hint, "__metadata__")}


EDIT_KEYS = checkers(EditSpec)
