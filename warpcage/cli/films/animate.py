"""`warpcage animate`: a film, a folder of its frames, or a job file of them."""

from __future__ import annotations

import argparse
import hashlib
import json
import pathlib
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Any

from ...cage.pose_file import PoseFile
from ...core.files import require_file
from ...core.names import TRANSPARENT, counted
from ...core.overlap import BackgroundWriter
from ...core.reports import bar
from ...editor.exports import DEFAULT_SIZE, Film, checked_film_path, export_film
from ...editor.pictures.scene import view_camera
from ...editor.session import read_session
from ...editor.things import read_fields, require_alone
from ...editor.timeline import frame_times
from ...edits.place import PlaceFile
from ...errors import InputError
from ...view.camera import Camera
from ...view.film import FILM_ENDINGS, checked_rate, write_film
from .. import shared
from ..arguments import options
from ..arguments.render import OF_SESSIONS, Default
from ..cameras import check_saved, image_size, save_cameras, warn_of_edges
from ..render import checked_opacity, size_text
from ..shared import Deformation, read_deformation
from ..words import set_frames
from .folder import frame_path, make_folder
from .jobs import FilmJob, checked_jobs_path, film_words, session_job
from .shot import Shot
from .staging import read_things, staging_of
from .workers import FilmWorkers, frame_outputs

#: Stands for the folder of frames that a job file leaves to `warpcage run`.
FRAMES = pathlib.Path("frames")

#: Options that go with --session.
WITH_SESSION = (
    "command field output jobs session transparent background format overlay size scene_scale device quiet verbose"
).split()


def run_animate(args: argparse.Namespace) -> None:
    if args.session is not None:
        _run_session(args)
        return
    given = {name for name in OF_SESSIONS if not isinstance(getattr(args, name), Default)}
    for name in OF_SESSIONS:
        default = getattr(args, name)
        setattr(args, name, default.value if isinstance(default, Default) else default)
    output = FRAMES if args.jobs is not None else _checked_output(args.output)
    jobs = None if args.jobs is None else checked_jobs_path(args.jobs)
    here = jobs is None and args.workers is None
    parts, kind = ({}, "") if here else frame_outputs(output, args.show, args.format)
    _check(args, output)
    device, scaled = args.device, args.show in ("depth", "disparity")  # by a few frames, which are rendered
    if not here and not scaled:
        args.device = "cpu"
    if not here and (args.add or shared.is_stage(args.field)):
        raise InputError("--workers and --jobs render a field alone: leave them out where several things are shown")
    field, stage = read_things(args)
    if args.show == "masks":
        shared.require_voxels(field, "--show masks")
    args.timed, args.film_rate = not given & {"motion", "interpolation"}, args.fps if "fps" in given else None
    shared.require_fillable(args, field)
    deformation = read_deformation(args, field, args.interpolation)
    staging = staging_of(args, field, stage, args.interpolation)
    timed: PoseFile | PlaceFile | None = None if deformation is None else deformation.film
    if staging is not None and (timed is not None or deformation is None):  # poses without times keep to --frames
        timed = staging.longest(timed)
    if set_frames(args, timed, given) is None:
        timed = None
    shot = Shot(field, deformation, args, timed, staging)
    cameras = shot.cameras
    warn_of_edges(args, cameras[0], deformation)
    shared.set_lattice(args, cameras[0])
    if here or scaled:
        shot.prepare()

    save_cameras(args, cameras, args.fps)
    if here:
        _render(shot, output)
        return
    words = film_words(args, scale=shot.scale, deformed=deformation is not None) | {"outputs": parts}
    rate = {"frames": args.frames, "fps": str(args.fps)}
    job = FilmJob(args.field, words, [] if deformation is None else deformation.edits, {"film": rate})
    if jobs is not None:
        _say_jobs(jobs, job.write(jobs, shot.described()), cameras[0])
        return
    settings = _settings(args, cameras, deformation) | {"format": kind}
    options = {"workers": args.workers, "device": device, "quiet": args.quiet, "overwrite": bool(args.overwrite)}
    team = FilmWorkers(job, list(shot.described()), settings, **options)
    kept = 0
    if output.suffix:
        team.make_film(output, args.fps, loop=args.loop != "once")
    else:
        kept = team.make_frames(output)
    _say(shot, output, kept)


def _check(args: argparse.Namespace, output: pathlib.Path) -> None:
    """Raises ValueError for options that do not go together, before any long work."""
    if args.jobs is not None and args.workers is not None:
        raise InputError("--workers does not go with --jobs: give it to warpcage run")
    check_saved(args)
    if checked_opacity(args, output) and args.show != "rgb":
        raise InputError(f"--show {args.show} has no opacity: leave out --background transparent")
    if args.format == "exr" and args.show != "rgb":
        raise InputError("--format exr holds colours, opacity and depth together: leave out --show")
    if output.suffix:
        checked_rate(args.fps, output.suffix.lower())
    if args.overlay:
        shared.require_deformation(args, "--overlay")
    if args.show == "masks":
        shared.require_deformation(args, "--show masks")
    if args.shutter is not None and (args.jobs is not None or args.workers is not None):
        raise InputError("--shutter blurs frames that are rendered here: leave out --jobs and --workers")
    if args.shutter is not None and args.show != "rgb":
        raise InputError(f"--shutter blurs colours: leave it out, or --show {args.show}")


