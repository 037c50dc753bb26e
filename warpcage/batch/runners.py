"""What a worker's process begins with: the maker of items, their fingerprints, its notes."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import platform
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from ..core.devices import resolve_device
from ..core.locks import device_turn
from .chunk_runner import ChunkRunner, Maker, Place
from .items import EvaluateItem, FrameItem, Item
from .job_file import Fingerprints, ItemReader
from .manifest import OutputFolder


@dataclasses.dataclass(frozen=True)
class RunnerSettings:
    """What a worker needs to begin."""

    base: str  # folder of the job file
    reader: ItemReader
    out: str
    run: str  # of which run its notes are
    device: str | None = None  # Warp device; None is the first GPU, or the CPU
    worker: str = "0"
    notes: str = ""  # name of its file of notes
    retries: int = 2
    threads: int = 0  # for kernels on the CPU; 0 is what there is
    maker: Callable[[str, str, Any], Maker] | None = None  # of base, out and device; None is `Worker`
    prefetch: tuple[tuple[bytes, int], ...] = ()  # lines for `reader`: likely first items, whose needs are read early


def make_runner(settings: RunnerSettings) -> ChunkRunner:
    """A runner of chunks, in the process that calls; a RuntimeError where this machine does not see the folders of the
    run."""
    folder = OutputFolder(settings.out)
    for path in (pathlib.Path(settings.base), folder.notes):
        if not path.is_dir():
            raise RuntimeError(
                f"{platform.node()} does not see {str(path)!r}: all machines need the folders under the same path"
            )
    held = folder.worked_in()
    fingerprints = Fingerprints(settings.base, settings.out)
    first = settings.reader.item(*settings.prefetch[0]) if settings.prefetch else None
    if isinstance(first, FrameItem | EvaluateItem):
        fingerprints.expect(first.field)
    if settings.maker is None:
        maker, device = _worker(settings, first)
    else:
        device = resolve_device(settings.device)
        maker = settings.maker(settings.base, settings.out, device)
    runner = ChunkRunner(
        maker,
        settings.reader.item,
        fingerprints.begun,
        folder.new_notes(settings.notes or f"{settings.run}-{settings.worker}"),
        Place(settings.worker, platform.node(), device.name),
        retries=settings.retries,
        check_device=lambda: check_device(device),
        out=folder.path,
    )
    runner.keep(held)
    return runner


def _worker(settings: RunnerSettings, first: Item | None) -> tuple[Maker, wp.Device]:
    """What makes items, and its device; the first field is read meanwhile, and the device prepared."""
    from .references import PrefetchedField  # here, as the driver of a cluster needs nothing of it

    expected = None
    if isinstance(first, FrameItem | EvaluateItem):
        expected = PrefetchedField(os.path.join(settings.base, first.field), first.scene_scale)
    device = resolve_device(settings.device)
    with ThreadPoolExecutor(1, "warpcage-device") as beside:
        prepared = beside.submit(check_device, device)  # which makes its context
        from .worker import Worker

        prepared.result()
    return Worker(settings.base, settings.out, device, first=first, expected=expected), device


def check_device(device: wp.Device) -> None:
    """Raise where a GPU answers no more."""
    if device.is_cuda:  # after some errors of CUDA all that a process asks of it fails
        with device_turn(device):  # another thread may render
            wp.zeros(1, dtype=float, device=device).numpy()
            wp.synchronize_device(device)


def run_name() -> str:
    """A name for a run that no other has."""
    return os.urandom(6).hex()
