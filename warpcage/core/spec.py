"""Specs: frozen dataclasses whose fields are options, each described once, for JSON, flags, the page and docs."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any, NamedTuple

from ..errors import InputError
from .names import BACKGROUNDS, TRANSPARENT, checked_choice, listed, shown

# Nothing here needs NumPy, which `warpcage --help` does without.

#: Takes a JSON value and its name in messages; returns the checked value, or raises ValueError.
Checker = Callable[[Any, str], Any]


class Values(NamedTuple):
    """The values that an option takes."""

    check: Checker
    schema: Mapping[str, Any] = {}  # of JSON Schema
    convert: Callable[[str], Any] = str  # makes the value of a flag's text; ValueError leaves that to `check`

    def parse(self, text: str, name: str = "") -> Any:
        """The value that the text of a flag stands for. Raises ValueError for others; name: what messages call it."""
        value: Any = text
        try:
            value = self.convert(text)
        except InputError:
            raise  # it says what would be right
        except (ValueError, OverflowError):
            pass
        with contextlib.suppress(ValueError):
            return self.check(value, name)
        return self.check(text, name)  # which says what would be right

    @property
    def choices(self) -> tuple[str, ...]:
        """The names that it takes, where it takes names alone."""
        return tuple(self.schema.get("enum", ()))


class Option(NamedTuple):
    """A field of a spec."""

    values: Values
    help: str = ""  # what it does, as `--help` and docs have it
    flag: str | None = None  # "--name METAVAR"; None: it has no flag
    default_help: str | None = None  # what the default does; None: the default says it itself
    group: str = ""  # of flags, and of the page's panels
    label: str = ""  # on the editor's page; empty: it has no place there
    labels: Mapping[Any, tuple[str, ...]] = {}  # of values there, with their hints
    since: int = 1  # first version of files that has it

    @property
    def full_help(self) -> str:
        """The help with its default."""
        return self.help if self.default_help == "" else f"{self.help} (default: {self.default_help or '%(default)s'})"


def option(default: Any, values: Values, help: str = "", **described: Any) -> Any:
    """A field of a spec; described: other fields of Option. A default of MISSING makes it a field that is needed."""
    kept: Any = {"default_factory": dict} if default == {} else {"default": default}
    return dataclasses.field(**kept, metadata={"option": Option(values, help, **described)})


def changed(spec: type, name: str, default: Any, **changes: Any) -> Any:
    """An option of a spec with another default, for a spec that is derived of it; changes: of fields of Option."""
    return dataclasses.field(default=default, metadata={"option": options_of(spec)[name]._replace(**changes)})


@functools.cache
def options_of(spec: type) -> dict[str, Option]:
    """The options of a spec by their names, in order."""
    fields = dataclasses.fields(spec)
    return {field.name: field.metadata["option"] for field in fields if "option" in field.metadata}


@functools.cache
def names_of(spec: type, group: str) -> tuple[str, ...]:
    """The names of a group of a spec's options."""
    return tuple(name for name, option in options_of(spec).items() if option.group == group)


@functools.cache
def checkers(spec: type) -> dict[str, Checker]:
    """The check of each option of a spec."""
    return {name: option.values.check for name, option in options_of(spec).items()}


@functools.cache
def defaults_of(spec: type) -> dict[str, Any]:
    """The default of each option of a spec; MISSING where there is none."""
    fields = {field.name: field for field in dataclasses.fields(spec)}
    return {name: {} if fields[name].default_factory is dict else fields[name].default for name in options_of(spec)}


def options_json(spec: Any) -> dict[str, Any]:
    """The options of a spec that differ from their defaults, as JSON takes them."""
    values = ((name, getattr(spec, name), default) for name, default in defaults_of(type(spec)).items())
    return {name: plain(value) for name, value, default in values if value != default}


def schema(spec: type, only: Callable[[Option], Any] = lambda option: True) -> dict[str, Any]:
    """JSON Schema of a spec, with labels and groups for pages; only: which options it has."""
    properties = {}
    for name, option in options_of(spec).items():
        if only(option):
            entry = {"title": option.label or name, "description": option.help, "group": option.group}
            default = defaults_of(spec)[name]
            entry |= {} if default is dataclasses.MISSING else {"default": plain(default)}
            labels = {"labels": [[value, *texts] for value, texts in option.labels.items()]} if option.labels else {}
            properties[name] = entry | dict(option.values.schema) | labels
    return {"type": "object", "properties": properties, "additionalProperties": False}


