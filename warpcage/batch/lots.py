"""Lots: the items that a worker takes at once. They are cut from the list of what is to be made as workers ask."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

#: Seconds that a lot should take, and most items that it holds.
AIM, LARGEST = 10.0, 256

#: Lots that each worker should still get of what is left: towards the end they become small, so that all end together.
LOTS_PER_WORKER = 4

#: Seconds that a lot should take at least, as far as each worker gets as much: at its end a worker waits until the last
#: files are written.
LEAST = 0.5

#: Weight of the newest lot in the seconds that an item of a group is taken for, where it has as many items as those
#: before it.
NEWEST = 0.25


@dataclasses.dataclass(frozen=True)
class Lot:
    """Items that one worker takes at once."""

    number: int
    # numbers of the items in the job file, in the order in which they are made
    items: Sequence[int]
    # how often each was begun before and failed
    attempts: Sequence[int]
    # what the worker has loaded afterwards
    group: int
    # to be packed, in a lot without items; None else
    shard: int | None = None
    # after so many no more of its items are begun; None where it is known what they take
    seconds: float | None = None


@dataclasses.dataclass
class _Seconds:
    """A running mean of what an item takes, and how many items of a lot it is known by."""

    mean: float = 0.0
    items: float = 0.0

    def note(self, seconds: float, items: int) -> None:
        """Take in a lot of so many items, each of which counts."""
        before = (1.0 / NEWEST - 1.0) * self.items
        weight = items / (items + before) if before else 1.0
        self.mean += weight * (seconds - self.mean)
        self.items += weight * (items - self.items)


class Lots:
    """What is left to be made, in groups of items that share what a worker loads; items, groups and kinds are (n,).
    Items of a group follow each other; aim: seconds that a lot should take."""

    # Where nothing is known of a group, its items are taken to last as long as others of their kind.

    def __init__(
        self,
        items: np.ndarray,
        groups: np.ndarray,
        kinds: np.ndarray | None = None,
        *,
        aim: float = AIM,
        largest: int = LARGEST,
        # whether a lot is all that is left of a group (a shard), however long it takes
        whole: bool = False,
    ):
        self._items = np.asarray(items, np.int64)
        groups = np.asarray(groups, np.int64)
        starts = np.flatnonzero(np.diff(groups, prepend=groups[:1] - 1)) if len(groups) else np.zeros(0, np.int64)
        self._names = groups[starts]
        if len(np.unique(self._names)) < len(self._names):
            raise ValueError("items of a group must follow each other")
        self._begin = starts.copy()  # the first item of each group that nobody has taken
        self._end = np.append(starts[1:], len(groups))
        self._kinds = np.zeros(len(starts), np.int64) if kinds is None else np.asarray(kinds, np.int64)[starts]
        self._back: dict[int, list[int]] = {}  # what was taken and came back, by group
        self._by_size = np.argsort(
            self._begin - self._end, kind="stable"
        )  # the largest first: none is left for the end
        self._unclaimed = 0  # index into those
        self._open: set[int] = set()  # groups that were claimed and have items left
        self._seconds: dict[int, _Seconds] = {}  # an item of a group takes
        self._kind_seconds: dict[int, _Seconds] = {}
        self.aim, self._largest, self.whole = aim, largest, whole
        # items that nobody has
        self.left = len(self._items)

    @property
    def group_count(self) -> int:
        """Groups in all."""
        return len(self._names)

    def name(self, group: int) -> int:
        """What callers call a group."""
        return int(self._names[group])

    def left_in(self, group: int) -> int:
        """Items of a group that nobody has."""
        return int(self._end[group] - self._begin[group]) + len(self._back.get(group, ()))

    def seconds(self, group: int) -> float | None:
        """Seconds that an item of a group takes; None where nobody knows."""
        found = self._found(group)
        return None if found is None else found.mean

    def items_behind(self, group: int) -> float:
        """How many items of a lot `seconds` is known by; 0 where nobody knows."""
        found = self._found(group)
        return 0.0 if found is None else found.items

    def note(self, group: int, seconds: float, items: int = 1) -> None:
        """Keep how long an item of a group took; seconds: mean over the items of a lot; items: how many those were."""
        # One that is made alone takes longer than one among others. 0 is for seconds with what loading takes in them,
        # which hold only until others are known.
        kind = int(self._kinds[group])
        tables = [(self._kind_seconds, kind), *([(self._seconds, group)] if self.left_in(group) else [])]
        for table, key in tables:
            table.setdefault(key, _Seconds()).note(seconds, items)

    def _found(self, group: int) -> _Seconds | None:
        return self._seconds.get(group, self._kind_seconds.get(int(self._kinds[group])))

    def choose(self, loaded: int | None, sharers: dict[int, int]) -> int | None:
        """The group of which a worker should take its next lot; loaded: that it has; sharers: workers at each group."""
        # The loaded one as long as there is some of it; else one that nobody has begun, the largest first; else the one
        # with the most left for each worker at it.
        if loaded is not None and self.left_in(loaded):
            return loaded
        while self._unclaimed < len(self._by_size):
            group = int(self._by_size[self._unclaimed])
            self._unclaimed += 1
            if group not in self._open and self.left_in(group):
                self._open.add(group)
                return group
        return max(self._open, key=lambda group: self.left_in(group) / (1 + sharers.get(group, 0)), default=None)

    def take(self, group: int, workers: int, speed: float = 1.0) -> tuple[list[int], int]:
        """Cut a lot of a group; returns the items, and the group of the last of them.
        speed: seconds that the worker takes for what takes others one."""
        size = self._size(group, workers, speed)
        taken = self._cut(group, size)
        # where that has too few, the next groups that nobody has begun are taken with it, as far as they are of its
        # kind and taken whole
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

    def _size(self, group: int, workers: int, speed: float) -> int:
        if self.whole:
            return self.left_in(group)
        fair, equal = (-(-self.left // (lots * max(workers, 1))) for lots in (LOTS_PER_WORKER, 1))
        seconds = self.seconds(group)
        if seconds is None:  # the lot ends with its time; its first item may wait long for the hash of what it loads
            return min(fair, self._largest)
        each = max(seconds * speed, 1e-9)
        aimed, least = int(self.aim / each), int(min(self.aim, LEAST) / each)
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
