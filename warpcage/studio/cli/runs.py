"""`warpcage sweep` and `run`: job files of data sets, and what makes their items."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import pathlib
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...cage.random_poses import RandomPoses
from ...coordinate_kinds import COORDINATE_KINDS, names_where
from ...core.arrays import box_corners
from ...core.names import BACKGROUNDS, TRANSPARENT, counted
from ...core.npz import NpyFile
from ...core.reports import bar, say, say_above_bar, span_text
from ...core.spec import color
from ...core.threads import cpu_threads
from ...errors import InputError
from ...scene.formats.transforms import TransformsCameras
from ...view.camera import Camera, CameraFile, framing_orbit
from ..films.resolve import AssetResolver, RestCage
from ..films.timeline import shown_corners
from ..jobs.manifest import Part
from ..jobs.plan import Forecast, foresee
from ..jobs.run import RunProgress, RunReport, run_jobs
from ..jobs.sweeps import GivenSource, PoseSource, RandomSource, RandomViews, write_sweep
from ..spec.shot import PRECISE
from . import shared
from .arguments import options
from .arguments.runs import DEFAULT_BACKGROUNDS, OWN
from .cameras import (
    DEFAULT_SIZE,
    asset_resolver,
    camera_file,
    file_size,
    fitted_to,
    image_size,
    moved_to_field,
    sized_cameras,
)

#: Lines about items that failed; the manifest has all.
MAX_LINES = 10


def run_run(args: argparse.Namespace) -> int:
    part = None if args.part is None else Part.named(args.part)
    if args.dry_run:
        if part is not None:
            raise InputError("--dry-run looks at the whole job: leave out --part")
        count = args.workers or 1
        return _print_forecast(foresee(args.jobs, args.output, workers=count, cluster=args.cluster, device=args.device))
    given = {name: getattr(args, name) for name in ("workers", "cluster", "device", "retries", "item_timeout")}
    with contextlib.closing(_Bar(args.quiet)) as bar:
        report = run_jobs(args.jobs, args.output, **given, part=part, progress=bar.show, warn=say_above_bar)
    return _conclude(report, args.output)


class _Bar:
    """The bars of a run: one while items are checked, one while they are made, with throughput and time left."""

    def __init__(self, quiet: bool):
        self._quiet, self._bar, self._stage = quiet, None, ""

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def show(self, state: RunProgress) -> None:
        """Show how far the run is."""
        if state.stage != self._stage:
            self.close()
            start = state.kept if state.stage == "make" else 0
            brief = state.stage == "check"  # gone again: most jobs are looked through at once
            options: dict[str, Any] = {"stays": not brief, "delay": 0.5 * brief, "unit": " items", "smoothing": 0.1}
            self._bar = bar(state.total, state.stage, done=start, shown=not self._quiet, **options)
            self._stage = state.stage
        assert self._bar is not None
        if state.failed:
            self._bar.set_postfix(failed=state.failed, refresh=False)
        place = state.checked if state.stage == "check" else state.kept + state.done + state.failed
        self._bar.update(place - self._bar.n)


def _conclude(report: RunReport, output: str) -> int:
    """Say what came of a run; returns the exit status."""
    rate = f", {report.made / report.seconds:.3g} a second" if report.made and report.seconds else ""
    print(f"wrote {output}: {counted(report.made, 'item')}{rate}, {report.kept} were there already")
    for name, line in list(report.failed.items())[:MAX_LINES]:
        say(f"{name}: {line}")
    if len(report.failed) > MAX_LINES:
        more = len(report.failed) - MAX_LINES
        say(f"and {more} more, see {output}/manifest.jsonl")
    if report.failed:
        say(f"error: {counted(len(report.failed), 'item')} failed")
    if report.halt is not None:
        left = f"{counted(report.left, 'item')} left: the same command makes them once there is room"
        say(f"error: {report.halt}; {left}")
    return 0 if report.complete else 1


def _print_forecast(forecast: Forecast) -> int:
    """Print what a run would do."""
    plan = forecast.plan
    print(f"{counted(plan.total, 'item')}: {plan.kept} are there already and unchanged")
    if made := plan.total - plan.kept:
        kinds = ", ".join(counted(count, kind) for kind, count in forecast.counts.items())
        changed = f", {plan.changed} of them changed since they were made" if plan.changed else ""
        failed = f", {plan.failed_before} of them failed before" if plan.failed_before else ""
        print(f"{made} would be made: {kinds}, in {counted(plan.group_count, 'group')}{changed}{failed}")
    for kind, each in forecast.measured.items():
        parts = (("pose", each.pose_seconds), ("group", each.load_seconds))
        first = "".join(f", and {more:.3g} s more for the first of a {part}" for part, more in parts if more > 0)
        print(f"one {kind} takes {each.seconds:.3g} s{first} (measured: {each.source})")
    if forecast.measured:
        print(f"about {span_text(forecast.seconds)} by {counted(forecast.workers, 'worker')}")
    if forecast.unpaid is not None:
        print(forecast.unpaid)
    wrong = forecast.errors | forecast.missing
    for name, line in wrong.items():
        say(f"{name}: {line}")
    if forecast.missing_count:
        count = counted(forecast.missing_count, "item")
        say(f"error: files that {count} would read are missing")
    return 1 if wrong else 0


#: Degrees above the horizon of the cameras of orbit:N.
ELEVATION = 20.0


def run_sweep(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (".jsonl", ".json"), "job file")
    image_size(args)
    background = _background(args)
    _check_arguments(args)
    field = shared.read_field(args)
    resolver = asset_resolver()
    rest = resolver.rest(args.cage, args.cage_up, field, object=args.cage_object)
    sources = _pose_sources(args, rest, resolver)
    shown, up = shown_corners(field), tuple(field.up.tolist())
    given = _given_cameras(args)
    defaults = {
        **shared.shot_of(args).item_keys(deformed=True),
        "background": background,
        "coordinates": None,
        "up": args.cage_up,
        "object": args.cage_object,
        "falloff": args.falloff,
    }
    records = {"kind": args.records, "image": args.image, "depth": args.depth, "alpha": args.alpha}
    records |= {"items_per_shard": args.items_per_shard} if args.records == "webdataset" else {}
    made = write_sweep(
        output,
        field=args.field,
        cage=args.cage,
        rest=rest.cage,
        sources=sources,
        cameras=given or (lambda bounds: _made_cameras(args, np.concatenate([shown, bounds]), up)),
        coordinates=args.coordinates,
        views=args.views,
        seed=args.seeds[0],
        records=records,
        defaults={key: value for key, value in defaults.items() if value is not None},
    )
    files = [str(path) for path in (made.poses, made.cameras) if path is not None]
    beside = f"; beside it {', '.join(files)}" if files else ""
    poses = counted(sum(map(len, sources)), "pose")
    print(f"wrote {made.jobs}: {counted(made.items, 'picture')} of {poses}{beside}")
    print(f"warpcage run {made.jobs} -o FOLDER makes them")


@dataclasses.dataclass(frozen=True)
class _RandomWithBar(RandomSource):
    """Random poses, with a bar of how many are drawn."""

    quiet: bool = False

    def rows(self, most: int | None = None) -> Iterator[np.ndarray]:
        count = len(self) if most is None else min(most, len(self))
        yield from bar(count, "poses", shown=not self.quiet, stays=False, iterable=super().rows(most))


def _check_arguments(args: argparse.Namespace) -> None:
    """Refuse what cannot be before anything is loaded."""
    for text in args.poses:
        _random_count(text, "--poses")
    _orbit_numbers(args.cameras)
    if _random_count(args.cameras, "--cameras") is not None and args.views is not None:
        raise InputError("--views chooses among cameras that all poses share: random:N makes N new ones for each pose")
    if len(set(args.seeds)) < len(args.seeds):
        raise InputError(f"--seeds names one twice: {' '.join(map(str, args.seeds))}")
    if args.resolution == PRECISE:
        remedy = f"--resolution precise is for {' and '.join(names_where('is_precise'))}"
        for name in args.coordinates:
            COORDINATE_KINDS[name].require_precise(remedy)


def _background(args: argparse.Namespace) -> str | list[float] | None:
    """What stands behind pictures, as items have it; None is the field's own."""
    given = DEFAULT_BACKGROUNDS[args.image] if args.background is None else args.background
    known = (*BACKGROUNDS, TRANSPARENT, OWN)
    if isinstance(given, str) and given not in known:
        raise InputError(
            f"--background {given!r} is not known: {', '.join(known)}, or three numbers in [0, 1] such as 0.2,0.3,0.4"
        )
    if given == OWN:
        return None
    if given == TRANSPARENT and args.image == "jpg":
        raise InputError("a JPEG has no opacity: take --image png, or another --background")
    color(transparent=True).check(given, "--background")
    return given if isinstance(given, str) else list(given)


