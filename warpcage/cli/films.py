"""Films: as jobs of a command or a session, over several workers, and folders of frames that are continued."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import itertools
import json
import os
import pathlib
import re
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from fractions import Fraction
from typing import IO, Any

import numpy as np

from .. import __version__
from ..batch.items import ID
from ..batch.job_file import write_jobs
from ..batch.run import RunProgress, RunReport, run_jobs
from ..cage.pose_file import PoseFile
from ..core.files import PathLike, atomic_path, require_file
from ..core.names import FRAGMENTS_WORD, TRANSPARENT, counted
from ..core.reports import bar, say_above_bar
from ..deform.deformer import Deformer
from ..deform.stage import Stage
from ..editor.document import Document
from ..editor.exports import Film
from ..editor.renderer import view_camera
from ..editor.timeline import document_at, frame_rate, frame_times
from ..edits.edits import CageEdit
from ..edits.place import Place, PlaceFile
from ..errors import InputError, StateError
from ..field.voxel_field import VoxelField
from ..splats.io import splat_path
from ..splats.splat_field import load_field
from ..view.camera import Camera, CameraKey, camera_json
from ..view.exr import read_exr
from ..view.film import CLEAR_ENDINGS, read_film_frame, write_film
from ..view.pictures import read_image
from . import shared
from .arguments import options
from .words import parse_add

#: Endings of job files.
JOB_ENDINGS = (".jsonl", ".json")


@dataclasses.dataclass(frozen=True)
class FilmFrame:
    """A frame of a film."""

    index: int
    camera: Camera
    poses: Sequence[np.ndarray | None] = ()  # of each edit the posed vertices, (v, 3) world units; None: it removes

    @property
    def name(self) -> str:
        """The id of its item, and the name of its picture without an ending."""
        return f"frame_{self.index:04d}"


@dataclasses.dataclass(frozen=True)
class FilmJob:
    """What all frames of a film share."""

    field: PathLike
    words: dict[str, Any]  # of items, for all frames: how they are rendered, and "outputs"
    edits: Sequence[CageEdit] = ()
    extra: Any = None  # any JSON, kept in the header of the job file

    def write(self, path: PathLike, frames: Iterable[FilmFrame]) -> int:
        """Write the job file, and beside it arrays of each cage at rest, its faces and poses; returns how many frames.
        They are taken one by one, equal poses are written once; a field in the job's folder is named from there."""
        path = pathlib.Path(path)
        with contextlib.ExitStack() as files:  # arrays take their places after the job file, or not at all
            cages = [
                _EditArrays(edit, path.with_name(f"{path.stem}{number}"), files)
                for edit, number in zip(self.edits, _numbers(len(self.edits)), strict=True)
            ]
            usual = {"kind": "frame", "field": _reference(self.field, path.parent), **self.words}
            alone = len(cages) == 1
            defaults = usual | (cages[0].words if alone else {})

            def items() -> Iterator[dict[str, Any]]:
                for frame in frames:
                    posed = [cage.posed(pose) for cage, pose in zip(cages, frame.poses, strict=True)]
                    edits = {"edits": [cage.words | pose for cage, pose in zip(cages, posed, strict=True)]}
                    yield {
                        "id": frame.name,
                        **((posed[0] if alone else edits) if posed else {}),
                        "camera": camera_json(CameraKey(frame.camera)),
                        "extra": {"frame": frame.index},
                    }
                for cage in cages:
                    cage.close()

            return write_jobs(path, items(), defaults=defaults, extra=self.extra)


def film_words(args: argparse.Namespace, *, scale: tuple[float, float] | None, deformed: bool) -> dict[str, Any]:
    """The words of items for the options of `warpcage animate`, but "outputs"; the lattice of `args` is chosen already.
    scale: low and high disparity of pictures of depth and disparity."""
    if args.overlay and args.show != "rgb":
        raise InputError(f"items of jobs draw cages into colours alone: leave out --overlay, or --show {args.show}")
    words: dict[str, Any] = {
        "background": TRANSPARENT if shared.is_transparent(args) else args.background,
        "antialias": args.antialias,
        "disparity_scale": scale,
        "scene_scale": None if args.scene_scale == 1.0 else args.scene_scale,
    }
    if deformed:
        cells = shared.lattice_cells(args)
        words |= {
            "coordinates": args.coordinates,
            "resolution": "precise" if cells is None else cells,
            "density": args.density,
            "map": args.map,
            "fill": args.fill or None,
            "overlay": args.overlay or None,
        }
    return {name: value for name, value in words.items() if value is not None}


