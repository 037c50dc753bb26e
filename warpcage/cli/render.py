"""`warpcage render` and `animate`: pictures, flights, pictures of many poses, films."""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import os
import pathlib
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..cage.pose_file import PoseFile
from ..core.files import require_file
from ..core.names import TRANSPARENT, counted
from ..core.overlap import BackgroundWriter
from ..core.reports import bar
from ..deform.deformer import Deformer
from ..deform.stage import STAGE_ENDING, Stage
from ..editor.exports import DEFAULT_SIZE, Film, checked_film_path, export_film
from ..editor.renderer import view_camera
from ..editor.session import read_session
from ..editor.timeline import frame_times
from ..edits.place import PlaceFile
from ..errors import InputError
from ..mesh.mesh import ClosedMesh
from ..view import frame_parts
from ..view.camera import Camera
from ..view.camera_path import path_cameras
from ..view.exr import mean_picture, require_openexr, write_picture
from ..view.film import FILM_ENDINGS, checked_rate, film_size, require_clear_film, write_film
from ..view.frame import Frame, depth_along_view
from ..view.frame_parts import MASKS, picture
from ..view.motion import cameras_along, frame_places, frame_rate, time_at
from ..view.opacity import rgba_picture
from ..view.pictures import write_png
from . import shared
from .arguments import options
from .arguments.render import OF_SESSIONS, STEPS, Default
from .film_cameras import camera_track
from .films import (
    FilmFrame,
    FilmJob,
    FilmWorkers,
    Staging,
    checked_jobs_path,
    film_words,
    frame_outputs,
    frame_path,
    make_folder,
    read_things,
    session_job,
    staging_of,
)
from .shared import Deformation, read_deformation
from .words import set_frames


def colors(frame: Frame, camera: Camera, cages: Sequence[ClosedMesh], transparent: bool) -> np.ndarray:
    """The colours of a frame, (h, w, 3), or with straight opacity (h, w, 4); the edges of cages are drawn into it."""
    if transparent:
        return rgba_picture(frame, camera, cages)
    return picture(frame, "rgb", camera, cages)


def finished(image: np.ndarray) -> np.ndarray:
    """A picture that nobody changes any more: a film takes it without a copy."""
    image.flags.writeable = False
    return image


def checked_opacity(args: argparse.Namespace, output: pathlib.Path) -> bool:
    """Whether many pictures have opacity. Raises ValueError where their film or folder cannot hold what was asked."""
    if output.suffix and args.format is not None:
        raise InputError("--format is for folders of pictures: the ending of a film says what it is")
    require_format(args.format or "")
    transparent = shared.is_transparent(args)
    if transparent:
        require_clear_film(output)
    return transparent


def require_format(path: str | os.PathLike[str]) -> None:
    """Raises ValueError for an OpenEXR file where its library is not installed, before any long work."""
    if os.fspath(path).lower().endswith("exr"):
        require_openexr()


def picture_task(
    path: str | os.PathLike[str], image: np.ndarray, frame: Frame, camera: Camera
) -> tuple[Callable[[], None], int]:
    """What writes a picture of a frame, .png, or .exr with its depth, in any thread, and the bytes that it holds."""
    # It needs neither the frame any more, nor what that has on a device.
    depth = depth_along_view(frame, camera) if os.fspath(path).lower().endswith(".exr") else None
    return functools.partial(write_picture, path, image, depth), image.nbytes + (0 if depth is None else depth.nbytes)


def size_text(width: int, height: int, output: pathlib.Path) -> str:
    """The size of what is written, in words, and why it is not that of the pictures where it is not."""
    written = film_size(width, height, output.suffix.lower())
    cut = f" (cut from {width}x{height}: an MP4 has even sides)" if written != (width, height) else ""
    return f"{written[0]}x{written[1]}{cut}"


