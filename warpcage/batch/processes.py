"""Processes of workers on this machine: how one is started, asked and ended, and what it does."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import itertools
import os
import pickle
import platform
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

import warp as wp

from ..core.devices import start_warp
from ..core.names import error_line
from ..core.threads import cpu_threads, limit_threads
from .chunk_runner import ChunkOrder, ChunkRunner
from .runners import RunnerSettings, make_runner
from .scheduler import MOST_CHUNKS, ChunkReport

#: Calls that a worker answers at once: one a chunk, one that tells when all items are begun, and one that shortens a
#: chunk or tells of items.
MOST_CALLS = MOST_CHUNKS + 2

#: Seconds within which the first worker must have started here.
START_HERE = 120.0

#: Seconds that a process gets to be gone after it was killed: one that waits for a disk may take longer.
GONE = 10.0


class ChunkActor:
    """What runs in the process of a worker."""

    def __init__(self, settings: RunnerSettings):
        self._settings = settings
        self._limits = contextlib.ExitStack()
        if settings.threads:
            self._limits.enter_context(limit_threads(settings.threads))
        self._runner: ChunkRunner = make_runner(settings)

    def facts(self) -> dict[str, Any]:
        """Where it works, once it can."""
        return {"pid": os.getpid(), "host": platform.node()}

    def run(self, order: ChunkOrder) -> ChunkReport:
        """Make a chunk."""
        return self._runner.run(order)

    def begun(self, number: int) -> None:
        """Wait until all items of a chunk are begun."""
        self._runner.wait_until_begun(number)

    def recall(self, number: int, share: float) -> list[int]:
        """Give items back."""
        return self._runner.recall(number, share)

    def oldest(self, number: int) -> tuple[int, float] | None:
        """The item that has been under way for longest, and for how long."""
        return self._runner.oldest(number)

    def stop(self) -> None:
        """Begin no more items."""
        self._runner.stop()


class Process(Protocol):
    """A process with a `ChunkActor`, here or on another machine."""

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the actor; the answer comes later."""
        ...

    def kill(self) -> None:
        """End the process, wherever it is at."""
        ...

    def wait(self) -> None:
        """Wait until a process that was killed is gone, where that can be known."""
        ...


class WorkerDied(RuntimeError):
    """Why a process here answers no more: one line."""


