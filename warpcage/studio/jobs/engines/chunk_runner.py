"""The items of a chunk, one after the other, in whichever process a worker lives."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import datetime
import math
import os
import pathlib
import platform
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Protocol

import warp as wp

from .... import __version__
from ....core.devices import resolve_device
from ....core.names import error_line
from ....core.threads import device_turn, limit_threads
from ....errors import InputError, StateError
from ..items import Item
from ..job_file import Fingerprints, ItemReader, JobFile
from ..manifest import DONE, ERROR, FAILED, NO_ROOM, STARTED, Notes, OutputFolder, notes_of_chunk
from ..webdataset import pack_shard, shard_size, shard_stage

#: What the same input brings again: there is no use in trying it once more.
BAD_INPUT = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, AssertionError, ImportError)
BAD_INPUT += (FileNotFoundError, IsADirectoryError, NotADirectoryError)

#: Chunks of a worker: one of which it makes items, the others while their last files are being written.
MAX_CHUNKS = 2

#: Calls that a worker answers at once: one a chunk, and those that shorten one or look at its items.
MAX_CALLS = MAX_CHUNKS + 2


class Maker(Protocol):
    """Makes items: `jobs.worker.Worker`, or what stands for it in tests."""

    def submit(self, item: Item, out: str | os.PathLike[str] | None = None) -> Future[dict[str, int]]:
        """Make an item; its files may be written while the next one is made. out: where, instead of the run's folder.
        Becomes its files and their sizes in bytes, or what went wrong."""
        ...

    def close(self) -> None:
        """End what writes files."""
        ...


@dataclasses.dataclass(frozen=True)
class Chunk:
    """Items that one worker takes at once."""

    number: int
    items: Sequence[int]  # numbers of the items in the job file, in the order in which they are made
    attempts: Sequence[int]  # how often each was begun before and failed
    group: int  # what the worker has loaded afterwards
    shard: int | None = None  # to be packed, in a chunk without items; of one that is sent, that its items belong to
    seconds: float | None = None  # after so many no more of its items are begun; None where it is known what they take
    # of a chunk that is sent: lines of its items, as they stand, with their numbers; outputs of all items of its shard,
    # where that is packed
    lines: Sequence[tuple[bytes, int]] = ()
    packed: Sequence[dict[str, str]] | None = None


@dataclasses.dataclass
class ChunkReport:
    """What became of a chunk."""

    done: list[int] = dataclasses.field(default_factory=list)
    seconds: list[float] = dataclasses.field(default_factory=list)  # of each of those, what it added
    failed: list[tuple[int, str]] = dataclasses.field(default_factory=list)  # not tried again, with a line each
    errors: list[tuple[int, str]] = dataclasses.field(default_factory=list)  # may be tried again, with one line each
    left: list[int] = dataclasses.field(default_factory=list)  # were not begun, or their making ended without blame
    loading: bool = False  # whether the first item loaded what the others found there: its seconds are not usual
    halt: str | None = None  # one line: why nothing can be written any more
    broken: str | None = None  # why the worker can make no more
    pack_error: str | None = None  # why the shard was not packed


def leaves_no_room(error: BaseException) -> bool:
    """Whether an error says that nothing can be written any more: a full disk, a quota, or one that is read-only."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in NO_ROOM
    return any(os.strerror(number) in str(error) for number in NO_ROOM)  # libraries in C++ give it as text


@dataclasses.dataclass
class _UnderWay:
    """An item that was begun and is not settled."""

    item: Item
    index: int
    attempts: int
    begun: float
    inputs: str = ""
    future: Future[dict[str, int]] = dataclasses.field(default_factory=Future)


class ChunkUnderWay:
    """A chunk of which items are made, or whose files are being written."""

    def __init__(self, order: Chunk):
        self.order, self.report = order, ChunkReport()
        self.waiting: collections.deque[int] = collections.deque(range(len(order.lines)))  # places that were not begun
        self.line: collections.deque[_UnderWay] = collections.deque()  # begun and not settled, in that order


