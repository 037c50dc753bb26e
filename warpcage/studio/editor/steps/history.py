"""The steps that can be undone and done again, in memory and in the session's file."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ....core.checks import checked_whole, listed
from ....core.files import DAMAGED
from ....core.names import agreed, counted, renamed_keys
from ....errors import InputError
from ....render.surface_mesh import AnyObject, object_size
from ...films.checks import MAX_LINE, checked_items
from ...films.document import OLD_KEYS, Document, Edit, Key, Step, checked_edit, checked_key, part_json
from ...films.session.scene import Fields

#: Steps that can be undone.
DEPTH = 500

#: Bytes of a session's file that its steps may take beyond what it holds, about: each change writes it anew.
MAX_BYTES = 4_000_000

#: Identifies a field among those that its file has held: bounds and size, as JSON takes them.
Mark = list[Any]


class History:
    """Documents before and after the present one, each with the name of the step between.
    They share what did not change, so a step costs what it moved: 2.4 kB for a cage of 100 vertices."""

    def __init__(self) -> None:
        self.undo_steps: list[Step] = []  # (name, document before it), the newest last
        self.redo_steps: list[Step] = []  # (name, document after it), the next one last

    def push(self, label: str, before: Document, looks: bool = False) -> None:
        """Remember the document before a step. What was undone is forgotten, unless it `looks`: at another time."""
        self.undo_steps.append((label, before))
        del self.undo_steps[:-DEPTH]
        if not looks:
            self.redo_steps.clear()

    def undo(self, present: Document) -> Step:
        """The step that is undone and the document before it. Raises ValueError where there is none."""
        return self._step("undo", self.undo_steps, self.redo_steps, present)

    def redo(self, present: Document) -> Step:
        """The step that is done again and the document after it. Raises ValueError where there is none."""
        return self._step("redo", self.redo_steps, self.undo_steps, present)

    @staticmethod
    def _step(verb: str, steps: list[Step], others: list[Step], present: Document) -> Step:
        if not steps:
            raise InputError(f"there is nothing to {verb}")
        label, document = steps.pop()
        others.append((label, present))
        if document.time != present.time:  # it goes to the time at which it was left: a key must not land elsewhere
            present = dataclasses.replace(present, time=document.time, view=document.view)
        return label, seen_as(document, present)

    def summary(self) -> dict[str, Any]:
        """How many steps there are each way, and the names of the next ones."""
        sides = {"undo": self.undo_steps, "redo": self.redo_steps}
        labels = {f"{side}_label": steps[-1][0] if steps else None for side, steps in sides.items()}
        return {side: len(steps) for side, steps in sides.items()} | labels

    def to_json(self, present: Document, fields: Fields) -> dict[str, Any]:
        """What a session's file keeps of the steps beside the present document, as JSON takes it: the nearest ones."""
        # Lists of their own: the server's thread goes on meanwhile.
        steps = list(self.undo_steps), list(self.redo_steps)
        pool = _Pool(present if any(steps) else None)
        undo, redo = map(pool.steps, steps)
        files = {file: _mark(field) for file, field in {"": fields.main, **fields.files}.items() if file in pool.files}
        return {"fields": files, "parts": pool.parts, "undo": undo, "redo": redo}


def seen_as(document: Document, present: Document) -> Document:
    """A document, seen from where the person looks now. Numbers that were given out stay so."""
    number = max(document.next_id, present.next_id)
    return dataclasses.replace(document, view=present.view, time=present.time, next_id=number)


def read_history(content: Any, fields: Fields, load: Callable[[str], AnyObject]) -> tuple[History, str | None]:
    """The steps of a session's file, and one line of what became of those that cannot be gone back to.
    fields: of its document; those of other steps are loaded by their files' names."""
    history, gone = History(), _Gone(fields, load)
    if content is None:  # a session of before steps were kept
        return history, None
    try:
        gone.marks = content["fields"]
        read = _Reader(content["parts"])
        for name, steps in (("undo", history.undo_steps), ("redo", history.redo_steps)):
            kept = checked_items(content[name], DEPTH, name)
            for index in reversed(range(len(kept))):
                label, document = read.step(kept[index])
                if not gone.has_all(document):
                    gone.count += index + 1
                    break
                steps.insert(0, (label, document))
    except (*DAMAGED, ValueError, MemoryError):
        return History(), "The undo steps in the session's file are damaged and left out."
    return history, gone.report()


class _Gone:
    """Which fields of steps are gone by now, and how many steps need them."""

    def __init__(self, fields: Fields, load: Callable[[str], AnyObject]):
        self._fields, self._load = fields, load
        self.marks: Mapping[str, Mark] = {}
        self.count = 0
        self._known: dict[str, bool] = {}  # by file, "" the session's own

    def has_all(self, document: Document) -> bool:
        """Whether all fields of a document are there, and as they were."""
        return all(self._has(one.file or "") for one in document.objects)

    def _has(self, file: str) -> bool:
        if file not in self._known:
            self._known[file], files = False, self._fields.files
            with contextlib.suppress(OSError, ValueError):
                field = self._fields.main if not file else files[file] if file in files else self._load(file)
                self._known[file] = self.marks.get(file) == _mark(field)
                if file and self._known[file]:
                    files[file] = field
        return self._known[file]

    def report(self) -> str | None:
        """One line of how many steps are left out, and for which files."""
        if not self.count:
            return None
        names = [file or "the session's field" for file, is_there in self._known.items() if not is_there]
        steps, verb = counted(self.count, "undo step"), agreed(self.count, "is", "are")
        return f"{steps} {verb} left out: {listed(names)} {agreed(len(names), 'is', 'are')} gone or changed."


