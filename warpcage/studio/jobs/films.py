"""Films that workers make: their frames as items of job files, in a folder, and the film of them as they come."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import os
import pathlib
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from ... import __version__
from ...core.files import PathLike, atomic_path
from ...core.names import counted
from ...core.reports import bar, say_above_bar
from ...edits.edits import CageEdit, edit_spec
from ...errors import InputError, StateError
from ...view.camera import Camera, CameraKey, camera_json
from ..films.folder import frame_files, frame_path, make_folder
from ..films.video import CLEAR_ENDINGS, read_film_frame, write_film
from .job_file import write_jobs
from .run import RunProgress, run_jobs

#: Folder in that of the frames in which workers write; a run that is over leaves none.
WORKPLACE = ".run"

#: The keys of an edit in the order of job files.
EDIT_ORDER = ("cage", "keep", "remove", "fragments", "falloff", "held")

#: Seconds between looks for a frame.
LOOK_SECONDS = 0.05


@dataclasses.dataclass(frozen=True)
class FilmFrame:
    """A frame of a film."""

    index: int
    camera: Camera
    poses: Sequence[np.ndarray | None] = ()  # of each edit the posed vertices, (v, 3) world units; None: it removes
    moments: Sequence[tuple[Camera, Sequence[np.ndarray | None]]] = ()  # of its shutter, each with its poses


@dataclasses.dataclass(frozen=True)
class FilmJob:
    """What all frames of a film share."""

    field: PathLike
    spec: dict[str, Any]  # keys of items for all frames: how they are rendered, and "outputs"
    edits: Sequence[CageEdit] = ()
    extra: Any = None  # any JSON, kept in the header of the job file

    def write(self, path: PathLike, frames: Iterable[FilmFrame]) -> int:
        """Write the job file, and beside it arrays of each cage at rest, its faces and poses; returns how many frames.
        They are taken one by one, equal poses are written once; a field in the job's folder is named from there."""
        path = pathlib.Path(path)
        alone = len(self.edits) == 1
        with contextlib.ExitStack() as files:  # arrays take their places after the job file, or not at all
            cages = [
                _EditArrays(edit, path.with_name(path.stem if alone else f"{path.stem}.{number}"))
                for number, edit in enumerate(self.edits, 1)
            ]
            defaults = {"kind": "frame", "field": _reference(self.field, path.parent), **self.spec}

            def moment(camera: Camera, poses: Sequence[np.ndarray | None]) -> dict[str, Any]:
                posed = [cage.posed(pose).get("posed") for cage, pose in zip(cages, poses, strict=True)]
                return {"camera": camera_json(CameraKey(camera)), **({"posed": posed} if posed else {})}

            def items() -> Iterator[dict[str, Any]]:
                for frame in frames:
                    posed = [cage.posed(pose) for cage, pose in zip(cages, frame.poses, strict=True)]
                    moments = [moment(*each) for each in frame.moments]
                    edits = {"edits": [cage.spec | pose for cage, pose in zip(cages, posed, strict=True)]}
                    yield {
                        "id": f"frame_{frame.index:04d}",
                        **((posed[0] if alone else edits) if posed else {}),
                        "camera": camera_json(CameraKey(frame.camera)),
                        **({"moments": moments} if moments else {}),
                        "extra": {"frame": frame.index},
                    }
                for cage in cages:
                    cage.write(files)

            return write_jobs(path, items(), defaults=defaults | (cages[0].spec if alone else {}), extra=self.extra)


def _reference(file: PathLike, folder: pathlib.Path) -> str:
    """A file as a job file in a folder names it: both can be moved together where one is below the other."""
    path, base = (pathlib.Path(os.path.abspath(each)) for each in (file, folder))
    return str(path.relative_to(base)) if path.is_relative_to(base) else str(path)


class _EditArrays:
    """The arrays of an edit: its cage at rest, and its poses, each once."""

    def __init__(self, edit: CageEdit, stem: pathlib.Path):
        rest, faces, self._poses = (stem.with_name(f"{stem.name}.{part}.npy") for part in ("rest", "faces", "poses"))
        self._arrays = {rest: edit.cage.vertices, faces: edit.cage.face_array}
        self._shape, self._rows = edit.cage.vertices.shape, dict[bytes, int]()  # rows of poses by their bytes
        poses = None if edit.remove else self._poses.name
        spec = edit_spec(edit, {"vertices": rest.name, "faces": faces.name}, poses).rest
        self.spec = {name: spec[name] for name in EDIT_ORDER if name in spec}

    def posed(self, vertices: np.ndarray | None) -> dict[str, str]:
        """The keys of a pose; None: the edit removes."""
        if vertices is None:
            return {}
        row = self._rows.setdefault(np.ascontiguousarray(vertices, np.float64).tobytes(), len(self._rows))
        return {"posed": f"{self._poses.name}#{row}"}

    def write(self, files: contextlib.ExitStack) -> None:
        """Write files that take their places where `files` is closed without an error."""
        poses = np.frombuffer(b"".join(self._rows), np.float64).reshape(-1, *self._shape)
        for path, array in (self._arrays | ({self._poses: poses} if len(poses) else {})).items():
            np.save(files.enter_context(atomic_path(path)), array, allow_pickle=False)


