"""Where workers live, in this process or in processes of their own, and the driver that gives them chunks."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import queue
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

from ..errors import StateError
from .chunk_runner import Chunk, ChunkReport, ChunkRunner, RunnerSettings
from .processes import LocalHost, LocalProcess, RayHost, RayProcess
from .scheduler import MOST_CHUNKS, Dispatcher

TICK = 1.0  # seconds after which the driver looks for stragglers even where nothing happened
ANSWER = 60.0  # seconds within which a worker that is asked must answer: one that does not is taken for hung
LEAST_LOOK = 0.5  # seconds between two looks at a worker at least
GRACE = 5.0  # seconds that workers get to end the items that they have begun, when a run is interrupted

#: Workers up to which a driver is told when the items of a chunk are begun, so that another one can be under way while
#: files are written. Chunks of more workers take so long that this gains nothing, and costs the driver a message each.
MOST_OVERLAPPING = 64


class Answer(NamedTuple):
    """What a worker answers to what was submitted."""

    worker: str
    method: str  # of `ChunkRunner`
    number: int  # of the chunk that it is about; 0 for none
    found: Any
    error: str | None = None  # one line: why the worker will answer nothing any more


class Engine(Protocol):
    """Where workers live: in this process, in others, or under a virtual clock."""

    overlapping: bool  # whether it is to be asked when all items of a chunk are begun

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        ...

    def start(self, worker: str, start: int) -> None:
        """Start the process of a worker, for the time `start` from 1; the answer of "facts" says that it has."""

    def submit(self, worker: str, method: str, *given: Any) -> None:
        """Call a method of a worker's `ChunkRunner`, which `wait` has the answer of."""

    def cancel(self, worker: str) -> None:
        """End the process of a worker, wherever it is at; what it has not answered is not heard any more."""

    def wait(self, timeout: float) -> Iterable[Answer]:
        """What was answered since, at least one unless the time passes; RuntimeError where no worker can start.
        Of a worker that is ended while this is looked through no more answers come."""
        ...


class Journal(Protocol):
    """What chunks are made of, and what workers have noted of them."""

    def order(self, chunk: Chunk) -> Chunk:
        """A chunk as it is sent."""
        ...

    def noted(self, worker: str, start: int, chunk: Chunk) -> tuple[ChunkReport, list[int]]:
        """What a worker that was started so often noted of a chunk, and what it had begun besides, the newest last."""
        ...

    def lost(self, item: int, error: str, attempts: int) -> None:
        """Note that an item failed for good because its workers died."""


