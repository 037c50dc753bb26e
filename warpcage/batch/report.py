"""What a run tells: how far it is, and what came of it."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class RunProgress:
    """How far a run is."""

    # "check" while items are compared with what is there, "make" after that
    stage: str
    total: int
    checked: int = 0
    # items that were there already
    kept: int = 0
    # items that were made
    done: int = 0
    failed: int = 0
    # places where work is done
    workers: int = 0
    # since the first worker was asked for
    seconds: float = 0.0


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
