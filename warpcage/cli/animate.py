"""`warpcage animate`: a film of a pose."""

from __future__ import annotations

import argparse
import hashlib
import json
import pathlib
import shlex

import numpy as np
from numpy.typing import ArrayLike

from ..cage.pose_file import PoseFile
from ..core.files import require_file
from ..core.names import counted
from ..editor.exports import DEFAULT_SIZE, Film, checked_film_path, export_film
from ..editor.renderer import camera
from ..editor.session import read_session
from ..editor.timeline import frame_times
from ..view.camera import Camera
from ..view.camera_path import camera_at, path_cameras
from ..view.film import FILM_ENDINGS, checked_rate, write_film
from ..view.motion import axis_rotation, cameras_along
from . import inputs, options, outputs, view
from .arguments.animate import OF_SESSIONS, Default
from .deformation import Deformation, read_deformation
from .film_jobs import FilmJob, checked_jobs_path, film_words
from .film_keys import set_frames
from .film_workers import FilmWorkers, frame_outputs
from .frame_folder import write_folder
from .session_jobs import session_job
from .shot import Shot

#: Stands for the folder of frames that a job file leaves to `warpcage run`.
FRAMES = pathlib.Path("frames")

#: Options that go with --session.
WITH_SESSION = (
    "command",
    "field",
    "output",
    "jobs",
    "session",
    "transparent",
    "background",
    "format",
    "overlay",
    "size",
    "scene_scale",
    "device",
    "quiet",
    "verbose",
)


def run(args: argparse.Namespace) -> None:
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
    field = inputs.read_field(args)
    if args.show == "masks":
        inputs.require_voxels(field, "--show masks")
    args.timed, args.film_rate = not given & {"motion", "interpolation"}, args.fps if "fps" in given else None
    inputs.require_fillable(args, field)
    deformation = read_deformation(args, field, args.interpolation)
    times = set_frames(args, deformation and deformation.film, given)
    film = None if times is None or deformation is None else deformation.camera_film
    cameras = _chosen_cameras(args, inputs.visible_points(field, deformation, args.frame), film, times or [])
    view.warn_of_edges(args, cameras[0], deformation)
    inputs.set_lattice(args, cameras[0])
    renders = deformation if here or scaled else None
    deformer = None if renders is None else inputs.make_deformer(field, renders, args)
    shot = Shot(field, deformer, deformation, cameras, args, times)

    view.save_cameras(args, cameras, args.fps)
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
        raise ValueError("--workers does not go with --jobs: give it to warpcage run")
    view.check_saved(args)
    if outputs.checked_opacity(args, output) and args.show != "rgb":
        raise ValueError(f"--show {args.show} has no opacity: leave out --background transparent")
    if args.format == "exr" and args.show != "rgb":
        raise ValueError("--format exr holds colours, opacity and depth together: leave out --show")
    if output.suffix:
        checked_rate(args.fps, output.suffix.lower())
    if args.overlay:
        inputs.require_deformation(args, "--overlay")
    if args.show == "masks":
        inputs.require_deformation(args, "--show masks")


def _render(shot: Shot, output: pathlib.Path) -> None:
    """Render the film or the folder here."""
    from tqdm import tqdm

    args, cameras, kept = shot.args, shot.cameras, 0
    with tqdm(range(args.frames), desc="animate", disable=args.quiet) as frames:  # ends before an error is said
        if output.suffix:
            write_film(output, map(shot.picture, frames), args.fps, loop=args.loop != "once")
        else:
            settings = _settings(args, cameras, shot.deformation)
            kept = write_folder(output, frames, cameras, shot.task, settings, overwrite=bool(args.overwrite))
    _say(shot, output, kept)
    shot.warn()


def _say(shot: Shot, output: pathlib.Path, kept: int) -> None:
    """Say what was written, a film or a folder in which some frames were kept."""
    args, cameras = shot.args, shot.cameras
    if not output.suffix:
        print(f"wrote {output}: {counted(args.frames - kept, 'frame')}, {kept} were there already")
        return
    size = outputs.size_text(cameras[0].width, cameras[0].height, output)
    print(f"wrote {output}: {counted(args.frames, 'frame')} of {size}, {output.stat().st_size / 1e6:.2f} MB")


def _say_jobs(path: pathlib.Path, count: int, camera: Camera) -> None:
    make = shlex.join(["warpcage", "run", str(path), "-o", "frames"])
    print(f"wrote {path}: {counted(count, 'frame')} of {camera.width}x{camera.height}, made by: {make}")


