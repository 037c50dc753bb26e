"""Workers in processes of their own: their chunks, their deaths, and what they report."""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol

from .chunk_runner import ChunkOrder
from .loop import ANSWER, Begun, Died, Event, Finished, LateItems, Ready, Returned
from .manifest import DONE, ERROR, FAILED, OutputFolder, notes_of_chunk
from .processes import Process, Share
from .runners import RunnerSettings
from .scheduler import Chunk, ChunkReport

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
