"""The chunks of what is left and who gets them: by measured seconds, by what a worker holds already."""

from __future__ import annotations

import collections
import dataclasses
import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from ...core.names import counted
from ...errors import InputError
from .engines.chunk_runner import MAX_CHUNKS, Chunk, ChunkReport

AIM, LARGEST = 10.0, 256  # seconds that a chunk should take, and most items that it holds
CHUNKS_PER_WORKER = 4  # that each should still get of what is left: they become small, and all end together
MIN_CHUNK = 0.5  # seconds, as far as each worker gets as much: a chunk waits until its last files are written
NEWEST_CHUNKS = 0.25  # weight of the newest chunk in an item's seconds, where it has as many items as those before it


@dataclasses.dataclass
class _Seconds:
    """A running mean of what an item takes, and how many items of a chunk it is known by."""

    mean: float = 0.0
    items: float = 0.0

    def note(self, seconds: float, items: int) -> None:
        """Take in a chunk of so many items, each of which counts."""
        before = (1.0 / NEWEST_CHUNKS - 1.0) * self.items
        weight = items / (items + before) if before else 1.0
        self.mean += weight * (seconds - self.mean)
        self.items += weight * (items - self.items)


class ChunkQueue:
    """What is left to be made, in groups of items that share what a worker loads; items, groups and kinds are (n,).
    Items of a group follow each other, and last as those of their kind until more is known; aim: seconds of a chunk."""

    def __init__(
        self,
        items: np.ndarray,
        groups: np.ndarray,
        kinds: np.ndarray | None = None,
        *,
        aim: float = AIM,
        largest: int = LARGEST,
        whole: bool = False,  # whether a chunk is all that is left of a group (a shard), however long it takes
    ):
        self._items = np.asarray(items, np.int64)
        groups = np.asarray(groups, np.int64)
        starts = np.flatnonzero(np.diff(groups, prepend=groups[:1] - 1)) if len(groups) else np.zeros(0, np.int64)
        self.names = groups[starts]  # what callers call each group
        if len(np.unique(self.names)) < len(self.names):
            raise InputError("items of a group must follow each other")
        self._begin = starts.copy()  # the first item of each group that no worker has taken
        self._end = np.append(starts[1:], len(groups))
        self._kinds = np.zeros(len(starts), np.int64) if kinds is None else np.asarray(kinds, np.int64)[starts]
        self._back: dict[int, list[int]] = {}  # what was taken and came back, by group
        # the largest first: none is left for the end
        self._by_size = np.argsort(self._begin - self._end, kind="stable")
        self._unclaimed = 0  # index into those
        self._open: set[int] = set()  # groups that were claimed and have items left
        self._seconds: dict[int, _Seconds] = {}  # an item of a group takes
        self._kind_seconds: dict[int, _Seconds] = {}
        self.aim, self._largest, self.whole = aim, largest, whole
        self.left = len(self._items)  # items that no worker has

    def left_in(self, group: int) -> int:
        """Items of a group that no worker has."""
        return int(self._end[group] - self._begin[group]) + len(self._back.get(group, ()))

    def seconds(self, group: int) -> float | None:
        """Seconds that an item of a group takes; None where that is unknown."""
        found = self._seconds.get(group, self._kind_seconds.get(int(self._kinds[group])))
        return None if found is None else found.mean

    def usual_seconds(self) -> dict[int, float]:
        """Seconds that items of a kind take, of the kinds of which more was made than what loads."""
        return {kind: each.mean for kind, each in self._kind_seconds.items() if each.items}

    def note(self, group: int, seconds: float, items: int = 1) -> None:
        """Keep how long an item of a group took; seconds: mean over the items of a chunk; items: how many."""
        # One alone takes longer than one among others. 0: loading is in the seconds, which hold until others are known.
        kind = int(self._kinds[group])
        tables = [(self._kind_seconds, kind), *([(self._seconds, group)] if self.left_in(group) else [])]
        for table, key in tables:
            table.setdefault(key, _Seconds()).note(seconds, items)

    def choose(self, loaded: int | None, sharers: collections.Counter[int | None]) -> int | None:
        """The group of which a worker should take its next chunk; loaded: that it has; sharers: workers at each."""
        # The loaded one while any is left, else the largest that none has begun, else that with most left a worker.
        if loaded is not None and self.left_in(loaded):
            return loaded
        while self._unclaimed < len(self._by_size):
            group = int(self._by_size[self._unclaimed])
            self._unclaimed += 1
            if group not in self._open and self.left_in(group):
                self._open.add(group)
                return group
        return max(self._open, key=lambda group: self.left_in(group) / (1 + sharers[group]), default=None)

    def take(self, group: int, workers: int) -> tuple[list[int], int]:
        """Cut a chunk of a group; returns the items, and the group of the last of them."""
        size = self._size(group, workers)
        taken = self._cut(group, size)
        # too few: the next groups that no worker has begun go with it, where they are of its kind and fit whole
        while not self.whole and len(taken) < size and self._unclaimed < len(self._by_size):
            following = int(self._by_size[self._unclaimed])
            fits = self.left_in(following) <= size - len(taken) and self._kinds[following] == self._kinds[group]
            if not fits or following in self._open:
                break
            self._unclaimed += 1
            taken += self._cut(following, size - len(taken))
            group = following
        return taken, group

    def put_back(self, group: int, items: Iterable[int]) -> None:
        """Items that were taken and not made."""
        items = list(items)
        if items:
            self._back.setdefault(group, []).extend(items)
            self._open.add(group)
            self.left += len(items)

    def _size(self, group: int, workers: int) -> int:
        if self.whole:
            return self.left_in(group)
        fair, equal = (-(-self.left // (chunks * max(workers, 1))) for chunks in (CHUNKS_PER_WORKER, 1))
        seconds = self.seconds(group)
        if seconds is None:  # the chunk ends with its time; its first item may wait long for the hash of what it loads
            return min(fair, self._largest)
        each = max(seconds, 1e-9)
        aimed, least = int(self.aim / each), int(min(self.aim, MIN_CHUNK) / each)
        return max(1, min(aimed, max(fair, min(least, equal)), self._largest))

    def _cut(self, group: int, size: int) -> list[int]:
        back = self._back.get(group, [])
        taken = back[:size]
        if taken:
            del back[:size]
            if not back:
                del self._back[group]
        begin = int(self._begin[group])
        end = min(begin + size - len(taken), int(self._end[group]))
        self._begin[group] = end
        taken += self._items[begin:end].tolist()
        self.left -= len(taken)
        if self.left_in(group):
            self._open.add(group)
        else:
            self._open.discard(group)
            self._seconds.pop(group, None)  # that of the kind stays
        return taken


#: Deaths of a worker in a row, none of which made an item, after which its place is given up.
MAX_EARLY_DEATHS = 3

MIN_SHARED = 2.0  # a chunk is shortened for a worker with nothing to do where it would take so many more seconds
STRAGGLING = 2.0  # a worker that takes so many times what its chunk should have taken gives back what is not begun


@dataclasses.dataclass
class _Worker:
    """A place where a process works; when that dies, another takes its place."""

    chunks: dict[int, Chunk] = dataclasses.field(default_factory=dict)  # all that it has, by number, the oldest first
    making: int | None = None  # number of that of which items are made; files of the others are being written
    began: float = 0.0
    group: int | None = None
    consecutive_failures: int = 0  # deaths in a row without an item
    recalled: bool = False  # whether its chunk was asked back


class Dispatcher:
    """Gives chunks to workers, and knows when all is settled; retries: how often an item may be tried again.
    shards: items that are open of each shard, where chunks are shards; 0 where it is only to be packed."""

    # Times are arguments: a simulation under a virtual clock runs the very same code (python benchmarks batch-scale).

    def __init__(self, chunks: ChunkQueue, *, retries: int = 2, shards: dict[int, int] | None = None):
        self.chunks, self.retries = chunks, retries
        self.done = 0
        self.failures: dict[int, str] = {}  # items that will not be tried again, with one line each
        self.stopped = False
        self._workers: dict[str, _Worker] = {}
        self._sharers: collections.Counter[int | None] = collections.Counter()  # workers at each group
        self.attempts: collections.Counter[int] = collections.Counter()  # how often items were begun and failed
        self._retries: collections.deque[tuple[int, int, str]] = collections.deque()  # item, group, where it failed
        self._shards = {shard: count for shard, count in (shards or {}).items() if count}
        ready = [(shard, 0) for shard, count in (shards or {}).items() if not count]
        self._packs: collections.deque[tuple[int, int]] = collections.deque(ready)  # shard, attempts
        self.unpacked: list[tuple[int, str]] = []  # shards that could not be packed
        self._numbers = itertools.count(1)
        self._busy: set[str] = set()

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to be assigned or waited for."""
        return not self._busy and (self.stopped or not self.open)

    @property
    def open(self) -> bool:
        """Whether there is an item that no worker has."""
        return bool(self.chunks.left or self._retries or self._packs)

    @property
    def names(self) -> list[str]:
        """The places where work is done."""
        return list(self._workers)

    @property
    def left(self) -> int:
        """Items that are neither made nor failed."""
        held = sum(len(chunk.items) for name in self._busy for chunk in self._workers[name].chunks.values())
        return self.chunks.left + len(self._retries) + held

    @property
    def workers(self) -> int:
        return len(self._workers)

    def takes(self, name: str) -> bool:
        """Whether a worker can make the items of another chunk."""
        worker = self._workers[name]
        return worker.making is None and len(worker.chunks) < MAX_CHUNKS

    def add_worker(self, name: str) -> None:
        """A place where work can be done; its process may start later."""
        self._workers[name] = _Worker()

    def next_chunk(self, name: str, now: float) -> Chunk | None:
        """The next chunk of a worker that makes items of none; None where there is nothing for it at present.
        now: seconds of any clock that never goes back."""
        worker = self._workers[name]
        if self.stopped:
            return None
        chunk = self._pack(worker) or self._retry(name, worker, loaded_only=True) or self._cut(worker)
        chunk = chunk or self._retry(name, worker, loaded_only=False)
        if chunk is None:
            return None
        worker.chunks[chunk.number] = chunk
        worker.making, worker.began, worker.recalled = chunk.number, now, False
        self._busy.add(name)
        return chunk

    def begun(self, name: str, number: int) -> bool:
        """A worker has begun all items of a chunk; returns whether it takes another one while files are written."""
        worker = self._workers.get(name)
        if worker is None or worker.making != number:
            return False  # not what it makes: its report was there before
        worker.making = None
        return self.takes(name)

    def reported(self, name: str, report: ChunkReport, number: int | None = None) -> None:
        """A worker is done with a chunk; number: of the chunk, None is the one of which it makes items."""
        worker = self._workers[name]
        number = worker.making if number is None else number
        assert number is not None
        chunk = worker.chunks.pop(number)
        worker.making = None if worker.making == number else worker.making
        self._settle(name, [chunk], report)
        if chunk.shard is not None and report.pack_error is not None:
            self._pack_again(chunk, report.pack_error)
        if report.done:
            worker.consecutive_failures = 0
            usual = report.seconds[1:] if report.loading else report.seconds
            mean = sum(usual) / len(usual) if usual else report.seconds[0]
            self.chunks.note(chunk.group, mean, len(usual))
        elif report.broken is not None:
            worker.consecutive_failures += 1
        if report.halt is not None:
            self.stop()

    def died(self, name: str, report: ChunkReport, begun: Sequence[int], reason: str) -> list[tuple[int, str]]:
        """A worker died; report: what it had settled; begun: items begun and not settled, the newest last.
        Returns the newest, with its error, where that is not tried again."""
        worker = self._workers[name]
        self._move(worker, None)  # what takes its place has nothing loaded
        worker.consecutive_failures = 0 if report.done else worker.consecutive_failures + (not begun)
        chunks, worker.chunks, worker.making = list(worker.chunks.values()), {}, None
        lost: list[tuple[int, str]] = []
        charged = begun[-1] if begun else None
        if charged is not None and self.attempts[charged] >= self.retries:
            times = counted(self.attempts[charged] + 1, "time")
            lost = [(charged, f"{reason}, {times} while it was made")]
            report.failed.extend(lost)
        elif charged is not None:
            report.errors.append((charged, reason))
        settled = {*report.done, *(item for item, _ in [*report.failed, *report.errors]), *begun}
        report.left = [item for chunk in chunks for item in chunk.items if item not in settled]
        self._settle(name, chunks, report)
        groups = {item: chunk.group for chunk in chunks for item in chunk.items}
        # those whose files were being written are made again alone, so that one that kills its worker is known by that
        self._retries.extend((item, groups[item], "") for item in begun[:-1])
        for chunk in chunks:
            if chunk.shard is not None:
                self._pack_again(chunk, reason)
        return lost

    def given_up(self, name: str) -> bool:
        """Whether a worker's place is not filled again, as it dies before it makes anything; it is forgotten then."""
        if self._workers[name].consecutive_failures < MAX_EARLY_DEATHS:
            return False
        del self._workers[name]
        return True

    def recalls(self, idle: int, now: float) -> list[tuple[str, int, float]]:
        """Chunks that are to be shortened, so that `idle` workers that have nothing to do get some of them.
        Returns workers, numbers of their chunks, and the share of what each has not begun that it should give back."""
        if self.stopped or not idle or self.chunks.left:
            return []
        late = []
        for name in self._busy:
            worker = self._workers[name]
            chunk = worker.chunks.get(worker.making or 0)
            if chunk is None or worker.recalled or len(chunk.items) < 2:
                continue
            seconds = self.chunks.seconds(chunk.group)
            passed = now - worker.began
            expected = (seconds or 0.0) * len(chunk.items)
            if passed > STRAGGLING * max(expected, MIN_SHARED):
                late.append((passed, name, chunk.number, 1.0))
            elif expected - passed > MIN_SHARED:
                late.append((expected - passed, name, chunk.number, 0.5))
        late.sort(reverse=True)
        for _, name, _, _ in late[:idle]:
            self._workers[name].recalled = True
        return [(name, number, share) for _, name, number, share in late[:idle]]

    def returned(self, name: str, number: int, items: Sequence[int]) -> None:
        """A worker gave back items of its chunk that it had not begun."""
        worker = self._workers.get(name)
        if worker is None or worker.making != number or not items:
            return  # the chunk ended meanwhile, or soon will: its report says what was left
        chunk, back = worker.chunks[number], set(items)
        worker.chunks[number] = dataclasses.replace(chunk, items=[item for item in chunk.items if item not in back])
        worker.recalled = False  # what it still holds may be asked for later
        self.chunks.put_back(chunk.group, items)

    def stop(self) -> None:
        """Give out no more chunks."""
        self.stopped = True

    def _settle(self, name: str, chunks: Sequence[Chunk], report: ChunkReport) -> None:
        """Count what a report of chunks says that a worker has no more, and put the rest back into the queue."""
        if not self._workers[name].chunks:
            self._busy.discard(name)
        groups = {item: chunk.group for chunk in chunks for item in chunk.items}  # without what it gave back meanwhile
        self.done += len(report.done)
        self.failures.update(report.failed)
        settled = [*report.done, *(item for item, _ in report.failed)]
        for item in settled:
            self.attempts.pop(item, None)
        for item, _ in report.errors:
            self.attempts[item] += 1
            self._retries.append((item, groups[item], name))
        for group in dict.fromkeys(groups.values()):
            self.chunks.put_back(group, [item for item in report.left if groups.get(item) == group])
        if self._shards:
            for group, count in collections.Counter(groups[item] for item in settled).items():
                shard = int(self.chunks.names[group])
                self._shards[shard] -= count
                if not self._shards[shard]:
                    del self._shards[shard]
                    self._packs.append((shard, 0))

    def _cut(self, worker: _Worker) -> Chunk | None:
        if not self.chunks.left:
            return None
        group = self.chunks.choose(worker.group, self._sharers)
        if group is None:
            return None
        known = self.chunks.whole or self.chunks.seconds(group) is not None
        items, taken = self.chunks.take(group, len(self._workers))
        self._move(worker, taken)
        return self._chunk(items, taken, None if known else self.chunks.aim)

    def _retry(self, name: str, worker: _Worker, loaded_only: bool) -> Chunk | None:
        """An item that failed, alone and elsewhere where there is an elsewhere."""
        for _ in range(len(self._retries)):
            item, group, failed_at = self._retries.popleft()
            elsewhere = failed_at != name or len(self._workers) == 1 or failed_at not in self._workers
            if elsewhere and (group == worker.group or not loaded_only):
                self._move(worker, group)
                return self._chunk([item], group)
            self._retries.append((item, group, failed_at))
        return None

    def _pack(self, worker: _Worker) -> Chunk | None:
        if not self._packs:
            return None
        shard, attempts = self._packs.popleft()
        return dataclasses.replace(self._chunk([], worker.group or 0), attempts=[attempts], shard=shard)

    def _pack_again(self, chunk: Chunk, reason: str) -> None:
        assert chunk.shard is not None
        if chunk.attempts[0] < self.retries:
            self._packs.append((chunk.shard, chunk.attempts[0] + 1))
        else:
            self.unpacked.append((chunk.shard, reason))

    def _chunk(self, items: list[int], group: int, seconds: float | None = None) -> Chunk:
        return Chunk(next(self._numbers), items, [self.attempts[item] for item in items], group, seconds=seconds)

    def _move(self, worker: _Worker, group: int | None) -> None:
        """Note what a worker has loaded."""
        self._sharers[worker.group] -= 1
        self._sharers[group] += 1
        worker.group = group
