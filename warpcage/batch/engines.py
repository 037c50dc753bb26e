"""Where workers live and the loop that drives them: in this process, or in processes of their own."""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, Protocol, TypeVar

from ..errors import StateError
from .chunk_runner import Chunk, ChunkOrder, ChunkReport, ChunkRunner, RunnerSettings
from .manifest import DONE, ERROR, FAILED, OutputFolder, notes_of_chunk
from .processes import Process, Share
from .scheduler import MOST_CHUNKS, Dispatcher

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
        raise StateError(f"no worker is left: {reason}")


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


SLOW = 0.5  # seconds of an item; then a chunk is settled before the next, as this thread tells of it only after that


class LocalEngine:
    """Runs chunks in this process, one after the other: items in the thread that waits, while others wait for files."""

    def __init__(self, runner: ChunkRunner, order: Callable[[Chunk], ChunkOrder]):
        self._runner, self._order = runner, order
        self._chunk: Chunk | None = None
        self._events: list[Event] = []
        self._launches: list[float] = []
        self._settling = ThreadPoolExecutor(MOST_CHUNKS, "warpcage-settling")
        self._settled: queue.SimpleQueue[tuple[str, int, Future[ChunkReport]]] = queue.SimpleQueue()
        self._ending = 0

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def launch(self, worker: str) -> None:
        """The worker is here; a RuntimeError when it is started again."""
        if self._launches:  # a device that is lost stays so in this process
            raise StateError("the device works no more in this process: run again, what is made is kept")
        self._launches.append(self.now())
        self._events.append(Ready(worker))

    def give(self, worker: str, chunk: Chunk) -> None:
        """Take a chunk; `wait` makes it."""
        self._chunk, self._worker = chunk, worker

    def recall(self, worker: str, number: int, share: float) -> None:
        """Nothing comes back: while a chunk is made nobody can ask."""
        self._events.append(Returned(worker, number, []))

    def lost(self, item: int, error: str, attempts: int) -> None:
        """Never called: where the worker dies, so does the driver."""
        raise AssertionError(item)

    def stop(self) -> None:
        """Begin no more items."""
        self._runner.stop()

    def wait(self, timeout: float) -> list[Event]:
        """Make the chunk that was given, or wait for one whose files are being written."""
        events, self._events = self._events, []
        if self._chunk is not None:
            order, self._chunk = self._order(self._chunk), None
            start = self.now()
            begun = self._runner.begin(order)
            if self.now() - start > SLOW * len(order.indices):
                events.append(Finished(self._worker, self._runner.settle(begun), order.number))
            else:
                self._settle(self._worker, order.number, self._settling.submit(self._runner.settle, begun))
                events.append(Begun(self._worker, order.number))
        while self._ending and not (events and self._settled.empty()):
            try:
                worker, number, found = self._settled.get(timeout=timeout)
            except queue.Empty:
                break
            self._ending -= 1
            events.append(Finished(worker, found.result(), number))
        return events

    def _settle(self, worker: str, number: int, found: Future[ChunkReport]) -> None:
        """Let a report come into the queue."""
        self._ending += 1
        found.add_done_callback(lambda done: self._settled.put((worker, number, done)))

    def close(self) -> None:
        """Wait for files that are being written, and close the notes of the worker."""
        self._settling.shutdown()
        self._runner.close()


#: Seconds that workers get to end the items that they have begun, when a run is interrupted.
GRACE = 5.0

#: Workers up to which a driver is told when the items of a chunk are begun, so that another one can be under way while
#: files are written. Chunks of more workers take so long that this gains nothing, and costs the driver a message each.
MOST_OVERLAPPING = 64


class Host(Protocol):
    """Starts processes of workers: on this machine, or on a cluster."""

    share: Share

    def start(self, settings: RunnerSettings) -> Process:
        """Start the process of a worker, whose first answer may take a while."""
        ...

    def waited(self, seconds: float) -> None:
        """Raise RuntimeError where no worker can start any more, after so long without one."""
        ...

    def death_line(self, error: BaseException) -> str:
        """Why a worker gives no answer but an error: one line, without its name."""
        ...


