"""Where workers live, this process, others and clusters of Ray: how one is started, asked and ended."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import pickle
import queue
import signal
import socket
import time
import types
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import warp as wp

from ....core.devices import start_warp
from ....core.names import error_line, extra_line
from ....core.threads import cpu_threads
from ....errors import InputError, MissingPackageError, StateError
from .chunk_runner import MAX_CALLS, MAX_CHUNKS, RunnerSettings, make_runner
from .serving import LocalProcess, process_of


class ChunkActor:
    """What runs in the process of a worker on a cluster."""

    def __init__(self, settings: RunnerSettings):
        self._runner = make_runner(settings)

    def call(self, asked: tuple[Any, ...]) -> Any:
        """Call a method of the runner, by its name and what it is given: Ray packs each argument by itself."""
        method, *given = asked
        return getattr(self._runner, method)(*given)


@dataclasses.dataclass(frozen=True)
class Share:
    """What each worker gets of a machine."""

    workers: int
    gpus: int  # of each, 0 or 1
    cpus: float  # cores that Ray sets aside for each, on clusters
    threads: int  # of each for kernels on the CPU; 0 is what there is
    device: str | None


class Host:
    """What starts workers; share: of each."""

    share: Share
    patience, no_place = 120.0, ""  # seconds within which the first worker must have started, and why it has not

    def work(self) -> None:
        """Called before answers are waited for."""

    def death_line(self, error: BaseException) -> str:
        """Why a worker gives no answer but an error: one line."""
        return str(error)


SLOW = 0.5  # seconds of an item; then a chunk is settled before the next, as this thread reports it only after that


class ThisProcess(Host):
    """This process as the only worker: the thread that waits for answers makes items, others wait for their files."""

    def __init__(self, device: str | None):
        self.share = Share(1, 0, 0, 0, device)
        self._runner: Any = None
        self._settling = ThreadPoolExecutor(MAX_CHUNKS, "warpcage-settling")
        self._next: tuple[Any, Future[Any]] | None = None  # the chunk that is to be begun
        self._slow = False  # whether the items of the newest chunk were

    def start(self, settings: RunnerSettings) -> ThisProcess:
        if self._runner is not None:  # a device that is lost stays so in this process
            raise StateError("the device works no more in this process: run again, what is made is kept")
        self._runner = make_runner(settings)
        return self

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the runner; chunks are begun by `work`."""
        if method == "settle" and not self._slow:
            return self._settling.submit(self._runner.settle, *given)
        future: Future[Any] = Future()
        if method == "begin":
            self._next = given[0], future
        else:
            future.set_result(getattr(self._runner, method)(*given))
        return future

    def work(self) -> None:
        if self._next is not None:
            (order, begun), self._next = self._next, None
            start = time.monotonic()
            self._runner.begin(order)
            self._slow = time.monotonic() - start > SLOW * len(order.items)
            begun.set_result(None)

    def death_line(self, error: BaseException) -> str:
        raise error

    def kill(self) -> None:
        """The worker is this process."""

    def wait(self) -> None:
        """Wait for files that are being written, and close the notes of the worker."""
        self._settling.shutdown()
        if self._runner is not None:
            self._runner.close()


class LocalHost(Host):
    """Starts workers on this machine: one a GPU, else with equal parts of the cores; one alone has what there is."""

    def __init__(self, workers: int, device: str | None, gpus: Callable[[], int] | None = None):
        self._device = device
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
        process = process_of(self.share.workers, int(settings.worker), self._device)
        process.send(pickle.dumps(settings))  # what its maker imports may fail, which is reported then
        return process


def require_shared(device: str | None) -> None:
    """Raise ValueError for a device that several workers cannot share."""
    if device not in (None, "cpu", "cuda"):
        raise InputError(f"--device of several workers is cpu or cuda, each has the GPU of its number, got {device!r}")


def _count_gpus() -> int:
    start_warp()
    return len(wp.get_cuda_devices())


#: Seconds within which a cluster must answer.
CONNECT = 10.0


