"""Processes of this machine that work for a driver: how they are started and asked, and what they do."""

# A driver that has a process of this module start while it loads itself, and plans, has a worker that many seconds
# sooner. So nothing is imported here that takes time.

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from ....package import PausedCollection

if TYPE_CHECKING:
    from .chunk_runner import ChunkRunner

#: Seconds that a process gets to be gone after it was killed: one that waits for a disk may take longer.
GONE = 10.0


class WorkerDied(RuntimeError):
    """Why a process answers no more: one line."""


class LocalProcess:
    """A process of this machine, which ends with the thread that started it. Calls and answers go through pipes.
    loads: before its settings come it loads what makes items, and starts the device."""

    def __init__(self, workers: int, number: int, device: str | None, loads: bool = False):
        self._stderr = tempfile.TemporaryFile()  # what it prints, of which only the last line may ever be shown
        program = f"import sys; sys.path[:] = {[*map(str, sys.path)]!r}; from {__name__} import serve"
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"{program}; serve({loads}, {device and str(device)!r})"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env=os.environ | (gpu_of(number) if workers > 1 and device != "cpu" else {}),
            start_new_session=True,  # Ctrl-C is for the driver, which lets it end what it has begun
        )
        self._numbers, self._ended = itertools.count(), ""
        self._waiting: dict[int, Future[Any]] = {}
        self._sender = ThreadPoolExecutor(1, "warpcage-process")  # a process that hangs reads nothing
        threading.Thread(target=self._receive, name="warpcage-process", daemon=True).start()

    def send(self, content: Any) -> None:
        """Send an object, the settings of its worker, pickled, first; nothing to a process that has ended."""
        message = pickle.dumps(content)
        if not self._ended:
            with contextlib.suppress(RuntimeError):  # it ended just now
                self._sender.submit(write_message, self._process.stdin, message)

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the worker's runner; the answer comes later."""
        number, future = next(self._numbers), Future[Any]()
        self._waiting[number] = future
        self.send((number, method, given))
        self._end_calls()
        return future

    def kill(self) -> None:
        """End the process, wherever it is at."""
        self._process.kill()

    def wait(self) -> None:
        """Wait until a process that was killed is gone."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GONE)

    def _receive(self) -> None:
        """Receive answers, in a thread, until the process ends."""
        assert self._process.stdout is not None and self._process.stdin is not None
        with self._process.stdout as pipe, self._stderr:
            while (answer := received(pipe)) is not None:
                number, error, found = answer
                future = self._waiting.pop(number)
                if error is None:
                    future.set_result(found)
                else:
                    future.set_exception(WorkerDied(error))
            self._ended = self._last_line(self._process.wait())
        self._end_calls()
        self._sender.shutdown()
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def _end_calls(self) -> None:
        """Let calls fail that a process that has ended does not answer; any thread may call it."""
        while self._ended and self._waiting:
            with contextlib.suppress(KeyError):  # another thread took it
                self._waiting.popitem()[1].set_exception(WorkerDied(self._ended))

    def _last_line(self, status: int) -> str:
        """Why the process ended; status: negative is a signal."""
        if status < 0:
            return "its worker died: killed, or a crash of the process"
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"its worker died: exit status {status}{': ' if last else ''}{last}"


def gpu_of(number: int) -> dict[str, str]:
    """Environment of a process for one GPU, by its number among those seen here; empty where there is none."""
    seen = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = [str(number)] * (number + 1) if seen is None else seen.split(",") if seen else []
    return {"CUDA_VISIBLE_DEVICES": names[number]} if number < len(names) else {}


#: Processes that were started before it is known whether they have work, by the arguments of their `LocalProcess`.
_early: dict[tuple[int, int, str | None], LocalProcess] = {}


@contextlib.contextmanager
def early_processes(workers: int, count: int, device: str | None, loads: bool = True) -> Iterator[None]:
    """Start the first `count` of so many processes, unless they are there, for the first run in the block.
    Processes that it did not take are ended afterwards."""
    keys = [(workers, number, device) for number in range(count)]
    try:
        for key in keys:
            if key not in _early:
                _early[key] = LocalProcess(*key, loads)
        yield
    finally:
        left = [process for key in keys if (process := _early.pop(key, None)) is not None]
        for process in left:
            process.kill()
        for process in left:
            process.wait()


def process_of(workers: int, number: int, device: str | None) -> LocalProcess:
    """The process of one of several workers, one that was started early if there is one."""
    key = workers, number, device
    return _early.pop(key, None) or LocalProcess(*key)


def received(pipe: Any) -> Any:
    """The next object of a pipe; None where it has ended, also in the midst of one."""
    with contextlib.suppress(EOFError, pickle.UnpicklingError):
        return pickle.load(pipe)


def write_message(pipe: Any, message: bytes) -> None:
    """Write a pickled object into a pipe."""
    pipe.write(message)
    pipe.flush()


def serve(loads: bool, device: str | None) -> None:
    """The work of a process: answer the calls of its driver, each in a thread, until that is gone.
    loads, device: as `LocalProcess` has them."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # with its driver, also where it hangs: PR_SET_PDEATHSIG
    calls, answers, lock = sys.stdin.buffer, os.fdopen(os.dup(1), "wb"), threading.Lock()
    os.dup2(2, 1)  # what is printed is no answer
    if loads:
        # what goes wrong is raised again, and reported, where the runner is made
        with PausedCollection(frozen=True), contextlib.suppress(Exception):
            from ....core.devices import resolve_device
            from .. import worker  # noqa: F401
            from .chunk_runner import check_device

            check_device(resolve_device(device))
    settings = received(calls)
    if settings is None:
        return
    with PausedCollection(frozen=True):
        from ....core.names import error_line
        from .chunk_runner import MAX_CALLS, make_runner

    def make() -> ChunkRunner:
        with PausedCollection(frozen=True):
            return make_runner(pickle.loads(settings))

    pool = ThreadPoolExecutor(MAX_CALLS + 1, "warpcage-calls")
    runner = pool.submit(make)

    def answer(number: int, method: str, given: tuple[Any, ...]) -> None:
        error = found = None
        try:
            found = getattr(runner.result(), method)(*given)
        except BaseException as failure:
            action = "could not start" if failure is runner.exception() else "failed"
            error = f"its worker {action}: {error_line(failure, named=True)}"
        message = pickle.dumps((number, error, found))
        with lock:
            write_message(answers, message)

    while (call := received(calls)) is not None:
        pool.submit(answer, *call)
    os._exit(0)  # its driver is gone