def checked_jobs_path(text: str) -> pathlib.Path:
    """The path of a job file, once it is clear that one can be written there. Raises ValueError otherwise."""
    return options.check_output(text, JOB_ENDINGS, "job file")


def _numbers(count: int) -> list[str]:
    return [""] if count == 1 else [f".{number}" for number in range(1, count + 1)]


def _reference(file: PathLike, folder: pathlib.Path) -> str:
    """A file as a job file in a folder names it: both can be moved together where one is below the other."""
    path, base = (pathlib.Path(os.path.abspath(each)) for each in (file, folder))
    return str(path.relative_to(base)) if path.is_relative_to(base) else str(path)


class _EditArrays:
    """The arrays of an edit: its cage at rest, and its poses, each of which is written once."""

    def __init__(self, edit: CageEdit, stem: pathlib.Path, files: contextlib.ExitStack):
        rest, faces, poses = (stem.with_name(f"{stem.name}.{part}.npy") for part in ("rest", "faces", "poses"))
        for path, array in ((rest, edit.cage.vertices), (faces, edit.cage.faces)):
            np.save(files.enter_context(atomic_path(path)), array, allow_pickle=False)
        self._poses = poses.name
        self._rows = None if edit.remove else _Rows(files.enter_context(atomic_path(poses)), edit.cage.vertices.shape)
        if self._rows is not None:
            files.callback(self._rows.close)
        self._known: dict[bytes, int] = {}
        self.words = {"cage": {"vertices": rest.name, "faces": faces.name}} | _edit_words(edit)

    def posed(self, vertices: np.ndarray | None) -> dict[str, str]:
        """The words of a pose."""
        if self._rows is None:
            return {}
        assert vertices is not None
        row = np.ascontiguousarray(vertices, np.float64)
        key = hashlib.blake2b(row.tobytes(), digest_size=16).digest()
        if key not in self._known:
            self._known[key] = self._rows.append(row)
        return {"posed": f"{self._poses}#{self._known[key]}"}

    def close(self) -> None:
        """Finish the file of poses."""
        if self._rows is not None:
            self._rows.close()


def _edit_words(edit: CageEdit) -> dict[str, Any]:
    """The words of an edit besides its cage and its pose, those that say nothing left out."""
    walls = edit.held if isinstance(edit.held, str) else list(edit.held)
    fading = {} if edit.remove or not edit.falloff else {"falloff": edit.falloff, "held": walls}
    words = {"keep": edit.keep_source, "remove": edit.remove, FRAGMENTS_WORD: edit.fragments, **fading}
    return {name: value for name, value in words.items() if value and value != "cut"}


class _Rows:
    """An .npy file of float64 that grows by a row at a time; its header is written again at the end."""

    def __init__(self, path: pathlib.Path, shape: tuple[int, ...]):
        self._shape, self._count = shape, 0
        self._file: IO[bytes] = path.open("r+b")
        self._start = self._write_header()

    def append(self, row: np.ndarray) -> int:
        """Write a row. Returns its number."""
        self._file.write(row.tobytes())
        self._count += 1
        return self._count - 1

    def close(self) -> None:
        """Say in the header how many rows there are."""
        if self._file.closed:
            return
        with self._file:
            self._file.seek(0)
            if self._write_header() != self._start:
                raise StateError("NumPy wrote a header of another length")

    def _write_header(self) -> int:
        # with room for the digits of a first axis that grows
        header = {"descr": "<f8", "fortran_order": False, "shape": (self._count, *self._shape)}
        np.lib.format.write_array_header_1_0(self._file, header)
        return self._file.tell()


#: Folder in that of the frames in which workers write; a run that is over leaves none.
WORKPLACE = ".run"

