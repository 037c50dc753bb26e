"""Free memory: how much there is, refusals of work that needs more, and a cache of bounded size."""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ..errors import InputError

if TYPE_CHECKING:
    import warp as wp

#: Bytes where nothing is known: beyond any memory.
UNKNOWN = 1 << 62

#: Fewer bytes than this are not checked.
LITTLE = 1 << 20

#: Limit and use of a control group, and what its statistics call pages of files, which the kernel gives back when it
#: must: version 2, then version 1.
_GROUP_FILES = (
    ("memory.max", "memory.current", ("inactive_file", "active_file")),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
)


class MemoryShortage(InputError):
    """Work that was refused before it began, as there is not enough memory free."""


def is_shortage(error: BaseException | None) -> bool:
    """Whether an error says that there was not enough memory, or came of one that did."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, MemoryError | MemoryShortage) or "Failed to allocate" in str(error):  # Warp: no class
            return True
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return False


def free_bytes(device: wp.Device) -> int:
    """Bytes that can still be allocated on a device; for the CPU as `free_host_bytes`."""
    return free_host_bytes() if device.is_cpu else device.free_memory


def free_host_bytes(root: str = "/") -> int:
    """Bytes of main memory that this process can still allocate; `root` holds proc and sys, for tests."""
    # The least of what the system has free, and what control groups (containers, jobs of a cluster) and the limits of
    # the process (`ulimit -v` and `-d`) leave. Limits that cannot be read count as none.
    base = pathlib.Path(root)
    return max(0, min(_system_bytes(base), *_group_bytes(base), *_process_bytes(base)))


def require_memory(size: int, device: wp.Device, message: str, *, held: int = 0) -> None:
    """Refuse work that needs more bytes than are free or `held`: allocated now and used again.
    `{size}` in the message becomes what is needed and what is free."""
    free = free_bytes(device) + held
    if size > free:
        figures = f"{size / 2**30:.2f} GiB, {device.alias} has {free / 2**30:.2f} GiB free"
        raise MemoryShortage(message.format(size=figures))


def require_host_memory(size: int, what: str) -> None:
    """Refuse what needs more bytes of main memory than are free: "`what` 4.00 GiB of memory, 1.00 GiB are free"."""
    if size <= LITTLE:  # to ask the system would take longer than to fill them
        return
    free = free_host_bytes()
    if size > free:
        raise MemoryShortage(f"{what} {size / 2**30:.2f} GiB of memory, {free / 2**30:.2f} GiB are free")


def _system_bytes(base: pathlib.Path) -> int:
    """What the whole machine can still give, or else all it has."""
    for line in _lines(base / "proc/meminfo"):
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not a POSIX system
        return UNKNOWN


def _group_bytes(base: pathlib.Path) -> Iterator[int]:
    """What is left of each control group of this process that has a limit: its own, and all around it."""
    yield UNKNOWN
    for folder, limit_file, used_file, pages in _groups(base):
        limit = _whole(folder / limit_file)
        if limit < UNKNOWN:  # version 1 has a number for no limit
            held = dict(line.split(maxsplit=1) for line in _lines(folder / "memory.stat") if " " in line)
            yield limit - _whole(folder / used_file) + sum(int(held.get(name, 0)) for name in pages)


@functools.lru_cache(maxsize=8)
def _groups(base: pathlib.Path) -> list[tuple[pathlib.Path, str, str, tuple[str, str]]]:
    """Folders of the control groups of this process, with what their files are called. Looked for once."""
    found = []
    for line in _lines(base / "proc/self/cgroup"):
        _, controllers, group = line.strip().split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        mount = base / "sys/fs/cgroup" / ("memory" if controllers else "")
        inner = pathlib.PurePosixPath(group.lstrip("/"))
        # in a container the groups around it are not there to see, and its own is the mount itself
        folders = [mount / place for place in (inner, *inner.parents)]
        found += [(folder, *names) for folder in folders for names in _GROUP_FILES if (folder / names[0]).is_file()]
    return found


def _process_bytes(base: pathlib.Path) -> Iterator[int]:
    """What is left of this process's own limits."""
    yield UNKNOWN
    try:
        import resource
    except ImportError:  # not a POSIX system
        return
    pages = next(iter(_lines(base / "proc/self/statm")), "").split()
    # of address space the process has the first number in use, of data the sixth, counted in pages
    for limit, place in ((resource.RLIMIT_AS, 0), (resource.RLIMIT_DATA, 5)):
        soft = resource.getrlimit(limit)[0]
        if soft != resource.RLIM_INFINITY:
            used = int(pages[place]) * resource.getpagesize() if len(pages) > place else 0
            yield soft - used


def _whole(path: pathlib.Path) -> int:
    """The number in a file of the system, UNKNOWN where there is none."""
    text = next(iter(_lines(path)), "").strip()
    return int(text) if text.isdigit() else UNKNOWN


def _lines(path: pathlib.Path) -> list[str]:
    """The lines of a file of the system, none where it is not there."""
    try:
        with open(path) as lines:
            return list(lines)
    except OSError:
        return []


Value = TypeVar("Value")

#: Calls of `settle` after which a value is measured in any case.
MEASURED_EVERY = 256


@dataclasses.dataclass
class _Kept(Generic[Value]):
    """A value, the bytes that it took when it was measured, and how often it was settled."""

    value: Value
    size: int = 0
    calls: int = 0


class LRUCache(Generic[Value]):
    """Values by key, of which those that were not used for longest are let go, and `dropped` is called with each.
    The one that is used last stays, whatever bytes it takes by `measure`. None: no limit of bytes, none counted."""

    def __init__(
        self,
        most: int,
        most_bytes: int | None = None,
        measure: Callable[[Value], int] | None = None,
        dropped: Callable[[Value], Any] | None = None,
    ):
        self.most, self.most_bytes, self.measure, self._dropped = most, most_bytes, measure, dropped
        self._values: OrderedDict[Hashable, _Kept[Value]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._values

    @property
    def held_bytes(self) -> int:
        """Bytes of all values together, as they were measured last."""
        return sum(kept.size for kept in self._values.values())

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, made where it is not kept; it is now the one that was used last."""
        if key in self._values:
            self._values.move_to_end(key)
            return self._values[key].value
        while len(self._values) >= self.most:  # before the new one is made, which needs the memory
            self._drop_oldest()
        value = make()
        self._values[key] = _Kept(value)
        self.settle(key)
        return value

    def settle(self, key: Hashable) -> None:
        """Measure a value anew, which may have grown since it was made, and let go of what is too much."""
        if key not in self._values or self.measure is None:
            return
        kept = self._values[key]
        kept.calls += 1
        if kept.calls % MEASURED_EVERY and kept.calls & (kept.calls - 1):  # measuring takes a while: at 1, 2, 4 ...
            return
        kept.size = self.measure(kept.value)
        while self.most_bytes is not None and len(self._values) > 1 and self.held_bytes > self.most_bytes:
            self._drop_oldest()

    def items(self) -> list[tuple[Hashable, Value]]:
        """Keys and values, from the one that was not used for longest."""
        return [(key, kept.value) for key, kept in self._values.items()]

    def drop(self, key: Hashable) -> None:
        """Let go of a value, if it is kept."""
        if key in self._values:
            self._let_go(self._values.pop(key).value)

    def clear(self) -> None:
        """Let go of all values."""
        while self._values:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        self._let_go(self._values.popitem(last=False)[1].value)

    def _let_go(self, value: Value) -> None:
        if self._dropped is not None:
            self._dropped(value)