class Driver:
    """Makes all that a dispatcher has; item_timeout: seconds after which the worker of an item is ended, None is never.
    progress: called after each answer; warn: takes a line about a worker that died."""

    def __init__(
        self,
        dispatcher: Dispatcher,
        engine: Engine,
        journal: Journal,
        *,
        item_timeout: float | None = None,
        progress: Callable[[], None] = lambda: None,
        warn: Callable[[str], None] = lambda line: None,
    ):
        self._dispatcher, self._engine, self._journal = dispatcher, engine, journal
        self._limit, self._progress, self._warn = item_timeout, progress, warn
        self._idle: dict[str, None] = {}
        self._starts: collections.Counter[str] = collections.Counter()  # how often each was started
        self._orders: dict[str, dict[int, Chunk]] = {}  # of the chunks of each worker, by number, the oldest first
        self._looks: dict[tuple[str, int], float] = {}  # when a chunk of a worker is to be looked at
        self._asked: dict[tuple[str, int], float] = {}  # since when a worker owes an answer about a chunk
        self.halt: str | None = None  # why it ended before its end, one line

    def run(self) -> str | None:
        """Start the workers, and make all; returns why it ended before its end, one line; None where all is settled."""
        for name in self._dispatcher.names:
            self._start(name)
        while not self._dispatcher.finished:
            for answer in self._engine.wait(TICK):
                self._hear(answer)
                self._progress()
            self._look()
            self._hand_out()
        return self.halt

    def drain(self, seconds: float) -> None:
        """Let workers end, within seconds, what they have begun, and begin no more."""
        self.stop()
        end = self._engine.now() + seconds
        while any(self._orders.values()) and self._engine.now() < end:
            for answer in self._engine.wait(0.1):
                self._hear(answer)

    def stop(self) -> None:
        """Let all workers begin no more items."""
        self._dispatcher.stop()
        for name in self._orders:
            self._engine.submit(name, "stop")

    def _start(self, name: str) -> None:
        self._starts[name] += 1
        self._engine.start(name, self._starts[name])
        self._orders[name] = {}

    def _hear(self, answer: Answer) -> None:
        name, number = answer.worker, answer.number
        if answer.error is not None:
            self._died(name, answer.error)
        elif answer.method == "facts":
            self._idle[name] = None
        elif answer.method == "begun" and self._dispatcher.begun(name, number):
            self._idle[name] = None
        elif answer.method == "recall":
            self._dispatcher.returned(name, number, answer.found)
        elif answer.method == "oldest" and self._asked.pop((name, number), None) is not None:
            item, seconds = answer.found or (None, 0.0)
            self._looks[name, number] = self._engine.now() + max((self._limit or 0.0) - seconds, LEAST_LOOK)
            if self._limit is not None and seconds > self._limit:
                self._died(name, f"its worker was ended: the item took longer than {self._limit:g} s", item)
        elif answer.method == "run":
            self._reported(name, number, answer.found)

    def _reported(self, name: str, number: int, report: ChunkReport) -> None:
        """A worker is done with a chunk. One that can make no more is ended; its other chunks are as its notes say."""
        self._forget(name, number)
        if report.broken is not None:
            for order in self._end(name):
                rest, _ = self._journal.noted(name, self._starts[name], order)
                self._dispatcher.reported(name, rest, self._engine.now(), order.number)
        self._dispatcher.reported(name, report, self._engine.now(), number)
        if report.halt is not None and self.halt is None:
            self.halt = report.halt
            self.stop()
        if report.broken is not None:
            self._replace(name, report.broken)
        elif self._dispatcher.takes(name):
            self._idle[name] = None

    def _died(self, name: str, reason: str, late: int | None = None) -> None:
        """A worker answers no more, or is not to; late: the item that took too long, which is to blame then."""
        report, begun = ChunkReport(), []
        for order in self._end(name):
            noted, begun_of_chunk = self._journal.noted(name, self._starts[name], order)
            for part in ("done", "seconds", "failed", "errors"):
                getattr(report, part).extend(getattr(noted, part))
            begun += begun_of_chunk
        if late is not None:  # none is to blame where it was settled at the last moment
            begun = [item for item in begun if item != late] + [late] if late in begun else []
        for item, error in self._dispatcher.died(name, report, begun, reason):
            self._journal.lost(item, error, self._dispatcher.retries + 1)
        self._replace(name, reason)

    def _end(self, name: str) -> list[Chunk]:
        """Make sure that a worker is gone which may merely not answer; returns what it had, the oldest first."""
        self._idle.pop(name, None)
        orders = list(self._orders.pop(name).values())
        for order in orders:
            self._looks.pop((name, order.number), None)
            self._asked.pop((name, order.number), None)
        self._engine.cancel(name)
        return orders

    def _replace(self, name: str, reason: str) -> None:
        """Start another process in the place of one that died, unless that dies again and again."""
        self._warn(f"worker {name}: {reason}: it is started again")
        if not self._dispatcher.given_up(name):
            if not self._dispatcher.stopped and not self._dispatcher.finished:
                self._start(name)
            return
        self._warn(f"worker {name} is given up: it died before it made anything, again and again")
        if not self._dispatcher.workers and not self._dispatcher.finished:
            raise StateError(f"no worker is left: {reason}")

    def _forget(self, name: str, number: int) -> None:
        del self._orders[name][number]
        self._looks.pop((name, number), None)
        self._asked.pop((name, number), None)

    def _look(self) -> None:
        """Ask workers whose items may be late, each once; those that do not answer are ended."""
        now = self._engine.now()
        for key in [key for key, when in self._looks.items() if when <= now and key not in self._asked]:
            self._asked[key] = now
            self._engine.submit(key[0], "oldest", key[1])
        for name in dict.fromkeys(name for (name, _), asked in self._asked.items() if asked < now - ANSWER):
            self._died(name, f"its worker was ended: it did not answer for {ANSWER:g} s")

    def _hand_out(self) -> None:
        """Give work to workers that have none; where there is none, ask those that are late for some of theirs."""
        dispatcher = self._dispatcher
        for name in list(self._idle):
            if dispatcher.stopped or not dispatcher.open:
                break
            chunk = dispatcher.next_chunk(name, self._engine.now())
            if chunk is None:
                continue
            del self._idle[name]
            order = self._orders[name][chunk.number] = self._journal.order(chunk)
            self._engine.submit(name, "run", order)
            if self._engine.overlapping:
                self._engine.submit(name, "begun", chunk.number)
            if self._limit is not None:  # none of its items can be late before
                self._looks[name, chunk.number] = self._engine.now() + self._limit
        for name, number, share in dispatcher.recalls(len(self._idle), self._engine.now()):
            self._engine.submit(name, "recall", number, share)


SLOW = 0.5  # seconds of an item; then a chunk is settled before the next, as this thread tells of it only after that