#: Seconds between looks for a frame where nobody tells of one.
LOOK_SECONDS = 0.2


class FilmWorkers:
    """Workers that make the frames of a film."""

    def __init__(
        self,
        job: FilmJob,
        frames: Sequence[FilmFrame],
        settings: dict[str, Any],  # all that decides how they look, as JSON has it; "format" is their ending
        *,
        workers: int,
        device: str | None,
        quiet: bool,
        overwrite: bool = False,  # replace frames of another film in the folder
    ):
        self.job, self.frames, self.settings = job, frames, settings
        self.workers, self.device, self.quiet, self.overwrite = workers, device, quiet, overwrite

    @property
    def cameras(self) -> list[Camera]:
        return [frame.camera for frame in self.frames]

    def make_frames(self, folder: pathlib.Path, told: Callable[[], None] = lambda: None) -> int:
        """Make the frames of a folder that are not there yet; returns how many were there.
        told: called now and then, in this thread; what it raises ends the run."""
        _collect(folder / WORKPLACE, folder)  # of a run that was killed

        def make(missing: list[int], begin: Callable[[], None]) -> None:
            begin()
            with tempfile.TemporaryDirectory(prefix="warpcage-") as temporary:
                path = pathlib.Path(temporary) / "film.jsonl"
                self.job.write(path, (self.frames[index] for index in missing))
                try:
                    _require_all(self._run(path, folder / WORKPLACE, len(missing), told))
                finally:
                    _collect(folder / WORKPLACE, folder)

        return make_folder(folder, self.cameras, make, self.settings, overwrite=self.overwrite)

    def make_film(self, output: pathlib.Path, rate: Fraction, *, loop: bool) -> None:
        """Make the frames in a folder beside a film, and the film of them, in order, as they come.
        The folder is removed at the end; after an error or an interrupt it stays, and the next run goes on with it."""
        folder = output.with_name(f".{output.name}.frames")
        self.settings, self.overwrite = self.settings | {"version": __version__}, True  # that folder is ours
        encoder = FilmEncoder(output, rate, loop, [self._places(folder, frame) for frame in self.frames])
        try:
            with encoder:
                self.make_frames(folder, encoder.told)
        except BaseException:
            if made := frame_files(folder):
                print(
                    f"warpcage: {counted(len(made), 'frame')} kept in {folder}: run it again to go on", file=sys.stderr
                )
            raise
        shutil.rmtree(folder)

    def _places(self, folder: pathlib.Path, frame: FilmFrame) -> list[pathlib.Path]:
        """Where a frame may be found once it is whole."""
        place = frame_path(folder, frame.index, self.settings["format"])
        return [place, folder / WORKPLACE / place.name]

    def _run(self, path: pathlib.Path, out: pathlib.Path, missing: int, told: Callable[[], None]) -> RunReport:
        count = len(self.frames)
        with bar(count, "animate", done=count - missing, shown=not self.quiet) as shown:

            def show(state: RunProgress) -> None:
                told()
                if state.stage == "make":
                    shown.update(count - missing + state.kept + state.done + state.failed - shown.n)

            return run_jobs(path, out, workers=self.workers, device=self.device, progress=show, warn=say_above_bar)


def frame_outputs(output: pathlib.Path, show: str, kind: str | None) -> tuple[dict[str, str], str]:
    """The words "outputs" of frames that become a film or a folder, and their ending; kind: --format of a folder."""
    if output.suffix.lower() in CLEAR_ENDINGS:
        if show != "rgb":
            raise InputError(f"--workers makes {output.suffix} films of colours alone: leave out --show, or --workers")
        return {"film": "{id}.npz"}, "npz"  # as many bits as they hold
    return {show: "{id}." + (kind or "png")}, kind or "png"


def _require_all(report: RunReport) -> None:
    if report.failed:
        name, line = next(iter(report.failed.items()))
        more = f" ({counted(len(report.failed), 'frame')} failed)" if len(report.failed) > 1 else ""
        raise StateError(f"{name}: {line}{more}")
    if report.halt is not None:
        raise StateError(report.halt)


