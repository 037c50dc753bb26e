"""Python threads that launch parts of a kernel on the CPU."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

#: Threads a CPU launch is cut over. Warp's CPU backend runs one launch on one thread, and releases the GIL meanwhile.
CPU_THREADS = os.cpu_count() or 1

_pool: ThreadPoolExecutor | None = None


def run_parallel(tasks, threads: int | None = None) -> list:
    """Run callables on the shared CPU thread pool and return their results in order (the first error is raised).

    After an error or an interrupt no task is left running: its arrays may be freed as soon as this returns.
    """
    global _pool
    if (CPU_THREADS if threads is None else threads) <= 1 or len(tasks) == 1:
        return [task() for task in tasks]
    if _pool is None:
        _pool = _started_pool()
    batch = _Batch()
    try:
        return list(_pool.map(batch.run, tasks))
    except BaseException:
        batch.stop()
        raise


def _started_pool() -> ThreadPoolExecutor:
    """A pool with all its threads running, as an interrupt that meets the start of one leaves it behind for ever."""
    pool = ThreadPoolExecutor(CPU_THREADS, thread_name_prefix="warpcage")
    all_there = threading.Barrier(CPU_THREADS)
    for future in [pool.submit(all_there.wait, timeout=60) for _ in range(CPU_THREADS)]:
        future.result()
    return pool


class _Batch:
    """Tasks of which none begins once it was stopped. It counts those that run, as an interrupt in the middle of
    handing a task over leaves no future to wait for."""

    def __init__(self):
        self._changed = threading.Condition()
        self._running, self._stopped = 0, False

    def run(self, task):
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


def _forget_pool() -> None:
    """A forked process has the pool without its threads: tasks would wait in it for ever."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_forget_pool)
