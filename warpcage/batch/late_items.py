"""When workers are asked how long their items take, and which are to be ended."""

from __future__ import annotations

import dataclasses
from typing import Generic, TypeVar

#: A worker, or one of its lots.
Key = TypeVar("Key")

#: Seconds within which a worker that is asked must answer: one that does not is taken for hung.
ANSWER = 60.0

#: Seconds between two looks at a worker at least.
LEAST = 0.5


@dataclasses.dataclass
class _Looks:
    """A lot of a worker: when to look at it next, and since when it owes an answer."""

    next: float
    asked: float | None = None


class LateItems(Generic[Key]):
    """Knows which lots of workers are to be asked about when, so that few are asked often. Times are handed in.
    limit: seconds that an item may take; patience: seconds within which a worker must answer."""

    def __init__(self, limit: float, patience: float):
        self.limit, self.patience = limit, patience
        self._workers: dict[Key, _Looks] = {}

    def given(self, worker: Key, now: float) -> None:
        """A worker gets a lot: none of its items can be late before the limit has passed."""
        self._workers[worker] = _Looks(now + self.limit)

    def ended(self, worker: Key) -> None:
        """A worker is done with its lot, or dead."""
        self._workers.pop(worker, None)

    def due(self, now: float) -> list[Key]:
        """Workers that are to be asked for their oldest item; they count as asked."""
        due = [name for name, looks in self._workers.items() if looks.asked is None and looks.next <= now]
        for name in due:
            self._workers[name].asked = now
        return due

    def answered(self, worker: Key, seconds: float | None, now: float) -> bool:
        """A worker has answered of itself or of a lot; returns whether its oldest item is late.
        seconds: how long that takes so far; None where it has none under way."""
        looks = self._workers.get(worker)
        if looks is None:
            return False
        looks.asked = None
        looks.next = now + max(self.limit - (seconds or 0.0), LEAST)
        return seconds is not None and seconds > self.limit

    def silent(self, now: float) -> list[Key]:
        """Workers that were asked and do not answer."""
        late = now - self.patience
        return [name for name, looks in self._workers.items() if looks.asked is not None and looks.asked < late]
