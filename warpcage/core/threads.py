"""Python threads that launch parts of a kernel on the CPU, and locks of devices and of objects that own buffers."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from ..errors import InputError

if TYPE_CHECKING:
    import warp as wp

#: Environment variable with the number of CPU threads to use, where all cores would be too many.
THREADS_VARIABLE = "WARPCAGE_THREADS"

#: A part of a long launch aims at this many seconds: an interrupt waits for the parts that run.
PART_SECONDS = 0.2

#: A part that takes less than this costs more to begin than it brings, and so do other threads for less than that.
MIN_PART_SECONDS, MIN_SHARED_SECONDS = 0.0005, 0.002

#: A part of items that turn out to be quick has at most this many times those of the first part.
MAX_GROWTH = 8

#: Parts of a launch for each thread, so that none is left with the last long one: of many items, and of few, where each
#: part should have ITEMS_PER_PART.
PARTS_PER_THREAD, MIN_PARTS, ITEMS_PER_PART = 8, 2, 2048

#: Seconds that a garbage collection waits for a capture, at most: the capture may wait for what its thread holds.
MAX_COLLECTION_WAIT = 1.0

_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()
_limit: int | None = None  # of `limit_threads`


def cpu_threads() -> int:
    """Threads over which launches on the CPU are cut: what WARPCAGE_THREADS asks for, else the number of cores."""
    # Warp's CPU backend runs a launch on one thread, without the GIL.
    if _limit is not None:
        return _limit
    asked = os.environ.get(THREADS_VARIABLE, "")
    if not asked:
        return os.cpu_count() or 1
    if not (asked.isascii() and asked.isdigit() and int(asked) >= 1):
        raise InputError(f"{THREADS_VARIABLE} must be a whole number of at least 1, got {asked!r}")
    return int(asked)


@contextlib.contextmanager
def limit_threads(count: int) -> Iterator[None]:
    """Use another number of CPU threads for a while, in this process: in all its threads."""
    global _limit
    before, _limit = _limit, count
    _forget_pool()
    try:
        yield
    finally:
        _limit = before
        _forget_pool()


def run_parallel(
    tasks: Sequence[Callable[[], Any]],
    threads: int | None = None,
    stop: Callable[[], None] | None = None,
    here: int = 0,  # how many of the first ones this thread runs
) -> list[Any]:
    """Run tasks on the shared pool of CPU threads, or here where `threads` is 1; returns their results in order.
    Several threads may do so at once. The first error is raised, after `stop`, by which long tasks can end early."""
    # After an error or an interrupt no task is left running: its arrays may be freed as soon as this returns.
    if (cpu_threads() if threads is None else threads) <= 1 or len(tasks) == 1:
        return [task() for task in tasks]
    pool = _shared_pool()
    batch = _Batch()
    try:
        others = pool.map(batch.run, tasks[here:])
        return [*map(batch.run, tasks[:here]), *others]
    except BaseException:
        if stop is not None:
            stop()
        batch.stop()
        raise


def run_parts(run: Callable[[int, int], None], count: int, threads: int, first: int) -> None:
    """Run items in parts, `run(begin, end)`, on the shared pool; 1 thread runs them here.
    `first`: items that a part has at most, until it is known how long they take."""
    # The first few run here, and so does the rest where it would be done as soon as other threads have begun.
    parts = _Parts(count, threads, first)
    if threads > 1 and parts.run_here(run):
        return

    def work() -> None:
        while (part := parts.take()) is not None:
            begun = time.perf_counter()
            try:
                run(*part)
            except BaseException:
                parts.stop()
                raise
            parts.note(part[1] - part[0], time.perf_counter() - begun)

    # This thread is one of them: if it waited, the others would begin on one core, until the system shares them out.
    run_parallel([work] * threads, threads, parts.stop, here=1)


class _Parts:
    """Splits the items of a launch into parts, sized by how long the ones before took."""

    def __init__(self, count: int, threads: int, first: int):
        self._lock = threading.Lock()
        self._next, self._count, self._threads = 0, count, threads
        # items differ: where the first ones are quick, the next may be as slow as was foreseen
        parts = max(MIN_PARTS, min(PARTS_PER_THREAD, count // (ITEMS_PER_PART * threads))) * threads
        self._most = MAX_GROWTH * first
        self._largest = min(self._most, -(-count // parts) if threads > 1 else count)
        self._size = max(1, min(first, self._largest))
        self._least = 1  # items that are worth a part

    def run_here(self, run: Callable[[int, int], None]) -> bool:
        """Run a part, and the rest where it is not worth the other threads; returns whether all is done."""
        end = min(self._size, ITEMS_PER_PART)
        begun = time.perf_counter()
        run(0, end)
        seconds = time.perf_counter() - begun
        self._next = end
        if (self._count - end) * seconds < MIN_SHARED_SECONDS * end:
            self._next = self._count
            if self._count > end:
                run(end, self._count)
            return True
        self.note(end, seconds)
        return False

    def take(self) -> tuple[int, int] | None:
        """First and last item (exclusive) of the next part; None where there is none."""
        with self._lock:
            begin = self._next
            fair = -(-(self._count - begin) // self._threads)  # so that the other threads get as much
            self._next = min(begin + min(self._size, max(fair, self._least)), self._count)
            return (begin, self._next) if self._next > begin else None

    def note(self, items: int, seconds: float) -> None:
        """How long a part took, for the next ones."""
        rate = items / max(seconds, 1e-9)
        with self._lock:
            self._least = int(max(1, min(self._most, rate * MIN_PART_SECONDS)))
            self._size = int(max(self._least, min(self._largest, rate * PART_SECONDS)))

    def stop(self) -> None:
        """Let no further part begin."""
        with self._lock:
            self._next = self._count


def _shared_pool() -> ThreadPoolExecutor:
    """The pool, started at its first use."""
    global _pool
    with _pool_lock:
        pool = _pool
        if pool is None:
            pool = _pool = _started_pool()
        return pool


def _started_pool() -> ThreadPoolExecutor:
    """A pool with all its threads running: an interrupt during the start of a thread would leave it broken for good."""
    count = cpu_threads()
    pool = ThreadPoolExecutor(count, thread_name_prefix="warpcage")
    all_there = threading.Barrier(count)
    for future in [pool.submit(all_there.wait, timeout=60) for _ in range(count)]:
        future.result()
    return pool


class _Batch:
    """Tasks that can be stopped: none begins afterwards."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        # counted: an interrupt while tasks are submitted leaves no future to await
        self._running, self._stopped = 0, False

    def run(self, task: Callable[[], Any]) -> Any:
        with self._changed:
            if self._stopped:
                return None
            self._running += 1
        try:
            return task()
        finally:
            with self._changed:
                self._running -= 1
                self._changed.notify_all()

    def stop(self) -> None:
        """Let none begin any more, and wait for those that run."""
        with self._changed:
            self._stopped = True
            self._changed.wait_for(lambda: self._running == 0)


