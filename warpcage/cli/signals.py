"""Signals that end a command as an interrupt does: what is half-written is removed."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType


class Ended(KeyboardInterrupt):
    """A signal asks the program to end; whatever cleans up after an interrupt does so here too."""

    def __init__(self, number: int):
        super().__init__()
        self.status = 128 + number  # what shells give to a program that the signal killed


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise Ended where SIGTERM or SIGHUP would kill the process. A signal that is ignored stays so (nohup)."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread alone
        return

    def end(number: int, frame: FrameType | None) -> None:
        raise Ended(number)

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {}
    try:
        for number in numbers:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, end)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