@dataclasses.dataclass(eq=False)
class ChunkRunner:
    """Makes the items of chunks, and notes what became of each.
    `begin` makes, of one chunk at a time; `settle` waits for files and notes, in any, maybe while the next is made."""

    maker: Maker
    read: ItemReader
    fingerprint: Callable[[Item], str]  # the hash of an item's inputs, as they are before it is made
    notes: Notes
    place: Mapping[str, str]  # device, worker and host, for the records
    _: dataclasses.KW_ONLY
    retries: int = 2
    check_device: Callable[[], None] = lambda: None  # raises if the device is lost, after errors not of the input
    out: pathlib.Path | None = None  # folder of the run, where there are shards

    def __post_init__(self) -> None:
        self._lock, self._chunks = threading.Lock(), dict[int, ChunkUnderWay]()
        self._stopped = False
        self._settled_at = 0.0  # when the newest item was
        self._group: str | None = None
        self.held = contextlib.ExitStack()  # open as long as this may write; `close` closes it

    def run(self, order: Chunk) -> ChunkReport:
        """Make a chunk; returns what became of its items."""
        self.begin(order)
        return self.settle(order.number)

    def begin(self, order: Chunk) -> None:
        """Begin the items of a chunk, or pack its shard; files may be written until `settle` has returned."""
        with self._lock:
            chunk = self._chunks[order.number] = ChunkUnderWay(order)
        try:
            self._make(chunk)
        except BaseException:  # an interrupt too
            self.settle(order.number)
            raise

    def settle(self, number: int) -> ChunkReport:
        """Wait for the files of a chunk whose items are begun, and note what became of them."""
        chunk = self._chunks[number]
        try:
            while chunk.line:
                self._settle(chunk)
        finally:  # also at an interrupt: what is being written is noted once it is there
            while chunk.line:
                self._settle(chunk)
        with self._lock:
            del self._chunks[number]
        report = chunk.report
        settled = {*report.done, *(index for index, _ in [*report.failed, *report.errors])}
        report.left = [index for index in chunk.order.items if index not in settled]
        return report

    def facts(self) -> dict[str, Any]:
        """Which process it is."""
        return {"pid": os.getpid(), "host": platform.node()}

    def recall(self, number: int, share: float) -> list[int]:
        """Give back a share of the items of a chunk that were not begun, from its end: their numbers in the job file.
        Any thread may call it while a chunk runs; one that is not under way gives nothing back."""
        with self._lock:
            chunk = self._chunks.get(number)
            if chunk is None:
                return []
            back = [chunk.waiting.pop() for _ in range(math.ceil(share * len(chunk.waiting)))]
            return [chunk.order.items[place] for place in reversed(back)]

    def oldest(self) -> tuple[int, float] | None:
        """The item that has been under way longest, by its number in the job file, and its seconds so far; None where
        none is under way. Any thread may call it."""
        with self._lock:
            under_way = (made for chunk in self._chunks.values() for made in chunk.line if not made.future.done())
            first = next(under_way, None)
        return None if first is None else (first.index, time.perf_counter() - first.begun)

    def stop(self) -> None:
        """Begin no more items."""
        self._stopped = True

    def _make(self, chunk: ChunkUnderWay) -> None:
        """Begin all items of a chunk; those whose files are there meanwhile are noted."""
        order, report = chunk.order, chunk.report
        if order.packed is not None:
            self._pack(order, report)
        begin = time.perf_counter()
        while report.halt is None and report.broken is None:
            with self._lock:
                place = chunk.waiting.popleft() if chunk.waiting and not self._stopped else None
            late = place and order.seconds is not None and time.perf_counter() - begin > order.seconds
            if place is None or late:
                return
            self._begin(chunk, place)
            while chunk.line and chunk.line[0].future.done():
                self._settle(chunk)

    def _begin(self, chunk: ChunkUnderWay, place: int) -> None:
        """Make an item as far as this thread does it."""
        order, report = chunk.order, chunk.report
        item = self.read(*order.lines[place])
        if not self._noted({"id": item.id, "state": STARTED, "lot": order.number}, report):
            return
        report.loading |= not place and item.group != self._group
        made = _UnderWay(item, order.items[place], order.attempts[place], time.perf_counter())
        with self._lock:
            chunk.line.append(made)
        try:
            made.inputs = self.fingerprint(item)
            # items of a shard stand in a folder of their own until it is packed
            stage = None if order.shard is None or self.out is None else shard_stage(self.out, order.shard)
            made.future = self.maker.submit(item, stage)
        except Exception as error:
            made.future.set_exception(error)
        except BaseException:
            chunk.line.pop()
            raise
        self._group = item.group

    def _settle(self, chunk: ChunkUnderWay) -> None:
        """Note what became of the first item in the line of a chunk."""
        made, report = chunk.line[0], chunk.report
        error = made.future.exception()
        with self._lock:
            chunk.line.popleft()
            now = time.perf_counter()
            seconds = now - max(made.begun, self._settled_at)  # of items that overlap, what each adds
            self._settled_at = now
        if error is not None and self._ends(report, error):
            return
        record: dict[str, Any] = {
            "id": made.item.id,
            "state": DONE,
            "inputs": made.inputs,
            "outputs": made.future.result() if error is None else {},
            "kind": made.item.kind,
            "seconds": round(seconds, 4),
            **self.place,
            "attempts": made.attempts + 1,
            "version": __version__,
            "finished": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds"),
        }
        final = isinstance(error, BAD_INPUT) or made.attempts >= self.retries
        if error is not None:
            record |= {"state": FAILED if final else ERROR, "error": error_line(error, named=True)}
        if not self._noted(record, report):
            return
        if error is None:
            report.done.append(made.index)
            report.seconds.append(seconds)
            return
        (report.failed if final else report.errors).append((made.index, error_line(error, named=True)))
        if not isinstance(error, BAD_INPUT) and report.broken is None:
            try:
                self.check_device()
            except Exception as failure:  # whatever the device says, it is lost to this process
                report.broken = error_line(failure, named=True)
                self.stop()

    def _ends(self, report: ChunkReport, error: BaseException) -> bool:
        """Whether an error ends a chunk, as nothing can be written any more; nothing more is begun then."""
        if leaves_no_room(error):
            report.halt = report.halt or error_line(error, named=True)
            self.stop()
        return leaves_no_room(error)

    def _noted(self, record: dict[str, Any], report: ChunkReport) -> bool:
        """Append to the notes; False where there is no room for that, which ends the chunk."""
        try:
            self.notes.append(record)
        except OSError as error:
            if not self._ends(report, error):
                raise
            return False
        return True

    def _pack(self, order: Chunk, report: ChunkReport) -> None:
        assert self.out is not None and order.shard is not None and order.packed is not None
        try:
            pack_shard(self.out, order.shard, [{"outputs": outputs} for outputs in order.packed])
        except Exception as error:
            if not self._ends(report, error):
                report.pack_error = error_line(error, named=True)

    def close(self) -> None:
        """End the maker's threads, and close the notes."""
        self.held.close()


