"""Names that options take, and texts of messages that depend on a number or on an error."""

from __future__ import annotations

import contextlib
import functools
import os
import pathlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypeVar, get_args

from ..coordinate_kinds import COORDINATE_KINDS, CoordinateKind, Coordinates
from ..easings import EASING_KINDS
from ..easings import Easing as Easing
from ..errors import Error, InputError

_Choice = TypeVar("_Choice")

#: Letters of a value or a name that a message shows.
MAX_SHOWN = 60

#: Kinds of coordinates, as `coordinates=` takes them (coordinate_kinds.py).
COORDINATES: tuple[str, ...] = tuple(COORDINATE_KINDS)

#: Their defaults: of what poses a field, as the paper has it, and of points, which may lie outside of a cage.
FIELD_COORDINATES: Coordinates = "harmonic"
POINT_COORDINATES: Coordinates = "mean_value"

#: What happens to points outside of a cage, as `outside=` takes them.
OUTSIDE = ("extend", "raise", "nan")

#: How a sample's density follows an edit, as `density=` takes them.
Density: TypeAlias = Literal["opacity", "paper"]
DENSITIES: tuple[str, ...] = get_args(Density)

#: What a map on a lattice keeps, as `store=` takes them.
Store: TypeAlias = Literal["map", "weights"]
STORES: tuple[str, ...] = get_args(Store)

#: Keys of edits in files up to version 0.2, by their names now; see `renamed_keys`.
OLD_KEYS = {"fragments": "crumbs"}

#: How splats follow a cage, as `map=` takes them.
SplatMap: TypeAlias = Literal["forward", "backward"]
SPLAT_MAPS: tuple[str, ...] = get_args(SplatMap)

#: Qualities of a fit, as `quality=` takes them; `fitting.options` says what each sets.
Quality: TypeAlias = Literal["fast", "standard", "high"]
QUALITIES: tuple[str, ...] = get_args(Quality)

#: Most frames of a film, more than 11 hours at 24 a second, and most rays along each side of a pixel.
MAX_FRAMES, MAX_SUPERSAMPLING = 1_000_000, 8

#: Colours behind a picture, by name.
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.5, 0.5, 0.5), "gray": (0.5, 0.5, 0.5)}

#: The name of no background: pictures with opacity.
TRANSPARENT = "transparent"

#: What may stand behind a field while it is fitted: a new random colour for every ray, an outer field or
#: background layers that are fitted too, the scene's one colour, or whichever of these the pictures suggest.
FIT_BACKGROUNDS = ("auto", "outer", "layers", "random", "constant")

#: Names of easings (easings.py), and what stands in place of one for a curve of one's own.
EASINGS: tuple[str, ...] = tuple(EASING_KINDS)
CURVE = '{"bezier": [x1, y1, x2, y2]}'

#: Moves of a film's camera by name with their default amounts, and their help.
MOVES = {"turn": 360.0, "dolly": 0.6, "crane": 25.0, "hand-held": 0.0, "follow": 0.0}
MOVE_HELP = "turn[:DEGREES], dolly[:SHARE], crane[:DEGREES], hand-held[:SEED] or follow[:PART], several joined by +"

#: What something in a scene stands on: what is level, what is upright, or either.
PLANES = ("ground", "wall", "any")

#: What a film does at its end.
LOOPS = ("once", "loop", "ping-pong")


def checked_choice(value: object, name: str, choices: Sequence[str]) -> str:
    """A value that is one of the names that an option takes."""
    if not isinstance(value, str) or value not in choices:
        got = " ".join(repr(value)[:60].split())
        raise InputError(f"{name} must be one of {', '.join(choices)}, got {got}{meant(value, choices)}")
    return value


def meant(value: object, names: Iterable[str]) -> str:
    """What ends a message, such as ", did you mean green?": empty where none of the names is near to a value."""
    import difflib

    near = difflib.get_close_matches(value, names, 1) if isinstance(value, str) and len(value) <= 60 else []
    return f", did you mean {near[0]}?" if near else ""


def chosen(value: object, what: str, **choices: _Choice) -> _Choice:
    """What stands for a name among `choices`, one for each name that the caller can work with; others are refused."""
    return choices[checked_choice(value, what, tuple(choices))]


