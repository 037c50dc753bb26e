"""Output beside results: progress of long work, the logger, a line while kernels compile."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import inspect
import os
import sys
import tempfile
import threading
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeAlias, TypeVar

from ..errors import Cancelled, InputError

#: What `progress=` takes beside True and False: a function that is called with how much is done, of how much (0 where
#: that is not known), and what. Work stops where it returns False, or raises.
Progress: TypeAlias = Callable[[int, int, str], object]


class Reporter:
    """What a call reports to: the function that its caller gave, or bars on stderr where that is True."""

    # What the function raised is raised again by each later report and at the end of the call: work that catches
    # errors on its way goes on to the next report at most.
    def __init__(self, progress: bool | Progress):
        self.shows_bars = progress is True
        self._call: Any = _Bars() if progress is True else progress
        self.error: Exception | None = None
        if not callable(self._call):
            raise InputError(f"progress must be True, False or a function, got {type(progress).__name__}")

    def __call__(self, done: int, total: int, message: str) -> None:
        if self.error is None:
            import numpy as np  # `warpcage --help` starts without it

            try:
                answer = self._call(done, total, message)
                if isinstance(answer, bool | np.bool_) and not answer:  # a comparison of NumPy's numbers is no bool
                    of = f" of {total}" if total else ""
                    raise Cancelled(f"{message.partition(':')[0]} was cancelled, {done}{of} done")
            except Exception as error:
                self.error = error
        self.raise_error()

    def raise_error(self) -> None:
        """Raise what the function raised, if it did."""
        if self.error is not None:
            raise self.error from self.error.__cause__

    def close(self) -> None:
        """End the bar that is shown."""
        if self.shows_bars:
            self._call.close()


Decorated = TypeVar("Decorated", bound=Callable[..., Any])


def reports_progress(function: Decorated) -> Decorated:
    """Decorator of a function with an argument `progress`: it gets False, or the Reporter of what the caller gave."""
    default = inspect.signature(function).parameters["progress"].default

    @functools.wraps(function)
    def reporting(*values: Any, **options: Any) -> Any:
        import numpy as np  # as above

        progress = options.get("progress", default)
        if isinstance(progress, np.bool_):
            progress = bool(progress)
        if progress is None or progress is False or isinstance(progress, Reporter):  # the last: of a call around it
            return function(*values, **options | {"progress": progress or False})
        reporter = Reporter(progress)
        try:
            result = function(*values, **options | {"progress": reporter})
        except Exception:
            reporter.raise_error()
            raise
        finally:
            reporter.close()
        reporter.raise_error()
        return result

    return reporting  # pyright: ignore[reportReturnType]


def report_progress(progress: bool | Progress, done: int, total: int, message: str) -> None:
    """Report how far work is, `total` 0 where that is not known, to the `progress` that `reports_progress` gave.
    What changes during the work stands behind a colon: "fit: 31.20 dB"."""
    if not isinstance(progress, bool):
        progress(done, total, message)


def shows_bars(progress: bool | Progress) -> bool:
    """Whether reports are shown as bars on stderr."""
    return isinstance(progress, Reporter) and progress.shows_bars


def bar(total: int | None, what: str, *, done: int = 0, shown: bool = True, stays: bool = True, **options: Any) -> Any:
    """A bar of tqdm on stderr, in logs lines; `total` None or 0 where it is not known.
    stays: whether it is left when it ends; options: more of tqdm's."""
    kind = _bar_kind(sys.stderr.isatty() or "ipykernel" in sys.modules)  # a notebook shows bars, and is no terminal
    options |= {"total": total or None, "initial": done, "desc": what, "disable": not shown, "leave": stays}
    return kind(file=sys.stderr, **options)


def span_text(seconds: float) -> str:
    """Such as "2 h 5 min", of whole units."""
    if seconds < 120:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def say(line: str) -> None:
    """Print a line of the program on stderr."""
    print(f"warpcage: {line}", file=sys.stderr)


def say_above_bar(line: str) -> None:
    """Print a warning on stderr, above a bar that may be shown."""
    from tqdm import tqdm

    tqdm.write(f"warpcage: warning: {line}", file=sys.stderr)


#: Seconds between two lines of a bar in a log.
LOG_SECONDS = 10.0


_NOWHERE: Any = types.SimpleNamespace(write=lambda text: None, flush=lambda: None)


@functools.cache
def _bar_kind(terminal: bool) -> Any:
    """The class of bars on a terminal or elsewhere; tqdm is loaded where one is shown, as it takes a while."""
    from tqdm import tqdm

    class LineBar(tqdm):
        """A bar of logs: a line each 10 s, and one of its last state."""

        def __init__(self, *, file: Any, **options: Any):
            self._log, self._due = file, LOG_SECONDS
            super().__init__(file=_NOWHERE, **options)

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

    def __call__(self, done: int, total: int, message: str) -> None:
        what, _, more = message.partition(": ")
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
    """Show the level of LOG_VARIABLE, where `show_log` was not called."""
    if _shown is None:
        show_log(requested_level())


def requested_level() -> str:
    """The level in LOG_VARIABLE, "" for none."""
    return os.environ.get(LOG_VARIABLE, "").lower()


#: What Warp's native code writes where there is no NVIDIA driver.
NOTE = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver."

#: Names under which drivers are found.
_DRIVERS = ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so", "libcuda.so.1")

_done = threading.Event()


@contextlib.contextmanager
def without_driver_note() -> Iterator[None]:
    """Keep a line off standard error that Warp writes as it starts without a CUDA driver; once in a process."""
    # Native code writes to the descriptor, which is a file for that time; all its other lines are written afterwards.
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
    """Whether there is an NVIDIA driver."""
    for name in _DRIVERS:
        with contextlib.suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


#: Called once, before the first module of kernels of this process is compiled.
on_compiling: Callable[[], object] | None = None


def report_compiling() -> None:
    """Call `on_compiling`, the first time."""
    global on_compiling
    call, on_compiling = on_compiling, None
    if call is not None:
        call()