@dataclasses.dataclass(frozen=True)
class RunnerSettings:
    """What a worker needs to begin."""

    base: str  # folder of the job file
    reader: ItemReader
    out: str
    notes: str  # name of its file of notes; of all workers that of the run, with which these begin
    device: str | None = None  # Warp device; None is the first GPU, or the CPU
    worker: str = "0"
    retries: int = 2
    threads: int = 0  # for kernels on the CPU; 0 is what there is
    maker: Callable[[str, str, Any], Maker] | None = None  # of base, out and device; None is `Worker`


def make_runner(settings: RunnerSettings) -> ChunkRunner:
    """A runner of chunks, in the process that calls; a RuntimeError where this machine does not see the folders of the
    run."""
    folder = OutputFolder(settings.out)
    for path in (pathlib.Path(settings.base), folder.notes):
        if not path.is_dir():
            raise StateError(
                f"{platform.node()} does not see {str(path)!r}: all machines need the folders under the same path"
            )
    held = contextlib.ExitStack()
    held.enter_context(folder.worked_in())
    if settings.threads:
        held.enter_context(limit_threads(settings.threads))
    device = resolve_device(settings.device)
    make = settings.maker
    if make is None:
        from ..worker import Worker  # here, as the driver of a cluster needs nothing of it

        make = Worker

    check_device(device)
    maker, notes = make(settings.base, settings.out, device), folder.new_notes(settings.notes)
    for each in (notes, maker):  # which is closed first
        held.callback(each.close)
    runner = ChunkRunner(
        maker,
        settings.reader,
        Fingerprints(settings.base, settings.out).of,
        notes,
        {"device": device.name, "worker": settings.worker, "host": platform.node()},
        retries=settings.retries,
        check_device=lambda: check_device(device),
        out=folder.path,
    )
    runner.held = held
    return runner


