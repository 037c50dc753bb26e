"""`warpcage.run_jobs`: make what a job file names, on several workers, and report how it went or would go."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import os
import pathlib
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cage.pose_file import is_preset
from ..core.checks import checked_positive, checked_whole
from ..core.devices import resolve_device
from ..core.files import NpyFile, PathLike, require_file
from ..core.memory import LRUCache
from ..core.names import counted, error_line
from ..core.threads import cpu_threads, limit_threads
from ..errors import InputError
from .chunk_runner import Chunk, ChunkReport, Maker, RunnerSettings, leaves_no_room, make_runner, run_name
from .engines import GRACE, Driver, Engine, LocalEngine, ProcessEngine
from .items import FOLDER, Item
from .job_file import Fingerprints, JobFile, references_of
from .manifest import DONE, ERROR, FAILED, Manifest, OutputFolder, Part, merge_notes, newest_seconds, notes_of_chunk
from .processes import LocalHost, RayHost, ray_session
from .scheduler import AIM, KIND_NUMBERS, Dispatcher, Plan, make_plan, open_shards
from .webdataset import finish_folder, shard_path, shard_size, span_of
from .words import split_reference

if TYPE_CHECKING:
    from .worker import Worker


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


LEAST_AIM = 2.0  # seconds of a chunk where there are few workers, so that progress is seen
WORKERS_PER_SECOND = 100  # for which a chunk takes a second more

#: Items between two calls of `progress` while they are checked.
CHECKED_AT_ONCE = 100

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
        warn: Called with a line where a worker dies, and at the end where one worker would have been quicker than
            several. None says nothing.
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
        ImportError: For a cluster where Ray is not installed (`pip install 'warpcage[cluster]'`).
        OSError: Where the output folder cannot be written to.
        RuntimeError: Where no worker can start.
    """
    options = Options(workers, cluster, device, retries, part, item_timeout)
    tell, say = progress or (lambda state: None), warn or (lambda line: None)
    folder, halt = OutputFolder(out, options.part), None
    with contextlib.ExitStack() as held:
        job = held.enter_context(JobFile(path))
        journal = RunJournal(job, folder)
        folder.prepare()
        held.enter_context(folder.driven())
        held.enter_context(folder.nothing_left())
        folder.merge()
        plan = planned(job, folder, tell)
        shards = open_shards(plan, folder, job) if shard_size(job) else None
        begin = time.monotonic()
        if not len(plan.items) and not shards:
            return _ended(job, folder, plan, None, begin)
        settings = RunnerSettings(
            str(job.folder), job.reader, str(folder.path), journal.run, device, retries=retries, maker=make
        )
        if not len(plan.items):  # there is nothing but shards to be packed
            options = Options()
        dispatcher = None
        try:
            with journal, _engine(options, settings) as (engine, count):
                chunks = plan.chunks(aim=_aim(options, count), whole=shards is not None)
                dispatcher = journal.dispatcher = Dispatcher(chunks, retries=retries, shards=shards)
                for number in range(max(1, min(count, len(plan.items)))):
                    dispatcher.add_worker(str(number))
                halt = _drive(plan, dispatcher, engine, journal, options, count, begin, tell, say)
        finally:
            full = _merge(folder)
        return _ended(job, folder, plan, dispatcher, begin, halt or full)


def _drive(
    plan: Plan,
    dispatcher: Dispatcher,
    engine: Engine,
    journal: RunJournal,
    options: Options,
    count: int,
    begin: float,
    progress: Progress,
    warn: Callable[[str], None],
) -> str | None:
    """Make what a plan has, by `count` workers at most; returns why it ended before its end, one line."""
    state = RunProgress("make", plan.total, plan.total, plan.kept)
    told: list[float] = []  # seconds of each time; the second is that a worker is ready
    warned: list[str] = []

    def tell() -> None:
        told.append(time.monotonic() - begin)
        counts = {"done": dispatcher.done, "failed": len(dispatcher.failures), "workers": dispatcher.workers}
        progress(dataclasses.replace(state, **counts, seconds=told[-1]))

    def note(line: str) -> None:
        warned.append(line)
        warn(line)

    tell()
    driver = Driver(dispatcher, engine, journal, item_timeout=options.item_timeout, progress=tell, warn=note)
    try:
        halt = driver.run()
    except BaseException:
        with contextlib.suppress(Exception):
            driver.drain(0.0 if options.local else GRACE)
        raise
    if count > 1 and options.cluster is None and halt is None and len(told) > 1 and not warned:
        line = unpaid(count, dispatcher.done, told[1], time.monotonic() - begin - told[1])
        if line is not None:
            warn(line)
    return halt


