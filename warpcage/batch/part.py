"""A part of a job: one of several equal ranges of its items, which runs of their own make beside each other."""

from __future__ import annotations

import dataclasses
import re

from ..core.checks import shown


@dataclasses.dataclass(frozen=True)
class Part:
    """One of the parts of a job: `number`, from 1, of `count`."""

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise ValueError(f"there is no part {self.number} of {self.count}: they are numbered from 1")

    @classmethod
    def named(cls, text: str) -> Part:
        """The part of a text such as "3/16". Raises ValueError for others."""
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None:
            raise ValueError(f"a part must be a number of how many, such as 3/16, got {shown(text)}")
        return cls(int(found[1]), int(found[2]))

    @property
    def name(self) -> str:
        """Names its files."""
        return f"part-{self.number}-of-{self.count}"

    def range(self, total: int, unit: int = 1) -> range:
        """Numbers of its items, of `total`; unit: items that stay together, those of a shard."""
        # All parts together have each item once, and as equal numbers of units as can be.
        units = -(-total // unit)
        begin, end = (min(total, unit * (units * part // self.count)) for part in (self.number - 1, self.number))
        return range(begin, end)
