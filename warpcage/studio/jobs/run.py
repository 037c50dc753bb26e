"""`warpcage.run_jobs`: make what a job file names, on several workers, and report how it went."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
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
        chunks = ChunkQueue(plan.items, plan.groups, plan.kinds, whole=shards is not None)
        dispatcher, begin = Dispatcher(chunks, retries=retries, shards=shards), time.monotonic()
        if not dispatcher.open:
            return _ended(job, folder, plan, dispatcher, begin, None)
        journal.failures = dispatcher.failures
        settings = RunnerSettings(
            str(job.folder), job.reader, str(folder.path), journal.run, device, retries=retries, maker=make
        )
        local = local or not len(plan.items)  # here too, where shards are only to be packed
        try:
            with contextlib.ExitStack() as working:  # whatever ends it, nothing works afterwards
                if local:
                    host = ThisProcess(device)
                elif cluster is None:
                    host = LocalHost(workers or 1, device)
                else:
                    host = RayHost(working.enter_context(ray_session(cluster)), workers, device)
                engine = working.enter_context(contextlib.closing(ProcessEngine(host, settings)))
                count = host.share.workers
                chunks.aim = MIN_AIM if local else min(AIM, MIN_AIM + count / WORKERS_PER_SECOND)
                for number in range(max(1, min(count, len(plan.items)))):
                    dispatcher.add_worker(str(number))
                watch = _Watch(plan, dispatcher, count, begin, report, say, count == 1 or cluster is not None)
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
            try:
                folder.merge()
            except OSError as error:  # without room the notes stay, and the next run merges them
                if not leaves_no_room(error):
                    raise
                halt = halt or error_line(error, named=True)
        return _ended(job, folder, plan, dispatcher, begin, halt)


@dataclasses.dataclass
class _Watch:
    """Reports how far a run is, and once where fewer workers would be quicker."""

    plan: Plan
    dispatcher: Dispatcher
    count: int  # of workers
    begin: float
    progress: Progress
    say: Callable[[str], None]
    quiet: bool  # whether that is not looked at any more
    times: list[float] = dataclasses.field(default_factory=list)  # seconds, two: at the second a worker is ready

    @functools.cached_property
    def numbers(self) -> collections.Counter[int]:
        """Items by kind."""
        return collections.Counter(self.plan.kinds.tolist())

    def report(self) -> None:
        plan, dispatcher, seconds = self.plan, self.dispatcher, time.monotonic() - self.begin
        if len(self.times) < 2:
            self.times.append(seconds)
        counts = dispatcher.done, len(dispatcher.failures), dispatcher.workers
        self.progress(RunProgress("make", plan.total, plan.total, plan.kept, *counts, seconds))
        usual = {} if self.quiet else dispatcher.chunks.usual_seconds()
        if dispatcher.left and usual.keys() >= self.numbers.keys():
            mean = sum(self.numbers[kind] * each for kind, each in usual.items()) / self.numbers.total()
            self.judge(seconds + dispatcher.left * mean / self.count, foreseen=True)

    def warn(self, line: str) -> None:
        self.quiet = True
        self.say(line)

    def judge(self, end: float, foreseen: bool) -> None:
        """Warn where it is so; end: seconds of the run."""
        if not self.quiet and len(self.times) > 1:
            start = self.times[1]
            if line := unpaid(self.count, len(self.plan.items), start, end - start, foreseen=foreseen):
                self.warn(line)


TICK = 1.0  # seconds after which the driver looks for stragglers even where nothing happened
ANSWER = 60.0  # seconds within which a worker that is asked must answer: one that does not is taken for hung
MIN_LOOK = 0.5  # seconds between two looks at a worker at least
GRACE = 5.0  # seconds that workers get to end the items that they have begun, when a run is interrupted


@dataclasses.dataclass(eq=False)
class Driver:
    """Makes all that a dispatcher has; item_timeout: seconds after which the worker of an item is ended, None is never.
    progress: called after each answer; warn: takes a line about a worker that died."""

    dispatcher: Dispatcher
    engine: ProcessEngine
    journal: RunJournal
    _: dataclasses.KW_ONLY
    item_timeout: float | None = None
    progress: Callable[[], None] = lambda: None
    warn: Callable[[str], None] = lambda line: None
    halt: str | None = None  # why it ended before its end, one line

    def __post_init__(self) -> None:
        self._idle: dict[str, None] = {}
        self._starts: collections.Counter[str] = collections.Counter()  # how often each was started
        self._sent: dict[str, dict[int, Chunk]] = {}  # what each worker has, by number, the oldest first
        self._looks: dict[str, float] = {}  # when each is to be asked whether an item is late
        self._asked: dict[str, float] = {}  # since when each owes an answer to that

    def run(self) -> str | None:
        """Start the workers, and make all; returns why it ended before its end, one line; None where all is settled."""
        for name in self.dispatcher.names:
            self._start(name)
        while not self.dispatcher.finished:
            for answer in self.engine.wait(TICK):
                self._take(answer)
                self.progress()
            self._look()
            self._submit_chunks()
        return self.halt

    def drain(self, seconds: float) -> None:
        """Let workers end, within seconds, what they have begun, and begin no more."""
        self.stop()
        end = self.engine.now() + seconds
        while any(self._sent.values()) and self.engine.now() < end:
            for answer in self.engine.wait(0.1):
                self._take(answer)

    def stop(self) -> None:
        """Let all workers begin no more items."""
        self.dispatcher.stop()
        for name in self._sent:
            self.engine.submit(name, "stop")

    def _start(self, name: str) -> None:
        self._starts[name] += 1
        self.engine.start(name, self._starts[name])
        self._sent[name] = {}

    def _take(self, answer: Answer) -> None:
        name, number = answer.worker, answer.number
        if answer.error is not None:
            self._died(name, answer.error)
        elif answer.method == "facts":
            self._idle[name] = None
        elif answer.method == "begin":
            self.engine.submit(name, "settle", number)
            if self.dispatcher.begun(name, number):
                self._idle[name] = None
        elif answer.method == "recall":
            self.dispatcher.returned(name, number, answer.found)
        elif answer.method == "oldest" and self.item_timeout is not None:
            item, seconds = answer.found or (None, 0.0)
            self._asked.pop(name, None)
            self._looks[name] = self.engine.now() + max(self.item_timeout - seconds, MIN_LOOK)
            if seconds > self.item_timeout:
                self._died(name, f"its worker was ended: the item took longer than {self.item_timeout:g} s", item)
        elif answer.method in ("run", "settle"):
            self._reported(name, number, answer.found)

    def _reported(self, name: str, number: int, report: ChunkReport) -> None:
        """A worker is done with a chunk. One that can make no more is ended; its other chunks are as its notes say."""
        del self._sent[name][number]
        if report.broken is not None:
            for order in self._end(name):
                rest, _ = self.journal.noted(name, self._starts[name], order)
                if not order.items:  # a shard, which may not be packed
                    rest.pack_error = report.broken
                self.dispatcher.reported(name, rest, order.number)
        self.dispatcher.reported(name, report, number)
        if report.halt is not None and self.halt is None:
            self.halt = report.halt
            self.stop()
        if report.broken is not None:
            self._replace(name, report.broken)
        elif self.dispatcher.takes(name):
            self._idle[name] = None

    def _died(self, name: str, reason: str, late: int | None = None) -> None:
        """A worker answers no more, or is not to; late: the item that took too long, which is to blame then."""
        report, begun = ChunkReport(), []
        for order in self._end(name):
            noted, begun_of_chunk = self.journal.noted(name, self._starts[name], order)
            for part in ("done", "seconds", "failed", "errors"):
                getattr(report, part).extend(getattr(noted, part))
            begun += begun_of_chunk
        if late is not None:  # none is to blame where it was settled at the last moment
            begun = [item for item in begun if item != late] + [late] if late in begun else []
        for item, error in self.dispatcher.died(name, report, begun, reason):
            self.journal.lost(item, error, self.dispatcher.retries + 1)
        self._replace(name, reason)

    def _end(self, name: str) -> list[Chunk]:
        """Make sure that a worker is gone which may merely not answer; returns what it had, the oldest first."""
        self._idle.pop(name, None)
        self._asked.pop(name, None)
        self.engine.cancel(name)
        return list(self._sent.pop(name).values())

    def _replace(self, name: str, reason: str) -> None:
        """Start another process in the place of one that died, unless that dies again and again."""
        self.warn(f"worker {name}: {reason}: it is started again")
        if not self.dispatcher.given_up(name):
            if not self.dispatcher.stopped and not self.dispatcher.finished:
                self._start(name)
            return
        self.warn(f"worker {name} is given up: it died before it made anything, again and again")
        if not self.dispatcher.workers and not self.dispatcher.finished:
            raise StateError(f"no worker is left: {reason}")

    def _look(self) -> None:
        """Ask workers whose items may be late; those that do not answer are ended."""
        now = self.engine.now()
        for name in [] if self.item_timeout is None else [name for name, sent in self._sent.items() if sent]:
            if name not in self._asked and self._looks[name] <= now:
                self._asked[name] = now
                self.engine.submit(name, "oldest")
            elif self._asked.get(name, now) < now - ANSWER:
                self._died(name, f"its worker was ended: it did not answer for {ANSWER:g} s")

    def _submit_chunks(self) -> None:
        """Give work to workers that have none; where there is none, ask those that are late for some of theirs."""
        dispatcher = self.dispatcher
        for name in list(self._idle):
            if dispatcher.stopped or not dispatcher.open:
                break
            chunk = dispatcher.next_chunk(name, self.engine.now())
            if chunk is None:
                continue
            del self._idle[name]
            order = self.journal.order(chunk)
            self.engine.submit(name, "begin" if self.engine.overlapping else "run", order)
            if not self._sent[name]:  # none of its items can be late before
                self._looks[name] = self.engine.now() + (self.item_timeout or 0.0)
            self._sent[name][chunk.number] = order
        for name, number, share in dispatcher.recalls(len(self._idle), self.engine.now()):
            self.engine.submit(name, "recall", number, share)


def _ended(
    job: JobFile, folder: OutputFolder, plan: Plan, dispatcher: Dispatcher, begin: float, halt: str | None
) -> RunReport:
    """What came of a run; what belongs to all of its items together is written."""
    if job.records.get("kind") == FOLDER and halt is None and folder.part is None:
        with contextlib.closing(folder.read_manifest()) as manifest:
            finish_folder(folder.path, job, manifest)
    seconds = time.monotonic() - begin
    failed = {job.item(index).id: line for index, line in sorted(dispatcher.failures.items())}
    failed |= {shard_path(folder.path, shard).name: line for shard, line in dispatcher.unpacked}
    return RunReport(plan.total, plan.kept, dispatcher.done, failed, dispatcher.left, halt, seconds)
