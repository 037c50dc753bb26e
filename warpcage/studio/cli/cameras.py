"""The camera of a picture, and its size, by the options that say them."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from ...core.files import errors_of, read_json, seen_note
from ...core.reports import say
from ...errors import InputError
from ...render.belonging import SceneViews
from ...scene.formats.datasets.splatting import CAMERAS, is_output
from ...scene.formats.datasets.splatting import NAME as SPLATTING
from ...scene.load import holding_format, load_scene
from ...splats.splat_field import AnyField
from ...view.camera import Camera, CameraFile, CameraKey, fitted
from ...view.camera_file import camera_program
from ..films.edits import Deformation
from ..films.film import DEFAULT_SIZE
from ..films.motion import cameras_along
from ..films.moves import CameraMove, MovingCamera, camera_moves, within_sight
from ..films.resolve import AssetResolver, file_and_name
from ..films.timeline import CameraTrack, MovingScene, keyed_track, middle, moving_track, side_camera
from .arguments import options

#: An array of Warp holds as many.
MAX_PIXELS = 2**31 - 1


def asset_resolver() -> AssetResolver:
    """What loads the files that a command names; prints what it reports."""
    return AssetResolver(report=say)


def image_size(args: argparse.Namespace) -> tuple[int, int] | None:
    """Width and height of --size, None where it is not given."""
    if args.size is None:
        return None
    width, height = args.size.of(*DEFAULT_SIZE)
    if width * height > MAX_PIXELS:
        raise InputError(f"--size: {width}x{height} is too large, a picture has at most {MAX_PIXELS:,} pixels")
    return width, height


def chosen_camera(args: argparse.Namespace, points: np.ndarray) -> Camera:
    """The camera of the view options. Where none is given, it sees all points (n, 3)."""
    size = image_size(args)
    if args.camera is not None:
        if options.given(args, "eye", "target", "view", "frame"):
            raise InputError("--camera cannot be combined with --eye, --target, --view or --frame")
        if named := camera_file(args.camera):
            cameras = _file_cameras(args, named[0])
            with errors_of(named[0], "camera file"):
                return fitted_to(cameras.named(named[1]), args)
        return fitted_to(scene_camera(args, args.camera), args)
    width, height = size or DEFAULT_SIZE
    view = {"up": args.up, "fov_degrees": args.fov or options.FOV, "width": width, "height": height}
    framed = side_camera(points, args.view or "corner", **view)
    if args.eye is None and args.target is None:
        return framed
    if args.eye is not None and args.view is not None:
        raise InputError("--view cannot be combined with --eye: both say where the camera stands")
    target = chosen_target(args, points)
    eye = framed.center + target - middle(points) if args.eye is None else args.eye
    return Camera.look_at(eye, target, **view)


def named_camera(args: argparse.Namespace, text: str) -> Camera:
    """The camera that FILE[:NAME] or SCENE:[SPLIT:]INDEX names, at its own size."""
    if named := camera_file(text):
        return Camera.load(*named)
    return scene_camera(args, text)


def camera_file(text: str) -> tuple[str, str] | None:
    """File and name of a camera ("" for all) where a text names a camera file, else None."""
    return file_and_name(text, "json|glb|gltf")


def camera_keys(args: argparse.Namespace, text: str) -> list[CameraKey]:
    """The cameras of a file as keys, at --size where it is given."""
    path, name = camera_file(text) or (text, "")
    keys = _file_cameras(args, path).path(name)
    return [dataclasses.replace(key, camera=fitted_to(key.camera, args)) for key in keys]


def _file_cameras(args: argparse.Namespace, path: str) -> CameraFile:
    """The cameras of a file; a path of nerfstudio goes along with a field that was taken out of its frame."""
    file, motion = CameraFile.load(path, size=file_size(args)), getattr(args, "frame_motion", None)
    if motion is None or not path.lower().endswith(".json"):
        return file
    if camera_program(read_json(path, "camera file", (dict, list))) != "nerfstudio":
        return file
    moved = motion.moved([key.camera for key in file])
    keys = [dataclasses.replace(key, camera=camera) for key, camera in zip(file, moved, strict=True)]
    return CameraFile(keys, fps=file.fps, loop=file.loop)


def check_saved(args: argparse.Namespace) -> None:
    """Check the path of --save-camera before any long work."""
    if args.save_camera is not None:
        options.check_output(args.save_camera, (".json",), "camera file")


def save_cameras(args: argparse.Namespace, cameras: Sequence[Camera], fps: float | Fraction | None = None) -> None:
    """Write the file of --save-camera, if it was asked for; those of a film at the times of their frames."""
    if args.save_camera is None:
        return
    times = [None] * len(cameras) if fps is None else [float(index / Fraction(fps)) for index in range(len(cameras))]
    keys = [CameraKey(camera, time) for camera, time in zip(cameras, times, strict=True)]
    CameraFile(keys, fps=None if fps is None else float(fps)).save(args.save_camera)


def warn_of_edges(args: argparse.Namespace, camera: Camera, deformation: Deformation) -> None:
    """Say on stderr where a posed cage reaches out of a picture that is framed by the field at rest."""
    chosen = options.given(args, "frame", "camera", "eye", "target", "cameras")
    if deformation.is_still or chosen:
        return
    posed = [cage.vertices for cage in deformation.posed if cage is not None]
    pixels, depth = camera.project(np.concatenate(posed or [np.zeros((0, 3))]))
    beyond = (pixels < 0.0) | (pixels > (camera.width, camera.height))
    if (beyond.any(axis=1) | (depth <= 0.0)).any():
        say("the cage reaches out of the picture, which is framed by the object at rest: --frame posed shows all of it")


def chosen_target(args: argparse.Namespace, points: np.ndarray) -> np.ndarray:
    """(3,) what the camera looks at, or turns around. Where it is not given, the middle of the points (n, 3)."""
    return middle(points) if args.target is None else np.asarray(args.target, np.float64)


def fitted_to(camera: Camera, args: argparse.Namespace) -> Camera:
    """A camera at the size of --size, at its own where it is not given; see `fitted`."""
    image_size(args)  # refuses others
    if args.size is None:
        return camera
    if args.size.height is None and args.size.shape is None:
        return fitted(camera, (args.size.width,))
    size = args.size.of(camera.width, camera.height)
    found = fitted(camera, size, widen=args.size.widen)
    aside, above = found.fx * camera.width / camera.fx - size[0], found.fy * camera.height / camera.fy - size[1]
    if max(aside, above) > 1.5 and not getattr(args, "has_said_cut", False):
        args.has_said_cut = True
        cut = "left and right" if aside > above else "top and bottom"
        say(
            f"{size[0]}x{size[1]} cuts the camera's {camera.width}x{camera.height} picture at {cut}: --size "
            f"{size[0]}x{size[1]} widen shows all of it, and more at the other sides"
        )
    return found


def file_size(args: argparse.Namespace) -> tuple[int, int] | None:
    """The size of pictures from cameras of files that have none. None is that of the file."""
    size = image_size(args)
    return size if size is not None and args.size.height is not None and not args.size.widen else None


def scene_cameras(args: argparse.Namespace, text: str) -> list[Camera]:
    """The cameras that SCENE[:SPLIT] names, in the order of the pictures; without a split all of an output folder of
    3D Gaussian Splatting."""
    path, split = text, "train"
    if not pathlib.Path(path).exists() and ":" in path:
        path, _, split = path.rpartition(":")
    elif splatting_output(path):
        return [moved_to_field(args, key.camera) for key in CameraFile.load(pathlib.Path(path) / CAMERAS)]
    return [moved_to_field(args, camera) for camera in _loaded(path, split).cameras]


def splatting_output(path: str) -> bool:
    """Whether a folder is an output folder of 3D Gaussian Splatting, and no scene of another format."""
    folder = pathlib.Path(path)
    return is_output(folder) and holding_format(folder).name == SPLATTING


def seen_cameras(args: argparse.Namespace, field: AnyField) -> list[Camera]:
    """The cameras that saw what a field shows, as far as they are known: those that its fit refined, or else those of
    the scene that --camera names; none where neither is known."""
    refined = getattr(field, "refined_cameras", None)
    if refined is not None:
        return refined.cameras
    text = args.camera or ""
    named = "" if camera_file(text) else text.rpartition(":")[0]
    if not named or pathlib.Path(named).exists():
        return scene_cameras(args, named) if named else []
    try:
        return scene_cameras(args, named.rpartition(":")[0])  # of SCENE:SPLIT; fits take the training pictures
    except (ValueError, FileNotFoundError):  # a scene may have that split alone
        return scene_cameras(args, named)


@functools.lru_cache(maxsize=2)
def _loaded(path: str, split: str) -> SceneViews:
    """The cameras of a scene, with few of its pictures; a command may ask for them twice."""
    return SceneViews.of(load_scene(path, split=split))


def named_scene(args: argparse.Namespace) -> tuple[pathlib.Path, SceneViews] | None:
    """The folder and the views of the scene whose cameras a command's options name; None where they name none, or one
    that cannot be read, which is reported where its cameras are taken."""
    camera, _, index = (getattr(args, "camera", None) or "").rpartition(":")
    path_of_film = None if getattr(args, "turn", None) is not None else getattr(args, "cameras", None)
    for text in (getattr(args, "scene", None), path_of_film, camera):
        if not isinstance(text, str) or camera_file(text):
            continue
        path, split = (text, "train") if pathlib.Path(text).exists() else text.rpartition(":")[::2]
        if path and pathlib.Path(path).is_dir():
            with contextlib.suppress(ValueError, OSError):
                views = _loaded(path, split)
                if text != camera or not index.isdigit() or int(index) < len(views.cameras):
                    return pathlib.Path(path), views
    return None


def moved_to_field(args: argparse.Namespace, camera: Camera) -> Camera:
    """A camera of a scene in the world of the field, which may have been straightened."""
    motion = getattr(args, "straightening", None)  # of the field that was read
    return camera if motion is None else camera.moved(motion)


def sized_cameras(args: argparse.Namespace, text: str) -> list[Camera]:
    """The cameras that SCENE[:SPLIT] names, at --size where it is given."""
    return [fitted_to(camera, args) for camera in scene_cameras(args, text)]


def scene_camera(args: argparse.Namespace, text: str) -> Camera:
    """The camera that SCENE:[SPLIT:]INDEX names; of an output folder of 3D Gaussian Splatting also by its picture."""
    path, separator, index = text.rpartition(":")
    if separator and splatting_output(path):
        return moved_to_field(args, Camera.load(pathlib.Path(path) / CAMERAS, index))
    if not separator or not index.isdigit():
        raise InputError(
            f"--camera must be a camera file (.json, .glb, .gltf), SCENE:INDEX or SCENE:SPLIT:INDEX, got {text!r}"
            f"{seen_note(text)}"
        )
    cameras = scene_cameras(args, path)
    if int(index) >= len(cameras):
        raise InputError(f"{path!r} has pictures 0 to {len(cameras) - 1}, got {index}")
    return cameras[int(index)]


def _say_pace(cameras: str, keys: Sequence[CameraKey], scene: MovingScene) -> None:
    """Say where keys of cameras at times are shown in another time, that of a film without times of its own."""
    last = max((key.time for key in keys if key.time is not None), default=0.0)
    spec, own = scene.spec, round(last * scene.spec.fps) + 1
    if scene.keys is None and last > 0.0 and abs(own - spec.frames) > 1:
        say(
            f"the cameras of {cameras} take {last:g} s, and are shown in "
            f"{float(spec.frames / spec.fps):g} s: --frames {own} keeps their times"
        )


def camera_track(args: argparse.Namespace, scene: MovingScene, points: np.ndarray) -> CameraTrack:
    """The camera of a film; that of the film's keys where no option names another.
    points: (n, 3) around what the film shows, world units."""
    placed = options.given(args, "camera", "view", "eye", "target")
    spec, deformation = scene.spec, scene.deformation
    film = None if scene.keys is None else deformation.camera_film
    if film is not None and not placed and args.cameras is None and args.turn is None:
        return lambda frames: [fitted_to(film.camera_at(scene.time(frame)), args) for frame in frames]
    moves = None if args.cameras is None else camera_moves(args.cameras)
    if args.cameras is None or moves is not None:
        if moves is not None and args.turn is not None:
            raise InputError("--cameras turn:DEGREES says how far the camera turns: leave --turn and --full-turn out")
        turn = args.turn
        if moves is None and turn is None and deformation.film is not None:
            turn = 0.0
            say("the camera stays, as the poses have times: --turn 360 turns it around")
        moves = moves or [CameraMove("turn", turn)]
        axis = np.asarray(args.up, np.float64)
        if np.linalg.norm(axis) == 0:
            raise InputError("--up must not be 0 0 0")
        camera, pivot = chosen_camera(args, points), chosen_target(args, points)
        moving = MovingCamera(camera, pivot, axis / np.linalg.norm(axis), moves, spec.frames, float(spec.fps))
        moving, notes = within_sight(moving, seen_cameras(args, scene.field), anywhere=not placed)
        for note in notes:
            say(note)
        return moving_track(moving, scene.field, deformation.edits, scene.cages, asset_resolver())
    if placed or options.given(args, "turn", "frame"):
        raise InputError("--cameras cannot be combined with --turn, --camera, --view, --frame, --eye or --target")
    if camera_file(args.cameras):
        keys = camera_keys(args, args.cameras)
        _say_pace(args.cameras, keys, scene)
        return keyed_track(keys, spec.frames, None if scene.keys is None else scene.time)
    cameras = sized_cameras(args, args.cameras)
    return lambda frames: cameras_along(cameras, spec.frames, spec.interpolation, frames)