#: What `threading.RLock()` makes: a lock that the thread that holds it may take again.
Lock: TypeAlias = "contextlib.AbstractContextManager[bool]"

_Method = TypeVar("_Method", bound=Callable[..., Any])

_device_locks: dict[int, Lock] = {}


def device_turn(device: wp.Device) -> contextlib.AbstractContextManager[object]:
    """What to hold (`with`) while work for a device is launched: one lock in the process for each CUDA device."""
    # Warp's current stream and list of captures belong to a CUDA device: another thread's launch would land in this
    # one's graph, or on a side stream that nothing waits for. Launched work needs no lock. CPU launches share no state.
    return contextlib.nullcontext() if device.is_cpu else _device_lock(device)


def owner_lock(device: wp.Device) -> Lock:
    """The lock of an object that owns buffers on a device: its own on the CPU, `device_turn` on CUDA."""
    # On the CPU threads with an object each do not wait; on CUDA two locks could make two threads wait for ever.
    return threading.RLock() if device.is_cpu else _device_lock(device)


def in_turn(method: _Method) -> _Method:
    """Let a method of an object with a `device` hold `device_turn` of it."""

    @functools.wraps(method)
    def turn(self: Any, *args: Any, **options: Any) -> Any:
        with device_turn(self.device):
            return method(self, *args, **options)

    return turn  # pyright: ignore[reportReturnType]


def collector_lock() -> Lock:
    """A lock: while a thread holds it, garbage collections of other threads wait."""
    # Arrays that a collection frees are given back on CUDA's default stream. While another thread begins a capture that
    # is an error, and ends the capture (Warp 1.19; what is freed once it has begun waits for its end).
    if _note_collection not in gc.callbacks:
        gc.callbacks.append(_note_collection)
    return _collector_lock


_collector_lock = threading.RLock()

_collecting = threading.local()


def _note_collection(phase: str, _: dict[str, Any]) -> None:
    """Hold the lock from the start of a collection to its end."""
    if phase == "start":
        lock = _collector_lock
        _collecting.lock = lock if lock.acquire(timeout=MAX_COLLECTION_WAIT) else None
    elif (held := getattr(_collecting, "lock", None)) is not None:  # else it began before this was called
        _collecting.lock = None
        held.release()


def _device_lock(device: wp.Device) -> Lock:
    return _device_locks.setdefault(device.ordinal, threading.RLock())


def _forget_pool() -> None:
    """Start another pool with the next tasks; those that are under way end in the old one."""
    global _pool
    with _pool_lock:
        _pool = None


def _begin_child() -> None:
    """A forked process lacks the threads of the pool, and those that may hold a lock: tasks would wait for ever."""
    global _pool, _pool_lock, _collector_lock
    _pool, _pool_lock, _collector_lock = None, threading.Lock(), threading.RLock()
    _device_locks.clear()


if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_begin_child)
