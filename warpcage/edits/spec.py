"""The spec of an edit in files, and what its JSON refers to: names of files, and poses that are drawn at random."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..core.names import renamed_keys, shown
from ..core.spec import (
    Checker,
    Values,
    checked_keys,
    checked_text,
    checkers,
    flag,
    number,
    numbers,
    one_of,
    option,
    options_json,
    text,
    whole,
)
from ..errors import InputError

if TYPE_CHECKING:
    from ..cage.random_poses import RandomPoseOptions

#: Names of items and outputs: parts between slashes, none of which is hidden or leads up.
_PART = re.compile(r"\w[\w.\-]*")

_NAME = re.compile(r"\w[\w.\-]*(?:/\w[\w.\-]*)*", re.ASCII)

#: A file of arrays, keyframes or cameras, and the key of one of them.
_REFERENCE = re.compile(r"(.+\.(npy|json|glb|gltf|usd[ac]?|pc2|mdd))#(.+)", re.IGNORECASE | re.DOTALL)

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


def split_reference(reference: str) -> tuple[str, str]:
    """The file and the key of a reference "file#key" to an array, poses or cameras; "" for all of the file."""
    found = _REFERENCE.fullmatch(reference)
    return (found[1], found[3]) if found else (reference, "")


def canonical(value: Any) -> str:
    """The canonical text of a JSON value: sorted keys and no spaces."""
    return _encoder().encode(value)


@functools.cache
def _encoder() -> Any:
    import json  # which help does without

    return json.JSONEncoder(sort_keys=True, separators=(",", ":"))


#: The key of a pose that is drawn at random.
RANDOM = "random"


def _modes(value: Any, name: str) -> list[str]:
    from ..cage.random_poses import POSE_MODES  # with NumPy

    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise InputError(f"{name} must be a list of some of {', '.join(POSE_MODES)}, got {shown(value)}")
    return value


_RANDOM: dict[str, Checker] = {
    **dict.fromkeys(("seed", "number"), whole(0).check),
    **dict.fromkeys(("stretch", "reach"), functools.partial(numbers, count=2)),
    "modes": _modes,
}


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
    from ..cage.random_poses import RandomPoseOptions  # with NumPy

    chance = RandomPoseOptions(**options)
    return {name: list(getattr(chance, name)) for name in ("stretch", "reach", "modes")}


def _cage(value: Any, name: str) -> Any:
    if isinstance(value, dict):
        if set(value) != {"vertices", "faces"}:
            raise InputError(f'{name} must be a cage file, or "vertices" and "faces", got {shown(value)}')
        return {name: _array(each, f"{name!r} of {name}") for name, each in value.items()}
    return checked_text(value, name)


def _array(value: Any, name: str) -> Any:
    if isinstance(value, list) and value:
        return value
    if isinstance(value, str) and value:
        return checked_text(value, name)
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

    cage: Any = option(
        dataclasses.MISSING, Values(_cage), "the cage at rest: a file, or an object of `vertices` and `faces`"
    )
    posed: Any = option(
        None,
        Values(_posed),
        "the same cage posed: a file, a keyframe (`poses.json#wave`), an array, or what draws it at random",
    )
    keep: bool = option(False, flag(), "leave a copy where it was")
    remove: bool = option(False, flag(), "draw nothing in its place; such an edit has no `posed`")
    falloff: float | None = option(
        None,
        number(0.0),
        "hold the sides of a cage that cut through the object, and fade the edit out in a band of this width inside "
        "them, world units, so that a part does not tear off",
        flag="--falloff WIDTH",
        default_help="no side is held",
    )
    held: str | tuple[int, ...] = option(
        "cut", Values(held_walls), 'walls that it fades towards: "cut", "still", or numbers of faces'
    )
    fragments: float | None = option(
        None,
        number(0.0),
        "take loose pieces that a cage cuts off along with its part, up to this size, world units",
        flag="--fragments SIZE",
        default_help="they stay",
    )
    up: str | None = option(None, one_of("y", "z"), "axis that points up in its cage files", default_help="it is found")
    object: str | None = option(None, text(), "the object that is the cage in a file of several")

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
        return {name: value for name, value in options_json(self).items() if value != 0.0}

    @property
    def rest(self) -> dict[str, Any]:
        """The edit without its pose."""
        return {name: value for name, value in self.to_json().items() if name != "posed"}


EDIT_KEYS = checkers(EditSpec)
