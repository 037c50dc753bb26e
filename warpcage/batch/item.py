"""What all items of a job share: names, outputs, and their JSON."""

from __future__ import annotations

import abc
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any, ClassVar

from ..core.checks import shown
from .words import Checker, checked_words, safe_name

#: Names in the folder of a run that no output may have, in any case of letters.
RESERVED = ("manifest.jsonl",)

#: What stands for an item's id in the names of its outputs.
ID = "{id}"


@dataclasses.dataclass(frozen=True, eq=False)
class Item(abc.ABC):
    """One thing to make."""

    # a relative name, unique in its job
    id: str
    # the files that it writes by what they hold, relative to the folder of the run
    outputs: dict[str, str]
    # any JSON that is kept with its record
    extra: Any = None

    #: The word of its kind, the words that it takes, and all kinds by their words.
    kind: ClassVar[str]
    known: ClassVar[dict[str, Checker]]
    kinds: ClassVar[dict[str, type[Item]]] = {}

    def __init_subclass__(cls) -> None:
        Item.kinds[cls.kind] = cls

    @property
    @abc.abstractmethod
    def group(self) -> str:
        """What a worker has to load for it: items of one group share that."""

    @property
    def pose(self) -> str:
        """What it shows of what is loaded: items of one group and pose share a map. Empty where there is none."""
        return ""

    @property
    def version(self) -> int:
        """The first version of job files that has all of its words."""
        return 1

    @property
    def order(self) -> tuple[str, str]:
        """By which items are sorted so that workers load and pose as little as they can."""
        return self.group, self.pose

    def to_json(self) -> dict[str, Any]:
        """The item as JSON, with what it takes from defaults of its file, but without what is usual.
        `from_json` makes an equal item of it."""
        entry: dict[str, Any] = {"id": self.id, "kind": self.kind, "outputs": dict(self.outputs)}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name not in entry and value != _default(field):
                entry[field.name] = plain(value)
        return entry

    @staticmethod
    def from_json(entry: Mapping[str, Any], defaults: Mapping[str, Any] | Defaults | None = None) -> Item:
        """An item of the kind that it says from JSON; defaults: what holds where that says nothing.
        Words of other kinds of items are left out of the defaults."""
        if not isinstance(entry, Mapping):
            raise ValueError(f"an item must be a JSON object, got {shown(entry)}")
        usual = defaults if isinstance(defaults, Defaults) else Defaults(defaults or {})
        kind = entry.get("kind") or usual.words.get("kind") or "frame"
        if not isinstance(kind, str) or kind not in Item.kinds:
            raise ValueError(f"'kind' must be one of {', '.join(Item.kinds)}, got {shown(kind)}")
        return Item.kinds[kind]._made(entry, usual.of(Item.kinds[kind]))

    @classmethod
    def _made(cls, entry: Mapping[str, Any], usual: dict[str, Any]) -> Item:
        given = {word: value for word, value in usual.items() if word not in entry}
        given |= checked_words(entry, cls.known, f"an item of kind {cls.kind!r}")
        given.pop("kind", None)
        if "id" not in given:
            raise ValueError('an item needs an "id", such as "frame_0001"')
        return cls(**cls._completed(given))

    @classmethod
    @abc.abstractmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        """The arguments of the constructor of checked words."""


class Defaults:
    """What holds where an item says nothing, checked once for all items of a kind."""

    def __init__(self, words: Mapping[str, Any]):
        self.words = words
        self._checked: dict[str, dict[str, Any]] = {}

    def of(self, maker: type[Item]) -> dict[str, Any]:
        """The checked words that a kind of item takes. Raises ValueError for one that cannot be."""
        if maker.kind not in self._checked:
            usual = {word: value for word, value in self.words.items() if word in maker.known}
            self._checked[maker.kind] = checked_words(usual, maker.known, "'defaults'")
        return self._checked[maker.kind]


def _default(field: dataclasses.Field) -> Any:
    return field.default_factory() if field.default_factory is not dataclasses.MISSING else field.default


def plain(value: Any) -> Any:
    """A value as JSON takes it."""
    if hasattr(value, "to_json"):
        return value.to_json()
    return [plain(each) for each in value] if isinstance(value, tuple) else value


def canonical(value: Any) -> str:
    """The one text of a JSON value: sorted words and no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)


def digest(value: Any) -> str:
    """A short hash of a JSON value: 16 hexadecimal digits."""
    return hashlib.blake2b(canonical(value).encode(), digest_size=8).hexdigest()


def output_path(path: Any, item_id: str, word: str) -> str:
    """A checked name of an output, with the item's id put in. Raises ValueError for others."""
    found = safe_name(path.replace(ID, item_id) if isinstance(path, str) else path, word)
    if found.lower() in RESERVED:
        raise ValueError(f"{word} cannot be {found!r}, which is the run's own")
    return found