def _collect(workplace: pathlib.Path, folder: pathlib.Path) -> None:
    """Put the frames of a run in their places, and remove what else it wrote."""
    for path in frame_files(workplace):
        os.replace(path, folder / path.name)
    shutil.rmtree(workplace, ignore_errors=True)


class FilmEncoder:
    """Writes a film of frames that others write, in another thread (`with`). The block ends when it is written."""

    def __init__(self, output: pathlib.Path, rate: Fraction, loop: bool, places: list[list[pathlib.Path]]):
        self._output, self._rate, self._loop, self._places = output, rate, loop, places
        self._news, self._ended = threading.Event(), threading.Event()
        self._stopped = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._encode, name="warpcage-film")

    def told(self) -> None:
        """There may be frames. Raises the error of the encoder, if it has one."""
        self._news.set()
        if self._error is not None:
            raise self._error

    def __enter__(self) -> FilmEncoder:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._news.set()
                self._ended.wait()
        finally:
            self._stopped = True
            self._news.set()
            self._ended.wait()
        if kind is None and self._error is not None:
            raise self._error

    def _encode(self) -> None:
        try:
            write_film(self._output, self._frames(), self._rate, loop=self._loop)
        except BaseException as error:
            self._error = error
        finally:
            self._ended.set()

    def _frames(self) -> Iterator[np.ndarray]:
        for places in self._places:
            yield self.frame(places)

    def frame(self, places: list[pathlib.Path]) -> np.ndarray:
        """The frame that comes to one of some places, once it is there."""
        while not self._stopped:
            for path in filter(pathlib.Path.exists, places):  # one that comes only now is looked for again
                try:
                    return read_film_frame(path)
                except (FileNotFoundError, ValueError):
                    if path.exists():
                        raise
                    # it was moved just now
            self._news.wait(LOOK_SECONDS)
            self._news.clear()
        raise InterruptedError("the film was given up")


def session_job(
    document: Document, field: VoxelField, film: Film, path: str | os.PathLike[str], scene_scale: float = 1.0
) -> tuple[FilmJob, Iterator[FilmFrame]]:
    """The job of a session's film, and its frames, which are those of `editor.exports.film_pictures`.
    path: the field's file; scene_scale: as the field was loaded."""
    if film.overlay:
        raise InputError("--jobs of a session draws no cages: leave --overlay out")
    settings, rate = document.settings, frame_rate(document.timeline)
    edits = [edit for edit in document.edits if edit.visible]
    words = {
        "background": TRANSPARENT if film.transparent else settings.background,
        "supersampling": settings.supersampling,
        "scene_scale": None if scene_scale == 1.0 else scene_scale,
        "outputs": {"rgb": f"{ID}.png"},
    }
    if edits:
        fills = settings.fill and words["background"] is None and field.background_model is not None
        words |= {
            "coordinates": settings.coordinates,
            "resolution": settings.resolution,
            "density": settings.density,
            "fill": fills or None,
        }
    times = frame_times(document.timeline)

    def frames() -> Iterator[FilmFrame]:
        for index, time in enumerate(times):
            moment = document_at(document, time)
            poses = [None if edit.kind == "remove" else edit.posed for edit in moment.edits if edit.visible]
            yield FilmFrame(index, view_camera(moment.view, film.width, film.height), poses)

    given = {name: value for name, value in words.items() if value is not None}
    extra = {"film": {"frames": len(times), "fps": str(rate)}}
    return FilmJob(path, given, [edit.cage_edit for edit in edits], extra), frames()


#: The note beside the frames that says which film they are of.
SETTINGS_NAME = "animation.json"

#: The last chunk of every PNG file.
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"

#: What frames are called.
FRAME_NAME = re.compile(r"frame_[0-9]{4,}\.(png|exr|npz)")


