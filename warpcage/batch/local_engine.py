"""One worker in the process of the driver: no Ray, no other process."""

from __future__ import annotations

import time
from collections.abc import Callable

from .loop import Event, Finished, Ready, Returned
from .lot_runner import LotOrder, LotRunner
from .lots import Lot


class LocalEngine:
    """Runs lots in this process, one after the other.

    Args:
        runner: Makes the items.
        order: The order of a lot, with its items.
    """

    def __init__(self, runner: LotRunner, order: Callable[[Lot], LotOrder]):
        self._runner, self._order = runner, order
        self._lot: Lot | None = None
        self._events: list[Event] = []
        self._launches: list[float] = []

    def now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.monotonic()

    def launch(self, worker: str) -> None:
        """The worker is here. A device that is lost stays so in this process.

        Raises:
            RuntimeError: When it is started again.
        """
        if self._launches:
            raise RuntimeError("the device works no more in this process: run again, what is made is kept")
        self._launches.append(self.now())
        self._events.append(Ready(worker))

    def give(self, worker: str, lot: Lot) -> None:
        """Take a lot; `wait` makes it."""
        self._lot, self._worker = lot, worker

    def recall(self, worker: str, number: int, share: float) -> None:
        """Nothing comes back: while a lot is made nobody can ask."""
        self._events.append(Returned(worker, number, []))

    def lost(self, item: int, error: str, attempts: int) -> None:
        """Never called: where the worker dies, so does the driver."""
        raise AssertionError(item)

    def stop(self) -> None:
        """Begin no more items."""
        self._runner.stop()

    def wait(self, timeout: float) -> list[Event]:
        """Make the lot that was given."""
        events, self._events = self._events, []
        if self._lot is not None:
            order, self._lot = self._order(self._lot), None
            events.append(Finished(self._worker, self._runner.run(order)))
        return events

    def close(self) -> None:
        """Close the notes of the worker."""
        self._runner.close()
