"""Pipelines of threads: pictures are encoded while the next ones are rendered, and only few of them wait."""

from __future__ import annotations

# Pictures are made in the caller's thread, where interrupts arrive and a device is talked to; encoding runs beside it,
# without the interpreter's lock. The faster waits for the other, so that memory does not grow with their number.
import queue
import threading
import types
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from ...core.threads import cpu_threads

#: Bytes of what waits and is worked on, at most; of larger items one at a time.
ROOM = 1 << 29

#: Threads at most: of tasks, such as a PNG file each, and of what is prepared for one encoder.
TASK_THREADS, PREPARING_THREADS = 16, 4

#: Items that are taken beyond the number of threads, so that no thread waits for the next one.
SPARE = 2

_Item = TypeVar("_Item")
_Prepared = TypeVar("_Prepared")


class BackgroundWriter:
    """Runs tasks on a few threads of its own while the caller makes the next ones (`with`); the block ends when all are
    done. The first error of a task is raised by `run` or at the end. `room`: bytes that unfinished tasks may hold."""

    # After an error, in the block or of a task, or an interrupt, no task begins any more; those that run are awaited.

    def __init__(self, threads: int | None = None, room: int = ROOM):
        count = min(TASK_THREADS, cpu_threads()) if threads is None else threads
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="warpcage-beside")
        self._gate = Gate(count + SPARE, room)
        self._error: BaseException | None = None

    def run(self, task: Callable[[], Any], size: int = 0) -> None:
        """Submit a task that holds so many bytes; waits while too many are unfinished."""
        if self._gate.enter(size):
            self._pool.submit(self._run, task, size)
        else:
            self._raise()

    def __enter__(self) -> BackgroundWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._gate.wait_until_empty()
        except BaseException:  # an interrupt
            self._gate.close()
            raise
        finally:
            if kind is not None:
                self._gate.close()
            self._pool.shutdown(cancel_futures=True)
        if kind is None:
            self._raise()

    def _run(self, task: Callable[[], Any], size: int) -> None:
        try:
            if not self._gate.closed:
                task()
        except BaseException as error:
            if self._error is None:
                self._error = error
            self._gate.close()
        finally:
            self._gate.leave(size)

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error


def stream(
    items: Iterable[_Item],
    prepare: Callable[[_Item], _Prepared],
    consume: Callable[[Iterator[_Prepared]], Any],
    *,
    threads: int | None = None,
    room: int = ROOM,
) -> None:
    """Take items in this thread, prepare each on a few others, and consume the results, in order, in one more.
    `room`: bytes (`nbytes` of items) that may wait and be worked on. The first error is raised."""
    # After any error or interrupt nothing is left running: `consume` gets an exception from its iterator, to clean up.
    count = min(PREPARING_THREADS, cpu_threads()) if threads is None else threads
    gate, line = Gate(count + SPARE, room), queue.SimpleQueue[tuple[Future[_Prepared], int] | None]()
    abandoned, ended = threading.Event(), threading.Event()
    failed: list[BaseException] = []

    def prepared() -> Iterator[_Prepared]:
        while True:
            entry = line.get()
            if abandoned.is_set():
                raise _Abandoned
            if entry is None:
                return
            yield entry[0].result()
            gate.leave(entry[1])

    def work() -> None:
        try:
            consume(prepared())
        except BaseException as error:
            failed.append(error)
        finally:
            gate.close()
            ended.set()

    pool = ThreadPoolExecutor(count, thread_name_prefix="warpcage-prepare")
    consumer = threading.Thread(target=work, name="warpcage-consume")
    consumer.start()
    try:
        for item in items:
            size = getattr(item, "nbytes", 0)
            if not gate.enter(size):
                break
            line.put((pool.submit(prepare, item), size))
            del item  # what is rendered next may take its place
        line.put(None)
        ended.wait()  # a `join` that is interrupted would take the thread for ended (Python before 3.13)
    except BaseException:
        abandoned.set()
        line.put(None)
        raise
    finally:
        ended.wait()
        consumer.join()
        pool.shutdown(cancel_futures=True)
    if failed:
        raise failed[0]


class _Abandoned(Exception):
    """What a consumer gets where the items end in an error."""


class Gate:
    """Bounds the items and bytes that are in work; one item may be of any size."""

    def __init__(self, most: int, room: int = ROOM):
        self._changed = threading.Condition()
        self._most, self._room = most, room
        self._count = self._bytes = 0
        self.closed = False

    def enter(self, size: int) -> bool:
        """Wait for room for so many bytes, and take it; False where the gate is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._fits(size))
            if self.closed:
                return False
            self._count += 1
            self._bytes += size
            return True

    def leave(self, size: int) -> None:
        """Give room back: as many bytes as came in."""
        with self._changed:
            self._count -= 1
            self._bytes -= size
            self._changed.notify_all()

    def close(self) -> None:
        """Let nothing in any more."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def wait_until_empty(self) -> None:
        """Wait until all that came in has left."""
        with self._changed:
            self._changed.wait_for(lambda: self._count == 0)

    def _fits(self, size: int) -> bool:
        return self._count == 0 or (self._count < self._most and self._bytes + size <= self._room)
