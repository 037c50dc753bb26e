"""`warpcage pose -o poses.json`: keys of a pose file."""

from __future__ import annotations

import argparse
import pathlib

from ..cage.axes import with_up
from ..cage.cage import Cage
from ..cage.pose_file import PoseFile
from ..cage.presets import is_preset
from ..core.names import counted
from ..view.camera import CameraKey
from . import inputs, pose, view
from .film_keys import note_jumps, pose_file, read_film
from .keyframes import read_pose, read_poses
from .standing import posed_up

#: Options for pose files alone.
OPTIONS = ("key", "at", "easing", "posed", "camera", "remove", "fps", "loop")


def run(args: argparse.Namespace, output: pathlib.Path) -> None:
    """Add a key to a pose file, or all keys of a file that moves, and say what the film is then."""
    inputs.quiet_warp()
    rest, _ = pose.read_cage(args)
    file = PoseFile.load(output, rest) if output.exists() else PoseFile(rest)
    if args.key is None:
        _add_all(file, args)
    elif args.remove:
        _remove(file, args, output)
    else:
        _add_key(file, args)
    file.fps = file.fps if args.fps is None else float(args.fps)
    file.loop = args.loop or file.loop
    if not len(file) and not file.cameras:
        raise ValueError(f"{str(output)!r} would hold no key: remove the file instead")
    file.save(output)
    print(f"wrote {output}: {_described(file)}")


def _posed(args: argparse.Namespace) -> str:
    """The word of --posed."""
    return with_up(args.posed, args.up) if is_preset(args.posed) else args.posed


def _add_key(file: PoseFile, args: argparse.Namespace) -> None:
    name = args.key
    if not name.strip():
        raise ValueError("--key needs a name")
    timed = [other for other in file.times if other != name]
    if args.at is None and timed and name not in file.times:
        raise ValueError(f"--key {name!r} needs --at SECONDS: the other keys of the file have times")
    untimed = [other for other in file.names if other != name and other not in file.times]
    if args.at is not None and untimed:
        raise ValueError(f"--at: key {untimed[0]!r} of the file has no time; give all keys times, or none")
    alone = args.posed is None and not args.steps
    if args.camera is not None:
        _add_camera(file, args)
        if alone:
            return  # a camera and no pose
    if name not in file or not alone:  # otherwise another time or easing of the pose that is there
        begin = file.rest if args.posed is None else read_pose(file.rest, _posed(args), posed_up(args))
        file[name] = pose.stepped(begin, args)
    if args.at is not None:
        same = [other for other in timed if file.times[other] == args.at]
        if same:
            raise ValueError(
                f"key {same[0]!r} of the file is at {args.at:g} s too: give another time (for a jump give the key "
                "before it --easing hold)"
            )
        file.times[name] = args.at
    if args.easing is not None:
        file.easings[name] = args.easing


def _add_camera(file: PoseFile, args: argparse.Namespace) -> None:
    held = [key for key in file.cameras if key.name == args.key]
    time = args.at if args.at is not None or not held else held[0].time
    if time is None:
        raise ValueError(f"--key {args.key!r} needs --at SECONDS: a camera is reached at a time")
    easing = args.easing or (held[0].easing if held else "smooth")
    key = CameraKey(view.named_camera(args, args.camera), time, args.key, easing)
    same = [other for other in file.cameras if other.name != args.key and other.time == time]
    if same:
        raise ValueError(f"camera {same[0].name!r} of the file is at {time:g} s too: give another time")
    file.cameras = [other for other in file.cameras if other.name != args.key] + [key]


def _add_all(file: PoseFile, args: argparse.Namespace) -> None:
    """All keys of --posed, in the place of those of their names."""
    if args.posed is None:
        if args.at is None and args.easing is None and not args.steps and not args.remove and (args.fps or args.loop):
            return  # rate and loop alone
        raise ValueError("a pose file needs --key NAME, or --posed with a file that moves")
    for name in ("at", "easing", "camera", "steps", "remove"):
        if getattr(args, name):
            raise ValueError(f"{'steps of the pose go' if name == 'steps' else f'--{name} goes'} with --key")
    up = posed_up(args)
    film = read_film(file.rest, [args.posed], up, None, args.fps)
    if film is None:
        named = pose_file(args.posed)
        poses = read_poses(file.rest, args.posed, up)
        if len(poses) < 2 and named is None:
            raise ValueError(f"{args.posed!r} holds one pose: give it a name, --key NAME")
        film = PoseFile.load(named[0], file.rest) if named and not named[1] else _shapes(file.rest, args.posed, up)
    if bool(film.times) != bool(file.times) and len(file):
        raise ValueError("keys with times and keys without do not go into one pose file: write another one")
    for name in film.names:
        film[name].require_usable(f"keyframe {name!r} of {args.posed!r}")
        file[name] = film[name]
        if name in film.times:
            file.times[name] = film.times[name]
        if name in film.easings:
            file.easings[name] = film.easings[name]
    file.fps, file.loop = film.fps or file.fps, film.loop or file.loop
    note_jumps(file, args.posed)


def _shapes(rest: Cage, text: str, up: str | None) -> PoseFile:
    """The shapes of a glTF file."""
    from ..cage.motion import gltf_poses

    file = gltf_poses(text, rest, up=up)
    if file is None:
        raise ValueError(f"{text!r} holds one pose: give it a name, --key NAME")
    return file


def _remove(file: PoseFile, args: argparse.Namespace, output: pathlib.Path) -> None:
    for name in ("at", "easing", "posed", "camera", "steps"):
        if getattr(args, name):
            raise ValueError(f"--remove takes a key out: leave {'the steps' if name == 'steps' else f'--{name}'} out")
    cameras = [key for key in file.cameras if key.name != args.key]
    if args.key not in file and len(cameras) == len(file.cameras):
        raise ValueError(f"{output}: there is no key {args.key!r} to remove")
    file.cameras = cameras
    if args.key in file:
        del file[args.key]


def _described(file: PoseFile) -> str:
    """The keys and the film in a line."""
    if not file.times and not file.cameras:
        return f"{counted(len(file), 'key')} without times: {', '.join(file.names)}"
    names = [f"{name} at {file.times[name]:g} s" for name in file.timed]
    shown = names if len(names) <= 8 else [*names[:3], "...", names[-1]]
    end = f", {file.loop}" if file.loop else ""
    rate = f", {file.fps:g} frames a second" if file.fps else ""
    cameras = [f"{key.name or 'camera'} at {key.time:g} s" for key in file.cameras]
    shown += [f"cameras {', '.join(cameras[:8])}"] if cameras else []
    return f"{counted(len(file) + len(cameras), 'key')} over {file.length:g} s{rate}{end}: {', '.join(shown)}"
