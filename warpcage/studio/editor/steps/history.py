"""The steps that can be undone and done again, in memory and in the session's file."""

from __future__ import annotations

import base64
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
from ...films.document import (
    OLD_KEYS,
    Document,
    Edit,
    Key,
    Step,
    Timeline,
    checked_edit,
    checked_key,
    edit_json,
    key_json,
    selection_json,
)
from ...films.session.scene import Fields
from ...spec.settings import Settings

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
        if not self.undo_steps:
            raise InputError("there is nothing to undo")
        label, before = self.undo_steps.pop()
        self.redo_steps.append((label, present))
        return label, _as_it_was(before, present)

    def redo(self, present: Document) -> Step:
        """The step that is done again and the document after it. Raises ValueError where there is none."""
        if not self.redo_steps:
            raise InputError("there is nothing to redo")
        label, after = self.redo_steps.pop()
        self.undo_steps.append((label, present))
        return label, _as_it_was(after, present)

    def summary(self) -> dict[str, object]:
        """How many steps there are each way, and the names of the next ones."""
        return {
            "undo": len(self.undo_steps),
            "redo": len(self.redo_steps),
            "undo_label": self.undo_steps[-1][0] if self.undo_steps else None,
            "redo_label": self.redo_steps[-1][0] if self.redo_steps else None,
        }

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


def _as_it_was(document: Document, present: Document) -> Document:
    """A document of the history at the time of the film that it was left at: a key must not land elsewhere."""
    return seen_as(
        document,
        present
        if document.time == present.time
        else dataclasses.replace(present, time=document.time, view=document.view),
    )


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
            files = self._fields.files
            try:
                field = self._fields.main if not file else files[file] if file in files else self._load(file)
            except (OSError, ValueError):
                self._known[file] = False
            else:
                self._known[file] = self.marks.get(file) == _mark(field)
                if file and self._known[file]:
                    files[file] = field
        return self._known[file]

    def report(self) -> str | None:
        """One line of how many steps are left out, and for which files."""
        if not self.count:
            return None
        names = [file or "the session's field" for file, is_there in self._known.items() if not is_there]
        verb = agreed(len(names), "is", "are")
        steps = counted(self.count, "undo step")
        return f"{steps} {agreed(self.count, 'is', 'are')} left out: {listed(names)} {verb} gone or changed."


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
        return {
            "edits": [self._number(edit, lambda one: edit_json(one, self._array)) for edit in document.edits],
            "objects": [self._number(one, dataclasses.asdict) for one in document.objects],
            "selection": self._number(document.selection, selection_json),
            "settings": self._number(document.settings, Settings.to_json),
            "view": self._number(document.view, dataclasses.asdict),
            "timeline": self._number(document.timeline, self._film),
            "time": document.time,
            "next_id": document.next_id,
        }

    def _film(self, film: Timeline) -> dict[str, Any]:
        keys = [self._number(key, lambda one: key_json(one, self._array)) for key in film.keys]
        return {"keys": keys, **{name: getattr(film, name) for name in ("length", "fps", "loop", "follows_keys")}}

    def _array(self, array: np.ndarray) -> int:
        return self._number(array, lambda rows: base64.b64encode(rows.tobytes()).decode())

    def _number(self, part: Any, made: Callable[[Any], Any]) -> int:
        """The number of a part, which is put into the pool where it is not in it; made: what JSON has of it."""
        number = self._by_object.get(id(part))
        if number is None:
            content = made(part)
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
        self._edits: dict[int, Edit] = {}
        self._keys: dict[int, Key] = {}
        self._arrays: dict[tuple[str, int], np.ndarray] = {}

    def step(self, content: Any) -> Step:
        """A step from what the pool made of it."""
        label, held = content
        held = renamed_keys(held, OLD_KEYS)
        if not isinstance(label, str):
            raise InputError("the name of a step must be a text")
        parts = {name: self._part(held[name]) for name in ("selection", "settings", "view", "timeline")}
        objects = [self._part(number) for number in held["objects"]]
        return label[:MAX_LINE], Document.from_json({**held, **parts, "objects": objects}, self._edit, self._key)

    def _part(self, number: Any) -> Any:
        return self._parts[checked_whole(number, "the number of a part", 0, len(self._parts) - 1)]

    def _rows(self, number: Any, kind: str) -> list[Any]:
        return np.frombuffer(base64.b64decode(self._part(number), validate=True), kind).reshape(-1, 3).tolist()

    def _edit(self, number: Any) -> Edit:
        if number not in self._edits:
            content = self._part(number)
            rows = {name: self._rows(content[name], kind) for name, kind in _KINDS.items()}
            made = checked_edit({**content, **rows})
            shared: dict[str, Any] = {
                name: self._arrays.setdefault((kind, content[name]), getattr(made, name))
                for name, kind in _KINDS.items()
            }
            self._edits[number] = dataclasses.replace(made, **shared)
        return self._edits[number]

    def _key(self, number: Any, sizes: Mapping[int, int]) -> Key:
        if number not in self._keys:
            content, kind = self._part(number), _KINDS["posed"]
            held = content["poses"] or {}
            rows = {edit: self._rows(array, kind) for edit, array in held.items()}
            made = checked_key({**content, "poses": rows or None}, sizes)
            shared = {
                int(edit): self._arrays.setdefault((kind, array), (made.poses or {})[int(edit)])
                for edit, array in held.items()
            }
            self._keys[number] = dataclasses.replace(made, poses=shared or None)
        return self._keys[number]


#: The numbers in the arrays of an edit.
_KINDS = {"faces": "<i4", "rest": "<f8", "posed": "<f8"}