def warn_of_masks(shares: dict[str, float], where: str = "the picture") -> None:
    """Print a line on stderr for each mask that marks anything; where: how the line calls the picture."""
    for name, share in shares.items():
        if share > 0:
            print(f"warpcage: warning: {100 * share:.2f} % of {where} {MASKS[name][1]}", file=sys.stderr)


class Shot:
    """Renders frames by index, so that a folder can be continued anywhere."""

    def __init__(
        self,
        field: shared.AnyField,
        deformation: Deformation | None,  # None where the field is shown as it is
        args: argparse.Namespace,
        film: PoseFile | PlaceFile | None = None,  # keys at times, where there are any
        staging: Staging | None = None,  # what stands beside the field
    ):
        self.staging = staging
        self.field, self.deformation, self.args, self.film = field, deformation, args, film
        self.deformer: Deformer | None = None  # None where the field is shown as it is, or where others render
        keys = None if film is None or deformation is None else deformation.camera_film
        points, time_of = seen_points(field, deformation, args, staging), None if film is None else self.time
        self.track = camera_track(args, field, deformation, points, keys, time_of, self.cages)
        self.cameras = self.track(range(args.frames))  # one a frame
        self.held: float | None = None  # the place that the deformer is posed at
        self.shares: dict[str, list[float]] = {}
        self.scale: tuple[float, float] | None = None  # low and high disparity

    def prepare(self) -> None:
        """Make what renders here."""
        if self.deformation is not None:
            self.deformer = shared.make_deformer(self.field, self.deformation, self.args)
        self.scale = self._scale() if self.args.show in ("depth", "disparity") else None

    def is_still(self) -> bool:
        """Whether several frames are one picture."""
        poses = [camera.camera_to_world for camera in self.cameras]
        if len(poses) < 2 or any(not np.array_equal(pose, poses[0]) for pose in poses):
            return False
        if self.staging is not None and self.staging.longest(None) is not None:
            return False
        if self.deformation is None or self.deformation.is_still:
            return True
        return len({self.place(frame) for frame in range(len(poses))}) == 1

    def time(self, frame: float) -> float:
        """Seconds of a frame, or between two, where there are keys at times."""
        assert self.film is not None
        return time_at(frame, self.film.length, frame_rate(self.args.fps), self.args.loop)

    def place(self, frame: float) -> float:
        """Where the poses are at a frame, or between two: a time, or a place among them."""
        if self.film is not None:
            return self.time(frame)
        count = 1 if self.deformation is None else self.deformation.pose_count
        return float(frame_places(self.args.frames, count, self.args.motion, self.args.interpolation, [frame])[0])

    def cages(self, frame: float) -> list[Cage | None]:
        """The posed cages of a frame, or between two, one an edit; None for what is removed."""
        if self.deformation is None:
            return []
        place = self.place(frame)
        try:
            return self.deformation.at(place) if self.film is None else self.deformation.at_time(place)
        except ValueError as error:
            raise InputError(f"frame {frame:g}, between the poses: {error}") from error

    def frame(self, frame: float, camera: Camera) -> tuple[Frame, list[Cage]]:
        """A frame, or what is between two, and the cages that it shows."""
        if self.deformer is None or self.deformation is None:
            return shared.render_view(self._scene(self.field, frame), camera, self.args), []
        place, cages = self.place(frame), self.cages(frame)
        try:
            if place != self.held:
                self.deformer.pose(cages)
                self.held = place
        except ValueError as error:
            raise InputError(f"frame {frame:g}, between the poses: {error}") from error
        found = shared.render_view(self._scene(self.deformer, frame), camera, self.args)
        return found, self.deformation.drawn(self.deformer.deformed or cages)

    def _scene(self, renderer: shared.AnyField | Deformer, frame: float) -> shared.AnyField | Deformer | Stage:
        """What a frame shows: what renders the field, alone or among others as they are then."""
        if self.staging is None:
            return renderer
        self.staging.at(frame / float(self.args.fps) if self.film is None else self.time(frame))
        return self.staging.with_main(renderer)

    def taken(self, index: int) -> tuple[np.ndarray, Frame, Camera]:
        """What the film shows of a frame, (h, w, 3), (h, w) or, with opacity, (h, w, 4), and the frame itself."""
        camera = self.cameras[index]
        if self.args.shutter is None:
            frame, cages = self.frame(index, camera)
            return self._shown(frame, cages, camera), frame, camera
        share, count = self.args.shutter
        moments = index + share * ((np.arange(count) + 0.5) / count - 0.5)  # the frame is in the middle of them
        pictures, middle = [], None
        for number, (moment, moved) in enumerate(zip(moments, self.track(moments), strict=True)):
            frame, cages = self.frame(float(moment), moved)
            pictures.append(self._shown(frame, cages, moved))
            middle = (frame, moved) if number == count // 2 else middle
        assert middle is not None
        return mean_picture(pictures), *middle

    def picture(self, index: int) -> np.ndarray:
        """What the film shows of a frame; not to be written to."""
        return finished(self.taken(index)[0])

    def task(self, index: int, path: pathlib.Path) -> tuple[Callable[[], None], int]:
        """Render a frame. Returns what writes its picture to a file, in any thread, and the bytes that it holds."""
        return picture_task(path, *self.taken(index))

    def _shown(self, frame: Frame, cages: Sequence[Cage], camera: Camera) -> np.ndarray:
        if self.args.show == "masks":
            for name, share in frame_parts.mask_shares(frame).items():
                self.shares.setdefault(name, []).append(share)
        drawn = cages if self.args.overlay else ()
        if self.args.show == "rgb":
            return colors(frame, camera, drawn, shared.is_transparent(self.args))
        return frame_parts.picture(frame, self.args.show, camera, drawn, self.scale)

    def _scale(self) -> tuple[float, float]:
        """From a few frames, always the same ones, so that a folder that is continued keeps its colours."""
        probes = sorted({round(share * (self.args.frames - 1)) for share in (0.0, 0.25, 0.5, 0.75)})
        return frame_parts.disparity_scale([self.frame(index, self.cameras[index])[0] for index in probes])

    def described(self) -> Iterator[FilmFrame]:
        """The frames as items of a job describe them."""
        for index, camera in enumerate(self.cameras):
            yield FilmFrame(index, camera, [None if cage is None else cage.vertices for cage in self.cages(index)])

    def warn(self) -> None:
        """Print what the masks marked on average, if they were asked for."""
        warn_of_masks({name: sum(shares) / len(shares) for name, shares in self.shares.items()}, "the film")