def _merge(folder: OutputFolder) -> str | None:
    """Merge the notes of a run; a line where there is no room for that: they stay, and the next run merges them."""
    try:
        folder.merge()
    except OSError as error:
        if not leaves_no_room(error):
            raise
        return error_line(error, named=True)
    return None


@dataclasses.dataclass(frozen=True)
class Options:
    """How a run works; see `run_jobs`."""

    workers: int | None = 1
    cluster: str | None = None
    device: str | None = None
    retries: int = 2
    part: Part | None = None
    item_timeout: float | None = None

    def __post_init__(self) -> None:
        if self.workers is not None:
            checked_whole(self.workers, "workers", 1, 100_000)
        checked_whole(self.retries, "retries", 0, 200)
        if self.item_timeout is not None:
            checked_positive(self.item_timeout, "item_timeout")

    @property
    def local(self) -> bool:
        """Whether the work is done in this process, which cannot end itself where an item takes too long."""
        return self.cluster is None and self.workers in (None, 1) and self.item_timeout is None


class RunJournal:
    """What workers are sent for chunks, and what they note of them."""

    dispatcher: Dispatcher  # knows which items failed

    def __init__(self, job: JobFile, folder: OutputFolder):
        self._job, self._folder, self.run, self._before = job, folder, run_name(), os.stat(job.path)
        self._shard_size, self._notes = shard_size(job), None

    def __enter__(self) -> RunJournal:
        return self

    def __exit__(self, *_: object) -> None:
        if self._notes is not None:
            self._notes.close()

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
        read = self._job.reader.item
        indices = {read(*line).id: index for line, index in zip(chunk.lines, chunk.items, strict=True)}
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
        """Note an item that failed with its workers."""
        self._notes = self._notes or self._folder.new_notes(f"{self.run}-driver")
        found = self._job.item(item)
        record = {"id": found.id, "state": FAILED, "kind": found.kind, "attempts": attempts, "error": error}
        self._notes.append(record)

    def _packed(self, shard: int) -> list[dict[str, str]]:
        """The outputs of all items of a shard that are there: what was to be made of it is settled."""
        begin = shard * self._shard_size
        indices = range(begin, min(begin + self._shard_size, len(self._job)))
        there = (self._job.item(index) for index in indices if index not in self.dispatcher.failures)
        return [{path: part for part, path in item.outputs.items()} for item in there]


def unpaid(workers: int, items: int, start: float, work: float) -> str | None:
    """A line where one worker would have been quicker than several, which took seconds to start, and then to work."""
    if workers * work >= start + work:  # at the left the most that one takes: it has the cores of all
        return None
    return (
        f"{workers} workers took {start:.1f} s to start and {work:.1f} s for {counted(items, 'item')}: fewer workers "
        "would have been quicker, they pay for longer work"
    )


def _ended(
    job: JobFile, folder: OutputFolder, plan: Plan, dispatcher: Dispatcher | None, begin: float, halt: str | None = None
) -> RunReport:
    """What came of a run; what belongs to all of its items together is written."""
    if job.records.get("kind") == FOLDER and halt is None and folder.part is None:
        with contextlib.closing(folder.read_manifest()) as manifest:
            finish_folder(folder.path, job, manifest)
    seconds = time.monotonic() - begin
    if dispatcher is None:
        return RunReport(plan.total, plan.kept, 0, {}, 0, halt, seconds)
    failed = {job.item(index).id: line for index, line in sorted(dispatcher.failures.items())}
    failed |= {shard_path(folder.path, shard).name: line for shard, line in dispatcher.unpacked}
    return RunReport(plan.total, plan.kept, dispatcher.done, failed, dispatcher.left, halt, seconds)