def _random_count(text: str, option: str) -> int | None:
    """N of random:N, None for any other text."""
    if not re.match(r"random(:|$)", text):
        return None
    found = re.fullmatch(r"random:(\d{1,9})", text)
    if found is None or int(found[1]) < 1:
        raise InputError(f"{option} {text!r} must be random:N, N at least 1")
    return int(found[1])


def _pose_sources(args: argparse.Namespace, rest: RestCage, resolver: AssetResolver) -> list[PoseSource]:
    """The poses of --poses in their order."""
    up, sources = shared.posed_up(args), []
    arrays = {text for text in args.poses if text.lower().endswith(".npy")}
    files = [text for text in args.poses if _random_count(text, "--poses") is None and text not in arrays]
    rest = resolver.with_ups(rest, files) if up is None else rest
    for text in args.poses:
        count = _random_count(text, "--poses")
        if count is not None:
            options_ = {"stretch": args.stretch, "reach": args.reach, "modes": args.modes}
            drawn = [RandomPoses(rest.cage, seed=seed, **options_) for seed in args.seeds]
            sources += [_RandomWithBar(poses, count, args.write_poses, cpu_threads(), args.quiet) for poses in drawn]
        elif text in arrays:
            sources.append(_array_source(text, rest.cage))
        else:
            cages = resolver.poses(rest, text, up)
            for cage in cages:
                cage.require_usable(f"cage {text!r}")
            sources.append(GivenSource([cage.vertices for cage in cages], text))
    return sources


