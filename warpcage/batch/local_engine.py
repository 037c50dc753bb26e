"""One worker in the process of the driver: no Ray, no other process."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from .chunk_runner import ChunkOrder, ChunkRunner
from .loop import Begun, Event, Finished, Ready, Returned
from .scheduler import MOST_CHUNKS, Chunk, ChunkReport

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
            raise RuntimeError("the device works no more in this process: run again, what is made is kept")
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
