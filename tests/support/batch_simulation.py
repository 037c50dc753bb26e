"""Workers under a virtual clock: the dispatcher's own code runs over thousands of them in seconds, and what a test does
to one of them happens to the microsecond."""

from __future__ import annotations

import collections
import dataclasses
import heapq
import math

import numpy as np

from warpcage.studio.jobs import Answer, Chunk, ChunkReport


@dataclasses.dataclass
class Conditions:
    """What a simulated run meets."""

    # (n,) what each item takes on a usual worker
    item_seconds: np.ndarray
    # (n,) which items share what is loaded
    groups: np.ndarray
    # (workers,) what each worker takes for a second's work
    speeds: np.ndarray
    # what loading another group takes
    load_seconds: float = 0.0
    # after so long the files of an item are there, once it is made
    write_seconds: float = 0.0
    # whether workers report when all items of a chunk are begun, before their files are there
    overlapping: bool = False
    # what starting a worker's process takes
    start_seconds: float = 2.0
    # seconds on the way of a message
    latency: float = 0.0005
    # seconds of the driver for a chunk, and for each of its items; for a report, and for each of its items
    send_cost: tuple[float, float] = (0.0, 0.0)
    receive_cost: tuple[float, float] = (0.0, 0.0)
    # of each worker at work, by chance
    deaths_per_hour: float = 0.0
    # items that kill every worker that makes them
    poison: frozenset[int] = frozenset()
    # items whose input is bad
    bad: frozenset[int] = frozenset()
    # share of the tries that fail by chance
    flaky: float = 0.0
    # after how many errors an item is not tried again
    retries: int = 200
    # share of the chunks during which a worker becomes slow, and how much
    stalls: tuple[float, float] = (0.0, 10.0)
    seed: int = 0


@dataclasses.dataclass
class _Work:
    """A chunk that a worker has."""

    worker: str
    chunk: Chunk
    items: list[int]  # that are begun before the time of the chunk is over, and were not given back
    starts: np.ndarray
    ends: np.ndarray
    death: float  # when the worker dies, infinity where it does not
    loading: bool
    version: int
    begun: bool = False  # whether all items are