def planned(job: JobFile, folder: OutputFolder, progress: Progress = lambda state: None) -> Plan:
    """What is to be made; folder: its notes are merged already; progress: as for `run_jobs`."""
    total = len(span_of(job, folder))

    def tell(count: int) -> None:
        if not count % CHECKED_AT_ONCE or count == total:
            progress(RunProgress("check", total, count))

    manifest = folder.read_manifest()
    try:
        return make_plan(job, folder, manifest, Fingerprints(job.folder, folder.path).of, tell)
    finally:
        manifest.close()


def _aim(options: Options, count: int) -> float:
    return LEAST_AIM if options.local else min(AIM, LEAST_AIM + count / WORKERS_PER_SECOND)


@contextlib.contextmanager
def _engine(options: Options, settings: RunnerSettings) -> Iterator[tuple[Engine, int]]:
    """Where the work is done, and by how many. Whatever ends it, nothing works afterwards."""
    with contextlib.ExitStack() as held:
        if options.local:
            yield held.enter_context(contextlib.closing(LocalEngine(make_runner(settings)))), 1
            return
        if options.cluster is None:
            host = LocalHost(options.workers or 1, options.device)
        else:
            host = RayHost(held.enter_context(ray_session(options.cluster)), options.workers, options.device)
        yield held.enter_context(contextlib.closing(ProcessEngine(host, settings))), host.share.workers


#: Files that are remembered: each is looked at once, however many items name it.
MOST_FILES = 100_000


class Missing:
    """Looks for files and rows that items name; base: folder that their paths are relative to."""

    def __init__(self, base: PathLike):
        self.base = base
        self._files: LRUCache[NpyFile | str | None] = LRUCache(MOST_FILES)

    def of(self, item: Item) -> str | None:
        """One line on the first that an item names and is not there; None where all is there."""
        found = (self._wrong(reference) for reference in references_of(item))  # whether it can be used shows later
        return next((line for line in found if line), None)

    def _wrong(self, reference: str) -> str | None:
        name, place = split_reference(reference)
        file = self._files.get(name, lambda: self._looked_at(name))
        if isinstance(file, str) or file is None or not place:
            return file if isinstance(file, str) else None
        rows = file.shape[0] if file.shape else 0
        if place.isdigit() and int(place) >= rows:
            return f"{file.path} has rows 0 to {rows - 1}, got {place}" if rows else f"{file.path} has no rows"
        return None

    def _looked_at(self, name: str) -> NpyFile | str | None:
        """The array in a .npy file, None for another that is there, or a line on what is wrong."""
        path = os.path.join(self.base, name)
        try:
            if os.path.isdir(path) or is_preset(name, self.base):
                return None
            return NpyFile(path) if name.lower().endswith(".npy") else require_file(path, "file") and None
        except (OSError, ValueError) as error:
            return str(error)


#: Items that name what is not there, of which a forecast keeps a line.
MOST_MISSING = 10


@dataclasses.dataclass(frozen=True)
class Measured:
    """What an item of a kind takes."""

    seconds: float  # an item, where all that it needs is loaded, and its pose there where others share it
    load_seconds: float  # what the first of a group takes more
    source: str  # the id of the item that was made for it, or "earlier runs"
    pose_seconds: float = 0.0  # what the first of a pose takes more, where others share it


@dataclasses.dataclass(frozen=True)
class Forecast:
    """What a run would do."""

    plan: Plan
    counts: dict[str, int]  # items to be made, by their kind
    measured: dict[str, Measured]  # by kind
    errors: dict[str, str]  # why an item of a kind could not be made, by its id
    missing: dict[str, str]  # what items name and is not there, by id, of MOST_MISSING of them; the count is of all
    missing_count: int
    workers: int
    seconds: float  # how long it would take, without what could not be measured


