"""What a run has to make: what is there already and as it should be is kept, the rest is put in order."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .items import ITEMS_PER_SHARD, KINDS, WEBDATASET, Item
from .job_file import JobFile
from .manifest import DONE, FAILED, Manifest, OutputFolder, id_key
from .scheduler import ChunkQueue
from .webdataset import shard_holds, staged_shards

KIND_NUMBERS = {kind: number for number, kind in enumerate(KINDS)}  # for `ChunkQueue`


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

    def first_items(self, most: int) -> list[int]:
        """Numbers of the items with which workers will probably begin: the first of each group, the largest groups
        before others."""
        starts = np.flatnonzero(np.diff(self.groups, prepend=self.groups[:1] - 1))
        sizes = np.diff(starts, append=len(self.groups))
        return self.items[starts[np.argsort(-sizes, kind="stable")[:most]]].tolist()

    def chunks(self, *, aim: float, whole: bool) -> ChunkQueue:
        """What is to be made, as workers take it."""
        return ChunkQueue(self.items, self.groups, self.kinds, aim=aim, whole=whole)


def make_plan(
    job: JobFile,
    folder: OutputFolder,
    manifest: Manifest,
    fingerprint: Callable[[Item], str],
    progress: Callable[[int], None] = lambda count: None,
) -> Plan:
    """Look at all items of a job, or of the part that the folder is for.
    fingerprint: the hash of an item's inputs; progress: called with the number of items that were looked at."""
    count, span = len(job), span_of(job, folder)
    shard = shard_size(job)
    keys, groups, poses = (np.zeros(count, np.int64) for _ in range(3))
    kinds, wanted = np.zeros(count, np.int8), np.zeros(count, bool)
    wanted[span.start : span.stop] = True
    names: dict[str, int] = {}
    paths, owners = [], []
    changed = failed_before = 0
    for checked, index in enumerate(span, 1):
        item = job.item(index)
        keys[index], kinds[index] = id_key(item.id.casefold()), KIND_NUMBERS[item.kind]
        groups[index] = names.setdefault(item.group, len(names))
        poses[index] = id_key(item.pose)
        paths += [id_key(path) for path in _paths(item)]
        owners += [index] * len(item.outputs)
        record = manifest.find(item.id) if len(manifest) else None
        if record is not None and record["state"] == DONE:
            outputs = record.get("outputs")
            there = shard_holds(folder.path, index // shard, outputs) if shard else folder.holds(outputs)
            wanted[index] = not (there and _unchanged(record, item, fingerprint))
            changed += int(wanted[index])
        failed_before += record is not None and record["state"] == FAILED
        progress(checked)
    numbers = np.arange(span.start, span.stop)
    _refuse_twins(job, keys[span.start : span.stop], numbers, lambda item: [item.id.casefold()], "the id")
    _refuse_twins(job, np.array(paths, np.int64), np.array(owners, np.int64), _paths, "the output")
    makes = np.flatnonzero(wanted)
    major = makes // shard if shard else groups[makes]
    # poses in the order in which they come first
    _, first, which = np.unique(poses[makes], return_index=True, return_inverse=True)
    minor = first[which] if len(makes) else which
    order = np.lexsort((makes, minor, groups[makes], major))
    group_count = len(np.unique(groups[makes]))
    return Plan(
        len(span),
        makes[order],
        major[order],
        kinds[makes][order],
        _runs(major[order], groups[makes][order], minor[order]),
        len(span) - len(makes),
        changed,
        failed_before,
        group_count,
    )


def _runs(*columns: np.ndarray) -> np.ndarray:
    """(n,) numbers of rows that follow each other and are alike in all columns (n,), from 0."""
    changes = np.zeros(len(columns[0]), bool)
    for column in columns:
        changes[1:] |= np.diff(column) != 0
    return np.cumsum(changes)


def shard_size(job: JobFile) -> int:
    """Items of a shard of a job; 0 where it has no shards."""
    if job.records.get("kind") != WEBDATASET:
        return 0
    return int(job.records.get("items_per_shard", ITEMS_PER_SHARD))


def span_of(job: JobFile, folder: OutputFolder) -> range:
    """Numbers of the items that a run looks at: all, or those of its part, which has whole shards."""
    return range(len(job)) if folder.part is None else folder.part.range(len(job), shard_size(job) or 1)


def open_shards(plan: Plan, folder: OutputFolder, job: JobFile) -> dict[int, int]:
    """Items to be made of each shard of a job with shards; 0 where its loose files are only to be packed."""
    shards, counts = np.unique(plan.groups, return_counts=True)
    span, size = span_of(job, folder), shard_size(job)
    staged = (shard for shard in staged_shards(folder.path) if folder.part is None or shard * size in span)
    return dict.fromkeys(staged, 0) | dict(zip(shards.tolist(), counts.tolist(), strict=True))


def _unchanged(record: dict, item: Item, fingerprint: Callable[[Item], str]) -> bool:
    try:
        return record.get("inputs") == fingerprint(item)
    except (OSError, ValueError):  # the worker will say what is wrong with it
        return False


def _paths(item: Item) -> list[str]:
    """What it writes. File systems that do not tell capitals apart are thought of."""
    return [path.casefold() for path in item.outputs.values()]


def _refuse_twins(
    job: JobFile, keys: np.ndarray, owners: np.ndarray, names: Callable[[Item], list[str]], what: str
) -> None:
    """Raise ValueError for the first name that two items have."""
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    for place in same:
        one, two = sorted((int(owners[order[place]]), int(owners[order[place + 1]])))
        shared = set(names(job.item(one))) & set(names(job.item(two))) if one != two else set(names(job.item(one)))
        if shared and (one != two or len(names(job.item(one))) > len(shared)):
            raise ValueError(
                f"{job.path}, lines {job.line(one)} and {job.line(two)}: two items have {what} {min(shared)!r}: "
                "each needs its own"
            )
