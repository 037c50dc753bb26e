"""`warpcage run`: make all that a job file describes."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from ..batch.forecast import Forecast, foresee
from ..batch.manifest import Part
from ..batch.run import Options, RunProgress, RunReport, run_jobs
from ..core.names import counted
from . import inputs

#: Lines about items that failed; the manifest has all.
MOST_LINES = 10


def run(args: argparse.Namespace) -> int:
    inputs.quiet_warp()
    part = None if args.part is None else Part.named(args.part)
    if args.dry_run:
        if part is not None:
            raise ValueError("--dry-run looks at the whole job: leave out --part")
        return _say(foresee(args.jobs, args.output, workers=args.workers or 1, device=args.device))
    Options(args.workers, args.cluster, args.device, args.retries, item_timeout=args.item_timeout)
    with _Bar(args.quiet) as bar:
        report = run_jobs(
            args.jobs,
            args.output,
            workers=args.workers,
            cluster=args.cluster,
            device=args.device,
            retries=args.retries,
            item_timeout=args.item_timeout,
            part=part,
            progress=bar.show,
            warn=bar.warn,
        )
    return _conclude(report, args.output)


class _Bar:
    """The bars of a run: one while items are checked, one while they are made, with throughput and time left."""

    def __init__(self, quiet: bool):
        self._quiet, self._bar, self._stage = quiet, None, ""

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def show(self, state: RunProgress) -> None:
        """Show how far the run is."""
        from tqdm import tqdm

        if state.stage != self._stage:
            if self._bar is not None:
                self._bar.close()
            start = state.kept if state.stage == "make" else 0
            options: dict[str, Any] = {"total": state.total, "initial": start, "unit": " items", "smoothing": 0.1}
            brief = state.stage == "check"  # gone again: most jobs are looked through at once
            self._bar = tqdm(desc=state.stage, disable=self._quiet, leave=not brief, delay=0.5 * brief, **options)
            self._stage = state.stage
        assert self._bar is not None
        if state.failed:
            self._bar.set_postfix(failed=state.failed, refresh=False)
        place = state.checked if state.stage == "check" else state.kept + state.done + state.failed
        self._bar.update(place - self._bar.n)

    def warn(self, line: str) -> None:
        """Print a line above the bar."""
        from tqdm import tqdm

        tqdm.write(f"warpcage: warning: {line}", file=sys.stderr)


def _conclude(report: RunReport, output: str) -> int:
    """Say what came of a run; returns the exit status."""
    rate = f", {report.made / report.seconds:.3g} a second" if report.made and report.seconds else ""
    print(f"wrote {output}: {counted(report.made, 'item')}{rate}, {report.kept} were there already")
    for name, line in list(report.failed.items())[:MOST_LINES]:
        print(f"warpcage: {name}: {line}", file=sys.stderr)
    if len(report.failed) > MOST_LINES:
        more = len(report.failed) - MOST_LINES
        print(f"warpcage: and {more} more, see {output}/manifest.jsonl", file=sys.stderr)
    if report.failed:
        print(f"warpcage: error: {counted(len(report.failed), 'item')} failed", file=sys.stderr)
    if report.halt is not None:
        left = f"{counted(report.left, 'item')} left: the same command makes them once there is room"
        print(f"warpcage: error: {report.halt}; {left}", file=sys.stderr)
    return 0 if report.complete else 1


def _say(forecast: Forecast) -> int:
    """Print what a run would do."""
    print(f"{counted(forecast.total, 'item')}: {forecast.kept} are there already and unchanged")
    made = forecast.total - forecast.kept
    kinds = ", ".join(counted(count, kind) for kind, count in forecast.counts.items())
    notes = [
        f"{count} {what}"
        for count, what in (
            (forecast.changed, "of them changed since they were made"),
            (forecast.failed_before, "of them failed before"),
        )
        if count
    ]
    if made:
        print(
            f"{made} would be made: {kinds}, in {counted(forecast.group_count, 'group')}"
            + "".join(f", {n}" for n in notes)
        )
    for kind, each in forecast.measured.items():
        first = "".join(
            f", and {seconds:.3g} s more for the first of a {what}"
            for seconds, what in ((each.pose_seconds, "pose"), (each.load_seconds, "group"))
            if seconds > 0
        )
        print(f"one {kind} takes {each.seconds:.3g} s{first} (measured: {each.source})")
    if forecast.measured:
        print(f"about {_duration(forecast.seconds)} by {counted(forecast.workers, 'worker')}")
    wrong = forecast.errors | forecast.missing
    for name, line in wrong.items():
        print(f"warpcage: {name}: {line}", file=sys.stderr)
    if forecast.missing_count:
        count = counted(forecast.missing_count, "item")
        print(f"warpcage: error: what {count} would read is not there", file=sys.stderr)
    return 1 if wrong else 0


def _duration(seconds: float) -> str:
    """Such as "2 h 5 min", of whole units."""
    if seconds < 120:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