def foresee(path: PathLike, out: PathLike, *, workers: int = 1, device: str | None = None) -> Forecast:
    """Look at a job and at what is there of it, and make up to three items of each kind that earlier runs do not know.
    workers: by how many it would be made, on the CPU they share the cores. Nothing is written to `out`."""
    from .worker import Worker  # here, as a driver of processes needs nothing of it

    with JobFile(path) as job, tempfile.TemporaryDirectory() as temporary:
        plan, known = _planned(job, OutputFolder(out), pathlib.Path(temporary))
        numbers = collections.Counter(plan.kinds.tolist())
        counts = {kind: numbers[number] for kind, number in KIND_NUMBERS.items() if numbers[number]}
        measured = {kind: Measured(known[kind], 0.0, "earlier runs") for kind in counts if kind in known}
        errors: dict[str, str] = {}
        missing, missing_count = _missing(job, plan)
        found = resolve_device(device)
        threads = max(1, cpu_threads() // workers) if found.is_cpu else cpu_threads()
        with limit_threads(threads), Worker(job.folder, temporary, found) as worker:
            for kind in counts:
                if kind not in measured:
                    _measure(job, plan, kind, worker, measured, errors)
    work = sum(counts[kind] * each.seconds + _poses(plan, kind) * each.pose_seconds for kind, each in measured.items())
    loads = max((each.load_seconds for each in measured.values()), default=0.0) * max(plan.group_count, 1)
    workers = max(1, min(workers, len(plan.items)))
    seconds = (work + loads) / workers
    return Forecast(plan, counts, measured, errors, missing, missing_count, workers, seconds)


def _missing(job: JobFile, plan: Plan) -> tuple[dict[str, str], int]:
    """What items to be made name and is not there, of some of them, and how many they are."""
    missing, lines, count = Missing(job.folder), {}, 0
    for index in plan.items:
        item = job.item(int(index))
        line = missing.of(item)
        if line is not None:
            count += 1
            if count <= MOST_MISSING:
                lines[item.id] = line
    return lines, count


def _planned(job: JobFile, folder: OutputFolder, temporary: pathlib.Path) -> tuple[Plan, dict[str, float]]:
    """The plan, and what items took in earlier runs; the notes of one that was killed count."""
    merged = temporary / "manifest.jsonl"
    merge_notes(folder.manifest, folder.notes.glob("*.jsonl"), into=merged)
    with contextlib.closing(Manifest(merged)) as manifest:
        return make_plan(job, folder, manifest, Fingerprints(job.folder, folder.path).of), newest_seconds(manifest)


def _measure(
    job: JobFile, plan: Plan, kind: str, worker: Worker, measured: dict[str, Measured], errors: dict[str, str]
) -> None:
    """Make the first item of a kind, the next of its group, for which all is loaded, and where both show one pose the
    first of another one."""
    places = np.flatnonzero(plan.kinds == KIND_NUMBERS[kind])
    first = job.item(int(plan.items[places[0]]))
    made = [first]
    if kind == "frame" and len(places) > 1:
        other = places[plan.poses[places] != plan.poses[places[0]]][:1]
        followers = [job.item(int(plan.items[place])) for place in [places[1], *other]]
        made += [each for each in followers if each.group == first.group]
        if len(made) > 1 and made[1].pose != first.pose:
            del made[2:]
    seconds = []
    for item in made:
        begin = time.perf_counter()
        try:
            worker.run(item)
        except Exception as error:  # whatever it is, a run would list it
            errors[item.id] = " ".join(str(error).split()) or type(error).__name__
            break
        seconds.append(time.perf_counter() - begin)
    if seconds:
        usual = seconds[min(1, len(seconds) - 1)]
        posing = max(0.0, seconds[2] - usual) if len(seconds) > 2 else 0.0
        measured[kind] = Measured(usual, seconds[0] - usual - posing, first.id, posing)


def _poses(plan: Plan, kind: str) -> int:
    """How often a worker moves a cage for the items of a kind."""
    return len(np.unique(plan.poses[plan.kinds == KIND_NUMBERS[kind]]))
