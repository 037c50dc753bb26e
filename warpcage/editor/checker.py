"""Checker: looks at the active cage of a session whenever the hand rests."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

from .checked import error_line
from .document import Document
from .inspection import inspect
from .session import Session

#: Seconds from a change to the check of the cage.
CHECK_SECONDS = 0.3

#: What is said of a cage that nobody has looked at.
NOTHING_KNOWN = {
    "problem": "",
    "crossing_faces": [],
    "folded_share": 0.0,
    "leaking_faces": [],
    "outside_share": 0.0,
    "inside_share": None,
    "lines": [],
}

_log = logging.getLogger(__name__)


class Checker:
    """Checks the active edit, one check at a time, in another thread. All else is in the thread of the server's loop.
    While `busy` (the hand moves or the film plays) the check waits; `tell` is called when the section has changed."""

    def __init__(self, session: Session, busy: Callable[[], bool], tell: Callable[[], None]):
        self._session, self._busy, self._tell = session, busy, tell
        self._timer: asyncio.TimerHandle | None = None
        self._task: asyncio.Task | None = None
        self._known: tuple[object, ...] = ()  # what the section says something of
        # the section `check` that pages are told; None where no edit is active
        self.section: dict[str, Any] | None = None

    def plan(self) -> None:
        """Check before long."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(CHECK_SECONDS, self._begin)

    async def stop(self) -> None:
        """Check no more."""
        if self._timer is not None:
            self._timer.cancel()
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _begin(self) -> None:
        self._timer = None
        if self._task is not None or self._busy():
            self.plan()
        elif not _same(self._known, _seen(self._session.document)):
            self._task = asyncio.create_task(self._check())

    async def _check(self) -> None:
        document = self._session.document
        number, self._known = document.selection.edit, ()
        try:
            if number is None:
                found = None
            else:
                before = self.section if self.section and self.section["edit"] == number else NOTHING_KNOWN
                self.section = {**before, "edit": number, "pending": True}
                self._tell()
                found = await asyncio.get_running_loop().run_in_executor(None, self._look, document, number)
            if _same(_seen(document), _seen(self._session.document)):  # otherwise another check is on its way
                self.section, self._known = found, _seen(document)
                self._tell()
        finally:
            self._task = None

    def _look(self, document: Document, number: int) -> dict[str, Any]:
        try:
            return inspect(document, number, self._session.field)
        except Exception as error:
            if not isinstance(error, ValueError | MemoryError | ArithmeticError | RuntimeError):
                _log.exception("a cage could not be checked")
            line = f"This cage could not be checked: {error_line(error)}"
            return {**NOTHING_KNOWN, "edit": number, "pending": False, "problem": line, "lines": [line]}


def _seen(document: Document) -> tuple[object, ...]:
    """What a check looks at."""
    return document.edits, document.selection.edit, document.settings.mode


def _same(one: tuple[object, ...], two: tuple[object, ...]) -> bool:
    return bool(one) and one[0] is two[0] and one[1:] == two[1:]
