"""`warpcage.run_jobs`: make what a job file names, on several workers, and report how it went."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import time
from collections.abc import Callable
from typing import Any

from ...core.checks import checked_positive, checked_whole
from ...core.files import PathLike
from ...core.names import error_line
from ...core.threads import cpu_threads
from ...errors import StateError
from .engines.chunk_runner import Chunk, ChunkReport, Maker, RunJournal, RunnerSettings, leaves_no_room
from .engines.processes import Answer, LocalHost, ProcessEngine, RayHost, ThisProcess, ray_session
from .engines.serving import early_processes
from .items import FOLDER
from .job_file import JobFile, warn_of_shards
from .manifest import OutputFolder, Part
from .plan import Plan, make_plan, open_shards, unpaid
from .scheduler import AIM, ChunkQueue, Dispatcher
from .webdataset import finish_folder, shard_path, shard_size, span_of


@dataclasses.dataclass(frozen=True)
class RunProgress:
    """How far a run is."""

    stage: str  # "check" while items are compared with what is there, "make" after that
    total: int
    checked: int = 0
    kept: int = 0  # items that were there already
    done: int = 0  # items that were made
    failed: int = 0
    workers: int = 0  # places where work is done
    seconds: float = 0.0  # since the first worker was asked for


@dataclasses.dataclass(frozen=True)
class RunReport:
    """What came of a run.

    Attributes:
        total: Items of the job.
        kept: Items that were there already.
        made: Items that were made.
        failed: Ids of items that failed, with one line each; the manifest has them too.
        left: Items that were neither made nor failed, as the run ended before.
        halt: Why it ended before its end, one line; None where it did not.
        seconds: How long it took.
    """

    total: int
    kept: int
    made: int
    failed: dict[str, str]
    left: int
    halt: str | None
    seconds: float

    @property
    def complete(self) -> bool:
        """Whether all items are there."""
        return not self.failed and not self.left and self.halt is None


MIN_AIM = 2.0  # seconds of a chunk where there are few workers, so that progress is seen
WORKERS_PER_SECOND = 100  # for which a chunk takes a second more

Progress = Callable[[RunProgress], None]

MakeMaker = Callable[[str, str, Any], Maker]  # of the folder of the job file, the output folder and the device


def run_jobs(
    path: PathLike,
    out: PathLike,
    *,
    workers: int | None = 1,
    cluster: str | None = None,
    device: str | None = None,
    retries: int = 2,
    item_timeout: float | None = None,
    part: Part | None = None,
    progress: Progress | None = None,
    warn: Callable[[str], None] | None = None,
    make: MakeMaker | None = None,
) -> RunReport:
    """Make the items of a job file: frames, fits, evaluations.

    What is there already and whose inputs did not change is kept. Each item's files appear whole, all of them or none,
    and `manifest.jsonl` in the output folder says once of each item what became of it. A worker that dies, killed, out
    of memory or with its machine, costs the item that it was making an attempt, and another takes its place. After an
    interrupt or a kill the same call makes what is missing.

    Args:
        path: The job file (`docs/batch.md`).
        out: The output folder. One run at a time writes to it. On clusters all machines see it, and the folder of the
            job file, under the same path.
        workers: Processes that work. 1 works in this process, but see `item_timeout`. With more each has a GPU of its
            own, or a part of the cores where there is none. None is one, or on a cluster all of its GPUs.
        cluster: Address of a Ray cluster, "auto" for the one that this machine belongs to. None is this machine.
        device: "cpu", or "cuda" for several workers; any Warp device for one. None is CUDA where there is one.
        retries: How often an item is tried again after an error that is not one of its input, or the death of its
            worker, elsewhere where there is an elsewhere.
        item_timeout: Seconds that an item may take, from its beginning until its files are written. The worker of one
            that takes longer is ended, and it counts as one whose worker died. One worker works in a process of its own
            then. None is no limit.
        part: One of several parts of the job, which runs beside those of the others; a run of the whole job merges what
            they note into the manifest, and writes what is of all items together. None is the whole job.
        progress: Called with how far the run is. None says nothing.
        warn: Called with a line where a worker dies, and with one where fewer workers would be quicker, as soon as it
            is known what an item takes. None says nothing.
        make: What makes the items in place of a worker of ours, so that everything around it can be tested: called in
            each process with the folder of the job file, the output folder and the device. What it returns has
            `submit(item, out)`, a Future of the bytes of the outputs by their paths, and `close()`. Processes import it
            by its module and name. None is the worker.

    Returns:
        What came of it; items that failed are in it, and end nothing.

    Raises:
        FileNotFoundError: If there is no such job file.
        ValueError: For a job file that cannot be read, a folder that another run writes to, a device that is not there,
            or a cluster that does not answer.
        ImportError: For a cluster where Ray is not installed (the extra `cluster`).
        OSError: Where the output folder cannot be written to.
        RuntimeError: Where no worker can start.
    """
    if workers is not None:
        checked_whole(workers, "workers", 1, 100_000)
    checked_whole(retries, "retries", 0, 200)
    if item_timeout is not None:
        checked_positive(item_timeout, "item_timeout")
    report, say = progress or (lambda state: None), warn or (lambda line: None)
    folder, halt = OutputFolder(out, part), None
    with contextlib.ExitStack() as held:
        job = held.enter_context(JobFile(path))
        warn_of_shards(job.records)
        journal = RunJournal(job, folder)
        folder.prepare()
        held.enter_context(folder.driven())
        held.enter_context(folder.nothing_left())
        # in this process, which cannot end itself where an item takes too long
        local = cluster is None and workers in (None, 1) and item_timeout is None
        count = 0 if local or cluster is not None else min(workers or 1, len(span_of(job, folder)), cpu_threads())
        # which load beside the plan
        held.enter_context(early_processes(workers or 1, count, device, make is None))
        folder.merge()
        with contextlib.closing(folder.read_manifest()) as manifest:
            plan = make_plan(job, folder, manifest, lambda *counts: report(RunProgress("check", *counts)))
        shards = open_shards(plan, folder, job) if shard_size(job) else None
        begin = time.monotonic()
        if not len(plan.items) and not shards:
            return _ended(job, folder, plan, None, begin)
        settings = RunnerSettings(
            str(job.folder), job.reader, str(folder.path), journal.run, device, retries=retries, maker=make
        )
        local = local or not len(plan.items)  # here too, where shards are only to be packed
        dispatcher = None
        try:
            with contextlib.ExitStack() as working:  # whatever ends it, nothing works afterwards
                if local:
                    host = ThisProcess(device)
                elif cluster is None:
                    host = LocalHost(workers or 1, device)
                else:
                    host = RayHost(working.enter_context(ray_session(cluster)), workers, device)
                working.enter_context(journal)
                engine = working.enter_context(contextlib.closing(ProcessEngine(host, settings)))
                count = host.share.workers
                aim = MIN_AIM if local else min(AIM, MIN_AIM + count / WORKERS_PER_SECOND)
                chunks = ChunkQueue(plan.items, plan.groups, plan.kinds, aim=aim, whole=shards is not None)
                dispatcher = Dispatcher(chunks, retries=retries, shards=shards)
                journal.failures = dispatcher.failures
                for number in range(max(1, min(count, len(plan.items)))):
                    dispatcher.add_worker(str(number))
                watch = _Watch(plan, dispatcher, count, begin, report, say, pays=count == 1 or cluster is not None)
                driver = Driver(
                    dispatcher, engine, journal, item_timeout=item_timeout, progress=watch.report, warn=watch.warn
                )
                watch.report()
                try:
                    halt = driver.run()
                except BaseException:
                    with contextlib.suppress(Exception):
                        driver.drain(0.0 if local else GRACE)
                    raise
                if halt is None:
                    watch.judge(time.monotonic() - begin, foreseen=False)
        finally:
            full = _merge(folder)
        return _ended(job, folder, plan, dispatcher, begin, halt or full)


class _Watch:
    """Reports how far a run is, and once where fewer workers would be quicker; pays: whether that is not looked at."""

    def __init__(
        self,
        plan: Plan,
        dispatcher: Dispatcher,
        count: int,  # of workers
        begin: float,
        progress: Progress,
        warn: Callable[[str], None],
        pays: bool,
    ):
        self._state = RunProgress("make", plan.total, plan.total, plan.kept)
        self._dispatcher, self._count, self._begin = dispatcher, count, begin
        self._progress, self._warn = progress, warn
        self._quiet, self._numbers = pays, collections.Counter(plan.kinds.tolist())  # items by kind
        self._times: list[float] = []  # seconds of the first two times; at the second a worker is ready

    def report(self) -> None:
        dispatcher, left = self._dispatcher, self._dispatcher.left
        seconds = time.monotonic() - self._begin
        if len(self._times) < 2:
            self._times.append(seconds)
        counts = {"done": dispatcher.done, "failed": len(dispatcher.failures), "workers": dispatcher.workers}
        self._progress(dataclasses.replace(self._state, **counts, seconds=seconds))
        usual = {} if self._quiet else dispatcher.chunks.usual_seconds()
        if left and usual.keys() >= self._numbers.keys():
            mean = sum(self._numbers[kind] * each for kind, each in usual.items()) / self._numbers.total()
            self.judge(seconds + left * mean / self._count, foreseen=True)

    def warn(self, line: str) -> None:
        self._quiet = True
        self._warn(line)

    def judge(self, end: float, foreseen: bool) -> None:
        """Say it where it is so; end: seconds of the run."""
        if not self._quiet and len(self._times) > 1:
            start, items = self._times[1], self._numbers.total()
            line = unpaid(self._count, items, start, end - start, foreseen=foreseen)
            if line is not None:
                self.warn(line)


def _merge(folder: OutputFolder) -> str | None:
    """Merge the notes of a run; a line where there is no room for that: they stay, and the next run merges them."""
    try:
        folder.merge()
    except OSError as error:
        if not leaves_no_room(error):
            raise
        return error_line(error, named=True)
    return None


TICK = 1.0  # seconds after which the driver looks for stragglers even where nothing happened
ANSWER = 60.0  # seconds within which a worker that is asked must answer: one that does not is taken for hung
MIN_LOOK = 0.5  # seconds between two looks at a worker at least
GRACE = 5.0  # seconds that workers get to end the items that they have begun, when a run is interrupted


@dataclasses.dataclass
class _Sent:
    """A chunk that a worker has."""

    order: Chunk
    look: float  # when it is to be looked at
    asked: float | None = None  # since when the worker owes an answer about it


class Driver:
    """Makes all that a dispatcher has; item_timeout: seconds after which the worker of an item is ended, None is never.
    progress: called after each answer; warn: takes a line about a worker that died."""

    def __init__(
        self,
        dispatcher: Dispatcher,
        engine: ProcessEngine,
        journal: RunJournal,
        *,
        item_timeout: float | None = None,
        progress: Callable[[], None] = lambda: None,
        warn: Callable[[str], None] = lambda line: None,
    ):
        self._dispatcher, self._engine, self._journal = dispatcher, engine, journal
        self._limit, self._progress, self._warn = item_timeout, progress, warn
        self._idle: dict[str, None] = {}
        self._starts: collections.Counter[str] = collections.Counter()  # how often each was started
        self._sent: dict[str, dict[int, _Sent]] = {}  # chunks of each worker, by number, the oldest first
        self.halt: str | None = None  # why it ended before its end, one line

    def run(self) -> str | None:
        """Start the workers, and make all; returns why it ended before its end, one line; None where all is settled."""
        for name in self._dispatcher.names:
            self._start(name)
        while not self._dispatcher.finished:
            for answer in self._engine.wait(TICK):
                self._take(answer)
                self._progress()
            self._look()
            self._submit_chunks()
        return self.halt

    def drain(self, seconds: float) -> None:
        """Let workers end, within seconds, what they have begun, and begin no more."""
        self.stop()
        end = self._engine.now() + seconds
        while any(self._sent.values()) and self._engine.now() < end:
            for answer in self._engine.wait(0.1):
                self._take(answer)

    def stop(self) -> None:
        """Let all workers begin no more items."""
        self._dispatcher.stop()
        for name in self._sent:
            self._engine.submit(name, "stop")

    def _start(self, name: str) -> None:
        self._starts[name] += 1
        self._engine.start(name, self._starts[name])
        self._sent[name] = {}

    def _take(self, answer: Answer) -> None:
        name, number = answer.worker, answer.number
        if answer.error is not None:
            self._died(name, answer.error)
        elif answer.method == "facts" or (answer.method == "begun" and self._dispatcher.begun(name, number)):
            self._idle[name] = None
        elif answer.method == "recall":
            self._dispatcher.returned(name, number, answer.found)
        elif answer.method == "oldest" and self._limit is not None and (sent := self._sent[name].get(number)):
            item, seconds = answer.found or (None, 0.0)
            sent.asked, sent.look = None, self._engine.now() + max(self._limit - seconds, MIN_LOOK)
            if seconds > self._limit:
                self._died(name, f"its worker was ended: the item took longer than {self._limit:g} s", item)
        elif answer.method == "run":
            self._reported(name, number, answer.found)

    def _reported(self, name: str, number: int, report: ChunkReport) -> None:
        """A worker is done with a chunk. One that can make no more is ended; its other chunks are as its notes say."""
        del self._sent[name][number]
        if report.broken is not None:
            for order in self._end(name):
                rest, _ = self._journal.noted(name, self._starts[name], order)
                if not order.items:  # a shard, which may not be packed
                    rest.pack_error = report.broken
                self._dispatcher.reported(name, rest, order.number)
        self._dispatcher.reported(name, report, number)
        if report.halt is not None and self.halt is None:
            self.halt = report.halt
            self.stop()
        if report.broken is not None:
            self._replace(name, report.broken)
        elif self._dispatcher.takes(name):
            self._idle[name] = None

    def _died(self, name: str, reason: str, late: int | None = None) -> None:
        """A worker answers no more, or is not to; late: the item that took too long, which is to blame then."""
        report, begun = ChunkReport(), []
        for order in self._end(name):
            noted, begun_of_chunk = self._journal.noted(name, self._starts[name], order)
            for part in ("done", "seconds", "failed", "errors"):
                getattr(report, part).extend(getattr(noted, part))
            begun += begun_of_chunk
        if late is not None:  # none is to blame where it was settled at the last moment
            begun = [item for item in begun if item != late] + [late] if late in begun else []
        for item, error in self._dispatcher.died(name, report, begun, reason):
            self._journal.lost(item, error, self._dispatcher.retries + 1)
        self._replace(name, reason)

    def _end(self, name: str) -> list[Chunk]:
        """Make sure that a worker is gone which may merely not answer; returns what it had, the oldest first."""
        self._idle.pop(name, None)
        self._engine.cancel(name)
        return [sent.order for sent in self._sent.pop(name).values()]

    def _replace(self, name: str, reason: str) -> None:
        """Start another process in the place of one that died, unless that dies again and again."""
        self._warn(f"worker {name}: {reason}: it is started again")
        if not self._dispatcher.given_up(name):
            if not self._dispatcher.stopped and not self._dispatcher.finished:
                self._start(name)
            return
        self._warn(f"worker {name} is given up: it died before it made anything, again and again")
        if not self._dispatcher.workers and not self._dispatcher.finished:
            raise StateError(f"no worker is left: {reason}")

    def _look(self) -> None:
        """Ask workers whose items may be late, each once; those that do not answer are ended."""
        if self._limit is None:
            return
        now = self._engine.now()
        for name, chunks in list(self._sent.items()):
            for number, sent in chunks.items():
                if sent.asked is None and sent.look <= now:
                    sent.asked = now
                    self._engine.submit(name, "oldest", number)
            if any(sent.asked is not None and sent.asked < now - ANSWER for sent in chunks.values()):
                self._died(name, f"its worker was ended: it did not answer for {ANSWER:g} s")

    def _submit_chunks(self) -> None:
        """Give work to workers that have none; where there is none, ask those that are late for some of theirs."""
        dispatcher = self._dispatcher
        for name in list(self._idle):
            if dispatcher.stopped or not dispatcher.open:
                break
            chunk = dispatcher.next_chunk(name, self._engine.now())
            if chunk is None:
                continue
            del self._idle[name]
            order = self._journal.order(chunk)
            self._engine.submit(name, "run", order)
            if self._engine.overlapping:
                self._engine.submit(name, "begun", chunk.number)
            # none of its items can be late before
            self._sent[name][chunk.number] = _Sent(order, self._engine.now() + (self._limit or 0.0))
        for name, number, share in dispatcher.recalls(len(self._idle), self._engine.now()):
            self._engine.submit(name, "recall", number, share)


def _ended(
    job: JobFile, folder: OutputFolder, plan: Plan, dispatcher: Dispatcher | None, begin: float, halt: str | None = None
) -> RunReport:
    """What came of a run; what belongs to all of its items together is written."""
    if job.records.get("kind") == FOLDER and halt is None and folder.part is None:
        with contextlib.closing(folder.read_manifest()) as manifest:
            finish_folder(folder.path, job, manifest)
    seconds = time.monotonic() - begin
    if dispatcher is None:  # all was there
        return RunReport(plan.total, plan.kept, 0, {}, 0, halt, seconds)
    failed = {job.item(index).id: line for index, line in sorted(dispatcher.failures.items())}
    failed |= {shard_path(folder.path, shard).name: line for shard, line in dispatcher.unpacked}
    return RunReport(plan.total, plan.kept, dispatcher.done, failed, dispatcher.left, halt, seconds)