#: Frames per second of films.
VIDEO_RATE, GIF_RATE = 24, 15

#: Options for one picture, of any number of poses and of any number of cameras.
SINGLE_POSE = ("disparity", "depth", "alpha", "masks")
SINGLE_CAMERA = (*SINGLE_POSE, "camera", "view", "frame", "eye", "target")

#: A picture, and the frame and the camera that it is of.
Picture = tuple[np.ndarray, Frame, Camera]


def pictures_of(
    args: argparse.Namespace,
    renderer: shared.AnyField | Deformer,
    deformation: Deformation | None,
    cameras: Sequence[Camera],
    pose: Callable[[int], object] = lambda index: None,  # called before each with its number
    staging: Staging | None = None,  # what stands beside it
) -> Iterator[Picture]:
    """The pictures of some cameras, one after the other."""
    for index, camera in enumerate(cameras):
        pose(index)
        frame = shared.render_view(renderer if staging is None else staging.with_main(renderer), camera, args)
        drawn = shared.drawn_cages(renderer, deformation) if args.overlay else ()
        yield colors(frame, camera, drawn, shared.is_transparent(args)), frame, camera


def run_flight(args: argparse.Namespace) -> None:
    """Render what each of several cameras sees."""
    if pathlib.Path(args.output).suffix:
        output = options.check_output(args.output, FILM_ENDINGS, "film (a folder of pictures has no ending)")
    else:
        output = _new_folder(args.output, "--cameras writes a new or an empty folder, or a film")
    checked_opacity(args, output)
    if args.scene is None:
        raise InputError("--cameras needs --scene, the scene of the cameras")
    if given := [name for name in SINGLE_CAMERA if getattr(args, name) is not None]:
        raise InputError(f"--cameras cannot be combined with --{given[0]}, which is for one picture")
    shared.check_saved(args)
    if args.cameras == "given" and args.frames is not None:
        raise InputError("--frames belongs to --cameras interpolate")
    field, stage = read_things(args)
    shared.require_fillable(args, field)
    cameras = chosen_cameras(args)
    deformation = read_deformation(args, field)
    staging = staging_of(args, field, stage)
    shared.set_lattice(args, cameras[0])
    renderer = shared.posed_renderer(field, deformation, args)
    pictures = pictures_of(args, renderer, deformation, cameras, staging=staging)
    shared.save_cameras(args, cameras)
    if output.suffix:
        rate = GIF_RATE if output.suffix.lower() == ".gif" else VIDEO_RATE
        write_film(output, (finished(image) for image, _, _ in pictures), rate)
    else:
        _write_pictures(output, pictures, (f"view_{index:04d}" for index in range(len(cameras))), args)
    size = size_text(cameras[0].width, cameras[0].height, output)
    print(f"wrote {output}: {counted(len(cameras), 'picture')} of {size}")