class SimulatedEngine:
    """What `ProcessEngine` does, under a virtual clock. The driver is one more worker, which messages keep busy.
    It is the journal of its chunks too, which are sent as they are."""

    def __init__(self, conditions: Conditions):
        self.conditions, self.overlapping = conditions, conditions.overlapping
        # (n,) how often each item was made
        self.made = np.zeros(len(conditions.item_seconds), np.int16)
        # seconds that the driver worked, and that workers made items and loaded what those need
        self.busy = self.worked = 0.0
        # workers that died; chunks, reports and recalls; chunks alone
        self.deaths = self.messages = self.chunks = 0
        self.random = np.random.default_rng(conditions.seed)
        self.time = 0.0
        self.queue: list[tuple[float, int, str, str, int]] = []  # when, order, what, worker, version
        self.count = 0
        self.works: dict[str, list[_Work]] = {}  # of each worker, the oldest first
        self.dead: dict[str, tuple[float, list[_Work]]] = {}  # when each died that was not started since, with what
        self.starts: dict[str, int] = {}  # how often each was started that is there
        self.killed: dict[str, float] = {}  # when each was killed of which the driver does not know yet
        self.silent: set[str] = set()  # those that answer nothing
        self.broken: set[str] = set()  # those whose device is lost, as their next reports say
        self.failing: collections.Counter[int] = collections.Counter()  # tries of items that will fail
        self.reply_seconds = conditions.latency  # on the way of an answer to what a worker is asked
        self.loaded: dict[str, int] = {}
        self.replies: dict[int, tuple[int, Answer]] = {}

    def now(self) -> float:
        """The virtual time of the driver, seconds."""
        return self.time

    def start(self, worker: str, start: int) -> None:
        """A process starts."""
        self.loaded.pop(worker, None)
        self.starts[worker] = start
        self.later(self.time + self.conditions.start_seconds, "ready", worker, start)

    def order(self, chunk: Chunk) -> Chunk:
        return chunk

    def submit(self, worker: str, method: str, *given) -> None:
        """A worker gets a chunk, is asked for items, or is stopped."""
        if method in ("run", "begin"):
            (chunk,) = given
            self.spend(self.conditions.send_cost, len(chunk.items))
            self.chunks += 1
            self.set_out(worker, chunk)
        elif method == "recall":
            self.recall(worker, *given)
        elif method == "oldest":
            self.reply(worker, method, 0, self.oldest(worker))
        elif method == "stop":
            there = self.time + self.conditions.latency
            self.spend(self.conditions.send_cost, 0)
            work = self.making(worker)
            if work is not None and there < work.death:
                self.shorten(worker, work, int(np.count_nonzero(work.starts <= there)))

    def recall(self, worker: str, number: int, share: float) -> None:
        """A worker is asked for items."""
        self.spend(self.conditions.send_cost, 0)
        work, back = self.making(worker), []
        there = self.time + self.conditions.latency
        if work is not None and work.chunk.number == number and there < work.death:
            waiting = int(np.count_nonzero(work.starts > there))
            back = self.shorten(worker, work, len(work.items) - math.ceil(share * waiting))
        self.reply(worker, "recall", number, back)

    def oldest(self, worker: str) -> tuple[int, float] | None:
        """The item that is under way for longest, and how long."""
        there, writing = self.time + self.conditions.latency, self.conditions.write_seconds
        for work in self.works.get(worker, []):
            under_way = (work.starts <= there) & (work.ends + writing > there)
            if under_way.any():
                place = int(np.argmax(under_way))
                return work.items[place], there - float(work.starts[place])
        return None

    def reply(self, worker: str, method: str, number: int, found) -> None:
        """A worker answers what it was asked."""
        self.count += 1
        self.replies[self.count] = self.starts.get(worker, 0), Answer(worker, method, number, found)
        there = self.time + self.conditions.latency + self.reply_seconds
        heapq.heappush(self.queue, (there, self.count, "reply", worker, self.count))

    def cancel(self, worker: str) -> None:
        """The process of a worker is gone."""
        if self.starts.get(worker):
            self.bury(worker, self.killed.get(worker, self.time))

    def bury(self, worker: str, death: float) -> None:
        """A worker is no more; what it had by then is what it noted."""
        works = self.works.pop(worker, [])
        self.dead[worker] = min([death, *(work.death for work in works)]), works
        self.starts[worker] = 0
        for each in (self.silent, self.broken):
            each.discard(worker)
        self.killed.pop(worker, None)

    # -- what a test does to a worker

    def kill(self, worker: str) -> None:
        """Its process dies now, whatever it does."""
        if self.starts.get(worker) and worker not in self.killed:
            self.killed[worker] = self.time
            self.later(self.time, "killed", worker, self.starts[worker])

    def slow(self, worker: str, factor: float) -> None:
        """All that it has to make takes so many times as long from now on."""
        work = self.making(worker)
        if work is not None:
            for times in (work.starts, work.ends):
                later = times > self.time
                times[later] = self.time + factor * (times[later] - self.time)
            self.schedule(worker, work)

    def hang(self, worker: str) -> None:
        """What it makes or writes for longest is never there; it begins no more of that chunk."""
        for work in self.works.get(worker, [])[:1]:
            place = int(np.count_nonzero(work.ends + self.conditions.write_seconds <= self.time))
            work.ends[place:] = np.inf
            rest = work.starts[place + 1 :]
            rest[rest > self.time] = np.inf
            self.schedule(worker, work)

    def lost(self, item: int, error: str, attempts: int) -> None:
        """Nothing is noted."""

    def wait(self, timeout: float) -> list[Answer]:
        """What happens next; the clock goes on to it, or by the time that passes."""
        end = self.time + timeout
        answers: list[Answer] = []
        while self.queue and not answers:
            when, _, what, worker, version = heapq.heappop(self.queue)
            if when > end:
                heapq.heappush(self.queue, (when, self.count + 1, what, worker, version))
                self.count += 1
                break
            answer = self.answer(what, worker, version)
            if answer is not None:
                self.time = max(self.time, when)
                if answer.method == "run" and answer.error is None:
                    self.spend(self.conditions.receive_cost, len(answer.found.done))
                answers.append(answer)
        if not answers:
            self.time = end
        return answers

    def answer(self, what: str, worker: str, version: int) -> Answer | None:
        if what == "killed" and version == self.starts.get(worker):
            self.deaths += 1
            self.bury(worker, self.killed[worker])
            return Answer(worker, "facts", 0, None, "killed")
        if worker in self.silent and what != "death":
            return None
        if what == "ready":
            return Answer(worker, "facts", 0, None) if version == self.starts.get(worker) else None
        if what == "reply":
            start, answer = self.replies.pop(version)
            return answer if start == self.starts.get(worker) else None
        works = self.works.get(worker, [])
        work = next((each for each in works if each.version == version), None)
        if work is None:
            return None
        if what == "death":
            self.deaths += 1
            self.bury(worker, work.death)
            return Answer(worker, "run", work.chunk.number, None, "killed")
        if what == "begun":
            work.begun = True
            return Answer(worker, "begin", work.chunk.number, None) if self.conditions.overlapping else None
        works.remove(work)
        report = self.report(work, len(work.items))
        report.broken = "device lost" if worker in self.broken else None
        return Answer(worker, "run", work.chunk.number, report)

    def making(self, worker: str) -> _Work | None:
        """The chunk of which a worker makes items."""
        return next((work for work in self.works.get(worker, []) if not work.begun), None)

    def set_out(self, worker: str, chunk: Chunk) -> None:
        """Decide what will happen to a chunk."""
        given, number = self.conditions, int(worker)
        items = np.asarray(chunk.items, np.int64)
        stalled = given.stalls[1] if self.random.random() < given.stalls[0] else 1.0
        seconds = given.item_seconds[items] * given.speeds[number] * stalled
        seconds[[item in given.bad for item in chunk.items] if given.bad else []] = 0.001
        groups = given.groups[items]
        changes = np.diff(groups, prepend=self.loaded.get(worker, -1)) != 0
        ends = self.time + given.latency + np.cumsum(seconds + changes * given.load_seconds)
        starts = np.concatenate([[self.time + given.latency], ends[:-1]])
        death = self.killed.get(worker, np.inf)
        if given.deaths_per_hour:
            death = starts[0] + self.random.exponential(3600.0 / given.deaths_per_hour)
        for place, item in enumerate(chunk.items if given.poison else ()):
            if item in given.poison:
                death = min(death, 0.5 * (starts[place] + ends[place]))
        begun = len(items) if chunk.seconds is None else int(np.count_nonzero(starts - starts[0] <= chunk.seconds))
        if begun:
            self.loaded[worker] = int(groups[begun - 1])
        loading = bool(changes[:1].any())
        work = _Work(worker, chunk, list(chunk.items[:begun]), starts[:begun], ends[:begun], death, loading, 0)
        self.works.setdefault(worker, []).append(work)
        self.schedule(worker, work)

    def shorten(self, worker: str, work: _Work, keep: int) -> list[int]:
        """Leave a worker the first items of its chunk; returns the others."""
        back = work.items[keep:]
        if back:
            work.items, work.starts, work.ends = work.items[:keep], work.starts[:keep], work.ends[:keep]
            self.schedule(worker, work)
        return back

    def schedule(self, worker: str, work: _Work) -> None:
        self.count += 1
        work.version = self.count
        end, given = float(work.ends[-1]) if len(work.ends) else self.time, self.conditions
        if work.death < end + given.write_seconds:
            self.later(work.death + given.latency, "death", worker, work.version)
        else:
            self.later(end + given.write_seconds + given.latency, "end", worker, work.version)
        if given.write_seconds and end < work.death:
            self.later(end + given.latency, "begun", worker, work.version)

    def noted(self, worker: str, start: int, chunk: Chunk) -> tuple[ChunkReport, list[int]]:
        """What a worker that died had settled of a chunk, and what it had begun besides."""
        death, works = self.dead[worker]
        work = next(each for each in works if each.chunk.number == chunk.number)
        settled = int(np.count_nonzero(work.ends + self.conditions.write_seconds <= death))
        report = self.report(work, settled)
        self.spend((0.0, self.conditions.receive_cost[1]), len(report.done))
        self.worked += float(np.maximum(np.minimum(work.ends, death) - work.starts, 0.0)[settled:].sum())
        return report, work.items[settled : int(np.count_nonzero(work.starts < death))]

    def report(self, work: _Work, settled: int) -> ChunkReport:
        """What becomes of the first items of a chunk; the others, also those that were given back, are left."""
        report, given = ChunkReport(left=list(work.chunk.items[settled:]), loading=work.loading), self.conditions
        taken = work.ends[:settled] - work.starts[:settled]
        self.worked += float(taken.sum())
        flaky = self.random.random(settled) < given.flaky if given.flaky else np.zeros(settled, bool)
        if not given.bad and not self.failing and not flaky.any():
            report.done, report.seconds = list(work.items[:settled]), taken.tolist()
            self.made[report.done] += 1
            return report
        tries = zip(work.items[:settled], work.chunk.attempts, taken.tolist(), flaky, strict=False)
        for item, attempts, seconds, fails in tries:
            if item in given.bad:
                report.failed.append((item, "bad input"))
            elif fails or self.failing[item] > 0:
                self.failing[item] -= 1
                (report.errors if attempts < given.retries else report.failed).append((item, "by chance"))
            else:
                report.done.append(item)
                report.seconds.append(seconds)
                self.made[item] += 1
        return report

    def spend(self, cost: tuple[float, float], items: int) -> None:
        """Time of the driver for a message."""
        seconds = cost[0] + cost[1] * items
        self.time += seconds
        self.busy += seconds
        self.messages += 1

    def later(self, when: float, what: str, worker: str, version: int) -> None:
        self.count += 1
        heapq.heappush(self.queue, (when, self.count, what, worker, version))
