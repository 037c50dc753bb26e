"""Items of lines of a job file, wherever those are read: workers get them as they stand."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping
from typing import Any

from ..core.checks import shown
from .items import Defaults, Item


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")


_DECODER = json.JSONDecoder(parse_constant=_no_constant)


@dataclasses.dataclass(frozen=True)
class ItemReader:
    """Makes items of the lines of a job file, in any process."""

    # for messages
    path: str
    # what holds where an item says nothing
    defaults: dict[str, Any]
    # how outputs are kept together
    records: dict[str, Any]

    @functools.cached_property
    def _usual(self) -> Defaults:
        return Defaults(self.defaults)

    def item(self, data: bytes, line: int) -> Item:
        """The item of a line, with what it takes from the header; line: its number, from 1, for messages."""
        entry = parsed_line(data, f"{self.path}, line {line}")
        try:
            return checked_item(entry, self._usual, self.records)
        except ValueError as error:
            name = f" ({shown(entry['id'])})" if isinstance(entry.get("id"), str) else ""
            raise ValueError(f"{self.path}, line {line}{name}: {error}") from None


def parsed_line(data: bytes, where: str, *, first: bool = False) -> dict[str, Any]:
    """The JSON object of a line; where: file and line, for messages.
    first: whether it is the first of its file, which may begin with a mark of its encoding."""
    try:
        text = data.decode("utf-8-sig" if first else "utf-8")
        content = _DECODER.decode(text)
    except UnicodeDecodeError:
        raise ValueError(f"{where}: it holds no text (UTF-8)") from None
    except RecursionError:
        raise ValueError(f"{where}: its JSON is nested too deeply") from None
    except json.JSONDecodeError as error:
        raise ValueError(
            f"{where}: its JSON breaks off or is damaged at column {error.colno}: every line is one whole object"
        ) from None
    except ValueError as error:  # NaN, or a number of too many digits
        raise ValueError(f"{where}: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{where}: it must be a JSON object, got {shown(content)}")
    return content


def checked_item(entry: Mapping[str, Any], defaults: Defaults, records: Mapping[str, Any]) -> Item:
    """An item of a job of the object of its line; records: "records" of the header."""
    if records:
        from .records import require_frame, require_recordable  # which needs cages: workers do without it at first

        require_frame(entry, defaults.words)
    item = Item.from_json(entry, defaults)
    if records:
        require_recordable(entry, item, records)
    return item