def chosen_cameras(args: argparse.Namespace) -> list[Camera]:
    """One camera per picture."""
    if shared.camera_file(args.scene):
        keys = shared.camera_keys(args, args.scene)
        if args.cameras == "interpolate":
            return path_cameras(keys, args.frames or max(1, STEPS * (len(keys) - 1) + 1))
        return [key.camera for key in keys]
    cameras = shared.sized_cameras(args, args.scene)
    if args.cameras == "given":
        return cameras
    return cameras_along(cameras, args.frames or max(1, STEPS * (len(cameras) - 1) + 1))


def _new_folder(text: str, what: str) -> pathlib.Path:
    """A folder that holds nothing yet; what: what a message says about it."""
    path = pathlib.Path(text)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{text!r} exists already: {what}")
    options.check_parent(path)
    return path


def _write_pictures(
    folder: pathlib.Path, pictures: Iterable[Picture], names: Iterable[str], args: argparse.Namespace
) -> None:
    """Write pictures into a folder under a name each."""
    with BackgroundWriter() as beside:
        for name, (image, frame, camera) in zip(names, pictures, strict=True):
            beside.run(*picture_task(folder / f"{name}.{args.format or 'png'}", image, frame, camera))


def seen_points(
    field: shared.AnyField, deformation: Deformation | None, args: argparse.Namespace, staging: Staging | None
) -> np.ndarray:
    """(n, 3) points around what a picture shows, world units."""
    points = shared.visible_points(field, deformation, args.frame)
    return points if staging is None else staging.points(points)


def run_many_poses(args: argparse.Namespace) -> None:
    """Render each of several poses. The field is read once, and its lattice is made once."""
    folder = _new_folder(args.output, "pictures of several poses go into a new or an empty folder")
    if given := [name for name in SINGLE_POSE if getattr(args, name) is not None]:
        raise InputError(f"--{given[0]} is for one picture: give the name of a picture with -o")
    shared.require_deformation(args, f"the folder {args.output!r}")
    checked_opacity(args, folder)
    shared.check_saved(args)
    field, stage = read_things(args)
    shared.require_fillable(args, field)
    deformation = read_deformation(args, field, "linear")
    assert deformation is not None
    staging = staging_of(args, field, stage)
    camera = shared.chosen_camera(args, seen_points(field, deformation, args, staging))
    shared.set_lattice(args, camera)
    deformer = shared.make_deformer(field, deformation, args)
    count = max(1, deformation.pose_count - 1)

    def pose(index: int) -> None:
        cages = deformation.at(float(min(index + 1, deformation.pose_count - 1)))
        try:
            deformer.pose(cages)
        except ValueError as error:
            raise InputError(f"pose {index + 1} of {count}: {error}") from error

    pictures = pictures_of(args, deformer, deformation, [camera] * count, pose, staging)
    digits = max(4, len(str(count)))
    _write_pictures(folder, pictures, (f"pose_{number:0{digits}d}" for number in range(1, count + 1)), args)
    shared.save_cameras(args, [camera])
    print(f"wrote {folder}: {counted(count, 'picture')} of {camera.width}x{camera.height}")


