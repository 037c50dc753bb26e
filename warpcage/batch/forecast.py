"""What a run would take: what is missing, and seconds by kind from earlier runs."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import os
import pathlib
import tempfile
import time

import numpy as np

from ..cage.pose_file import is_preset
from ..core.devices import resolve_device
from ..core.files import NpyFile, PathLike, require_file
from ..core.memory import LRUCache
from ..core.threads import cpu_threads, limit_threads
from .fingerprints import Fingerprints, references_of
from .items import Item
from .job_file import JobFile
from .manifest import Manifest, OutputFolder, merge_notes, newest_seconds
from .plan import KIND_NUMBERS, Plan, make_plan
from .words import split_reference
from .worker import Worker

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

    total: int
    kept: int  # items that are there and whose inputs did not change
    changed: int  # of the items to be made: whose inputs or files changed; that failed in an earlier run
    failed_before: int
    counts: dict[str, int]  # items to be made, by their kind
    group_count: int  # how often something is loaded for them at least
    measured: dict[str, Measured]  # by kind
    errors: dict[str, str]  # why an item of a kind could not be made, by its id
    missing: dict[str, str]  # what items name and is not there, by id, of MOST_MISSING of them; the count is of all
    missing_count: int
    workers: int
    seconds: float  # how long it would take, without what could not be measured


def foresee(path: PathLike, out: PathLike, *, workers: int = 1, device: str | None = None) -> Forecast:
    """Look at a job and at what is there of it, and make up to three items of each kind that earlier runs do not know.
    workers: by how many it would be made, on the CPU they share the cores. Nothing is written to `out`."""
    with JobFile(path) as job, tempfile.TemporaryDirectory() as temporary:
        plan, seconds = _planned(job, OutputFolder(out), pathlib.Path(temporary))
        numbers = collections.Counter(plan.kinds.tolist())
        counts = {kind: numbers[number] for kind, number in KIND_NUMBERS.items() if numbers[number]}
        measured = {kind: Measured(seconds[kind], 0.0, "earlier runs") for kind in counts if kind in seconds}
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
    return Forecast(
        plan.total,
        plan.kept,
        plan.changed,
        plan.failed_before,
        counts,
        plan.group_count,
        measured,
        errors,
        missing,
        missing_count,
        workers,
        (work + loads) / workers,
    )


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
