"""What was used last is kept, within a number of things and of bytes."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

Thing = TypeVar("Thing")


#: Calls of `settle` after which a thing is measured in any case.
MEASURED_EVERY = 256


@dataclasses.dataclass
class _Kept(Generic[Thing]):
    """A thing, the bytes that it took when it was measured, and how often it was settled."""

    thing: Thing
    size: int = 0
    calls: int = 0


class Recent(Generic[Thing]):
    """Things by key, of which those that were not used for longest are let go, and `dropped` is called with each.
    The one that is used last stays, whatever bytes it takes by `measure`. None: no limit of bytes, none counted."""

    def __init__(
        self,
        most: int,
        most_bytes: int | None = None,
        measure: Callable[[Thing], int] | None = None,
        dropped: Callable[[Thing], Any] | None = None,
    ):
        self.most, self.most_bytes, self.measure, self._dropped = most, most_bytes, measure, dropped
        self._things: OrderedDict[Hashable, _Kept[Thing]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._things)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._things

    @property
    def held_bytes(self) -> int:
        """Bytes of all things together, as they were measured last."""
        return sum(kept.size for kept in self._things.values())

    def get(self, key: Hashable, make: Callable[[], Thing]) -> Thing:
        """The thing of a key, made where it is not kept; it is now the one that was used last."""
        if key in self._things:
            self._things.move_to_end(key)
            return self._things[key].thing
        while len(self._things) >= self.most:  # before the new one is made, which needs the room
            self._drop_oldest()
        thing = make()
        self._things[key] = _Kept(thing)
        self.settle(key)
        return thing

    def settle(self, key: Hashable) -> None:
        """Measure a thing anew, which may have grown since it was made, and let go of what is too much."""
        if key not in self._things or self.measure is None:
            return
        kept = self._things[key]
        kept.calls += 1
        # measuring takes a while: at the first, second, fourth call and so on, then at every MEASURED_EVERY
        if kept.calls % MEASURED_EVERY and kept.calls & (kept.calls - 1):
            return
        kept.size = self.measure(kept.thing)
        while self.most_bytes is not None and len(self._things) > 1 and self.held_bytes > self.most_bytes:
            self._drop_oldest()

    def items(self) -> list[tuple[Hashable, Thing]]:
        """Keys and things, from the one that was not used for longest."""
        return [(key, kept.thing) for key, kept in self._things.items()]

    def drop(self, key: Hashable) -> None:
        """Let go of a thing, if it is kept."""
        if key in self._things:
            self._let_go(self._things.pop(key).thing)

    def clear(self) -> None:
        """Let go of all things."""
        while self._things:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        self._let_go(self._things.popitem(last=False)[1].thing)

    def _let_go(self, thing: Thing) -> None:
        if self._dropped is not None:
            self._dropped(thing)
