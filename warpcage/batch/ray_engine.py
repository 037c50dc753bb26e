"""Workers on clusters by Ray: actors, their deaths, and what they report."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import os
import platform
import queue
import signal
import socket
import threading
import time
import types
from collections.abc import Callable, Iterator
from typing import Any

from ..core.names import error_line
from ..core.threads import cpu_threads, limit_threads
from .chunk_runner import ChunkOrder, ChunkRunner
from .loop import ANSWER, Begun, Died, Event, Finished, LateItems, Ready, Returned
from .manifest import DONE, ERROR, FAILED, OutputFolder, notes_of_chunk
from .runners import RunnerSettings, make_runner
from .scheduler import MOST_CHUNKS, Chunk, ChunkReport


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


#: Seconds that workers get to end the items that they have begun, when a run is interrupted.
GRACE = 5.0

#: Seconds within which a cluster must answer.
CONNECT = 10.0

#: Seconds within which the first worker must have started, here and on a cluster, which may have to wait for machines.
START_HERE, START_THERE = 120.0, 900.0

#: Seconds between two looks for whether Ray itself still runs here, while no worker does.
LOOK = 2.0

#: Workers up to which a driver is told when the items of a chunk are begun, so that another one can be under way while
#: files are written. Chunks of more workers take so long that this gains nothing, and costs the driver a message each.
MOST_OVERLAPPING = 64

#: Bytes of Ray's store of objects on this machine: messages are small and do not go through it.
STORE = 100 * 2**20


def load_ray() -> types.ModuleType:
    """Ray, which only several workers and clusters need."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nobody is told
    try:
        import ray
    except ImportError:
        raise ImportError(
            "more than one worker, --cluster and --item-timeout need Ray: pip install 'warpcage[cluster]'"
        ) from None
    return ray


