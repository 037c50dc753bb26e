"""Where workers live, this process, others and clusters of Ray: how one is started, asked and ended."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import os
import pickle
import queue
import signal
import socket
import threading
import time
import types
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import warp as wp

from ....core.devices import start_warp
from ....core.names import error_line
from ....core.threads import cpu_threads
from ....errors import InputError, MissingPackageError, StateError
from .chunk_runner import MAX_CALLS, MAX_CHUNKS, Chunk, ChunkRunner, RunnerSettings, make_runner
from .serving import Started, early_environment, gpu_of, message, taken_early


class ChunkActor:
    """What runs in the process of a worker on a cluster."""

    def __init__(self, settings: RunnerSettings):
        self._runner = make_runner(settings)

    def call(self, asked: tuple[Any, ...]) -> Any:
        """Call a method of the runner, by its name and what it is given: Ray packs each argument by itself."""
        method, *given = asked
        return getattr(self._runner, method)(*given)


class WorkerDied(RuntimeError):
    """Why a process here answers no more: one line."""


class LocalProcess:
    """A process of this machine, which ends with the process that started it. Calls and answers go through pipes."""

    def __init__(self, started: Started):
        self._started, self._process, self._stderr = started, started.process, started.stderr
        self._lock, self._numbers, self._ended = threading.Lock(), itertools.count(), ""
        self._waiting: dict[int, Future[Any]] = {}
        self._asked: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        for work in (self._send, self._receive):  # a process that hangs reads nothing: no other thread waits for it
            threading.Thread(target=work, name="warpcage-process", daemon=True).start()

    def begin(self, settings: RunnerSettings) -> None:
        """Send the settings, once."""
        self._asked.put(pickle.dumps(settings))

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the worker's runner; the answer comes later."""
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
        self._started.end()

    def _send(self) -> None:
        """Send calls, in a thread."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError), self._process.stdin as pipe:
            while (message := self._asked.get()) is not None:
                pipe.write(len(message).to_bytes(8, "little") + message)
                pipe.flush()

    def _receive(self) -> None:
        """Receive answers, in a thread, until the process ends."""
        assert self._process.stdout is not None
        with self._process.stdout as pipe, self._stderr:
            while (answer := message(pipe)) is not None:
                number, error, found = pickle.loads(answer)
                future = self._waiting.pop(number)
                if error is None:
                    future.set_result(found)
                else:
                    future.set_exception(WorkerDied(error))
            line = self._last_line(self._process.wait())
        with self._lock:
            self._ended = line
        self._asked.put(None)
        for future in self._waiting.values():
            future.set_exception(WorkerDied(line))

    def _last_line(self, status: int) -> str:
        """Why the process ended; status: negative is a signal."""
        if status < 0:
            return "its worker died: killed, or a crash of the process"
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").split("\n")
        said = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"its worker died: exit status {status}{': ' if said else ''}{said}"


@contextlib.contextmanager
def processes_beforehand(
    workers: int, count: int, device: str | None, loads: bool
) -> Iterator[Mapping[str, LocalProcess]]:
    """Processes of the first `count` of so many workers, by their names; none is left at the end.
    They are those of `early_processes` where there are some. loads: as `Started` has it."""
    processes: dict[str, LocalProcess] = {}
    try:
        for number in range(count):
            started = taken_early(workers, number, device) if loads else None
            if started is None:
                started = Started(early_environment(workers, number, device), loads, device)
            processes[str(number)] = LocalProcess(started)
        yield processes
    finally:
        for process in processes.values():
            process.kill()
        for process in processes.values():
            process.wait()


@dataclasses.dataclass(frozen=True)
class Share:
    """What each worker gets of a machine."""

    workers: int
    gpus: int  # of each, 0 or 1
    cpus: float  # cores that Ray sets aside for each, on clusters
    threads: int  # of each for kernels on the CPU; 0 is what there is
    device: str | None


class LocalHost:
    """Starts workers on this machine: one a GPU, else with equal parts of the cores; one alone has what there is.
    early: processes that were started for them beforehand, by the names of workers."""

    patience, no_place = 120.0, ""  # seconds within which the first worker must have started, and why it has not

    def __init__(
        self,
        workers: int,
        device: str | None,
        gpus: Callable[[], int] | None = None,
        early: Mapping[str, LocalProcess] = types.MappingProxyType({}),
    ):
        self._early = dict(early)
        if workers == 1:
            self.share = Share(1, 0, 0, 0, device)
            return
        require_shared(device)
        count = 0 if device == "cpu" else (gpus or _count_gpus)()
        if device == "cuda" and not count:
            raise InputError("device 'cuda' is not there: this machine has no GPU that Warp sees")
        if count and workers > count:
            raise InputError(f"{workers} workers need as many GPUs, this machine has {count}: give --workers {count}")
        threads = max(1, cpu_threads() // workers)
        self.share = Share(workers, min(count, 1), 0, threads, "cuda:0" if count else "cpu")

    def start(self, settings: RunnerSettings) -> LocalProcess:
        process = self._early.pop(settings.worker, None)
        if process is None:
            process = LocalProcess(Started(gpu_of(int(settings.worker)) if self.share.gpus else {}))
        process.begin(settings)
        return process

    def death_line(self, error: BaseException) -> str:
        """Why a worker gives no answer but an error: the line of its process."""
        return str(error)


def require_shared(device: str | None) -> None:
    """Raise ValueError for a device that several workers cannot share."""
    if device not in (None, "cpu", "cuda"):
        raise InputError(f"--device of several workers is cpu or cuda, each has the GPU of its number, got {device!r}")


def _count_gpus() -> int:
    start_warp()
    return len(wp.get_cuda_devices())


#: Seconds within which a cluster must answer.
CONNECT = 10.0


def load_ray() -> types.ModuleType:
    """Ray, which only clusters need."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no reports of usage
    try:
        import ray
    except ImportError:
        raise MissingPackageError("--cluster needs Ray: pip install 'warpcage[cluster]'") from None
    return ray


