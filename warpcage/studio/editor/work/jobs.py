"""Jobs: work that takes a while, beside the session, with progress that can be cancelled."""

from __future__ import annotations

import collections
import dataclasses
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from ....core.names import error_line
from ....errors import InputError
from .uploads import shown

#: Jobs that are kept, finished ones included, and jobs that may wait or run at once.
MAX_JOBS, MAX_UNFINISHED = 40, 12

#: Letters of a failed job's line, and of what a job says of its progress.
MAX_TEXT = 400

_log = logging.getLogger(__name__)


class Cancelled(Exception):
    """Raised inside a job's work, at its next sign of progress, once the job was cancelled."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a job leaves: a line, and the address of the file that it wrote, if any."""

    text: str | None = None
    download: str | None = None


@dataclasses.dataclass(frozen=True)
class Job:
    """A job as pages see it."""

    id: int  # that no other job of the session has had
    name: str
    share: float | None = None  # how much of it is done, 0 to 1; None is not known
    text: str = ""  # what is done right now
    state: str = "running"  # "running" (or waiting for others of its kind), "done", "failed" or "cancelled"
    download: str | None = None  # address of the file that came of it
    result: str | None = None  # what came of it or went wrong, in one line


class Progress:
    """What a job's work calls between its steps; `report` takes share and text of what has changed."""

    def __init__(self, report: Callable[[float | None, str], None]):
        self._report = report
        self._cancelled = threading.Event()

    def __call__(self, share: float | None, text: str = "") -> None:
        """Say how far the work is, 0 to 1 (None is not known), and what is done next; raises Cancelled if the job was.
        Work lets it pass, after it has removed what is half written."""
        if self._cancelled.is_set():
            raise Cancelled
        self._report(None if share is None else min(max(float(share), 0.0), 1.0), text[:MAX_TEXT])

    def cancel(self) -> None:
        """Make the next call raise."""
        self._cancelled.set()

    @property
    def cancelled(self) -> bool:
        """Whether the job was cancelled."""
        return self._cancelled.is_set()


#: What a job does.
Work = Callable[[Progress], Outcome | None]