@contextlib.contextmanager
def ray_session(cluster: str | None) -> Iterator[types.ModuleType]:
    """Ray, started here or connected to a cluster; one that the program itself has started is used as it is.
    cluster: address of a cluster, None for this machine."""
    ray = load_ray()
    if ray.is_initialized():
        yield ray
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if cluster is None:
        options |= {"address": "local", "include_dashboard": False, "object_store_memory": STORE}
    else:
        _require_answer(cluster)
        options["address"] = cluster
    with _signals_kept():
        try:
            ray.init(**options)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            if cluster is None:
                raise
            raise ValueError(
                f"no Ray cluster answers at {cluster!r}: {error_line(error, named=True)}. One that asks for a token "
                "wants RAY_AUTH_MODE=token and its own token in ~/.ray/auth_token"
            ) from error
    _silence()
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
        raise ValueError(f"--cluster takes the address of a Ray cluster, such as 10.0.0.1:6379, got {address!r}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT).close()
    except (OSError, OverflowError) as error:
        raise ValueError(f"no Ray cluster answers at {address!r}: {error_line(error, named=True)}") from None


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


def _silence() -> None:
    """Keep Ray's own paragraphs about workers that died off the output, where this version lets us: we say it too."""
    with contextlib.suppress(Exception):
        from ray._private import ray_logging

        ray_logging.global_worker_stdstream_dispatcher.handlers.clear()


@dataclasses.dataclass(frozen=True)
class Share:
    """What each worker gets of a machine."""

    workers: int
    gpus: int  # of each, 0 or 1
    cpus: float  # cores that Ray sets aside for each, on clusters
    threads: int  # of each for kernels on the CPU
    device: str


def shares(ray: types.ModuleType, workers: int | None, cluster: bool, device: str | None) -> Share:
    """How workers share what there is: one a GPU, else the cores in equal parts.
    workers: None is all GPUs, or one a machine where there are none; cluster: there may be more machines later."""
    if device not in (None, "cpu", "cuda"):
        raise ValueError(f"--device of several workers is cpu or cuda, which Ray numbers by itself, got {device!r}")
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    gpus = int(sum(node.get("GPU", 0) for node in nodes))
    if device == "cuda" and not gpus and not cluster:
        raise ValueError("device 'cuda' is not there: Ray sees no GPU")
    cores = [int(node.get("CPU", 0)) for node in nodes]
    if device == "cuda" or (gpus and device is None):
        workers = workers or gpus
        if workers > gpus and not cluster:
            raise ValueError(f"{workers} workers need as many GPUs, this machine has {gpus}: give --workers {gpus}")
        on_one = max((int(node.get("GPU", 0)) for node in nodes), default=1) or 1
        return Share(workers, 1, 0, max(1, max(cores, default=1) // on_one), "cuda:0")
    workers = workers or len(nodes)
    each = max(1, sum(cores) // workers)
    while each > 1 and sum(count // each for count in cores) < workers:  # so that none waits for a place
        each -= 1
    if not cluster:
        each = max(1, cpu_threads() // workers)
    return Share(workers, 0, each if cluster else 0, each, "cpu")


class RayEngine:
    """Runs chunks in actors of Ray; cluster: whether they may live on other machines.
    item_timeout: seconds that an item may take before its worker is ended; None is no limit."""

    def __init__(
        self,
        ray: types.ModuleType,
        settings: RunnerSettings,  # of every worker: its name and notes are filled in
        share: Share,
        folder: OutputFolder,
        order: Callable[[Chunk], ChunkOrder],
        cluster: bool,
        item_timeout: float | None = None,
    ):
        self._ray, self.settings, self._share, self._folder, self._order = ray, settings, share, folder, order
        # threads: one a chunk, one that tells when all items are begun, and one that shortens a chunk or tells of items
        placing = {"scheduling_strategy": "SPREAD"} if cluster else {}
        self._actor = ray.remote(ChunkActor).options(
            num_gpus=share.gpus, num_cpus=share.cpus, max_concurrency=MOST_CHUNKS + 2, max_restarts=0, **placing
        )
        self._patience = START_THERE if cluster else START_HERE
        self._here, self._next_look = not cluster, 0.0
        self._events: queue.SimpleQueue[tuple[str, str, int, Any]] = queue.SimpleQueue()
        self._actors: dict[str, Any] = {}
        self._starts: dict[str, int] = {}  # how often each was started
        self._orders: dict[str, dict[int, ChunkOrder]] = {}  # of the chunks of each, by number
        self.places: dict[str, dict[str, Any]] = {}  # pid and host of each
        self._waiting_since: float | None = None  # when the first of those that start was asked for
        self._ready: set[str] = set()
        self._lost_notes = None
        self._overlapping = share.workers <= MOST_OVERLAPPING
        self._late: LateItems[tuple[str, int]] | None = None
        if item_timeout is not None:
            self._late = LateItems(item_timeout, ANSWER)

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def launch(self, worker: str) -> None:
        """Start an actor."""
        self._starts[worker] = self._starts.get(worker, 0) + 1
        prefetch = self.settings.prefetch
        if prefetch:  # whoever takes the place of one that died knows nothing: what it read may have been to blame
            prefetch = (prefetch[int(worker) % len(prefetch)],) if self._starts[worker] == 1 else ()
        notes = self._notes_name(worker)
        settings = dataclasses.replace(self.settings, worker=worker, notes=notes, prefetch=prefetch)
        actor = self._actors[worker] = self._actor.remote(settings)
        if not self._ready:
            self._waiting_since = self.now()
        self._ask(worker, "ready", actor.facts.remote())

    def give(self, worker: str, chunk: Chunk) -> None:
        """Send a chunk to an actor."""
        actor, order = self._actors[worker], self._order(chunk)
        self._orders.setdefault(worker, {})[chunk.number] = order
        self._ask(worker, f"report {chunk.number}", actor.run.remote(order))
        if self._overlapping:
            self._ask(worker, f"begun {chunk.number}", actor.begun.remote(chunk.number))
        if self._late is not None:
            self._late.given((worker, chunk.number), self.now())

    def recall(self, worker: str, number: int, share: float) -> None:
        """Ask an actor for items of its chunk."""
        self._ask(worker, f"recall {number}", self._actors[worker].recall.remote(number, share))

    def lost(self, item: int, error: str, attempts: int) -> None:
        """Note an item that failed with its workers."""
        if self._lost_notes is None:
            self._lost_notes = self._folder.new_notes(f"{self.settings.run}-driver")
        found = self.settings.reader.item(*self._order(Chunk(0, [item], [0], 0)).lines[0])
        record = {"id": found.id, "state": FAILED, "kind": found.kind, "attempts": attempts, "error": error}
        self._lost_notes.append(record)

    def stop(self) -> None:
        """Let all actors begin no more items."""
        for actor in self._actors.values():
            actor.stop.remote()

    def wait(self, timeout: float) -> list[Event]:
        """What actors answered; a RuntimeError where none could start for a long time, or Ray itself has ended on this
        machine."""
        events: list[Event] = []
        with contextlib.suppress(queue.Empty):
            answer = self._events.get(timeout=timeout)
            while True:
                events += self._told(*answer)
                answer = self._events.get_nowait()
        events += self._look()
        if not self._ready and self._waiting_since is not None:
            self._require_start(self.now() - self._waiting_since)
        return events

    def close(self, patience: float = 0.0) -> None:
        """End all actors; patience: seconds that they get to end the items that they have begun."""
        if patience and self._orders:
            end = self.now() + patience
            with contextlib.suppress(Exception):
                self.stop()
            while self._orders and self.now() < end:
                self.wait(0.1)
        for actor in self._actors.values():
            self._ray.kill(actor)
        self._actors.clear()
        if self._lost_notes is not None:
            self._lost_notes.close()
            self._lost_notes = None

    def _require_start(self, waited: float) -> None:
        """Raise RuntimeError where no worker can start any more, or none did for a long time."""
        if waited > self._patience:
            raise RuntimeError(
                f"no worker started within {self._patience:.0f} s: Ray has no place for one with "
                f"{self._share.gpus} GPUs and {self._share.cpus:g} CPUs"
            )
        if self._here and self.now() >= self._next_look:  # Ray would end this process, too, after a minute or two
            self._next_look = self.now() + LOOK
            if not any(node["Alive"] for node in self._ray.nodes()):
                raise RuntimeError("Ray's own processes on this machine have ended: the same command goes on")

    def _ask(self, worker: str, what: str, reference: Any) -> None:
        """Let the answer come into the queue, from a thread of Ray."""
        start = self._starts[worker]
        reference.future().add_done_callback(functools.partial(_answered, self._events, worker, what, start))

    def _look(self) -> list[Event]:
        """Ask workers whose items may be late; those that do not answer are ended."""
        if self._late is None:
            return []
        now = self.now()
        for worker, number in self._late.due(now):
            self._ask(worker, f"oldest {number}", self._actors[worker].oldest.remote(number))
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

    def _told(self, worker: str, what: str, start: int, answer: Any) -> list[Event]:
        """What an answer says."""
        if start != self._starts[worker] or worker not in self._actors:
            return []  # of a process that is gone
        error = answer.exception()
        if error is not None:
            return [self._death(worker, death_line(error))]
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
        """What is known of an actor that answers no more, or is not to."""
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
        with contextlib.suppress(Exception):
            self._ray.kill(self._actors[worker])
        del self._actors[worker]
        if not self._ready:
            self._waiting_since = self.now()
        return list(orders.values())

    def _notes_name(self, worker: str) -> str:
        return f"{self.settings.run}-{worker}-{self._starts[worker]}"


def _answered(events: queue.SimpleQueue, worker: str, what: str, start: int, answer: Any) -> None:
    events.put((worker, what, start, answer))


def death_line(error: BaseException) -> str:
    """Why a worker died, in one line instead of Ray's paragraphs, without its name."""
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