def _render(shot: Shot, output: pathlib.Path) -> None:
    """Render the film or the folder here."""
    args, cameras, kept = shot.args, shot.cameras, 0

    def make(missing: list[int], begin: Callable[[], None]) -> None:
        with _told(args, missing) as frames, BackgroundWriter() as beside:
            for index in frames:
                task = shot.task(index, frame_path(output, index, settings["format"]))
                if index == missing[0]:
                    begin()
                beside.run(*task)
                del task  # what is rendered next may take its place

    if output.suffix:
        with _told(args, range(args.frames)) as frames:
            write_film(output, map(shot.picture, frames), args.fps, loop=args.loop != "once")
    else:
        settings = _settings(args, cameras, shot.deformation)
        if shot.staging is not None:
            settings["things"] = shot.staging.fingerprints()
        kept = make_folder(output, cameras, make, settings, overwrite=bool(args.overwrite))
    _say(shot, output, kept)
    shot.warn()


def _told(args: argparse.Namespace, numbers: Sequence[int]) -> Any:
    """Numbers of frames with a bar, which ends before an error is said."""
    done = args.frames - len(numbers)
    return bar(args.frames, "animate", done=done, shown=not args.quiet, iterable=numbers)


def _say(shot: Shot, output: pathlib.Path, kept: int) -> None:
    """Say what was written, a film or a folder in which some frames were kept."""
    args, cameras = shot.args, shot.cameras
    if not output.suffix:
        print(f"wrote {output}: {counted(args.frames - kept, 'frame')}, {kept} were there already")
        return
    size = size_text(cameras[0].width, cameras[0].height, output)
    print(f"wrote {output}: {counted(args.frames, 'frame')} of {size}, {output.stat().st_size / 1e6:.2f} MB")
    if shot.is_still():
        print(f"warpcage: nothing moves in this film: its {args.frames} frames are equal", file=sys.stderr)


def _say_jobs(path: pathlib.Path, count: int, camera: Camera) -> None:
    make = shlex.join(["warpcage", "run", str(path), "-o", "frames"])
    print(f"wrote {path}: {counted(count, 'frame')} of {camera.width}x{camera.height}, made by: {make}")


def _run_session(args: argparse.Namespace) -> None:
    """The film of a session of the editor."""
    if args.workers is not None:
        raise InputError("--workers does not go with --session: write its --jobs, and give them to warpcage run")
    if given := _given_besides(args):
        raise InputError(f"--session cannot be combined with --{given[0].replace('_', '-')}: the session decides that")
    jobs = None if args.jobs is None else checked_jobs_path(args.jobs)
    output = FRAMES if jobs is not None else checked_film_path(args.output)
    options.check_parent(output)
    require_file(args.session, "session file")  # before a field is read, which takes a while
    width, height = image_size(args) or DEFAULT_SIZE
    if args.format is not None:
        raise InputError("--session writes PNG files into a folder: leave --format out")
    transparent = checked_opacity(args, output)
    if args.background is not None and not transparent:
        raise InputError("--session cannot be combined with --background: the session decides that")
    film = Film(width, height, args.overlay, transparent)
    if jobs is not None:
        args.device = "cpu"  # nothing is rendered
    field = shared.require_voxels(shared.read_field(args), "--session")
    document = read_session(args.session, field)
    fields = read_fields(document, field, pathlib.Path(args.session).resolve().parent)
    if jobs is not None:
        require_alone(document, "--jobs")
        job, frames = session_job(document, field, film, args.field, args.scene_scale)
        _say_jobs(jobs, job.write(jobs, frames), view_camera(document.view, width, height))
        return

    with bar(len(frame_times(document.timeline)), "animate", shown=not args.quiet) as shown:

        def report(share: float | None, text: str) -> None:
            shown.update(round((share or 0.0) * shown.total) - shown.n)

        count = export_film(document, fields, output, film, report)
    print(f"wrote {output}: {counted(count, 'frame')} of {size_text(width, height, output)}")
    if len(document.timeline.keys) < 2 and count > 1:
        print(
            f"warpcage: nothing moves in this film: its {count} frames are equal, as the session has no two keys (K "
            "keeps one in the editor)",
            file=sys.stderr,
        )


def _given_besides(args: argparse.Namespace) -> list[str]:
    """The options that were given and do not go with --session."""
    values = {name: value for name, value in vars(args).items() if name not in WITH_SESSION}
    return [
        name
        for name, value in values.items()
        if (not isinstance(value, Default) if name in OF_SESSIONS else value is not None)
    ]


def _checked_output(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.suffix:
        return options.check_output(text, FILM_ENDINGS, "film (a folder has no ending)")
    if path.exists() and not path.is_dir():
        raise InputError(f"film {text!r} is a file without an ending: give {', '.join(FILM_ENDINGS)} or a folder")
    options.check_parent(path)
    return path


def _settings(args: argparse.Namespace, cameras: list[Camera], deformation: Deformation | None) -> dict:
    """All that decides how frames look, so that a folder never mixes two films."""
    names = (
        "frames motion interpolation turn show overlay coordinates resolution "
        "density map antialias fill cage_up scene_scale"
    )
    settings = {name: getattr(args, name) for name in names.split()}
    settings["background"] = TRANSPARENT if shared.is_transparent(args) else args.background
    settings["format"] = args.format or "png"
    settings |= {} if args.shutter is None else {"shutter": args.shutter}
    settings["loop"], settings["fps"] = args.loop, None if args.loop is None else str(args.fps)
    settings["size"] = [cameras[0].width, cameras[0].height]
    settings["camera"] = hashlib.sha256(b"".join(camera.camera_to_world.tobytes() for camera in cameras)).hexdigest()
    settings["field"] = hashlib.sha256(pathlib.Path(args.field).read_bytes()).hexdigest()
    settings |= {"cage": [], "posed": []} if deformation is None else deformation.fingerprints()
    return json.loads(json.dumps(settings))  # tuples as lists, as they come back from the file
