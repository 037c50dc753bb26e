"""The items of a lot, one after the other, in whichever process a worker lives."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import datetime
import os
import pathlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol

from .. import __version__
from ..core.words import system_error_line
from .dispatcher import LotReport
from .items import Item
from .manifest import DONE, ERROR, FAILED, NO_ROOM, STARTED, Notes
from .webdataset import pack_shard, shard_stage

#: What the same input brings again: there is no use in trying it once more.
BAD_INPUT = (
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    AssertionError,
    ImportError,
    FileNotFoundError,
    IsADirectoryError,
    NotADirectoryError,
)


class Maker(Protocol):
    """Makes items: `batch.worker.Worker`, or what stands for it in tests."""

    def submit(self, item: Item, out: str | os.PathLike | None = None) -> Future[dict[str, int]]:
        """Make an item; its files may be written while the next one is made. out: where, instead of the run's folder.

        Becomes its files and their sizes in bytes, or what went wrong.
        """
        ...

    def close(self) -> None:
        """End what writes files."""
        ...


@dataclasses.dataclass(frozen=True)
class LotOrder:
    """A lot as it is sent to a worker.

    Attributes:
        number: Of the lot.
        indices: Numbers of its items in the job file.
        lines: The lines of that, as they stand, and their numbers: workers read them.
        attempts: How often each was begun before and failed.
        shard: The shard that they belong to; None where there are none.
        packed: The outputs of all items that the shard is to be packed of, by item; None where items are to be made.
        seconds: After so many no more items are begun, but for the first; None is no limit.
    """

    number: int
    indices: list[int]
    lines: list[tuple[bytes, int]]
    attempts: list[int]
    shard: int | None = None
    packed: list[dict[str, str]] | None = None
    seconds: float | None = None


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a worker works, for the records.

    Attributes:
        worker: Its name.
        host: The machine.
        device: Name of the processor or the GPU.
    """

    worker: str
    host: str
    device: str


def one_line(error: BaseException) -> str:
    """What went wrong, in one line."""
    if (line := system_error_line(error)) is not None:
        return line
    text = " ".join(str(error).split())
    told = isinstance(error, (ValueError, FileNotFoundError))  # both are raised with a sentence that says it all
    return text if text and told else f"{type(error).__name__}{': ' if text else ''}{text}"


def leaves_no_room(error: BaseException) -> bool:
    """Whether an error says that nothing can be written any more: a full disk, a quota, or one that is read-only.

    Libraries in C++ tell it in words alone.
    """
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in NO_ROOM
    return any(os.strerror(number) in str(error) for number in NO_ROOM)


@dataclasses.dataclass
class _UnderWay:
    """An item that was begun and is not settled."""

    item: Item
    index: int
    attempts: int
    begun: float
    seconds: float = 0.0  # of the thread that makes items
    inputs: Callable[[], str] = str
    future: Future[dict[str, int]] = dataclasses.field(default_factory=Future)