def _run_session(args: argparse.Namespace) -> None:
    """The film of a session of the editor."""
    if args.workers is not None:
        raise ValueError("--workers does not go with --session: write its --jobs, and give them to warpcage run")
    if given := _given_besides(args):
        raise ValueError(f"--session cannot be combined with --{given[0].replace('_', '-')}: the session decides that")
    jobs = None if args.jobs is None else checked_jobs_path(args.jobs)
    output = FRAMES if jobs is not None else checked_film_path(args.output)
    options.check_parent(output)
    require_file(args.session, "session file")  # before a field is read, which takes a while
    width, height = view.image_size(args) or DEFAULT_SIZE
    if args.format is not None:
        raise ValueError("--session writes PNG files into a folder: leave --format out")
    transparent = outputs.checked_opacity(args, output)
    if args.background is not None and not transparent:
        raise ValueError("--session cannot be combined with --background: the session decides that")
    film = Film(width, height, args.overlay, transparent)
    if jobs is not None:
        args.device = "cpu"  # nothing is rendered
    field = inputs.require_voxels(inputs.read_field(args), "--session")
    document = read_session(args.session, field)
    if jobs is not None:
        job, frames = session_job(document, field, film, args.field, args.scene_scale)
        _say_jobs(jobs, job.write(jobs, frames), camera(document.view, width, height))
        return

    from tqdm import tqdm

    with tqdm(total=len(frame_times(document.timeline)), desc="animate", disable=args.quiet) as bar:

        def report(share: float | None, text: str) -> None:
            bar.update(round((share or 0.0) * bar.total) - bar.n)

        count = export_film(document, field, output, film, report)
    print(f"wrote {output}: {counted(count, 'frame')} of {outputs.size_text(width, height, output)}")


def _given_besides(args: argparse.Namespace) -> list[str]:
    """The options that were given and do not go with --session."""
    values = {name: value for name, value in vars(args).items() if name not in WITH_SESSION}
    return [
        name
        for name, value in values.items()
        if (not isinstance(value, Default) if name in OF_SESSIONS else value is not None)
    ]


def _chosen_cameras(
    args: argparse.Namespace, points: np.ndarray, film: PoseFile | None, times: list[float]
) -> list[Camera]:
    """One camera per frame; that of the film's keys where no option names another."""
    named = (args.cameras, args.turn, args.camera, args.view, args.eye, args.target)
    if film is not None and all(one is None for one in named):
        return [view.fitted_to(film.camera_at(time), args) for time in times]
    if args.cameras is None:
        camera, pivot = view.chosen_camera(args, points), view.chosen_target(args, points)
        return turned_cameras(camera, pivot, args.up, 360.0 if args.turn is None else args.turn, args.frames)
    if any(given is not None for given in (args.turn, args.camera, args.view, args.frame, args.eye, args.target)):
        raise ValueError("--cameras cannot be combined with --turn, --camera, --view, --frame, --eye or --target")
    if view.camera_file(args.cameras):
        keys = view.camera_keys(args, args.cameras)
        if times and all(key.time is not None for key in keys):
            return [camera_at(keys, time) for time in times]  # of one film with the keys of the poses
        return path_cameras(keys, args.frames)
    return cameras_along(view.sized_cameras(args, args.cameras), args.frames, args.interpolation)


def turned_cameras(camera: Camera, pivot: np.ndarray, up: ArrayLike, degrees: float, count: int) -> list[Camera]:
    """Cameras carried around an axis, `degrees` in all: through pivot (3,), world units, in the direction up (3,)."""
    axis = np.asarray(up, np.float64)
    if np.linalg.norm(axis) == 0:
        raise ValueError("--up must not be 0 0 0")
    axis /= np.linalg.norm(axis)
    # After a full turn the next camera would be the first one again.
    steps = count if degrees % 360 == 0 else max(1, count - 1)
    cameras = []
    for angle in np.radians(degrees) * np.arange(count) / steps:
        turn = np.eye(4)
        turn[:3, :3] = axis_rotation(axis, angle)
        turn[:3, 3] = pivot - turn[:3, :3] @ pivot
        cameras.append(camera.moved(turn))
    return cameras


def _checked_output(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.suffix:
        return options.check_output(text, FILM_ENDINGS, "film (a folder has no ending)")
    if path.exists() and not path.is_dir():
        raise ValueError(f"film {text!r} is a file without an ending: give {', '.join(FILM_ENDINGS)} or a folder")
    options.check_parent(path)
    return path


def _settings(args: argparse.Namespace, cameras: list[Camera], deformation: Deformation | None) -> dict:
    """All that decides how frames look, so that a folder never mixes two films."""
    names = (
        "frames",
        "motion",
        "interpolation",
        "turn",
        "show",
        "overlay",
        "coordinates",
        "resolution",
        "density",
        "map",
        "antialias",
        "fill",
        "cage_up",
        "scene_scale",
    )
    settings = {name: getattr(args, name) for name in names}
    settings["background"] = options.TRANSPARENT if inputs.is_transparent(args) else args.background
    settings["format"] = args.format or "png"
    settings["loop"], settings["fps"] = args.loop, None if args.loop is None else str(args.fps)
    settings["size"] = [cameras[0].width, cameras[0].height]
    settings["camera"] = hashlib.sha256(b"".join(camera.camera_to_world.tobytes() for camera in cameras)).hexdigest()
    settings["field"] = hashlib.sha256(pathlib.Path(args.field).read_bytes()).hexdigest()
    settings |= {"cage": [], "posed": []} if deformation is None else deformation.fingerprints()
    return json.loads(json.dumps(settings))  # tuples as lists, as they come back from the file
