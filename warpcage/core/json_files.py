"""JSON files of the project: what is wrong with one, in words for who gave it."""

from __future__ import annotations

import json
from typing import Any

from .files import JSON_ROOM, PathLike, read_limited

#: What taking apart the contents of a file raises that is not as it should be.
DAMAGED = (KeyError, TypeError, AttributeError, OverflowError, RecursionError)


def read_json(path: PathLike, what: str) -> dict[str, Any]:
    """The object that a JSON file holds; a ValueError says what is wrong without the path."""
    data = read_limited(path, what, JSON_ROOM)
    try:
        content = json.loads(data.decode("utf-8"))
    except UnicodeDecodeError:
        raise ValueError(f"{not_a(what)}: it holds no text") from None
    except RecursionError:
        raise ValueError(f"{not_a(what)}: its JSON is nested too deeply") from None
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        wrong = f"its JSON breaks off or is damaged at {place}" if data.strip() else "it is empty"
        raise ValueError(f"{not_a(what)}: {wrong}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{not_a(what)}: it holds no JSON object")
    return content


def damage(what: str, error: Exception) -> str:
    """One line for an error of `DAMAGED`."""
    if isinstance(error, KeyError):
        return f"{not_a(what)}: it lacks {error.args[0]!r}"
    return f"{not_a(what)}: something in it is of another kind than it should be ({error})"


def not_a(what: str) -> str:
    """The beginning of the message."""
    return f"not {'an' if what[0] in 'aeiou' else 'a'} {what}"