def checked_keys(entry: Mapping[str, Any], known: Mapping[str, Checker], what: str) -> dict[str, Any]:
    """The values of a JSON object by key, each checked; null is a key that was left out."""
    if not isinstance(entry, Mapping):
        raise InputError(f"{what} must be an object, got {shown(entry)}")
    unknown = next((key for key in entry if key not in known), None)
    if unknown is not None:
        raise InputError(f"{what} has no {shown(unknown)}, only {listed(known, most=40)}")
    return {key: known[key](value, repr(key)) for key, value in entry.items() if value is not None}


def plain(value: Any) -> Any:
    """A value as JSON takes it."""
    if hasattr(value, "to_json"):
        return value.to_json()
    if isinstance(value, Fraction):
        return str(value)
    return [plain(each) for each in value] if isinstance(value, tuple) else value


# Kinds of values


@functools.cache
def _number_check(name: str) -> Callable[..., Any]:
    """A function of `core.checks`, which needs NumPy."""
    return getattr(importlib.import_module(".checks", __package__), name)


def _check(check: str, *limits: float | None) -> Checker:
    return lambda value, name: _number_check(check)(value, name, *limits)


def whole(minimum: int, maximum: int | None = None) -> Values:
    """Whole numbers in a range, None: no limit."""
    return Values(_check("checked_whole", minimum, maximum), {"type": "integer"} | _limits(minimum, maximum), int)


def number(minimum: float | None = None, maximum: float | None = None) -> Values:
    """Finite numbers in a range, None: no limit."""
    return Values(_check("checked_number", minimum, maximum), {"type": "number"} | _limits(minimum, maximum), float)


def positive() -> Values:
    """Finite numbers above 0."""
    return Values(_check("checked_positive"), {"type": "number", "exclusiveMinimum": 0}, float)


def _exact(value: Any, name: str) -> Fraction:
    try:
        # the digits of 1e999999999 would take all memory: a float is bounded, and its text has few digits
        is_ratio = isinstance(value, Fraction) or (isinstance(value, str) and "/" in value)
        found = Fraction(value if is_ratio else repr(float(value)))
    except (ValueError, TypeError, OverflowError, ZeroDivisionError):
        found = Fraction(0)
    if found <= 0 or isinstance(value, bool):
        raise InputError(f"{name} must be positive, a number or a ratio such as 2/3, got {shown(value)}")
    return found


def fraction() -> Values:
    """Numbers above 0, or ratios such as "2/3", exactly."""
    return Values(_exact, {"type": ["string", "number"]})


def _limits(minimum: float | None, maximum: float | None) -> dict[str, float]:
    limits = {"minimum": minimum, "maximum": maximum}
    return {name: value for name, value in limits.items() if value is not None}


def flag() -> Values:
    """True or false."""
    return Values(_check("checked_flag"), {"type": "boolean"})


def one_of(*names: str) -> Values:
    """One of some names."""
    return Values(functools.partial(checked_choice, choices=names), {"enum": list(names)})


def numbers(value: Any, name: str, count: int) -> tuple[float, ...]:
    """As many finite numbers."""
    if not isinstance(value, list | tuple) or len(value) != count:
        raise InputError(f"{name} must be {count} numbers, got {shown(value)}")
    return tuple(_number_check("checked_number")(each, name) for each in value)


def _color(value: Any, name: str, known: tuple[str, ...]) -> Any:
    if isinstance(value, str) and value in known:
        return value
    if isinstance(value, list | tuple):
        color = numbers(value, name, 3)
        if min(color) >= 0.0 and max(color) <= 1.0:
            return color
    what = "a colour, one of" if value == TRANSPARENT else "one of"
    raise InputError(f"{name} must be {what} {', '.join(known)}, or three numbers in [0, 1], got {shown(value)}")


def color_of(text: str) -> Any:
    """A name, or three numbers between commas."""
    parts = text.split(",")
    return text if len(parts) == 1 else tuple(map(float, parts))


def color(*, transparent: bool = False) -> Values:
    """Names of colours, or three numbers in [0, 1]; transparent: or none, so that pictures have opacity."""
    known = (*BACKGROUNDS, TRANSPARENT) if transparent else tuple(BACKGROUNDS)
    unit = {"type": "number", "minimum": 0, "maximum": 1}
    three = {"type": "array", "items": unit, "minItems": 3, "maxItems": 3}
    schema = {"anyOf": [{"enum": list(known)}, three], "format": "color"}
    return Values(functools.partial(_color, known=known), schema, color_of)


def checked_text(value: Any, name: str) -> str:
    """A text that can name a file."""
    try:
        if isinstance(value, str) and value.strip() and "\0" not in value and value.encode():
            return value
    except UnicodeEncodeError:
        pass
    raise InputError(f"{name} must be a text, got {shown(value)}")


def text() -> Values:
    """Texts that can name a file."""
    return Values(checked_text, {"type": "string"})


def anything(value: Any, name: str) -> Any:
    """A checker that takes any JSON."""
    return value