def check_device(device: wp.Device) -> None:
    """Raise where a GPU answers no more."""
    if device.is_cuda:  # after some errors of CUDA all that a process asks of it fails
        with device_turn(device):  # another thread may render
            wp.zeros(1, dtype=float, device=device).numpy()
            wp.synchronize_device(device)


def run_name() -> str:
    """A name for a run that no other has."""
    return os.urandom(6).hex()


class RunJournal:
    """What workers are sent for chunks, and what they note of them."""

    failures: Mapping[int, str] = {}  # items of the run that failed for good

    def __init__(self, job: JobFile, folder: OutputFolder):
        self._job, self._folder, self.run, self._before = job, folder, run_name(), os.stat(job.path)
        self._shard_size = shard_size(job)

    def order(self, chunk: Chunk) -> Chunk:
        """A chunk as it is sent. A ValueError once the job file has changed; one that is replaced is open as it was."""
        with contextlib.suppress(FileNotFoundError):
            now, before = os.stat(self._job.path), self._before
            if now.st_ino == before.st_ino and (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
                raise InputError(
                    f"{self._job.path} was changed while it ran: run again, what is made and unchanged is kept"
                )
        if chunk.shard is not None:
            return dataclasses.replace(chunk, packed=self._packed(chunk.shard))
        lines = [(self._job.data(index), self._job.line(index)) for index in chunk.items]
        shard = chunk.items[0] // self._shard_size if self._shard_size else None
        return dataclasses.replace(chunk, lines=lines, shard=shard)

    def noted(self, worker: str, start: int, chunk: Chunk) -> tuple[ChunkReport, list[int]]:
        """What a worker noted of a chunk: what it settled and what it left, and what it had begun, the newest last."""
        report = ChunkReport()
        indices = {self._job.reader(*line).id: index for line, index in zip(chunk.lines, chunk.items, strict=True)}
        path = self._folder.notes / f"{self.run}-{worker}-{start}.jsonl"
        settled, begun = notes_of_chunk(path, chunk.number)
        for record in settled:
            index = indices.pop(record["id"])
            if record["state"] == DONE:
                report.done.append(index)
                report.seconds.append(float(record["seconds"]))
            else:
                (report.errors if record["state"] == ERROR else report.failed).append((index, record["error"]))
        report.left = list(indices.values())
        return report, [indices[each] for each in begun]

    def lost(self, item: int, error: str, attempts: int) -> None:
        found = self._job.item(item)
        record = {"id": found.id, "state": FAILED, "kind": found.kind, "attempts": attempts, "error": error}
        with contextlib.closing(self._folder.new_notes(f"{self.run}-driver")) as notes:
            notes.append(record)

    def _packed(self, shard: int) -> list[dict[str, str]]:
        """The outputs of all items of a shard that are there: what was to be made of it is settled."""
        begin = shard * self._shard_size
        indices = range(begin, min(begin + self._shard_size, len(self._job)))
        there = (self._job.item(index) for index in indices if index not in self.failures)
        return [{path: part for part, path in item.outputs.items()} for item in there]