class LocalEngine:
    """Runs chunks in this process, one after the other: items in the thread that waits, while others wait for files."""

    overlapping = False  # it says when items are begun without being asked

    def __init__(self, runner: ChunkRunner):
        self._runner = runner
        self._given: tuple[str, Chunk] | None = None
        self._settling = ThreadPoolExecutor(MOST_CHUNKS, "warpcage-settling")
        self._told: queue.SimpleQueue[tuple[str, str, int, Future[Any]]] = queue.SimpleQueue()
        self._ending = 0

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def start(self, worker: str, start: int) -> None:
        """The worker is here; a RuntimeError when it is started again."""
        if start > 1:  # a device that is lost stays so in this process
            raise StateError("the device works no more in this process: run again, what is made is kept")
        self._tell(worker, "facts", 0)

    def submit(self, worker: str, method: str, *given: Any) -> None:
        """Take a chunk, which `wait` makes; nothing comes back of one, as nobody can ask while it is made."""
        if method == "run":
            self._given = worker, given[0]
        elif method == "recall":
            self._tell(worker, method, given[0], [])
        else:
            self._runner.stop()

    def cancel(self, worker: str) -> None:
        """The worker is this process."""

    def wait(self, timeout: float) -> list[Answer]:
        """Make the chunk that was given, or wait for one whose files are being written."""
        if self._given is not None:
            (worker, order), self._given = self._given, None
            start = self.now()
            begun = self._runner.begin(order)
            if self.now() - start > SLOW * len(order.items):
                self._tell(worker, "run", order.number, self._runner.settle(begun))
            else:
                self._ending += 1
                self._tell(worker, "begun", order.number)
                self._settling.submit(self._runner.settle, begun).add_done_callback(
                    lambda done: self._told.put((worker, "run", order.number, done))
                )
        answers: list[Answer] = []
        while not self._told.empty() or (self._ending and not answers):
            try:
                worker, method, number, found = self._told.get(timeout=timeout)
            except queue.Empty:
                break
            answers.append(Answer(worker, method, number, found.result()))
            self._ending -= method == "run"
        return answers

    def _tell(self, worker: str, method: str, number: int, found: Any = None) -> None:
        """Let an answer come into the queue."""
        done: Future[Any] = Future()
        done.set_result(found)
        self._ending += method == "run"
        self._told.put((worker, method, number, done))

    def close(self) -> None:
        """Wait for files that are being written, and close the notes of the worker."""
        self._settling.shutdown()
        self._runner.close()


Process = LocalProcess | RayProcess


class ProcessEngine:
    """Runs chunks in processes that a host starts; settings: of every worker, its name and notes are filled in."""

    def __init__(self, host: LocalHost | RayHost, settings: RunnerSettings):
        self._host = host
        self.settings = dataclasses.replace(settings, device=host.share.device, threads=host.share.threads)
        self.overlapping = host.share.workers <= MOST_OVERLAPPING
        self._answers: queue.SimpleQueue[tuple[str, Process, str, int, Future[Any]]] = queue.SimpleQueue()
        self._processes: dict[str, Process] = {}
        self.places: dict[str, dict[str, Any]] = {}  # pid and host of each that has started
        self._ready: set[str] = set()
        self._alone_since = self.now()  # since when no worker is ready, where none is

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def start(self, worker: str, start: int) -> None:
        """Start the process of a worker."""
        notes = f"{self.settings.run}-{worker}-{start}"
        settings = dataclasses.replace(self.settings, worker=worker, notes=notes)
        self._processes[worker] = self._host.start(settings)
        self.submit(worker, "facts")

    def submit(self, worker: str, method: str, *given: Any) -> None:
        """Call a method of its runner; the answer comes into the queue from another thread."""
        process, answers = self._processes[worker], self._answers
        number = given[0].number if method == "run" else given[0] if given else 0
        process.ask(method, *given).add_done_callback(
            lambda answer: answers.put((worker, process, method, number, answer))
        )

    def cancel(self, worker: str) -> None:
        """End a process."""
        self._ready.discard(worker)
        if not self._ready:
            self._alone_since = self.now()
        self.places.pop(worker, None)
        process = self._processes.pop(worker)
        process.kill()
        process.wait()

    def wait(self, timeout: float) -> Iterator[Answer]:
        """What workers answered; a RuntimeError where none could start for a long time."""
        with contextlib.suppress(queue.Empty):
            told = self._answers.get(timeout=timeout)
            while True:
                worker, process, method, number, answer = told
                if process is self._processes.get(worker):  # else one that is gone
                    error = answer.exception()
                    if error is not None:
                        yield Answer(worker, method, number, None, self._host.death_line(error))
                    else:
                        if method == "facts":
                            self._ready.add(worker)
                            self.places[worker] = answer.result()
                        yield Answer(worker, method, number, answer.result())
                told = self._answers.get_nowait()
        if not self._ready and self.now() - self._alone_since > self._host.patience:
            raise StateError(f"no worker started within {self._host.patience:.0f} s{self._host.no_place}")

    def close(self) -> None:
        """End all workers."""
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait()
        self._processes.clear()
