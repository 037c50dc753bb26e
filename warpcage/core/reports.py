"""What is said beside results: progress of long work, the logger, a word while kernels compile, no empty notes."""

from __future__ import annotations

import contextlib
import contextvars
import ctypes
import functools
import inspect
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeAlias, TypeVar

from ..errors import Cancelled, InputError

#: What `progress=` takes beside True and False: it is told how much is done, of how much, and what is done. Work stops
#: where it returns False, or raises.
Progress: TypeAlias = Callable[[int, int, str], object]

_listener: contextvars.ContextVar[Progress | None] = contextvars.ContextVar("listener", default=None)


class _Ended(BaseException):
    """Carries what a listener raised past all that catches errors on the way, up to the call that took it."""

    def __init__(self, error: Exception):
        super().__init__(error)
        self.error = error


@contextlib.contextmanager
def progress_scope(progress: bool | Progress | None) -> Iterator[None]:
    """Report the progress of a block: True shows bars on stderr, a function is called with it.
    False and None change nothing: a block within another one reports to the listener of that."""
    if progress is None or progress is False:
        yield
        return
    listener = _Bars() if progress is True else progress
    if not callable(listener):
        raise InputError(f"progress must be True, False or a function, got {type(progress).__name__}")
    token = _listener.set(listener)
    error: Exception | None = None
    try:
        yield
    except _Ended as ended:
        error = ended.error
    finally:
        _listener.reset(token)
        if isinstance(listener, _Bars):
            listener.close()
    if error is not None:
        raise error from error.__cause__


Decorated = TypeVar("Decorated", bound=Callable[..., Any])


def reports_progress(function: Decorated) -> Decorated:
    """Decorator of a function with an argument `progress`, whose calls are each a `progress_scope` of it."""
    default = inspect.signature(function).parameters["progress"].default

    @functools.wraps(function)
    def reporting(*values: Any, **options: Any) -> Any:
        with progress_scope(options.get("progress", default)):
            return function(*values, **options)

    return reporting  # pyright: ignore[reportReturnType]


def is_progress_requested() -> bool:
    """Whether there is a listener, for work that is done for reports alone."""
    return _listener.get() is not None


def report_progress(done: int, total: int, message: str) -> None:
    """Report how far work is, `total` 0 where that is not known; raises Cancelled where the listener returned False.
    What changes during the work stands behind a colon: "fit: 31.20 dB"."""
    listener = _listener.get()
    if listener is None:
        return
    import numpy as np  # `warpcage --help` starts without it

    token = _listener.set(None)  # what the caller does meanwhile is not part of the work
    try:
        answer = listener(done, total, message)
        if isinstance(answer, bool | np.bool_) and not answer:  # a comparison of NumPy's numbers is no bool
            raise Cancelled(f"{message.partition(':')[0]} was cancelled, {done}{f' of {total}' if total else ''} done")
    except Exception as error:
        raise _Ended(error) from None
    finally:
        _listener.reset(token)


def bar(total: int | None, what: str, *, done: int = 0, shown: bool = True, stays: bool = True, **options: Any) -> Any:
    """A bar of tqdm on stderr, `total` None or 0 where it is not known; elsewhere a line each 10 s and one at its end.
    stays: whether it stands there after it; options: more of tqdm's own."""
    kind = _bar_kind(sys.stderr.isatty() or "ipykernel" in sys.modules)  # a notebook shows bars, and is no terminal
    how = {"total": total or None, "initial": done, "desc": what, "disable": not shown, "leave": stays}
    return kind(file=sys.stderr, **how, **options)


def span_text(seconds: float) -> str:
    """Such as "2 h 5 min", of whole units."""
    if seconds < 120:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def say_above_bar(line: str) -> None:
    """Print a warning on stderr, above a bar that may be shown."""
    from tqdm import tqdm

    tqdm.write(f"warpcage: warning: {line}", file=sys.stderr)


#: Between two lines of a bar in a log.
LOG_SECONDS = 10.0


class _Nowhere:
    """A file that keeps nothing."""

    def write(self, text: str) -> None:
        pass

    def flush(self) -> None:
        pass