def make_folder(
    folder: pathlib.Path,
    cameras: list[Camera],
    make: Callable[[list[int], Callable[[], None]], None],
    settings: dict,  # all that decides how frames look, as JSON has it; "format" is their ending
    *,
    overwrite: bool = False,  # replace frames of another film
) -> int:
    """Make the frames of a film that are not there yet, each whole or not at all; returns how many were there.
    make(missing, begin) is called where any is missing, and calls `begin` before it writes the first."""
    foreign = _other_film(folder, settings)
    if foreign and not overwrite:
        raise InputError(
            f"folder {str(folder)!r} holds {foreign}: give another folder, or --overwrite to replace those frames; "
            "with the options of that film it is continued"
        )
    with _nothing_left_without_frames(folder):
        paths = [frame_path(folder, index, settings["format"]) for index in range(len(cameras))]
        pairs = enumerate(zip(paths, cameras, strict=True))
        missing = [index for index, pair in pairs if foreign or not _holds_picture(*pair)]

        def begin() -> None:
            for other in frame_files(folder) if foreign else [paths[index] for index in missing]:
                other.unlink(missing_ok=True)
            with atomic_path(folder / SETTINGS_NAME) as note:  # not before: without frames it binds nobody
                note.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")

        if missing:
            make(missing, begin)
    return len(cameras) - len(missing)


def frame_path(folder: pathlib.Path, index: int, kind: str) -> pathlib.Path:
    """The file of a frame; kind: its ending."""
    return folder / f"frame_{index:04d}.{kind}"


def frame_files(folder: pathlib.Path) -> list[pathlib.Path]:
    """The frames in a folder, in their order; none where there is no such folder."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    return [file for file in files if FRAME_NAME.fullmatch(file.name)]


def _other_film(folder: pathlib.Path, settings: dict) -> str:
    """Whose frames a folder holds, empty where it holds none or those of this film."""
    note = folder / SETTINGS_NAME
    held = _read_note(note) if note.exists() else None
    if not frame_files(folder) or held == settings:
        return ""
    if held is None:
        return f"other frames (no {SETTINGS_NAME} says of which film)"
    names = [name for name in settings if held.get(name) != settings[name]]
    changed = [_difference(name, held.get(name), settings[name]) for name in names]
    return f"frames of another film (other {', '.join(changed) or 'settings'})"


def _read_note(note: pathlib.Path) -> dict:
    """What a note says. Raises ValueError for a file of that name that is none: it is not ours to replace."""
    try:
        found = json.loads(note.read_text(encoding="utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict) or not {"frames", "field", "camera"} <= found.keys():
        raise InputError(f"{str(note)!r} is no note of frames that warpcage wrote: give another folder")
    return found


def _difference(name: str, there: object, here: object) -> str:
    """A setting that differs, with both values where they are short words or numbers."""
    if all(isinstance(value, str | int | float | None) and len(str(value)) <= 12 for value in (there, here)):
        there, here = ("default" if value is None else value for value in (there, here))
        return f"{name}: {there} there, {here} now"
    return name


@contextlib.contextmanager
def _nothing_left_without_frames(folder: pathlib.Path) -> Iterator[None]:
    """Where the block fails before the folder has a frame, take the note and the folders away that it made."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        yield
    except BaseException:
        if not frame_files(folder):
            with contextlib.suppress(OSError):  # what others put there stays
                (folder / SETTINGS_NAME).unlink(missing_ok=True)
                for each in made:
                    each.rmdir()
        raise


def _holds_picture(path: pathlib.Path, camera: Camera) -> bool:
    """Whether a file is a whole picture from a camera. What was cut, on a full disk or by hand, is rendered again."""
    try:
        return _picture_shape(path) == (camera.height, camera.width)
    except (OSError, ValueError, KeyError):
        return False


def _picture_shape(path: pathlib.Path) -> tuple[int, ...]:
    """Height and width of a frame, all of which is read."""
    if path.suffix == ".exr":
        return read_exr(path)["Z"].shape
    if path.suffix == ".npz":
        return read_film_frame(path).shape[:2]
    with open(path, "rb") as file:
        file.seek(-len(PNG_END), os.SEEK_END)
        if file.read() != PNG_END:  # all pixels may be there before
            raise InputError(f"{path} is cut off")
    return read_image(path).shape[:2]