class ProcessEngine:
    """Runs chunks in processes that a host starts.
    item_timeout: seconds that an item may take before its worker is ended; None is no limit."""

    def __init__(
        self,
        host: Host,
        settings: RunnerSettings,  # of every worker: its name and notes are filled in
        folder: OutputFolder,
        order: Callable[[Chunk], ChunkOrder],
        item_timeout: float | None = None,
    ):
        self._host, self._folder, self._order = host, folder, order
        self.settings = dataclasses.replace(settings, device=host.share.device, threads=host.share.threads)
        self._events: queue.SimpleQueue[tuple[str, str, int, Future[Any]]] = queue.SimpleQueue()
        self._processes: dict[str, Process] = {}
        self._starts: dict[str, int] = {}  # how often each was started
        self._orders: dict[str, dict[int, ChunkOrder]] = {}  # of the chunks of each, by number
        self.places: dict[str, dict[str, Any]] = {}  # pid and host of each
        self._waiting_since: float | None = None  # when the first of those that start was asked for
        self._ready: set[str] = set()
        self._lost_notes = None
        self._overlapping = host.share.workers <= MOST_OVERLAPPING
        self._late: LateItems[tuple[str, int]] | None = None
        if item_timeout is not None:
            self._late = LateItems(item_timeout, ANSWER)

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def launch(self, worker: str) -> None:
        """Start the process of a worker."""
        self._starts[worker] = self._starts.get(worker, 0) + 1
        prefetch = self.settings.prefetch
        if prefetch:  # whoever takes the place of one that died knows nothing: what it read may have been to blame
            prefetch = (prefetch[int(worker) % len(prefetch)],) if self._starts[worker] == 1 else ()
        notes = self._notes_name(worker)
        settings = dataclasses.replace(self.settings, worker=worker, notes=notes, prefetch=prefetch)
        self._processes[worker] = self._host.start(settings)
        if not self._ready:
            self._waiting_since = self.now()
        self._ask(worker, "ready", "facts")

    def give(self, worker: str, chunk: Chunk) -> None:
        """Send a chunk to a worker."""
        order = self._order(chunk)
        self._orders.setdefault(worker, {})[chunk.number] = order
        self._ask(worker, f"report {chunk.number}", "run", order)
        if self._overlapping:
            self._ask(worker, f"begun {chunk.number}", "begun", chunk.number)
        if self._late is not None:
            self._late.given((worker, chunk.number), self.now())

    def recall(self, worker: str, number: int, share: float) -> None:
        """Ask a worker for items of its chunk."""
        self._ask(worker, f"recall {number}", "recall", number, share)

    def lost(self, item: int, error: str, attempts: int) -> None:
        """Note an item that failed with its workers."""
        if self._lost_notes is None:
            self._lost_notes = self._folder.new_notes(f"{self.settings.run}-driver")
        found = self.settings.reader.item(*self._order(Chunk(0, [item], [0], 0)).lines[0])
        record = {"id": found.id, "state": FAILED, "kind": found.kind, "attempts": attempts, "error": error}
        self._lost_notes.append(record)

    def stop(self) -> None:
        """Let all workers begin no more items."""
        for process in self._processes.values():
            process.ask("stop")

    def wait(self, timeout: float) -> list[Event]:
        """What workers answered; a RuntimeError where none could start for a long time."""
        events: list[Event] = []
        with contextlib.suppress(queue.Empty):
            answer = self._events.get(timeout=timeout)
            while True:
                events += self._told(*answer)
                answer = self._events.get_nowait()
        events += self._look()
        if not self._ready and self._waiting_since is not None:
            self._host.waited(self.now() - self._waiting_since)
        return events

    def close(self, patience: float = 0.0) -> None:
        """End all workers; patience: seconds that they get to end the items that they have begun."""
        if patience and self._orders:
            end = self.now() + patience
            with contextlib.suppress(Exception):
                self.stop()
            while self._orders and self.now() < end:
                self.wait(0.1)
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait()
        self._processes.clear()
        if self._lost_notes is not None:
            self._lost_notes.close()
            self._lost_notes = None

    def _ask(self, worker: str, what: str, method: str, *given: Any) -> None:
        """Let the answer come into the queue, from another thread."""
        start, events = self._starts[worker], self._events
        answer = self._processes[worker].ask(method, *given)
        answer.add_done_callback(lambda answer: events.put((worker, what, start, answer)))

    def _look(self) -> list[Event]:
        """Ask workers whose items may be late; those that do not answer are ended."""
        if self._late is None:
            return []
        now = self.now()
        for worker, number in self._late.due(now):
            self._ask(worker, f"oldest {number}", "oldest", number)
        reason = f"its worker was ended: it did not answer for {self._late.patience:g} s"
        return [self._death(worker, reason) for worker in dict.fromkeys(worker for worker, _ in self._late.silent(now))]

    def _oldest(self, worker: str, number: int, found: tuple[int, float] | None) -> Event | None:
        """End a worker whose oldest item is late."""
        if self._late is None or number not in self._orders.get(worker, ()):
            return None  # of a chunk that has ended
        if not self._late.answered((worker, number), None if found is None else found[1], self.now()) or found is None:
            return None
        died = self._death(worker, f"its worker was ended: the item took longer than {self._late.limit:g} s")
        # that item is to blame, and none where it was settled at the last moment
        blamed = [item for item in died.begun if item != found[0]] + [found[0]] if found[0] in died.begun else []
        return dataclasses.replace(died, begun=blamed)

    def _told(self, worker: str, what: str, start: int, answer: Future[Any]) -> list[Event]:
        """What an answer says."""
        if start != self._starts[worker] or worker not in self._processes:
            return []  # of a process that is gone
        error = answer.exception()
        if error is not None:
            return [self._death(worker, self._host.death_line(error))]
        found, number = answer.result(), int(what.partition(" ")[2] or 0)
        if what == "ready":
            self._ready.add(worker)
            self.places[worker] = found
            self._waiting_since = None
            return [Ready(worker)]
        if what.startswith("begun"):
            return [Begun(worker, number)]
        if what.startswith("oldest"):
            died = self._oldest(worker, number, found)
            return [] if died is None else [died]
        if what.startswith("recall"):
            return [Returned(worker, number, found)]
        return self._reported(worker, number, found)

    def _reported(self, worker: str, number: int, report: ChunkReport) -> list[Event]:
        """A worker is done with a chunk. One that can make no more is ended; its other chunks are as its notes say."""
        orders = self._orders[worker]
        del orders[number]
        if not orders:
            del self._orders[worker]
        if self._late is not None:
            self._late.ended((worker, number))
        if report.broken is None:
            return [Finished(worker, report, number)]
        others = self._end(worker)
        events: list[Event] = []
        for order in others:
            rest, _ = self._noted(worker, order)
            unsettled = set(order.indices) - {*rest.done, *(index for index, _ in [*rest.failed, *rest.errors])}
            rest.left = [index for index in order.indices if index in unsettled]
            events.append(Finished(worker, rest, order.number))
        return [*events, Finished(worker, report, number)]

    def _death(self, worker: str, reason: str) -> Died:
        """What is known of a worker that answers no more, or is not to."""
        report, begun = ChunkReport(), []
        for order in self._end(worker):
            of_chunk, begun_of_chunk = self._noted(worker, order)
            report.done += of_chunk.done
            report.seconds += of_chunk.seconds
            report.failed += of_chunk.failed
            report.errors += of_chunk.errors
            begun += begun_of_chunk
        return Died(worker, report, begun, reason)

    def _noted(self, worker: str, order: ChunkOrder) -> tuple[ChunkReport, list[int]]:
        """What a worker noted of a chunk: what it settled, and what it had begun besides, the newest last."""
        report, read = ChunkReport(), self.settings.reader.item
        indices = {read(*line).id: index for line, index in zip(order.lines, order.indices, strict=True)}
        settled, begun = notes_of_chunk(self._folder.notes / f"{self._notes_name(worker)}.jsonl", order.number)
        for record in settled:
            index = indices[record["id"]]
            if record["state"] == DONE:
                report.done.append(index)
                report.seconds.append(float(record["seconds"]))
            else:
                (report.errors if record["state"] == ERROR else report.failed).append((index, record["error"]))
        return report, [indices[each] for each in begun]

    def _end(self, worker: str) -> list[ChunkOrder]:
        """Make sure that a process is gone whose node may merely not answer; returns what it had, the oldest first."""
        self._ready.discard(worker)
        orders = self._orders.pop(worker, {})
        if self._late is not None:
            for number in orders:
                self._late.ended((worker, number))
        self.places.pop(worker, None)
        process = self._processes.pop(worker)
        process.kill()
        process.wait()
        if not self._ready:
            self._waiting_since = self.now()
        return list(orders.values())

    def _notes_name(self, worker: str) -> str:
        return f"{self.settings.run}-{worker}-{self._starts[worker]}"