@dataclasses.dataclass
class FilmWorkers:
    """Workers that make the frames of a film."""

    job: FilmJob
    frames: Sequence[FilmFrame]
    settings: dict[str, Any]  # all that decides how they look, as JSON has it; "format" is their ending
    workers: int
    device: str | None
    quiet: bool
    overwrite: bool  # replace frames of another film in the folder

    def make_frames(self, folder: pathlib.Path, report: Callable[[], None] = lambda: None) -> int:
        """Make the frames of a folder that are not there yet; returns how many were there.
        report: called now and then, in this thread; what it raises ends the run."""
        _collect(folder / WORKPLACE, folder)  # of a run that was killed

        def make(missing: list[int], begin: Callable[[], None]) -> None:
            begin()
            with tempfile.TemporaryDirectory(prefix="warpcage-") as temporary:
                path = pathlib.Path(temporary) / "film.jsonl"
                self.job.write(path, (self.frames[index] for index in missing))
                try:
                    self._run(path, folder / WORKPLACE, len(missing), report)
                finally:
                    _collect(folder / WORKPLACE, folder)

        cameras = [frame.camera for frame in self.frames]
        return make_folder(folder, cameras, make, self.settings, overwrite=self.overwrite)

    def make_film(self, output: pathlib.Path, rate: Fraction, *, loop: bool) -> None:
        """Make the frames in a folder beside a film, and the film of them, in order, as they come.
        The folder is removed at the end; after an error or an interrupt it stays, and the next run goes on with it."""
        folder = output.with_name(f".{output.name}.frames")
        self.settings, self.overwrite = self.settings | {"version": __version__}, True  # that folder is ours
        paths = [frame_path(folder, frame.index, self.settings["format"]) for frame in self.frames]
        stop = threading.Event()
        frames = (coming_frame([path, folder / WORKPLACE / path.name], stop) for path in paths)
        with concurrent.futures.ThreadPoolExecutor(1, "warpcage-film") as thread:
            film = thread.submit(write_film, output, frames, rate, loop=loop)
            try:
                self.make_frames(folder, lambda: film.result() if film.done() else None)
                film.result()
            except BaseException:
                if made := frame_files(folder):
                    kept = f"{counted(len(made), 'frame')} kept in {folder}"
                    print(f"warpcage: {kept}: run it again to go on", file=sys.stderr)
                raise
            finally:
                stop.set()
        shutil.rmtree(folder)

    def _run(self, path: pathlib.Path, out: pathlib.Path, missing: int, report: Callable[[], None]) -> None:
        count = len(self.frames)
        with bar(count, "animate", done=count - missing, shown=not self.quiet) as shown:

            def show(state: RunProgress) -> None:
                report()
                if state.stage == "make":
                    shown.update(count - missing + state.kept + state.done + state.failed - shown.n)

            done = run_jobs(path, out, workers=self.workers, device=self.device, progress=show, warn=say_above_bar)
        if done.failed:
            name, line = next(iter(done.failed.items()))
            more = f" ({counted(len(done.failed), 'frame')} failed)" if len(done.failed) > 1 else ""
            raise StateError(f"{name}: {line}{more}")
        if done.halt is not None:
            raise StateError(done.halt)


def frame_outputs(output: pathlib.Path, show: str, kind: str | None) -> tuple[dict[str, str], str]:
    """The key "outputs" of frames that become a film or a folder, and their ending; kind: --format of a folder."""
    if output.suffix.lower() in CLEAR_ENDINGS:
        if show != "rgb":
            raise InputError(f"--workers makes {output.suffix} films of colours alone: leave out --show, or --workers")
        return {"film": "{id}.npz"}, "npz"  # as many bits as they hold
    return {show: "{id}." + (kind or "png")}, kind or "png"


def _collect(workplace: pathlib.Path, folder: pathlib.Path) -> None:
    """Put the frames of a run in their places, and remove what else it wrote."""
    for path in frame_files(workplace):
        os.replace(path, folder / path.name)
    shutil.rmtree(workplace, ignore_errors=True)


def coming_frame(places: list[pathlib.Path], stop: threading.Event) -> np.ndarray:
    """The frame that another process writes to one of some places, once it is there; an error after `stop`."""
    while True:
        for path in filter(pathlib.Path.exists, places):  # one that comes only now is looked for again
            try:
                return read_film_frame(path)
            except (FileNotFoundError, ValueError):
                if path.exists():
                    raise
                # it was moved just now
        if stop.wait(LOOK_SECONDS):
            raise InterruptedError("the film was given up")
