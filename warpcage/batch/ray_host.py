"""Workers on clusters by Ray."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import threading
import types
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

from ..core.names import error_line
from .processes import MOST_CALLS, ChunkActor, Share, require_shared
from .runners import RunnerSettings

#: Seconds within which a cluster must answer.
CONNECT = 10.0

#: Seconds within which the first worker must have started on a cluster, which may have to wait for machines.
START_THERE = 900.0


def load_ray() -> types.ModuleType:
    """Ray, which only clusters need."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nobody is told
    try:
        import ray
    except ImportError:
        raise ImportError("--cluster needs Ray: pip install 'warpcage[cluster]'") from None
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


class RayProcess:
    """A process that Ray has started somewhere."""

    def __init__(self, ray: types.ModuleType, actor: Any):
        self._ray, self._actor = ray, actor

    def ask(self, method: str, *given: Any) -> Future[Any]:
        """Call a method of the actor; the answer comes later."""
        return getattr(self._actor, method).remote(*given).future()

    def kill(self) -> None:
        """End the process, whose node may merely not answer."""
        with contextlib.suppress(Exception):
            self._ray.kill(self._actor)

    def wait(self) -> None:
        """Ray does not tell."""


class RayHost:
    """Starts workers on a cluster: one a GPU, else with the cores in equal parts.
    workers: None is all GPUs, or one a machine where there are none; there may be more machines later."""

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
        self._ray = ray
        self._actor = ray.remote(ChunkActor).options(
            num_gpus=self.share.gpus,
            num_cpus=self.share.cpus,
            max_concurrency=MOST_CALLS,
            max_restarts=0,
            scheduling_strategy="SPREAD",
        )

    def start(self, settings: RunnerSettings) -> RayProcess:
        """Start an actor."""
        return RayProcess(self._ray, self._actor.remote(settings))

    def waited(self, seconds: float) -> None:
        """Raise RuntimeError where no worker started for a long time."""
        if seconds > START_THERE:
            raise RuntimeError(
                f"no worker started within {START_THERE:.0f} s: Ray has no place for one with "
                f"{self.share.gpus} GPUs and {self.share.cpus:g} CPUs"
            )

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