def _mark(field: AnyObject) -> Mark:
    return [field.bounds.tolist(), object_size(field)]


class _Pool:
    """What documents share, each part once, as JSON takes it; arrays are the base64 of their numbers.
    `present`: what is in the pool before there is a step, and takes no room of theirs."""

    def __init__(self, present: Document | None) -> None:
        self.parts: list[Any] = []
        self.files: set[str] = set()  # of the objects of all steps; "" is the session's own
        self._size = 0
        self._by_text: dict[str, int] = {}
        self._by_object: dict[int, int] = {}  # by `id`: the history holds them meanwhile
        if present is not None:
            self._document(present)
            self._size = 0

    def steps(self, steps: Sequence[Step]) -> list[Any]:
        """Steps as JSON takes them, the nearest ones first as long as there is room; in their order."""
        kept: list[Any] = []
        for label, document in reversed(steps):
            count, files = len(self.parts), {one.file or "" for one in document.objects}
            made = [label, self._document(document)]
            self._size += len(json.dumps(made))
            if self._size > MAX_BYTES:
                del self.parts[count:]
                break
            kept.append(made)
            self.files |= files
        return kept[::-1]

    def _document(self, document: Document) -> dict[str, Any]:
        content = {name: [*map(self._number, getattr(document, name))] for name in ("edits", "objects")}
        content |= {name: self._number(getattr(document, name)) for name in _PARTS}
        return content | {"time": document.time, "next_id": document.next_id}

    def _inner(self, value: Any) -> Any:
        """What a part holds, as JSON takes it: arrays and keys are in the pool, too."""
        return self._number(value) if isinstance(value, np.ndarray | Key) else part_json(value, self._inner)

    def _number(self, part: Any) -> int:
        """The number of a part, which is put into the pool where it is not in it."""
        number = self._by_object.get(id(part))
        if number is None:
            is_array = isinstance(part, np.ndarray)
            content = _text(part) if is_array else part_json(part, self._inner)
            text = json.dumps(content)
            number = self._by_text.setdefault(text, len(self.parts))
            if number == len(self.parts):
                self.parts.append(content)
                self._size += len(text)
            self._by_object[id(part)] = number
        return number


class _Reader:
    """Documents from the parts of a pool; they share edits, keys and arrays as they did."""

    def __init__(self, parts: Any):
        self._parts = parts
        self._known: dict[tuple[Any, int], Any] = {}  # by what made them and their numbers

    def step(self, content: Any) -> Step:
        """A step from what the pool made of it."""
        label, held = content
        held = renamed_keys(held, OLD_KEYS)
        if not isinstance(label, str):
            raise InputError("the name of a step must be a text")
        parts = {name: self._part(held[name]) for name in _PARTS}
        parts["objects"] = [self._part(number) for number in held["objects"]]
        parts["edits"] = [self._once(self._edit, number) for number in held["edits"]]
        keys = [self._once(self._key, number) for number in parts["timeline"]["keys"]]
        return label[:MAX_LINE], Document.from_json(held | parts | {"timeline": parts["timeline"] | {"keys": keys}})

    def _part(self, number: Any) -> Any:
        return self._parts[checked_whole(number, "the number of a part", 0, len(self._parts) - 1)]

    def _once(self, make: Callable[..., Any], number: Any, *arguments: Any) -> Any:
        """What is made of a part of the pool, once for all that hold it."""
        place, content = (make, number, *arguments), self._part(number)
        if place not in self._known:
            self._known[place] = make(content, *arguments)
        return self._known[place]

    def _edit(self, content: Any) -> Edit:
        rows: Any = {name: self._once(_rows, content[name], kind) for name, kind in _KINDS.items()}
        return dataclasses.replace(checked_edit(content | rows), **rows)

    def _key(self, content: Any) -> Key:
        held = content["poses"] or {}
        poses = {int(edit): self._once(_rows, array, _KINDS["posed"]) for edit, array in held.items()} or None
        return dataclasses.replace(checked_key(content | {"poses": poses}), poses=poses)


def _text(rows: np.ndarray) -> str:
    """The base64 of the numbers of an array (n, k), behind k where it is not 3."""
    width = f"{rows.shape[1]}:" if rows.shape[1] != 3 else ""
    return width + base64.b64encode(rows.tobytes()).decode()


def _rows(text: Any, kind: str) -> np.ndarray:
    """An array from its `_text`, read-only."""
    width, _, numbers = text.rpartition(":")
    return np.frombuffer(base64.b64decode(numbers, validate=True), kind).reshape(-1, int(width or 3))


#: Parts of a document that are one part of the pool each.
_PARTS = ("selection", "settings", "view", "timeline")

#: The numbers in the arrays of an edit.
_KINDS = {"faces": "<i4", "rest": "<f8", "posed": "<f8"}