def coordinate_kind(name: object) -> CoordinateKind:
    """The kind of coordinates of a name; others are refused."""
    return COORDINATE_KINDS[checked_choice(name, "coordinates", COORDINATES)]


require_store = functools.partial(checked_choice, name="store", choices=STORES)


def renamed_keys(content: Any, names: Mapping[str, str] = OLD_KEYS) -> Any:
    """An object of JSON with the keys of older files by their names now; what is no object stays as it is."""
    if not isinstance(content, Mapping) or not any(old in content for old in names.values()):
        return content
    twice = next((new for new, old in names.items() if new in content and old in content), None)
    if twice is not None:
        raise InputError(f"{names[twice]!r} is the old name of {twice!r}: give one of them")
    now = {old: new for new, old in names.items()}
    return {now.get(key, key): value for key, value in content.items()}


def older_keys(content: Any) -> Any:
    """JSON with all keys as the first versions of files had them."""
    if isinstance(content, dict):
        return {OLD_KEYS.get(key, key): older_keys(value) for key, value in content.items()}
    return [older_keys(value) for value in content] if isinstance(content, list) else content


def listed(names: Iterable[Any], most: int = 8, *, none: str = "none") -> str:
    """Names in a message, long ones cut: the first `most` of them, and how many more there are."""
    texts = [str(name) for name in names]
    return (", ".join(map(_cut, texts[:most])) or none) + (
        f" and {len(texts) - most} more" if len(texts) > most else ""
    )


def shown(value: object) -> str:
    """A value in a message: its `repr` in one line, cut where it is long."""
    if isinstance(value, str):
        value = value[: 2 * MAX_SHOWN]  # however long it is
    try:
        return _cut(" ".join(repr(value).split()))
    except ValueError:  # a whole number of too many digits
        return f"a number of type {type(value).__name__}"


def _cut(text: str) -> str:
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def counted(count: int, noun: str, plural: str = "") -> str:
    """A count and its noun, such as "1 frame" or "2 frames"; an empty plural adds an "s"."""
    return f"{count} {agreed(count, noun, plural or f'{noun}s')}"


def agreed(count: int, one: str, several: str) -> str:
    """The singular, such as "is", or the plural, such as "are"."""
    return one if count == 1 else several


def install_line(missing: str, root: str) -> str:
    """What an import without some of its needs says; missing: their names, root: the folder above the package."""
    return f"warpcage needs {missing}: pip install {_checkout(root) or missing}"


def extra_line(extra: str = "") -> str:
    """The command that installs the package with an extra."""
    name = f"[{extra}]" if extra else ""
    # without a checkout the package is installed, and pip takes its extras from there: no index needs to know it
    return f"pip install {_checkout(str(pathlib.Path(__file__).parents[2]), name) or repr(f'warpcage{name}')}"


def _checkout(root: str, extras: str = "") -> str:
    """What pip installs a checkout with all its dependencies by, those that are imported later too; "" for none."""
    import shlex

    return f"-e {shlex.quote(root + extras)}" if os.path.isfile(os.path.join(root, "setup.py")) else ""


def error_line(error: object, limit: int | None = None, *, named: bool = False, folders: bool = True) -> str:
    """What went wrong in one line, such as "no space left on device 'film.mp4'", cut to `limit` letters.
    named: say the kind of an error that is no sentence for users; folders: names of files with their folders."""
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.strerror:
        name = os.fsdecode(error.filename) if error.filename else ""
        name = name if folders else pathlib.PurePath(name).name
        text = f"{error.strerror[0].lower()}{error.strerror[1:]}{f' {name!r}' if name else ''}"
    elif isinstance(error, MemoryError):
        text = f"not enough memory{': ' if text else ''}{text}"
    elif named and not (text and isinstance(error, (Error, ValueError, FileNotFoundError))):
        text = f"{type(error).__name__}{': ' if text else ''}{text}"
    elif isinstance(error, KeyError):
        text = f"{text[:60] or repr('')} is missing"
    return text[:limit] or type(error).__name__


@contextlib.contextmanager
def named_errors(what: str) -> Iterator[None]:
    """Put a name before what is wrong."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{what}: {error}") from error


def picture_stem(name: str) -> str:
    """The name of a picture without its ending; `.1` is none."""
    return re.sub(r"\.[A-Za-z]\w*$", "", name)