@contextlib.contextmanager
def ray_session(cluster: str) -> Iterator[types.ModuleType]:
    """Ray, connected to the cluster at an address; a connection that the program itself has is used as it is."""
    ray = load_ray()
    if ray.is_initialized():
        yield ray
        return
    _require_answer(cluster)
    with _signals_kept():
        try:
            ray.init(address=cluster, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            raise InputError(
                f"no Ray cluster answers at {cluster!r}: {error_line(error, named=True)}. One that asks for a token "
                "wants RAY_AUTH_MODE=token and its own token in ~/.ray/auth_token"
            ) from error
    with contextlib.suppress(Exception):  # its own paragraphs about workers that died, where this version lets us
        from ray._private import ray_logging

        ray_logging.global_worker_stdstream_dispatcher.handlers.clear()
    try:
        yield ray
    finally:
        with _signals_kept():
            ray.shutdown()


def _require_answer(address: str) -> None:
    """Raise ValueError where nothing listens at an address: Ray itself would try for minutes."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or "/" in host:
        raise InputError(f"--cluster takes the address of a Ray cluster, such as 10.0.0.1:6379, got {address!r}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"no Ray cluster answers at {address!r}: {error_line(error, named=True)}") from None


@contextlib.contextmanager
def _signals_kept() -> Iterator[None]:
    """Ray puts a handler of its own in the place of that for SIGTERM, which ends the process at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class RayProcess:
    """A process that Ray has started somewhere."""

    def __init__(self, ray: types.ModuleType, actor: Any):
        self._ray, self._actor = ray, actor

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the worker's runner; the answer comes later."""
        return self._actor.call.remote((method, *given)).future()

    def kill(self) -> None:
        """End the process, whose node may merely not answer."""
        with contextlib.suppress(Exception):
            self._ray.kill(self._actor)

    def wait(self) -> None:
        """Ray does not say."""


class RayHost:
    """Starts workers on a cluster: one a GPU, else with the cores in equal parts.
    workers: None is all GPUs, or one a machine where there are none; there may be more machines later."""

    patience = 900.0  # it may have to wait for machines

    def __init__(self, ray: types.ModuleType, workers: int | None, device: str | None):
        require_shared(device)
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        gpus = int(sum(node.get("GPU", 0) for node in nodes))
        cores = [int(node.get("CPU", 0)) for node in nodes]
        if device == "cuda" or (gpus and device is None):
            on_one = max((int(node.get("GPU", 0)) for node in nodes), default=1) or 1
            self.share = Share(workers or gpus, 1, 0, max(1, max(cores, default=1) // on_one), "cuda:0")
        else:
            workers = workers or len(nodes)
            each = max(1, sum(cores) // workers)
            while each > 1 and sum(count // each for count in cores) < workers:  # so that none waits for a place
                each -= 1
            self.share = Share(workers, 0, each, each, "cpu")
        need = f"{self.share.gpus} GPUs and {self.share.cpus:g} CPUs"
        self.no_place = f": Ray has no place for one with {need}"
        self._ray = ray
        self._actor = ray.remote(ChunkActor).options(
            num_gpus=self.share.gpus,
            num_cpus=self.share.cpus,
            max_concurrency=MAX_CALLS,
            max_restarts=0,
            scheduling_strategy="SPREAD",
        )

    def start(self, settings: RunnerSettings) -> RayProcess:
        return RayProcess(self._ray, self._actor.remote(settings))

    def death_line(self, error: BaseException) -> str:
        """Why a worker gives no answer but an error: one line instead of Ray's paragraphs."""
        cause = getattr(error, "cause", None)  # of an error in the actor itself
        if isinstance(cause, BaseException):
            return f"its worker failed: {error_line(cause, named=True)}"
        text = str(error)
        if "creation task" in text:
            return f"its worker could not start: {text.strip().splitlines()[-1].strip()}"
        if type(error).__name__ == "OutOfMemoryError" or "running low on memory" in text:
            return "its worker was ended: its machine ran out of memory"
        if "node has died" in text or "node died" in text:
            return "its worker died with its machine"
        return "its worker died: killed, or a crash of the process"


#: Workers up to which a driver learns when the items of a chunk are begun, so that another one can be under way while
#: files are written. Chunks of more workers take so long that this gains nothing, and costs the driver a message each.
MAX_OVERLAPPING = 64


Process = LocalProcess | RayProcess


class Answer(NamedTuple):
    """What a worker answers to what was submitted."""

    worker: str
    method: str  # of `ChunkRunner`
    number: int  # of the chunk that it is about; 0 for none
    found: Any
    error: str | None = None  # one line: why the worker will answer nothing any more


class ProcessEngine:
    """Runs chunks in processes that a host starts; settings: of every worker, its name and notes are filled in."""

    def __init__(self, host: LocalHost | RayHost, settings: RunnerSettings):
        self._host = host
        self.settings = dataclasses.replace(settings, device=host.share.device, threads=host.share.threads)
        self.overlapping = host.share.workers <= MAX_OVERLAPPING
        self._answers: queue.SimpleQueue[tuple[str, Process, str, int, Future[Any]]] = queue.SimpleQueue()
        self._processes: dict[str, Process] = {}
        self.places: dict[str, dict[str, Any]] = {}  # pid and host of each that has started
        self._ready: set[str] = set()
        self._alone_since = self.now()  # since when no worker is ready, where none is

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def start(self, worker: str, start: int) -> None:
        """Start the process of a worker, for the time `start` from 1; the answer of "facts" says that it has."""
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
        """End the process of a worker, wherever it is at; later answers of it are ignored."""
        self._ready.discard(worker)
        if not self._ready:
            self._alone_since = self.now()
        self.places.pop(worker, None)
        process = self._processes.pop(worker)
        process.kill()
        process.wait()

    def wait(self, timeout: float) -> Iterator[Answer]:
        """What workers answered since, at least once unless the time passes; a RuntimeError where none could start for
        a long time. Of a worker that is ended while this is looked through no more answers come."""
        with contextlib.suppress(queue.Empty):
            received = self._answers.get(timeout=timeout)
            while True:
                worker, process, method, number, answer = received
                if process is self._processes.get(worker):  # else one that is gone
                    error = answer.exception()
                    if error is not None:
                        yield Answer(worker, method, number, None, self._host.death_line(error))
                    else:
                        if method == "facts":
                            self._ready.add(worker)
                            self.places[worker] = answer.result()
                        yield Answer(worker, method, number, answer.result())
                received = self._answers.get_nowait()
        if not self._ready and self.now() - self._alone_since > self._host.patience:
            raise StateError(f"no worker started within {self._host.patience:.0f} s{self._host.no_place}")

    def close(self) -> None:
        """End all workers."""
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait()
        self._processes.clear()


SLOW = 0.5  # seconds of an item; then a chunk is settled before the next, as this thread reports it only after that


class LocalEngine:
    """Runs chunks in this process, one after the other: items in the thread that waits, while others wait for files."""

    overlapping = False  # it says when items are begun without being asked

    def __init__(self, runner: ChunkRunner):
        self._runner = runner
        self._given: tuple[str, Chunk] | None = None
        self._settling = ThreadPoolExecutor(MAX_CHUNKS, "warpcage-settling")
        self._answers: queue.SimpleQueue[tuple[str, str, int, Future[Any]]] = queue.SimpleQueue()
        self._ending = 0

    def now(self) -> float:
        return time.monotonic()

    def start(self, worker: str, start: int) -> None:
        """The worker is here; a RuntimeError when it is started again."""
        if start > 1:  # a device that is lost stays so in this process
            raise StateError("the device works no more in this process: run again, what is made is kept")
        self._report(worker, "facts", 0)

    def submit(self, worker: str, method: str, *given: Any) -> None:
        """Take a chunk, which `wait` makes; none comes back on recall, as no call arrives while it is made."""
        if method == "run":
            self._given = worker, given[0]
        elif method == "recall":
            self._report(worker, method, given[0], [])
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
                self._report(worker, "run", order.number, self._runner.settle(begun))
            else:
                self._ending += 1
                self._report(worker, "begun", order.number)
                self._settling.submit(self._runner.settle, begun).add_done_callback(
                    lambda done: self._answers.put((worker, "run", order.number, done))
                )
        answers: list[Answer] = []
        while not self._answers.empty() or (self._ending and not answers):
            try:
                worker, method, number, found = self._answers.get(timeout=timeout)
            except queue.Empty:
                break
            answers.append(Answer(worker, method, number, found.result()))
            self._ending -= method == "run"
        return answers

    def _report(self, worker: str, method: str, number: int, found: Any = None) -> None:
        """Let an answer come into the queue."""
        done: Future[Any] = Future()
        done.set_result(found)
        self._ending += method == "run"
        self._answers.put((worker, method, number, done))

    def close(self) -> None:
        """Wait for files that are being written, and close the notes of the worker."""
        self._settling.shutdown()
        self._runner.close()


Engine = ProcessEngine | LocalEngine
