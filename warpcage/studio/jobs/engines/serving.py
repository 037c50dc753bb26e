"""Processes of this machine that work for a driver: how they are started, and what they do until it is gone."""

# A driver that has a process of this module start while it loads itself, and plans, has a worker that many seconds
# sooner. So nothing is imported here that takes time.

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

#: Seconds that a process gets to be gone after it was killed: one that waits for a disk may take longer.
GONE = 10.0


class Started:
    """A process that waits for the settings of its worker, and ends with the thread that started it.
    loads: meanwhile it loads what makes items, and starts the device."""

    def __init__(self, environment: dict[str, str], loads: bool = False, device: str | None = None):
        self.stderr = tempfile.TemporaryFile()  # what it prints, of which only the last line may ever be shown
        program = f"import sys; sys.path[:] = {[*map(str, sys.path)]!r}; from {__name__} import serve"
        self.process = subprocess.Popen(
            [sys.executable, "-c", f"{program}; serve({loads}, {device and str(device)!r})"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.stderr,
            env=os.environ | environment,
            start_new_session=True,  # Ctrl-C is for the driver, which lets it end what it has begun
        )

    def end(self) -> None:
        """Kill the process, wherever it is at, and wait until it is gone."""
        self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(GONE)

    def close(self) -> None:
        """End a process that was not used."""
        self.end()
        for pipe in (self.process.stdin, self.process.stdout, self.stderr):
            if pipe is not None:
                pipe.close()


def gpu_of(number: int) -> dict[str, str]:
    """Environment of a process for one GPU, by its number among those seen here; empty where there is none."""
    seen = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = [str(number)] * (number + 1) if seen is None else seen.split(",") if seen else []
    return {"CUDA_VISIBLE_DEVICES": names[number]} if number < len(names) else {}


@dataclasses.dataclass
class _Early:
    """Processes that were started before it is known whether they have work; each is taken once."""

    workers: int = 0
    device: str | None = None
    waiting: dict[int, Started] = dataclasses.field(default_factory=dict)  # by the number of their worker


_early = _Early()


@contextlib.contextmanager
def early_processes(workers: int, count: int, device: str | None) -> Iterator[None]:
    """Start the first `count` of so many processes, for the first run in the block that asks for them.
    None that it did not take is left afterwards."""
    global _early
    before, _early = _early, _Early(workers, device)
    try:
        for number in range(count):
            _early.waiting[number] = Started(early_environment(workers, number, device), True, device)
        yield
    finally:
        for started in _early.waiting.values():
            started.close()
        _early = before


def taken_early(workers: int, number: int, device: str | None) -> Started | None:
    """The process that was started for a worker of so many; None where none was, or it was taken."""
    is_alike = (workers, device) == (_early.workers, _early.device)
    return _early.waiting.pop(number, None) if is_alike else None


def early_environment(workers: int, number: int, device: str | None) -> dict[str, str]:
    """Environment of the process of one of several workers, before it is known whether there are GPUs."""
    return gpu_of(number) if workers > 1 and device != "cpu" else {}


def message(pipe: Any) -> bytes | None:
    """The next message of a pipe; None where it has ended, also in the midst of one."""
    size = int.from_bytes(pipe.read(8), "little")
    found = pipe.read(size)
    return found if size and len(found) == size else None


def serve(loads: bool, device: str | None) -> None:
    """What a process of a worker does: answer what its driver asks, each in a thread, until that is gone.
    loads, device: as `Started` has them."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # with its driver, also where it hangs: PR_SET_PDEATHSIG
    asked, answers, lock = sys.stdin.buffer, os.fdopen(os.dup(1), "wb"), threading.Lock()
    os.dup2(2, 1)  # what is printed is no answer
    if loads:
        with contextlib.suppress(Exception):  # it is met again, and reported, where the runner is made
            _load(device)
    settings = message(asked)
    if settings is None:
        return
    from ....core.names import error_line
    from .chunk_runner import MAX_CALLS, make_runner

    pool = ThreadPoolExecutor(MAX_CALLS + 1, "warpcage-calls")
    runner = pool.submit(lambda: make_runner(pickle.loads(settings)))

    def answer(number: int, method: str, given: tuple[Any, ...]) -> None:
        error = found = None
        begun = False
        try:
            call = getattr(runner.result(), method)
            begun = True
            found = call(*given)
        except BaseException as failure:
            error = f"its worker {'failed' if begun else 'could not start'}: {error_line(failure, named=True)}"
        reply = pickle.dumps((number, error, found))
        with lock:
            answers.write(len(reply).to_bytes(8, "little") + reply)
            answers.flush()

    while (call := message(asked)) is not None:
        pool.submit(answer, *pickle.loads(call))
    os._exit(0)  # its driver is gone


def _load(device: str | None) -> None:
    """Load what makes items, and start the device."""
    from ....core.devices import resolve_device
    from .. import worker  # noqa: F401
    from .chunk_runner import check_device

    check_device(resolve_device(device))
