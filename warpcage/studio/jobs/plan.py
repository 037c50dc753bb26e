"""What a run has to make and keeps, and how long that would take."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import pathlib
import tempfile
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ...core.devices import resolve_device
from ...core.files import PathLike
from ...core.names import counted
from ...core.threads import cpu_threads, limit_threads
from .engines.chunk_runner import RunnerSettings, run_name
from .engines.processes import LocalHost, ProcessEngine
from .items import Item
from .job_file import Fingerprints, JobFile, Missing, UniqueNames
from .manifest import DONE, FAILED, Manifest, OutputFolder, id_key, merge_notes, newest_seconds
from .webdataset import shard_holds, shard_size, span_of, staged_shards

if TYPE_CHECKING:
    from .worker import Worker

KIND_NUMBERS = {kind: number for number, kind in enumerate(Item.kinds)}  # for `ChunkQueue`


@dataclasses.dataclass
class Plan:
    """What is made, and what is kept."""

    total: int
    items: np.ndarray  # (n,) numbers of those to be made, in the order in which workers should take them
    groups: np.ndarray  # (n,) which of them share what a worker loads; of a job with shards, the shard of each
    kinds: np.ndarray  # (n,) as KIND_NUMBERS has them
    poses: np.ndarray  # (n,) those that follow each other with one number show one pose of one group
    kept: int
    changed: int  # of the items to be made, those whose inputs changed or whose files are not as they were
    failed_before: int  # of the items to be made, those that failed in an earlier run
    group_count: int  # of those to be made: fields with the cages at rest on them, scenes


#: Items between two calls of `progress` while they are checked.
CHECKED_AT_ONCE = 100


def make_plan(
    job: JobFile, folder: OutputFolder, manifest: Manifest, progress: Callable[[int, int], None] = lambda *counts: None
) -> Plan:
    """Look at all items of a job, or of the part that the folder is for.
    progress: called now and then with the number of all items, and of those that were looked at."""
    fingerprint = Fingerprints(job.folder, folder.path).of
    count, span = len(job), span_of(job, folder)
    shard = shard_size(job)
    groups, poses = (np.zeros(count, np.int64) for _ in range(2))
    kinds, wanted = np.zeros(count, np.int8), np.zeros(count, bool)
    wanted[span.start : span.stop] = True
    names: dict[str, int] = {}
    unique = UniqueNames()
    changed = failed_before = 0
    for checked, index in enumerate(span, 1):
        item = job.item(index)
        kinds[index] = KIND_NUMBERS[item.kind]
        groups[index] = names.setdefault(item.group, len(names))
        poses[index] = id_key(item.pose)
        unique.note(index, item)
        record = manifest.find(item.id) if len(manifest) else None
        if record is not None and record["state"] == DONE:
            outputs = record.get("outputs")
            there = shard_holds(folder.path, index // shard, outputs) if shard else folder.holds(outputs)
            if there:
                with contextlib.suppress(OSError, ValueError):  # the worker will report what is wrong with it
                    wanted[index] = record.get("inputs") != fingerprint(item)
            changed += int(wanted[index])
        failed_before += record is not None and record["state"] == FAILED
        if not checked % CHECKED_AT_ONCE or checked == len(span):
            progress(len(span), checked)
    unique.require(job)
    makes = np.flatnonzero(wanted)
    major = makes // shard if shard else groups[makes]
    # poses in the order in which they come first
    _, first, which = np.unique(poses[makes], return_index=True, return_inverse=True)
    minor = first[which] if len(makes) else which
    order = np.lexsort((makes, minor, groups[makes], major))
    rows = np.stack([major, groups[makes], minor])[:, order]
    runs = np.cumsum(np.diff(rows, prepend=rows[:, :1]).any(axis=0))
    kept, group_count = len(span) - len(makes), len(np.unique(groups[makes]))
    return Plan(len(span), makes[order], rows[0], kinds[makes][order], runs, kept, changed, failed_before, group_count)


def open_shards(plan: Plan, folder: OutputFolder, job: JobFile) -> dict[int, int]:
    """Items to be made of each shard of a job with shards; 0 where its loose files are only to be packed."""
    shards, counts = np.unique(plan.groups, return_counts=True)
    span, size = span_of(job, folder), shard_size(job)
    staged = (shard for shard in staged_shards(folder.path) if folder.part is None or shard * size in span)
    return dict.fromkeys(staged, 0) | dict(zip(shards.tolist(), counts.tolist(), strict=True))


def unpaid(workers: int, items: int, start: float, work: float, *, foreseen: bool = False) -> str | None:
    """A line where one worker would be quicker than several, which take seconds to start, and then to work.
    foreseen: whether that is still to come."""
    if workers * work >= start + work:  # at the left the most that one takes: it has the cores of all
        return None
    take, quicker = ("take about", "are quicker") if foreseen else ("took", "would have been quicker")
    return (
        f"{workers} workers {take} {start:.1f} s to start and {work:.1f} s for {counted(items, 'item')}: fewer workers "
        f"{quicker}, they pay for longer work"
    )


#: Items that name what is not there, of which a forecast keeps a line.
MAX_MISSING = 10


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
    missing: dict[str, str]  # what items name and is not there, by id, of MAX_MISSING of them; the count is of all
    missing_count: int
    workers: int
    seconds: float  # how long it would take, without what could not be measured
    start: float = 0.0  # what comes before that: seconds until a process of several workers is there, as one was

    @property
    def unpaid(self) -> str | None:
        """A line where fewer workers are quicker; None where some items could not be measured."""
        if not self.measured or self.errors:
            return None
        return unpaid(self.workers, sum(self.counts.values()), self.start, self.seconds, foreseen=True)


def foresee(
    path: PathLike, out: PathLike, *, workers: int = 1, cluster: str | None = None, device: str | None = None
) -> Forecast:
    """Look at a job and at what is there of it, and make up to three items of each kind that earlier runs do not know.
    workers: by how many it would be made, on the CPU they share the cores. Nothing is written to `out`."""
    # A process of several workers is started, to see how long that takes, unless a cluster would make the items.
    from .worker import Worker  # here, as a driver of processes needs nothing of it

    with JobFile(path) as job, tempfile.TemporaryDirectory() as temporary:
        folder, merged = OutputFolder(out), pathlib.Path(temporary, "manifest.jsonl")
        merge_notes(folder.manifest, folder.notes.glob("*.jsonl"), into=merged)  # those of a run that was killed count
        with contextlib.closing(Manifest(merged)) as manifest:
            plan, known = make_plan(job, folder, manifest), newest_seconds(manifest)
        counts = {kind: count for kind, number in KIND_NUMBERS.items() if (count := int((plan.kinds == number).sum()))}
        measured = {kind: Measured(known[kind], 0.0, "earlier runs") for kind in counts if kind in known}
        errors: dict[str, str] = {}
        wrong, items = Missing(job.folder), (job.item(int(index)) for index in plan.items)
        absent = ((item.id, line) for item in items if (line := wrong.of(item)) is not None)
        missing = dict(itertools.islice(absent, MAX_MISSING))
        missing_count = len(missing) + sum(1 for _ in absent)
        found = resolve_device(device)
        threads = max(1, cpu_threads() // workers) if found.is_cpu else cpu_threads()
        with limit_threads(threads), Worker(job.folder, temporary, found) as worker:
            for kind in [kind for kind in counts if kind not in measured]:
                _measure(job, plan, kind, worker, measured, errors)
        workers = max(1, min(workers, len(plan.items)))
        several = workers > 1 and cluster is None
        start = _start_seconds(job, temporary, workers, device) if several else 0.0
    moves = {kind: len(np.unique(plan.poses[plan.kinds == KIND_NUMBERS[kind]])) for kind in measured}
    work = sum(counts[kind] * each.seconds + moves[kind] * each.pose_seconds for kind, each in measured.items())
    loads = max((each.load_seconds for each in measured.values()), default=0.0) * max(plan.group_count, 1)
    seconds = (work + loads) / workers
    return Forecast(plan, counts, measured, errors, missing, missing_count, workers, seconds, start)


def _start_seconds(job: JobFile, temporary: str, workers: int, device: str | None) -> float:
    """Seconds until the process of one of several workers is ready."""
    folder = OutputFolder(temporary)
    folder.prepare()
    settings = RunnerSettings(str(job.folder), job.reader, str(folder.path), run_name(), device)
    begin = time.monotonic()
    with contextlib.closing(ProcessEngine(LocalHost(workers, device), settings)) as engine:
        engine.start("0", 1)
        while not list(engine.wait(1.0)):
            pass
        return time.monotonic() - begin


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
