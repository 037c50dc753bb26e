"""The loop of a run: events of workers to the dispatcher, and items that take too long."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

from .scheduler import Chunk, ChunkReport, Dispatcher

#: Seconds after which the loop looks for stragglers even where nothing happened.
TICK = 1.0


@dataclasses.dataclass(frozen=True)
class Ready:
    """A worker has started."""

    worker: str


@dataclasses.dataclass(frozen=True)
class Begun:
    """A worker has begun all items of a chunk, whose files are being written. Not every engine tells."""

    worker: str
    number: int


@dataclasses.dataclass(frozen=True)
class Finished:
    """A worker is done with a chunk: that of a number, or the one that it makes."""

    worker: str
    report: ChunkReport
    number: int | None = None


@dataclasses.dataclass(frozen=True)
class Returned:
    """A worker gave back items of its chunk."""

    worker: str
    number: int
    items: Sequence[int]


@dataclasses.dataclass(frozen=True)
class Died:
    """A worker died: what it had settled of its chunks, what it had begun, the newest last, and why, in a line."""

    worker: str
    report: ChunkReport
    begun: Sequence[int]
    reason: str


Event = Ready | Begun | Finished | Returned | Died


class Engine(Protocol):
    """Where workers live: in this process, in others, or under a virtual clock."""

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        ...

    def launch(self, worker: str) -> None:
        """Start the process of a worker, the first one or another after its death; `Ready` or `Died` tells the end."""
        ...

    def give(self, worker: str, chunk: Chunk) -> None:
        """Let a worker make a chunk."""
        ...

    def recall(self, worker: str, number: int, share: float) -> None:
        """Ask for a share of what a worker has not begun of its chunk; `Returned` brings it."""
        ...

    def lost(self, item: int, error: str, attempts: int) -> None:
        """Note that an item failed for good because its workers died."""
        ...

    def stop(self) -> None:
        """Let workers begin no more items."""
        ...

    def wait(self, timeout: float) -> list[Event]:
        """What happened since, at least one event unless the time passes."""
        ...


def drive(
    dispatcher: Dispatcher,
    engine: Engine,
    *,
    progress: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] = lambda line: None,
) -> str | None:
    """Make all that a dispatcher has; returns why it ended before its end, one line; None where all is settled.
    The engine starts the workers; progress: called after each event; warn: takes a line about a worker that died."""
    idle: dict[str, None] = {}
    halt: str | None = None
    for name in dispatcher.names:
        engine.launch(name)
    while not dispatcher.finished:
        for event in engine.wait(TICK):
            if isinstance(event, Ready):
                idle[event.worker] = None
            elif isinstance(event, Begun):
                if dispatcher.begun(event.worker, event.number):
                    idle[event.worker] = None
            elif isinstance(event, Finished):
                dispatcher.reported(event.worker, event.report, engine.now(), event.number)
                if event.report.halt is not None and halt is None:
                    halt = event.report.halt
                    engine.stop()
                if event.report.broken is not None:
                    warn(f"worker {event.worker}: {event.report.broken}: it is started again")
                    idle.pop(event.worker, None)
                    _replace(dispatcher, engine, event.worker, event.report.broken, warn)
                elif dispatcher.takes(event.worker):
                    idle[event.worker] = None
            elif isinstance(event, Returned):
                dispatcher.returned(event.worker, event.number, event.items)
            else:
                idle.pop(event.worker, None)
                warn(f"worker {event.worker}: {event.reason}: it is started again")
                for item, error in dispatcher.died(event.worker, event.report, event.begun, event.reason):
                    engine.lost(item, error, dispatcher.retries + 1)
                _replace(dispatcher, engine, event.worker, event.reason, warn)
            progress()
        _hand_out(dispatcher, engine, idle)
    return halt


def _hand_out(dispatcher: Dispatcher, engine: Engine, idle: dict[str, None]) -> None:
    """Give work to workers that have none; where there is none, ask those that are late for some of theirs."""
    if dispatcher.stopped:
        return
    for name in list(idle):
        if not dispatcher.open:
            break
        chunk = dispatcher.next_chunk(name, engine.now())
        if chunk is not None:
            del idle[name]
            engine.give(name, chunk)
    for name, number, share in dispatcher.recalls(len(idle), engine.now()):
        engine.recall(name, number, share)


def _replace(dispatcher: Dispatcher, engine: Engine, name: str, reason: str, warn: Callable[[str], None]) -> None:
    """Start another process in the place of one that died, unless that dies again and again."""
    if not dispatcher.given_up(name):
        if not dispatcher.finished:
            engine.launch(name)
        return
    warn(f"worker {name} is given up: it died before it made anything, again and again")
    if not dispatcher.workers and not dispatcher.finished:
        raise RuntimeError(f"no worker is left: {reason}")


Key = TypeVar("Key")  # a worker, or one of its chunks

#: Seconds within which a worker that is asked must answer: one that does not is taken for hung.
ANSWER = 60.0

#: Seconds between two looks at a worker at least.
LEAST = 0.5


@dataclasses.dataclass
class _Looks:
    """A chunk of a worker: when to look at it next, and since when it owes an answer."""

    next: float
    asked: float | None = None


class LateItems(Generic[Key]):
    """Knows which chunks of workers are to be asked about when, so that few are asked often. Times are handed in.
    limit: seconds that an item may take; patience: seconds within which a worker must answer."""

    def __init__(self, limit: float, patience: float):
        self.limit, self.patience = limit, patience
        self._workers: dict[Key, _Looks] = {}

    def given(self, worker: Key, now: float) -> None:
        """A worker gets a chunk: none of its items can be late before the limit has passed."""
        self._workers[worker] = _Looks(now + self.limit)

    def ended(self, worker: Key) -> None:
        """A worker is done with its chunk, or dead."""
        self._workers.pop(worker, None)

    def due(self, now: float) -> list[Key]:
        """Workers that are to be asked for their oldest item; they count as asked."""
        due = [name for name, looks in self._workers.items() if looks.asked is None and looks.next <= now]
        for name in due:
            self._workers[name].asked = now
        return due

    def answered(self, worker: Key, seconds: float | None, now: float) -> bool:
        """A worker has answered of itself or of a chunk; returns whether its oldest item is late.
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
