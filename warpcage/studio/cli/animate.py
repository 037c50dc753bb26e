"""`warpcage animate`: a film, a folder of its frames, or a job file of them."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import pathlib
import shlex
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ...cage.pose_file import DEFAULT_RATE, PoseFile
from ...core.files import check_parent, require_file
from ...core.names import TRANSPARENT, counted, listed
from ...core.reports import bar, say
from ...core.spec import options_json, options_of, plain
from ...edits.edits import MAX_CELLS
from ...edits.place import PlaceFile
from ...errors import InputError
from ...field.voxel_field import VoxelField
from ...view import motion
from ...view.camera import Camera
from ..films.document import Document
from ..films.edits import Deformation
from ..films.film import Film
from ..films.folder import checked_film_path
from ..films.render import Look, require_voxels
from ..films.session.exports import DEFAULT_SIZE, export_film, film_shot
from ..films.session.exports import Film as SessionFilm
from ..films.session.scene import read_fields, view_camera
from ..films.session.session_file import read_session
from ..films.session.timeline import document_at, frame_rate, frame_times
from ..films.timeline import MovingScene
from ..films.video import checked_rate
from ..jobs.films import FilmFrame, FilmJob, FilmWorkers, frame_outputs
from ..jobs.items import ID
from ..spec.film import FilmSpec
from . import shared
from .arguments import options
from .cameras import camera_track, image_size, save_cameras, warn_of_edges
from .render import check_target, size_text, warn_of_masks

#: Endings of job files.
JOB_ENDINGS = (".jsonl", ".json")

#: Stands for the folder of frames that a job file leaves to `warpcage run`.
FRAMES = pathlib.Path("frames")

#: Options that go with --session.
WITH_SESSION = (
    "command field output jobs session transparent background format overlay size scene_scale device quiet verbose"
).split()

#: Options that a folder of frames names at their defaults too.
NAMED = (
    "frames motion interpolation turn show overlay coordinates resolution density map antialias fill cage_up "
    "scene_scale background format loop fps"
).split()


def run_animate(args: argparse.Namespace) -> None:
    if args.session is not None:
        return _run_session(args)
    if args.jobs is not None and args.workers is not None:
        raise InputError("--workers does not go with --jobs: give it to warpcage run")
    output, jobs = _targets(args, new=False)
    given = set(options.given(args, *options_of(FilmSpec)))
    here, spec = jobs is None and args.workers is None, shared.shot_of(args)
    parts, kind = ({}, "") if here else frame_outputs(output, spec.show, spec.format)
    if output.suffix:
        checked_rate(spec.fps, output.suffix.lower())
    device, scaled = args.device, spec.show in ("depth", "disparity")  # by a few frames, which are rendered
    if not here and not scaled:
        args.device = "cpu"
    if not here and (args.add or shared.is_stage(args.field)):
        raise InputError("--workers and --jobs render one field: leave them out for a scene of several objects")
    if not here and spec.overlay and spec.show != "rgb":
        raise InputError(f"items of jobs draw cages into colours alone: leave out --overlay, or --show {spec.show}")
    timed = not given & {"motion", "interpolation"}
    reader = shared.edit_reader(args, spec.interpolation, timed=timed, fps=args.fps)
    of_voxels = "--show masks" if spec.show == "masks" else ""
    field, deformation, objects = shared.read_shot(args, reader, of_voxels=of_voxels)
    if not here and getattr(args, "is_moved", False):
        raise InputError(
            "--workers and --jobs render the field as its file has it: write it where its dataset is first, with "
            "warpcage bake --frame"
        )
    keys: PoseFile | PlaceFile | None = deformation.film
    if objects is not None and (keys is not None or not deformation.edits):  # poses without times keep to --frames
        keys = objects.longest(keys)
    spec = _in_time(spec, keys, given)
    scene = MovingScene(field, spec, deformation, keys, objects)
    track = camera_track(args, scene, shared.seen_points(args, field, deformation, objects))
    film = Film(spec.frames, track, scene, Look.of(spec), spec.shutter)
    cameras = film.cameras
    warn_of_edges(args, cameras[0], deformation)
    shared.set_lattice(args, cameras[0])
    spec = dataclasses.replace(spec, resolution=args.resolution)
    if deformation.edits and (here or scaled):
        scene.render_by(shared.make_deformer(field, deformation, args))

    save_cameras(args, cameras, spec.fps)
    needs_settings = jobs is None and not (here and output.suffix)
    settings = _settings(args, spec, cameras, deformation) if needs_settings else {}
    if here:
        return _render(args, spec, film, scene, output, settings)
    keys_of_items = dataclasses.replace(spec, disparity_scale=film.scale).item_keys(deformed=bool(deformation.edits))
    extra = {"film": {"frames": spec.frames, "fps": str(spec.fps)}}
    job = FilmJob(args.field, keys_of_items | {"outputs": parts}, deformation.edits, extra)
    frames = _described(film, scene)
    if jobs is not None:
        return _write_job(jobs, job, frames, cameras[0])
    workers = {"workers": args.workers, "device": device, "quiet": args.quiet, "overwrite": spec.overwrite}
    team = FilmWorkers(job, list(frames), settings | {"format": kind}, **workers)
    kept = 0
    if output.suffix:
        team.make_film(output, spec.fps, loop=spec.loop != "once")
    else:
        kept = team.make_frames(output)
    _print_written(film, scene, output, kept)


def _targets(args: argparse.Namespace, new: bool = True) -> tuple[pathlib.Path, pathlib.Path | None]:
    """Where the film or the folder is written, and its job file, both checked; new: as `checked_film_path` has it."""
    jobs = None if args.jobs is None else options.check_output(args.jobs, JOB_ENDINGS, "job file")
    output = checked_film_path(args.output, new=new) if jobs is None else FRAMES
    check_parent(output)
    check_target(args, output)
    return output, jobs


def _described(film: Film, scene: MovingScene) -> Iterator[FilmFrame]:
    """The frames as items of a job describe them."""

    def poses(frame: float) -> list[np.ndarray | None]:
        return [None if cage is None else cage.vertices for cage in scene.cages(frame)]

    for index, camera in enumerate(film.cameras):
        taken = film.moments(index) if film.shutter is not None else []
        moments = [(moved, poses(frame)) for frame, moved in zip(taken, film.track(taken), strict=True)]
        yield FilmFrame(index, camera, poses(index), moments)


def _in_time(spec: FilmSpec, film: PoseFile | PlaceFile | None, given: set[str]) -> FilmSpec:
    """A spec with number, rate and loop of the frames by the keys of a film; None leaves them as they were asked for.
    given: names of the options given."""
    if film is None:
        if spec.loop is not None:
            raise InputError("--loop is for keys at times (a pose file with times, an animation): see --motion")
        return spec
    if "frames" in given:
        raise InputError("--frames is not for keys at times, the last of which ends the film: use --fps")
    loop = spec.loop or film.loop or "once"
    rate = spec.fps if "fps" in given else motion.frame_rate(DEFAULT_RATE if film.fps is None else film.fps)
    return dataclasses.replace(spec, loop=loop, fps=rate, frames=len(motion.frame_times(film.length, rate, loop)))


def _render(
    args: argparse.Namespace, spec: FilmSpec, film: Film, scene: MovingScene, output: pathlib.Path, settings: dict
) -> None:
    """Render the film or the folder here."""

    def with_bar(numbers: Sequence[int]) -> Any:  # the bar ends before an error is printed
        done = film.count - len(numbers)
        return bar(film.count, "animate", done=done, shown=not args.quiet, iterable=numbers)

    if settings and scene.objects is not None:
        settings |= {"objects": scene.objects.fingerprints()}
    options: dict[str, Any] = {"loop": spec.loop != "once", "overwrite": spec.overwrite}
    kept = film.write(output, spec.fps, settings, **options, reported=with_bar)
    _print_written(film, scene, output, kept)
    warn_of_masks(film.mask_shares, "the film")


def _print_written(film: Film, scene: MovingScene, output: pathlib.Path, kept: int) -> None:
    """Print what was written: a film or a folder in which some frames were kept."""
    if not output.suffix:
        print(f"wrote {output}: {counted(film.count - kept, 'frame')}, {kept} were there already")
        return
    size = size_text(film.cameras[0].width, film.cameras[0].height, output)
    print(f"wrote {output}: {counted(film.count, 'frame')} of {size}, {output.stat().st_size / 1e6:.2f} MB")
    if film.count > 1 and film.stands and scene.is_still():
        say(f"nothing moves in this film: its {film.count} frames are equal")


def _write_job(path: pathlib.Path, job: FilmJob, frames: Iterable[FilmFrame], camera: Camera) -> None:
    """Write the job file of a film, and print how its frames are made."""
    count = job.write(path, frames)
    make = shlex.join(["warpcage", "run", str(path), "-o", "frames"])
    print(f"wrote {path}: {counted(count, 'frame')} of {camera.width}x{camera.height}, made by: {make}")


def _run_session(args: argparse.Namespace) -> None:
    """The film of a session of the editor."""
    if args.workers is not None:
        raise InputError("--workers does not go with --session: write its --jobs, and give them to warpcage run")
    for name, value in vars(args).items():
        if value is not None and name not in WITH_SESSION:
            raise InputError(f"--session cannot be combined with --{name.replace('_', '-')}: the session decides that")
    if args.format is not None:
        raise InputError("--session writes PNG files into a folder: leave --format out")
    output, jobs = _targets(args)
    require_file(args.session, "session file")  # before a field is read, which takes a while
    width, height = image_size(args) or DEFAULT_SIZE
    spec = shared.shot_of(args)
    if spec.background not in (None, TRANSPARENT):
        raise InputError("--session cannot be combined with --background: the session decides that")
    film = SessionFilm(width, height, spec.overlay, spec.background == TRANSPARENT)
    if jobs is not None:
        args.device = "cpu"  # nothing is rendered
    field = require_voxels(shared.read_field(args), "--session")
    document = read_session(args.session, field)
    fields = read_fields(document, field, pathlib.Path(args.session).resolve().parent)
    if jobs is not None:
        if document.is_staged:
            names = listed([one.name for one in document.objects])
            raise InputError(f"--jobs goes with a field in its own place, and this session holds {names}")
        job, frames = _session_job(document, field, film, args.field, spec.scene_scale)
        return _write_job(jobs, job, frames, view_camera(document.view, width, height))

    with bar(len(frame_times(document.timeline)), "animate", shown=not args.quiet) as shown:

        def report(share: float | None, text: str) -> None:
            shown.update(round((share or 0.0) * shown.total) - shown.n)

        count = export_film(document, fields, output, film, report)
    print(f"wrote {output}: {counted(count, 'frame')} of {size_text(width, height, output)}")
    if len(document.timeline.keys) < 2 and count > 1:
        say(
            f"nothing moves in this film: its {count} frames are equal, as the session has no two keys (K "
            "keeps one in the editor)"
        )


def _settings(args: argparse.Namespace, spec: FilmSpec, cameras: list[Camera], deformation: Deformation) -> dict:
    """All that decides how frames look, so that a folder never mixes two films."""
    changed = options_json(dataclasses.replace(spec, overwrite=False))
    named = {name: plain(getattr(spec, name, args.cage_up)) for name in NAMED}
    settings = named | changed | {"format": spec.format or "png"}
    settings |= {"resolution": spec.deformer_options(MAX_CELLS)["resolution"], "fill": spec.fill or None}
    settings |= {"fps": None if spec.loop is None else str(spec.fps)}
    settings["size"] = [cameras[0].width, cameras[0].height]
    settings["camera"] = hashlib.sha256(b"".join(camera.camera_to_world.tobytes() for camera in cameras)).hexdigest()
    settings["field"] = hashlib.sha256(pathlib.Path(args.field).read_bytes()).hexdigest()
    settings |= deformation.fingerprints()
    return json.loads(json.dumps(settings))  # tuples as lists, as they come back from the file


def _session_job(
    document: Document, field: VoxelField, film: SessionFilm, path: str, scene_scale: float
) -> tuple[FilmJob, Iterator[FilmFrame]]:
    """The job of a session's film, and its frames, which are those of `films.session.exports.film_pictures`.
    path: the field's file; scene_scale: as the field was loaded."""
    if film.overlay:
        raise InputError("--jobs of a session draws no cages: leave --overlay out")
    edits = [edit for edit in document.edits if edit.visible]
    shot = dataclasses.replace(film_shot(document, field, film), scene_scale=scene_scale)
    spec = shot.item_keys(deformed=False) | {"outputs": {"rgb": f"{ID}.png"}}  # these first: files stay as they were
    spec |= shot.item_keys(deformed=bool(edits))
    times = frame_times(document.timeline)

    def frames() -> Iterator[FilmFrame]:
        for index, time in enumerate(times):
            moment = document_at(document, time)
            poses = [None if edit.kind == "remove" else edit.posed for edit in moment.edits if edit.visible]
            yield FilmFrame(index, view_camera(moment.view, film.width, film.height), poses)

    extra = {"film": {"frames": len(times), "fps": str(frame_rate(document.timeline))}}
    return FilmJob(path, spec, [edit.cage_edit for edit in edits], extra), frames()