def run_render(args: argparse.Namespace) -> None:
    if args.overlay:
        shared.require_deformation(args, "--overlay")
    if args.cameras is not None:
        return run_flight(args)
    if args.scene is not None or args.frames is not None:
        raise InputError("--scene and --frames belong to --cameras")
    if not pathlib.Path(args.output).suffix and shared.is_deformed(args):
        return run_many_poses(args)
    if args.posed is not None and len(args.posed) > 1:
        raise InputError(f"{len(args.posed)} poses make as many pictures: give a folder with -o, which has no ending")
    if args.format is not None:
        raise InputError("--format is for folders of pictures: the ending of a single one says what it is")
    output = options.check_output(args.output, (".png", ".exr"), "picture")
    require_format(output)
    shared.check_saved(args)
    shared.is_transparent(args)  # refuses others
    given = [kind for kind in SINGLE_POSE if getattr(args, kind) is not None]
    extra = {kind: options.check_output(getattr(args, kind), (".png",), "picture") for kind in given}
    if args.masks is not None:
        shared.require_deformation(args, "--masks")
    if args.save_stage is not None and not shared.is_stage(args.save_stage):
        raise InputError(f"--save-stage writes a file that ends in {STAGE_ENDING}, got {args.save_stage!r}")
    field, stage = read_things(args)
    if args.masks is not None:
        shared.require_voxels(field, "--masks")
    shared.require_fillable(args, field)
    deformation = read_deformation(args, field)
    staging = staging_of(args, field, stage)

    camera = shared.chosen_camera(args, seen_points(field, deformation, args, staging))
    shared.warn_of_edges(args, camera, deformation)
    shared.set_lattice(args, camera)
    renderer = shared.posed_renderer(field, deformation, args)
    image, frame, _ = next(pictures_of(args, renderer, deformation, [camera], staging=staging))
    write, _ = picture_task(output, image, frame, camera)
    write()
    for kind, path in extra.items():
        write_png(path, frame_parts.picture(frame, kind))
    shared.save_cameras(args, [camera])
    if args.save_stage is not None and staging is not None:
        staging.stage.save(args.save_stage)
    names = " and ".join(map(str, [output, *extra.values()]))
    print(f"wrote {names}: {frame.width}x{frame.height}, {100 * float(frame.alpha.mean()):.1f} % covered")
    if args.masks is not None:
        warn_of_masks(frame_parts.mask_shares(frame))


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
    shared.warn_of_edges(args, cameras[0], deformation)
    shared.set_lattice(args, cameras[0])
    if here or scaled:
        shot.prepare()

    shared.save_cameras(args, cameras, args.fps)
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
    shared.check_saved(args)
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
    width, height = shared.image_size(args) or DEFAULT_SIZE
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
    if jobs is not None:
        job, frames = session_job(document, field, film, args.field, args.scene_scale)
        _say_jobs(jobs, job.write(jobs, frames), view_camera(document.view, width, height))
        return

    with bar(len(frame_times(document.timeline)), "animate", shown=not args.quiet) as shown:

        def report(share: float | None, text: str) -> None:
            shown.update(round((share or 0.0) * shown.total) - shown.n)

        count = export_film(document, field, output, film, report)
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
