"""What a worker's process begins with: the maker of items, their fingerprints, its notes."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import platform
from collections.abc import Callable
from typing import Any

import warp as wp

from ..core.devices import resolve_device
from .fingerprints import Fingerprints
from .item_reader import ItemReader
from .lot_runner import LotRunner, Maker, Place
from .output_folder import OutputFolder


@dataclasses.dataclass(frozen=True)
class RunnerSettings:
    """What a worker needs to begin.

    Attributes:
        base: Folder of the job file.
        reader: Reads its lines.
        out: The output folder.
        run: Of which run its notes are.
        device: Warp device; None is the first GPU, or the CPU.
        worker: Its name.
        notes: Name of its file of notes.
        retries: How often an item may be tried again.
        threads: Threads for kernels on the CPU; 0 is what there is.
        maker: Makes what makes items, of `base`, `out` and `device`. None is `Worker`.
    """

    base: str
    reader: ItemReader
    out: str
    run: str
    device: str | None = None
    worker: str = "0"
    notes: str = ""
    retries: int = 2
    threads: int = 0
    maker: Callable[[str, str, Any], Maker] | None = None


def make_runner(settings: RunnerSettings) -> LotRunner:
    """A runner of lots, in the process that calls.

    Args:
        settings: What it needs.

    Returns:
        The runner.

    Raises:
        RuntimeError: Where this machine does not see the folders of the run.
        ValueError: For a device that is not there.
    """
    folder = OutputFolder(settings.out)
    for path in (pathlib.Path(settings.base), folder.notes):
        if not path.is_dir():
            raise RuntimeError(
                f"{platform.node()} does not see {str(path)!r}: all machines need the folders under the same path"
            )
    held = folder.worked_in()
    device = resolve_device(settings.device)
    maker = (settings.maker or _worker)(settings.base, settings.out, device)
    runner = LotRunner(
        maker,
        settings.reader.item,
        Fingerprints(settings.base, settings.out).begun,
        folder.new_notes(settings.notes or f"{settings.run}-{settings.worker}"),
        Place(settings.worker, platform.node(), device.name),
        retries=settings.retries,
        check_device=lambda: check_device(device),
        out=folder.path,
    )
    runner.keep(held)
    return runner


def _worker(base: str, out: str, device: wp.Device) -> Maker:
    """What makes items. It is loaded here, as the driver of a cluster needs nothing of it."""
    from .worker import Worker

    return Worker(base, out, device)


def check_device(device: wp.Device) -> None:
    """Raise where a GPU answers no more. After some errors of CUDA all that a process asks of it fails.

    Args:
        device: The device.
    """
    if device.is_cuda:
        wp.zeros(1, dtype=float, device=device).numpy()
        wp.synchronize_device(device)


def run_name() -> str:
    """A name for a run that no other has."""
    return os.urandom(6).hex()
