"""What runs in the process of a worker of Ray."""

from __future__ import annotations

import contextlib
import os
import platform
from typing import Any

from ..core.threads import limit_threads
from .dispatcher import LotReport
from .lot_runner import LotOrder, LotRunner
from .runners import RunnerSettings, make_runner


class LotActor:
    """What runs in the process of a worker."""

    def __init__(self, settings: RunnerSettings):
        self._settings = settings
        self._limits = contextlib.ExitStack()
        if settings.threads:
            self._limits.enter_context(limit_threads(settings.threads))
        self._runner: LotRunner = make_runner(settings)

    def facts(self) -> dict[str, Any]:
        """Where it works, once it can."""
        return {"pid": os.getpid(), "host": platform.node()}

    def run(self, order: LotOrder) -> LotReport:
        """Make a lot."""
        return self._runner.run(order)

    def begun(self, number: int) -> None:
        """Wait until all items of a lot are begun."""
        self._runner.wait_until_begun(number)

    def recall(self, number: int, share: float) -> list[int]:
        """Give items back."""
        return self._runner.recall(number, share)

    def oldest(self, number: int) -> tuple[int, float] | None:
        """The item that has been under way for longest, and for how long."""
        return self._runner.oldest(number)

    def stop(self) -> None:
        """Begin no more items."""
        self._runner.stop()