@contextlib.contextmanager
def ray_session(cluster: str) -> Iterator[types.ModuleType]:
    """Ray, connected to the cluster at an address; a connection that the program itself has is used as it is."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no reports of usage
    try:
        import ray
    except ImportError:
        raise MissingPackageError(f"--cluster needs Ray: {extra_line('cluster')}") from None
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
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # another thread, in which Ray puts none
            signal.signal(signal.SIGTERM, before)


@dataclasses.dataclass(eq=False)
class RayProcess:
    """A process that Ray has started somewhere."""

    ray: types.ModuleType
    actor: Any

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the worker's runner; the answer comes later."""
        return self.actor.call.remote((method, *given)).future()

    def kill(self) -> None:
        """End the process, whose node may merely not answer."""
        with contextlib.suppress(Exception):
            self.ray.kill(self.actor)

    def wait(self) -> None:
        """Ray does not say."""


class RayHost(Host):
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
        self.no_place = f": Ray has no place for one with {self.share.gpus} GPUs and {self.share.cpus:g} CPUs"
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
        # one line instead of Ray's paragraphs
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


Process = LocalProcess | RayProcess | ThisProcess


class Answer(NamedTuple):
    """What a worker answers to what was submitted."""

    worker: str
    method: str  # of `ChunkRunner`
    number: int  # of the chunk that it is about; 0 for none
    found: Any
    error: str | None = None  # one line: why the worker will answer nothing any more


class ProcessEngine:
    """Runs chunks in processes that a host starts; settings: of every worker, its name and notes are filled in."""

    def __init__(self, host: ThisProcess | LocalHost | RayHost, settings: RunnerSettings):
        self._host = host
        self.settings = dataclasses.replace(settings, device=host.share.device, threads=host.share.threads)
        self.overlapping = host.share.workers <= MAX_OVERLAPPING
        self._answers: queue.SimpleQueue[tuple[str, Process, str, int, Future[Any]]] = queue.SimpleQueue()
        self._processes: dict[str, Process] = {}
        self.places: dict[str, dict[str, Any]] = {}  # pid and host of each that is ready
        self._alone_since = self.now()  # since when no worker is ready, where none is

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def start(self, worker: str, start: int) -> None:
        """Start the process of a worker, for the time `start` from 1; the answer of "facts" says that it has."""
        notes = f"{self.settings.notes}-{worker}-{start}"
        settings = dataclasses.replace(self.settings, worker=worker, notes=notes)
        self._processes[worker] = self._host.start(settings)
        self.submit(worker, "facts")

    def submit(self, worker: str, method: str, *given: Any) -> None:
        """Call a method of its runner; the answer comes into the queue from another thread."""
        process, answers = self._processes[worker], self._answers
        number = getattr(given[0], "number", given[0]) if given else 0
        process.ask(method, *given).add_done_callback(
            lambda answer: answers.put((worker, process, method, number, answer))
        )

    def cancel(self, worker: str) -> None:
        """End the process of a worker, wherever it is at; later answers of it are ignored."""
        self.places.pop(worker, None)
        if not self.places:
            self._alone_since = self.now()
        process = self._processes.pop(worker)
        process.kill()
        process.wait()

    def wait(self, timeout: float) -> Iterator[Answer]:
        """What workers answered since, at least once unless the time passes; a RuntimeError where none could start for
        a long time. Of a worker that is ended while this is looked through no more answers come."""
        self._host.work()
        with contextlib.suppress(queue.Empty):
            while True:
                worker, process, method, number, answer = self._answers.get(timeout=timeout)
                timeout = 0.0
                if process is not self._processes.get(worker):
                    continue  # one that is gone
                if (error := answer.exception()) is not None:
                    yield Answer(worker, method, number, None, self._host.death_line(error))
                    continue
                if method == "facts":
                    self.places[worker] = answer.result()
                yield Answer(worker, method, number, answer.result())
        if not self.places and self.now() - self._alone_since > self._host.patience:
            raise StateError(f"no worker started within {self._host.patience:.0f} s{self._host.no_place}")

    def close(self) -> None:
        """End all workers."""
        for process in self._processes.values():  # all at once
            process.kill()
        for process in self._processes.values():
            process.wait()
        self._processes.clear()