class LocalProcess:
    """A process of this machine, which ends with whoever started it. What is asked and answered goes through pipes."""

    def __init__(self, settings: RunnerSettings, environment: dict[str, str]):
        self._words = tempfile.TemporaryFile()  # what it prints, of which only the last line may ever be shown
        program = f"import sys; sys.path[:] = {[*map(str, sys.path)]!r}; from {__name__} import serve; serve()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._words,
            env=os.environ | environment,
            start_new_session=True,  # Ctrl-C is for the driver, which lets it end what it has begun
        )
        self._lock, self._numbers, self._ended = threading.Lock(), itertools.count(), ""
        self._waiting: dict[int, Future[Any]] = {}
        self._asked: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._asked.put(pickle.dumps(settings))
        for work in (self._send, self._receive):  # a process that hangs reads nothing: nobody else is to wait for it
            threading.Thread(target=work, name="warpcage-process", daemon=True).start()

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the actor; the answer comes later."""
        future: Future[Any] = Future()
        with self._lock:
            number, ended = next(self._numbers), self._ended
            if not ended:
                self._waiting[number] = future
        if ended:
            future.set_exception(WorkerDied(ended))
        else:
            self._asked.put(pickle.dumps((number, method, given)))
        return future

    def kill(self) -> None:
        """End the process, wherever it is at."""
        self._process.kill()

    def wait(self) -> None:
        """Wait until a process that was killed is gone."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GONE)

    def _send(self) -> None:
        """Hand over what is asked, in a thread."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError), self._process.stdin as pipe:
            while (message := self._asked.get()) is not None:
                pipe.write(len(message).to_bytes(8, "little") + message)
                pipe.flush()

    def _receive(self) -> None:
        """Hand over answers, in a thread, until the process ends."""
        assert self._process.stdout is not None
        with self._process.stdout as pipe, self._words:
            while (answer := _message(pipe)) is not None:
                number, error, found = pickle.loads(answer)
                future = self._waiting.pop(number)
                if error is None:
                    future.set_result(found)
                else:
                    future.set_exception(WorkerDied(error))
            line = self._last_words(self._process.wait())
        with self._lock:
            self._ended = line
        self._asked.put(None)
        for future in self._waiting.values():
            future.set_exception(WorkerDied(line))

    def _last_words(self, status: int) -> str:
        """Why the process ended; status: negative is a signal."""
        if status < 0:
            return "its worker died: killed, or a crash of the process"
        self._words.seek(0)
        lines = self._words.read().decode(errors="replace").split("\n")
        said = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"its worker died: exit status {status}{': ' if said else ''}{said}"


def _message(pipe: Any) -> bytes | None:
    """The next message of a pipe; None where it has ended, also in the midst of one."""
    size = int.from_bytes(pipe.read(8), "little")
    message = pipe.read(size)
    return message if size and len(message) == size else None


def serve() -> None:
    """What a process of a worker does: answer what its driver asks, each in a thread, until that is gone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # with its driver, also where it hangs: PR_SET_PDEATHSIG
    asked, answers, lock = sys.stdin.buffer, os.fdopen(os.dup(1), "wb"), threading.Lock()
    os.dup2(2, 1)  # what is printed is no answer
    settings = _message(asked)
    if settings is None:
        return
    pool = ThreadPoolExecutor(MOST_CALLS + 1, "warpcage-calls")
    actor = pool.submit(lambda: ChunkActor(pickle.loads(settings)))

    def answer(number: int, method: str, given: tuple[Any, ...]) -> None:
        error = found = None
        begun = False
        try:
            call = getattr(actor.result(), method)
            begun = True
            found = call(*given)
        except BaseException as failure:
            error = f"its worker {'failed' if begun else 'could not start'}: {error_line(failure, named=True)}"
        message = pickle.dumps((number, error, found))
        with lock:
            answers.write(len(message).to_bytes(8, "little") + message)
            answers.flush()

    while (message := _message(asked)) is not None:
        pool.submit(answer, *pickle.loads(message))
    os._exit(0)  # nobody is there to hear of what it makes


@dataclasses.dataclass(frozen=True)
class Share:
    """What each worker gets of a machine."""

    workers: int
    gpus: int  # of each, 0 or 1
    cpus: float  # cores that Ray sets aside for each, on clusters
    threads: int  # of each for kernels on the CPU; 0 is what there is
    device: str | None


class LocalHost:
    """Starts workers on this machine: one a GPU, else with equal parts of the cores; one alone has what there is."""

    def __init__(self, workers: int, device: str | None, gpus: Callable[[], int] | None = None):
        self._gpus = ""
        if workers == 1:
            self.share = Share(1, 0, 0, 0, device)
            return
        require_shared(device)
        count = 0 if device == "cpu" else (gpus or _count_gpus)()
        if device == "cuda" and not count:
            raise ValueError("device 'cuda' is not there: this machine has no GPU that Warp sees")
        if count and workers > count:
            raise ValueError(f"{workers} workers need as many GPUs, this machine has {count}: give --workers {count}")
        self._gpus = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
        threads = max(1, cpu_threads() // workers)
        self.share = Share(workers, min(count, 1), 0, threads, "cuda:0" if count else "cpu")

    def start(self, settings: RunnerSettings) -> LocalProcess:
        """Start the process of a worker."""
        gpu = {"CUDA_VISIBLE_DEVICES": self._gpus.split(",")[int(settings.worker)]} if self.share.gpus else {}
        return LocalProcess(settings, gpu)

    def waited(self, seconds: float) -> None:
        """Raise RuntimeError where no worker started for a long time."""
        if seconds > START_HERE:
            raise RuntimeError(f"no worker started within {START_HERE:.0f} s")

    def death_line(self, error: BaseException) -> str:
        """Why a worker gives no answer but an error: the line of its process."""
        return str(error)


def require_shared(device: str | None) -> None:
    """Raise ValueError for a device that several workers cannot share."""
    if device not in (None, "cpu", "cuda"):
        raise ValueError(f"--device of several workers is cpu or cuda, each has the GPU of its number, got {device!r}")


def _count_gpus() -> int:
    start_warp()
    return len(wp.get_cuda_devices())