class Staging:
    """What stands beside a command's field, in one scene: of --add, or of a stage file; with what moves in films."""

    def __init__(
        self, args: argparse.Namespace, field: shared.AnyField, stage: Stage | None, interpolation: str | None = None
    ):
        self.stage = Stage(device=field.device) if stage is None else stage
        self.of_file = stage is not None
        if stage is None:
            self.stage.add(pathlib.Path(args.field).stem, field, path=args.field)
        self.main = next(iter(self.stage.items))
        self.moving: list[tuple[Deformer, shared.Deformation]] = []
        for text in args.add or ():
            path, place, edits = parse_add(text)
            name = free_name(pathlib.Path(path).stem, self.stage.items)
            path = require_file(splat_path(path), "field file")
            thing: Any = load_field(path, device=field.device)
            if edits is not None:
                deformation = shared.edits_of_file(edits, args, interpolation, thing)
                thing = shared.make_deformer(thing, deformation, args).pose(deformation.posed)
                self.moving.append((thing, deformation))
            self.stage.add(name, thing, place=place, path=path)

    def points(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) points around what a picture shows, world units; points: those around the command's own field."""
        seen = [] if self.of_file else [points]
        times = {0.0, *(time for item in self.stage.items.values() for time in item.places.places)}
        for self.stage.time in sorted(times, reverse=True):  # last the first, where pictures are made
            seen.append(self.stage.shown_points)
        return np.concatenate(seen)

    def with_main(self, renderer: shared.AnyField | Deformer) -> Stage:
        """The stage with what renders the command's own field; the things of a stage file stay as they are."""
        if not self.of_file and self.stage[self.main] is not renderer:
            self.stage.replace(self.main, renderer)
        return self.stage

    def at(self, seconds: float) -> None:
        """Move all to a time of the film, but for the command's own field, which its own poses move."""
        self.stage.time = seconds
        for deformer, deformation in self.moving:
            deformer.pose(deformation.at_time(seconds))

    def longest(self, film: PoseFile | None) -> PoseFile | PlaceFile | None:
        """The keys at times, of poses and of places, that last longest; None where there are none."""
        films: list[PoseFile | PlaceFile] = [] if film is None else [film]
        films += [each.film for _, each in self.moving if each.film is not None]
        films += [item.places for item in self.stage.items.values() if item.places.length > 0.0]
        return max(films, key=lambda each: each.length, default=None)

    def fingerprints(self) -> list[Any]:
        """All that decides how the scene looks besides the command's own field and its poses."""
        items = self.stage.items.items()
        paths = [item.path for _, item in items if item.path is not None and item.path.is_file()]
        files = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
        places = [[name, item.places.to_json()] for name, item in items]
        return [places, files, [deformation.fingerprints() for _, deformation in self.moving]]


def read_things(args: argparse.Namespace) -> tuple[shared.AnyField, Stage | None]:
    """The field of a command that may show several things, and the stage where its file is one of a stage."""
    if args.fill and (args.add or shared.is_stage(args.field)):
        raise InputError("--fill is for a field alone: leave it out where several things are shown")
    if not shared.is_stage(args.field):
        return shared.read_field(args), None
    if shared.is_deformed(args):
        raise InputError("the things of a stage file have cages of their own: leave --cage, --edit and --edits out")
    shared.require_field_scale(args)
    stage = Stage.load(args.field, device=shared.chosen_device(args))
    first = next(iter(stage.items.values()))
    args.up = tuple(stage.up) if args.up is None else args.up
    args.straightening = first.field.straightening if first.places.at(0.0) == Place() else None
    return first.field, stage


def staging_of(
    args: argparse.Namespace, field: shared.AnyField, stage: Stage | None, interpolation: str | None = None
) -> Staging | None:
    """What stands beside the field of a command, None where it is alone."""
    several = stage is not None or args.add or getattr(args, "save_stage", None)
    return Staging(args, field, stage, interpolation) if several else None


def free_name(name: str, taken: Collection[str]) -> str:
    """A name that is not taken: the same, or with the first number from 2 that makes it one."""
    names = itertools.chain([name], (f"{name} {number}" for number in itertools.count(2)))
    return next(each for each in names if each not in taken)
