"""A worker: makes items one after another, each whole or not at all, and keeps what the next ones need."""

from __future__ import annotations

import gc
import os
import pathlib
from concurrent.futures import Future, ThreadPoolExecutor

import warp as wp

from .. import __version__
from ..core.devices import resolve_device
from ..core.memory import is_shortage
from ..core.overlap import SPARE, TASK_THREADS, Gate
from ..core.threads import cpu_threads
from .fingerprints import Fingerprints
from .fits import FitMaker, make_evaluation
from .frames import FrameMaker
from .items import EvaluateItem, FitItem, FrameItem, Item, digest
from .manifest import CHECKPOINTS, PARTS, MadeItem, write_outputs
from .references import LoadedFields, PrefetchedField, References


class Worker:
    """Makes items. One thread at a time may use it.
    memory: bytes of fields, and deformers beside them; those in use stay in any case; None is half of what is free."""

    def __init__(
        self,
        base: str | os.PathLike,
        out: str | os.PathLike,
        device: wp.DeviceLike = None,
        *,
        memory: int | None = None,
        encoders: int | None = None,  # threads that encode beside rendering; None is one a CPU thread, 16 at most
        first: Item | None = None,  # that it will probably make first: a thread loads its kernels
        expected: PrefetchedField | None = None,  # the field of that, which is being read
    ):
        self.out, self.device = pathlib.Path(out), resolve_device(device)
        self.references = References(base)
        half = None if memory is None else memory // 2
        self.fields = LoadedFields(self.references, self.device, half, expected)
        self.frames = FrameMaker(self.references, self.fields, half)
        if isinstance(first, FrameItem):
            self.frames.begin_kernels(first)
        self._fingerprints = Fingerprints(self.references.base, self.out)
        self.fits = FitMaker(self.references, self._fingerprints, self.device)
        threads = min(TASK_THREADS, cpu_threads()) if encoders is None else encoders
        self._pool = ThreadPoolExecutor(threads, "warpcage-outputs")
        self._gate = Gate(threads + SPARE)

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Finish what is being written, and let go of all that is loaded."""
        self._pool.shutdown()
        self.forget()

    @property
    def held_bytes(self) -> int:
        """Bytes that all takes that is loaded."""
        return self.fields.held_bytes + self.frames.held_bytes

    def forget(self) -> None:
        """Let go of all that is loaded."""
        self.fits.forget()
        self._forget_fields()

    def _forget_fields(self) -> None:
        self.frames.forget()
        self.fields.forget()
        gc.collect()

    def run(self, item: Item, out: str | os.PathLike | None = None) -> dict[str, int]:
        """Make an item; returns the bytes of its outputs, by their paths. out: their folder; None is that of the
        worker."""
        return self.submit(item, out).result()

    def submit(self, item: Item, out: str | os.PathLike | None = None) -> Future[dict[str, int]]:
        """Make an item; its outputs are encoded and written in another thread, while the next item is rendered.
        Becomes the bytes of its outputs by their paths once they are in their places, or its error."""
        try:
            made = self._made(item)
        except Exception as error:
            failed: Future[dict[str, int]] = Future()
            failed.set_exception(error)
            return failed
        folder = self.out if out is None else pathlib.Path(out)
        self._gate.enter(made.held_bytes)  # waits while there are two more than threads, or ROOM bytes of pictures
        return self._pool.submit(self._write, made, folder)

    def _write(self, made: MadeItem, folder: pathlib.Path) -> dict[str, int]:
        """Write the outputs of an item, in a thread of the pool."""
        try:
            return write_outputs(made.writers, folder, self.out / PARTS)
        finally:
            self._gate.leave(made.held_bytes)

    def _made(self, item: Item) -> MadeItem:
        """Make an item; where memory is short, once more with nothing else loaded."""
        try:
            return self._made_once(item)
        except Exception as error:
            if not is_shortage(error) or not self.held_bytes:
                raise
        self.forget()
        return self._made_once(item)

    def _made_once(self, item: Item) -> MadeItem:
        if isinstance(item, FitItem):
            self._forget_fields()  # a fit plans with the memory that is free
            return self.fits.make(item, self.checkpoint_path(item))
        self.fits.forget()  # its pictures are for fits alone
        if isinstance(item, FrameItem):
            return self.frames.make(item)
        if isinstance(item, EvaluateItem):
            return make_evaluation(item, self.references, self.fields)
        raise ValueError(f"a worker makes no {type(item).__name__}")

    def checkpoint_path(self, item: FitItem) -> pathlib.Path:
        """Where the progress of a fit is kept: another place for other inputs, and for another version."""
        name = digest([self._fingerprints.of(item), __version__])
        return self.out / CHECKPOINTS / f"{name}.npz"