class LotRunner:
    """Makes the items of lots, and notes what became of each.

    Args:
        maker: Makes one item.
        read: An item of its line and the number of that.
        fingerprint: Begins the hash of an item's inputs, as they are before it is made; what it returns waits for it.
        notes: Where it is noted.
        place: What records say of the worker.
        retries: How often an item may be tried again.
        check_device: Raises where the device works no more; called after errors that are not those of the input.
        out: The folder of the run, where there are shards.

    Attributes:
        report: What became of the items of the newest lot so far.
    """

    def __init__(
        self,
        maker: Maker,
        read: Callable[[bytes, int], Item],
        fingerprint: Callable[[Item], Callable[[], str]],
        notes: Notes,
        place: Place,
        *,
        retries: int = 2,
        check_device: Callable[[], None] = lambda: None,
        out: pathlib.Path | None = None,
    ):
        self._maker, self._read, self._fingerprint, self._notes, self._place = maker, read, fingerprint, notes, place
        self._retries, self._check_device, self._out = retries, check_device, out
        self._lock = threading.Lock()
        self._order = LotOrder(0, [], [], [])
        self._waiting: collections.deque[int] = collections.deque()  # places in the lot that were not begun
        self._begun: dict[int, _UnderWay] = {}  # of the lot, which are not settled
        self._stopped = False
        self.report, self._settled_at = LotReport(), 0.0
        self._group: str | None = None
        self._held = contextlib.ExitStack()

    def run(self, order: LotOrder) -> LotReport:
        """Make a lot.

        Args:
            order: The lot.

        Returns:
            What became of its items.
        """
        if order.packed is not None:
            return self._packed(order)
        self.report = report = LotReport()
        with self._lock:
            self._order, self._waiting = order, collections.deque(range(len(order.lines)))
            self._begun = {}
        under_way: collections.deque[_UnderWay] = collections.deque()
        begin = self._settled_at = time.perf_counter()
        try:
            while report.halt is None and report.broken is None and (place := self._next()) is not None:
                if place and order.seconds is not None and time.perf_counter() - begin > order.seconds:
                    break
                self._begin(order, place, under_way)
                while under_way and under_way[0].future.done():
                    self._settle(under_way.popleft())
        finally:  # also at an interrupt: what is being written is noted once it is there
            while under_way:
                self._settle(under_way.popleft())
        settled = {*report.done, *(index for index, _ in [*report.failed, *report.errors])}
        report.left = [index for index in order.indices if index not in settled]
        return report

    def recall(self, number: int, share: float) -> list[int]:
        """Give items back that were not begun. Any thread may call it while a lot runs.

        Args:
            number: Of the lot; another one gives nothing back.
            share: Of those that were not begun, as many from the end.

        Returns:
            Their numbers in the job file.
        """
        with self._lock:
            if number != self._order.number:
                return []
            back = [self._waiting.pop() for _ in range(int(share * len(self._waiting)))]
            return [self._order.indices[place] for place in reversed(back)]

    def oldest(self, number: int) -> tuple[int, float] | None:
        """The item that has been under way for longest. Any thread may call it while a lot runs.

        Args:
            number: Of the lot.

        Returns:
            Its number in the job file, and the seconds since it was begun; None where none is under way, or for another
            lot.
        """
        with self._lock:
            begun = [made for made in self._begun.values() if not made.future.done()]
            if number != self._order.number or not begun:
                return None
        first = min(begun, key=lambda made: made.begun)
        return first.index, time.perf_counter() - first.begun

    def stop(self) -> None:
        """Begin no more items."""
        self._stopped = True

    def _next(self) -> int | None:
        with self._lock:
            return self._waiting.popleft() if self._waiting and not self._stopped else None

    def _begin(self, order: LotOrder, place: int, under_way: collections.deque[_UnderWay]) -> None:
        """Make an item as far as this thread does it."""
        item, report = self._read(*order.lines[place]), self.report
        try:
            self._notes.append({"id": item.id, "state": STARTED, "lot": order.number})
        except OSError as error:
            if not leaves_no_room(error):
                raise
            report.halt = report.halt or one_line(error)
            return
        report.loading |= not place and item.group != self._group
        made = _UnderWay(item, order.indices[place], order.attempts[place], time.perf_counter())
        with self._lock:
            self._begun[made.index] = made
        try:
            made.inputs = self._fingerprint(item)
            made.future = self._maker.submit(item, self._stage(order))
        except Exception as error:
            made.future.set_exception(error)
        made.seconds = time.perf_counter() - made.begun
        self._group = item.group
        under_way.append(made)

    def _settle(self, made: _UnderWay) -> None:
        """Note what became of an item that was begun."""
        report, error, sizes, inputs = self.report, None, {}, ""
        try:
            inputs = made.inputs()
            sizes = made.future.result()
        except Exception as failure:
            error = failure
        with self._lock:
            self._begun.pop(made.index, None)
        now = time.perf_counter()
        seconds = now - max(made.begun, self._settled_at)  # of items that overlap, what each adds
        self._settled_at = now
        if error is not None and leaves_no_room(error):
            report.halt = report.halt or one_line(error)
            return
        record: dict[str, Any] = {"id": made.item.id, "state": DONE, "inputs": inputs, "outputs": sizes}
        record |= self._facts(made.item, seconds, made.attempts + 1)
        final = isinstance(error, BAD_INPUT) or made.attempts >= self._retries
        if error is not None:
            record |= {"state": FAILED if final else ERROR, "error": one_line(error)}
        try:
            self._notes.append(record)
        except OSError as failure:
            if not leaves_no_room(failure):
                raise
            report.halt = report.halt or one_line(failure)
            return
        if error is None:
            report.done.append(made.index)
            # behind what waits for hashes of what was loaded, others seem to take nothing
            report.seconds.append(made.seconds if report.loading else seconds)
            return
        (report.failed if final else report.errors).append((made.index, one_line(error)))
        if not isinstance(error, BAD_INPUT) and report.broken is None:
            try:
                self._check_device()
            except Exception as failure:  # whatever the device says, it is lost to this process
                report.broken = one_line(failure)

    def _facts(self, item: Item, seconds: float, attempts: int) -> dict[str, Any]:
        """What a record says of how an item was made."""
        return {
            "kind": item.kind,
            "seconds": round(seconds, 4),
            "device": self._place.device,
            "worker": self._place.worker,
            "host": self._place.host,
            "attempts": attempts,
            "version": __version__,
            "finished": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds"),
        }

    def _stage(self, order: LotOrder) -> pathlib.Path | None:
        """Where the items of a shard stand until it is packed; None: in the folder of the run."""
        return None if order.shard is None or self._out is None else shard_stage(self._out, order.shard)

    def _packed(self, order: LotOrder) -> LotReport:
        """Pack a shard."""
        assert self._out is not None and order.shard is not None and order.packed is not None
        report = LotReport()
        try:
            pack_shard(self._out, order.shard, [{"outputs": outputs} for outputs in order.packed])
        except Exception as error:
            if leaves_no_room(error):
                report.halt = one_line(error)
            else:
                report.pack_error = one_line(error)
        return report

    def keep(self, held: contextlib.AbstractContextManager[Any]) -> None:
        """Keep something open as long as this may write.

        Args:
            held: What is closed by `close`.
        """
        self._held.enter_context(held)

    def close(self) -> None:
        """End the maker's threads, and close the notes."""
        self._maker.close()
        self._notes.close()
        self._held.close()