def _array_source(text: str, rest: Cage) -> GivenSource:
    """The poses of a file of vertices."""
    file = NpyFile(text)
    shape = file.shape if len(file.shape) == 3 else (1, *file.shape)
    if shape[1:] != rest.vertices.shape:
        raise InputError(f"{text} must hold (poses, {len(rest.vertices)}, 3) vertices of the cage, got {file.shape}")
    return GivenSource(file.read().reshape(shape), text)


def _given_cameras(args: argparse.Namespace) -> list[Camera] | None:
    """The cameras of files that --cameras names; None for those that are made."""
    text = args.cameras
    if _orbit_numbers(text) is not None or _random_count(text, "--cameras") is not None:
        return None
    if pathlib.Path(text).name.startswith("transforms") and text.lower().endswith(".json"):
        file = TransformsCameras(text)
        found = [file.camera(str(index), file_size(args)) for index in range(len(file))]
        return [fitted_to(moved_to_field(args, camera), args) for camera in found]
    named = camera_file(text)
    if named is None:
        options.require_folder(text if pathlib.Path(text).exists() else text.rpartition(":")[0] or text)
        return sized_cameras(args, text)
    path, name = named
    cameras = CameraFile.load(path, size=file_size(args))
    chosen = [cameras.named(name)] if name else [key.camera for key in cameras]
    return [fitted_to(camera, args) for camera in chosen]


def _made_cameras(
    args: argparse.Namespace, points: np.ndarray, up: tuple[float, ...]
) -> Sequence[Camera] | RandomViews:
    """The cameras of orbit:N and random:N, which see the bounding box of points (n, 3)."""
    points = box_corners([points.min(axis=0), points.max(axis=0)])
    width, height = image_size(args) or DEFAULT_SIZE
    fov, orbit = args.fov or options.FOV, _orbit_numbers(args.cameras)
    if orbit is None:
        count = _random_count(args.cameras, "--cameras") or 0
        return RandomViews(count, points, args.seeds[0], up, fov, width, height)
    view = {"up": up, "fov_degrees": fov, "width": width, "height": height}
    return framing_orbit(points, orbit[0], elevation_degrees=orbit[1], **view)


def _orbit_numbers(text: str) -> tuple[int, float] | None:
    """Number and elevation of orbit:N[:ELEVATION], None for any other text."""
    if not re.match(r"orbit(:|$)", text):
        return None
    found = re.fullmatch(r"orbit:(\d{1,6})(?::(-?\d+(?:\.\d+)?))?", text)
    elevation = ELEVATION if found is None or found[2] is None else float(found[2])
    if found is None or int(found[1]) < 1 or not -90.0 < elevation < 90.0:
        raise InputError(
            f"--cameras {text!r} must be orbit:N or orbit:N:ELEVATION, N at least 1, the elevation in degrees between "
            "-90 and 90"
        )
    return int(found[1]), elevation