class Jobs:
    """Jobs of a session, one at a time of each kind. All methods may be called from any thread.
    `listener` is called after each change, from the thread that made it."""

    def __init__(self, listener: Callable[[], None] = lambda: None):
        self._listener = listener
        self._lock = threading.Lock()
        self._jobs: dict[int, Job] = {}
        self._progress: dict[int, Progress] = {}  # of jobs that are not finished
        self._waiting: dict[str, collections.deque[tuple[int, Work]]] = {}  # by kind, while it has a thread
        self._threads: list[threading.Thread] = []
        self._next, self._closed = 1, False

    def start(self, name: str, kind: str, work: Work) -> int:
        """Begin a job in a thread, or let it wait for those of its kind that came before; returns its number."""
        with self._lock:
            if self._closed:
                raise InputError("the session is closing: nothing new is begun")
            if len(self._progress) >= MAX_UNFINISHED:
                raise InputError(f"{MAX_UNFINISHED} jobs are unfinished already: cancel one, or wait")
            number = self._add(name)
            self._progress[number] = Progress(lambda share, text: self._change(number, share=share, text=text))
            if kind in self._waiting:
                self._jobs[number] = dataclasses.replace(self._jobs[number], text="waits for the one before")
                self._waiting[kind].append((number, work))
            else:
                self._waiting[kind] = collections.deque([(number, work)])
                thread = threading.Thread(target=self._run_kind, args=(kind,), name=f"warpcage {kind}", daemon=True)
                self._threads = [one for one in self._threads if one.is_alive()] + [thread]
                thread.start()
        self._notify()
        return number

    def add(self, name: str, outcome: Outcome) -> int:
        """Note work that is done already; returns its number."""
        with self._lock:
            number = self._add(name, state="done", share=1.0, result=outcome.text, download=outcome.download)
        self._notify()
        return number

    def section(self) -> list[dict[str, Any]]:
        """The jobs as pages see them, the oldest first: dictionaries of the fields of Job."""
        with self._lock:
            return [dataclasses.asdict(job) for job in self._jobs.values()]

    def job(self, number: int) -> Job:
        """A job by its number. Raises ValueError where there is none."""
        with self._lock:
            return self._job(number)

    def cancel(self, number: int) -> None:
        """Ask a job to stop: one that waits does at once, one that runs at its next sign of progress."""
        with self._lock:
            job = self._job(number)
            if number not in self._progress:
                return
            self._progress[number].cancel()
            for queue in self._waiting.values():
                for entry in [entry for entry in queue if entry[0] == number]:
                    queue.remove(entry)
                    self._finish(number, state="cancelled", text="")
                    break
            if number in self._progress:
                self._jobs[number] = dataclasses.replace(job, text="is being cancelled")
        self._notify()

    def clear(self, number: int) -> None:
        """Forget a finished job."""
        with self._lock:
            if self._job(number).state == "running":
                raise InputError("the job is still running: cancel it first")
            del self._jobs[number]
        self._notify()

    def close(self, timeout: float = 10.0) -> bool:
        """Cancel all jobs, begin none, and wait so many seconds for their threads; returns whether all have ended."""
        with self._lock:
            self._closed = True
            numbers = list(self._progress)
        for number in numbers:
            self.cancel(number)
        return self.wait(timeout)

    def wait(self, timeout: float) -> bool:
        """Wait, so many seconds at most, until no job is left to run; returns whether all threads have ended."""
        end = time.monotonic() + timeout
        with self._lock:
            threads = list(self._threads)
        for thread in threads:
            thread.join(max(0.0, end - time.monotonic()))
        return not any(thread.is_alive() for thread in threads)

    def _add(self, name: str, **state: Any) -> int:
        """Put a job into the list, in the place of the oldest finished ones where there are many. Needs the lock."""
        number = self._next
        self._next += 1
        for old in [old for old in self._jobs if old not in self._progress][: max(0, len(self._jobs) + 1 - MAX_JOBS)]:
            del self._jobs[old]
        self._jobs[number] = Job(number, name, **state)
        return number

    def _job(self, number: int) -> Job:
        if number not in self._jobs:
            raise InputError(f"there is no job {number!r}: it may have been cleared")
        return self._jobs[number]

    def _run_kind(self, kind: str) -> None:
        """Run the jobs of a kind until none is left."""
        while True:
            with self._lock:
                queue = self._waiting[kind]
                if not queue:
                    del self._waiting[kind]
                    return
                number, work = queue.popleft()
                progress = self._progress[number]
                self._jobs[number] = dataclasses.replace(self._jobs[number], text="")
            self._run(number, work, progress)

    def _run(self, number: int, work: Work, progress: Progress) -> None:
        try:
            outcome = work(progress) or Outcome()
            changes = {"state": "done", "share": 1.0, "result": outcome.text, "download": outcome.download}
        except Cancelled:
            changes = {"state": "cancelled"}
        except (ValueError, OSError, MemoryError) as error:  # what a person's input or machine can cause
            changes = {"state": "failed", "result": shown(error_line(error, MAX_TEXT))}
        except BaseException as error:  # also what calls itself an exit: it would be lost in a thread
            _log.exception("job %s failed", number)
            changes = {"state": "failed", "result": shown(error_line(error, MAX_TEXT, named=True))}
        with self._lock:
            self._finish(number, text="", **changes)
        self._notify()

    def _finish(self, number: int, **changes: Any) -> None:
        """Note how a job ended. Needs the lock."""
        del self._progress[number]
        self._jobs[number] = dataclasses.replace(self._jobs[number], **changes)

    def _change(self, number: int, share: float | None, text: str) -> None:
        """Note how far a job is, and report it where a page would show the difference."""
        with self._lock:
            before = self._jobs[number]
            self._jobs[number] = dataclasses.replace(before, share=share, text=text)
        if text != before.text or _percent(share) != _percent(before.share):
            self._notify()

    def _notify(self) -> None:
        try:
            self._listener()
        except Exception:  # the work goes on whether or not it is shown
            _log.exception("a listener of jobs failed")


def _percent(share: float | None) -> int | None:
    return None if share is None else int(100 * share)