@functools.cache
def _bar_kind(terminal: bool) -> Any:
    """The class of bars on a terminal or elsewhere; tqdm is loaded where one is shown, as it takes a while."""
    from tqdm import tqdm

    class LineBar(tqdm):
        """A bar that is drawn nowhere: logs have a line of it each 10 s, and one of its last state."""

        def __init__(self, *, file: Any, **options: Any):
            self._log, self._due = file, LOG_SECONDS
            super().__init__(file=_Nowhere(), **options)

        def display(self, msg: str | None = None, pos: int | None = None) -> bool:
            seen = self.format_dict
            if (elapsed := seen["elapsed"]) >= self._due:
                self._due = elapsed + LOG_SECONDS
                done, total = seen["n"] - seen["initial"], seen["total"]
                left = (
                    span_text(elapsed * (total - seen["n"]) / done)
                    if total and done > 0 and "left" not in (seen["postfix"] or "")
                    else ""
                )
                self._write(seen, f", about {left} left" if left else "")
            return True

        def close(self) -> None:
            self._due = float("inf")  # as the last state is written here
            if self.leave and not self.disable:
                seen = self.format_dict
                self._write(seen, f" in {tqdm.format_interval(seen['elapsed'])}")
            super().close()

        def _write(self, seen: Mapping[str, Any], when: str) -> None:
            count = f"{seen['n']}/{seen['total']}" if seen["total"] else seen["n"]
            more = f", {seen['postfix']}" if seen["postfix"] else ""
            print(f"{self.desc.removesuffix(': ')}: {count}{when}{more}", file=self._log, flush=True)

    return tqdm if terminal else LineBar


class _Bars:
    """Progress as a bar after the other."""

    def __init__(self):
        self._bar: Any = None
        self._shown: tuple[str, int] | None = None  # what the bar is of

    def __call__(self, done: int, total: int, words: str) -> None:
        what, _, more = words.partition(": ")
        if self._shown != (what, total):
            self.close()
            self._bar, self._shown = bar(total, what, done=done), (what, total)
        self._bar.update(done - self._bar.n)
        if more:
            self._bar.set_postfix_str(more)

    def close(self) -> None:
        """End the bar that is shown."""
        bar, self._bar, self._shown = self._bar, None, None
        if bar is not None:
            bar.close()


#: Environment variable that shows the logger "warpcage" on stderr from a level on; Warp's own lines too at the first.
LOG_VARIABLE = "WARPCAGE_LOG"
LEVELS = ("debug", "info", "warning", "error")

_shown: Any = None  # the handler that `show_log` added


def show_log(level: str) -> None:
    """Show the logger "warpcage" on stderr from a level on; "" shows nothing of it."""
    import logging

    global _shown
    if level and level not in LEVELS:
        raise InputError(f"{LOG_VARIABLE} must be one of {', '.join(LEVELS)}, got {level[:60]!r}")
    log = logging.getLogger(__name__.removesuffix(".core.reports"))  # "warpcage", and another in copies of this module
    if _shown is not None:
        log.removeHandler(_shown)
    _shown = logging.StreamHandler() if level else logging.NullHandler()
    _shown.setFormatter(logging.Formatter("%(name)s: %(message)s"))
    log.addHandler(_shown)
    if level:
        log.setLevel(level.upper())


def start_log() -> None:
    """Show what LOG_VARIABLE asks for, where nothing was asked otherwise."""
    if _shown is None:
        show_log(asked_level())


def asked_level() -> str:
    """The level that LOG_VARIABLE asks for, "" for none."""
    return os.environ.get(LOG_VARIABLE, "").lower()


#: What Warp's native code writes where there is no driver of NVIDIA's, as on every machine without a GPU.
NOTE = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver."

#: Names under which drivers are found.
_DRIVERS = ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so", "libcuda.so.1")

_done = threading.Event()


@contextlib.contextmanager
def without_driver_note() -> Iterator[None]:
    """Leave the line out of standard error that Warp writes as it starts without a CUDA driver; once in a process."""
    # Native code writes to the descriptor: that is led into a file for the moment, of which all other lines come back.
    if _done.is_set() or has_driver():
        yield
        return
    _done.set()
    try:
        kept, held = os.dup(2), tempfile.TemporaryFile()
    except OSError:  # no standard error, or nowhere to keep it
        yield
        return
    try:
        os.dup2(held.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        with held:
            held.seek(0)
            lines = b"".join(line for line in held if not line.startswith(NOTE))
        with contextlib.suppress(OSError):
            os.write(2, lines)


def has_driver() -> bool:
    """Whether there is a driver of NVIDIA's."""
    for name in _DRIVERS:
        with contextlib.suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


#: Called once, before the first module of kernels of this process is compiled. None says nothing.
say: Callable[[], object] | None = None


def told() -> None:
    """Say it, if nobody has."""
    global say
    saying, say = say, None
    if saying is not None:
        saying()
