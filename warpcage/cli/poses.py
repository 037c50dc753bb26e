"""`warpcage pose` and `edits`: poses of a cage, keys of films, edits files."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
from typing import Any

from ..cage.axes import axis_of, default_towards, with_up
from ..cage.cage import Cage
from ..cage.motion import file_poses
from ..cage.pose_file import PoseFile, is_preset
from ..core.files import require_file
from ..core.names import counted
from ..errors import InputError
from ..mesh.io.formats import mesh_endings
from ..splats.io import splat_path
from ..splats.splat_field import load_field
from ..view.camera import CameraKey
from . import shared
from .arguments import options
from .edit_words import EditWords, parse_edit, read_edits_file, write_edits_file
from .pose_words import ending, note_jumps, pose_file, posed_up, read_film, read_pose, read_poses, read_rest
from .shared import Deformation, PosedEdit, is_session, numbered_edits, session_edits


def run_edits(args: argparse.Namespace) -> None:
    if args.file is None and not args.edit:
        raise InputError("give an edits file to read, or --edit for each edit to write")
    if args.edit and args.output is None:
        raise InputError("--edit needs -o, the edits file to write")
    output = None if args.output is None else options.check_output(args.output, (".json",), "edits file")
    if args.file is not None and is_session(args.file):
        if output is not None:
            raise InputError(f"{args.file} is a session of the editor, which --edits takes as it is: it needs no -o")
        deformation, names = session_edits(args.file)
        _list(args.file, deformation, names)
        return
    words = [] if args.file is None else read_edits_file(args.file)
    words += [parse_edit(text) for text in args.edit or ()]
    deformation = numbered_edits(words, args, "smooth")
    if output is not None:
        write_edits_file(output, [_with_file_words(edit, args) for edit in words])
    _list(f"wrote {output}" if output is not None else str(args.file), deformation, [str(edit) for edit in words])


def _with_file_words(edit: EditWords, args: argparse.Namespace) -> EditWords:
    """An edit that says which axis points up in its cages, and which object they are, where it was said for all."""
    return dataclasses.replace(edit, up=edit.up or args.cage_up, object=edit.object or args.cage_object)


def _list(what: str, deformation: Deformation, names: list[str]) -> None:
    """Print a line for each edit."""
    count = len(names)
    print(f"{what}: {count} edit{'s'[: count > 1]}{', in this order' if count > 1 else ''}")
    for number, (name, part) in enumerate(zip(names, deformation.parts, strict=True), 1):
        print(f"  {number}. {name} ({_size(part)})")


def _size(part: PosedEdit) -> str:
    """How large the cage of an edit is, and how many poses it has."""
    poses = 0 if part.keyframes is None else len(part.keyframes.cages) - 1
    return f"{len(part.edit.cage.vertices)} vertices" + (f", {poses} poses" if poses > 1 else "")


#: Options for pose files alone.
OPTIONS = ("key", "at", "easing", "posed", "camera", "remove", "fps", "loop")


def run_pose_keys(args: argparse.Namespace, output: pathlib.Path) -> None:
    """Add a key to a pose file, or all keys of a file that moves, and say what the film is then."""
    rest, _ = read_cage(args)
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
        raise InputError(f"{str(output)!r} would hold no key: remove the file instead")
    file.save(output)
    print(f"wrote {output}: {_described(file)}")


def _posed(args: argparse.Namespace) -> str:
    """The word of --posed."""
    return with_up(args.posed, args.up) if is_preset(args.posed) else args.posed


def _add_key(file: PoseFile, args: argparse.Namespace) -> None:
    name = args.key
    if not name.strip():
        raise InputError("--key needs a name")
    timed = [other for other in file.times if other != name]
    if args.at is None and timed and name not in file.times:
        raise InputError(f"--key {name!r} needs --at SECONDS: the other keys of the file have times")
    untimed = [other for other in file.names if other != name and other not in file.times]
    if args.at is not None and untimed:
        raise InputError(f"--at: key {untimed[0]!r} of the file has no time; give all keys times, or none")
    alone = args.posed is None and not args.steps
    if args.camera is not None:
        _add_camera(file, args)
        if alone:
            return  # a camera and no pose
    if name not in file or not alone:  # otherwise another time or easing of the pose that is there
        begin = file.rest if args.posed is None else read_pose(file.rest, _posed(args), posed_up(args))
        file[name] = stepped(begin, args)
    if args.at is not None:
        same = [other for other in timed if file.times[other] == args.at]
        if same:
            raise InputError(
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
        raise InputError(f"--key {args.key!r} needs --at SECONDS: a camera is reached at a time")
    easing = args.easing or (held[0].easing if held else "smooth")
    key = CameraKey(shared.named_camera(args, args.camera), time, args.key, easing)
    same = [other for other in file.cameras if other.name != args.key and other.time == time]
    if same:
        raise InputError(f"camera {same[0].name!r} of the file is at {time:g} s too: give another time")
    file.cameras = [other for other in file.cameras if other.name != args.key] + [key]


def _add_all(file: PoseFile, args: argparse.Namespace) -> None:
    """All keys of --posed, in the place of those of their names."""
    if args.posed is None:
        if args.at is None and args.easing is None and not args.steps and not args.remove and (args.fps or args.loop):
            return  # rate and loop alone
        raise InputError("a pose file needs --key NAME, or --posed with a file that moves")
    for name in ("at", "easing", "camera", "steps", "remove"):
        if getattr(args, name):
            raise InputError(f"{'steps of the pose go' if name == 'steps' else f'--{name} goes'} with --key")
    up = posed_up(args)
    film = read_film(file.rest, [args.posed], up, None, args.fps)
    if film is None:
        named = pose_file(args.posed)
        poses = read_poses(file.rest, args.posed, up)
        if len(poses) < 2 and named is None:
            raise InputError(f"{args.posed!r} holds one pose: give it a name, --key NAME")
        film = PoseFile.load(named[0], file.rest) if named and not named[1] else _shapes(file.rest, args.posed, up)
    if bool(film.times) != bool(file.times) and len(file):
        raise InputError("keys with times and keys without do not go into one pose file: write another one")
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
    file = file_poses(text, rest, up=up)
    if file is None:
        raise InputError(f"{text!r} holds one pose: give it a name, --key NAME")
    return file


def _remove(file: PoseFile, args: argparse.Namespace, output: pathlib.Path) -> None:
    for name in ("at", "easing", "posed", "camera", "steps"):
        if getattr(args, name):
            raise InputError(f"--remove takes a key out: leave {'the steps' if name == 'steps' else f'--{name}'} out")
    cameras = [key for key in file.cameras if key.name != args.key]
    if args.key not in file and len(cameras) == len(file.cameras):
        raise InputError(f"{output}: there is no key {args.key!r} to remove")
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


def run_pose(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (*mesh_endings("write"), ".json"), "cage file")
    if output.suffix.lower() == ".json":
        run_pose_keys(args, output)
        return
    given = [name for name in OPTIONS if getattr(args, name)]
    if given:
        raise InputError(f"--{given[0]} is for keys of a pose file: give one with -o (.json)")
    if not args.steps:
        raise InputError("no step given: --bend, --twist, --taper, --stretch, --scale, --rotate or --translate")
    if output.exists() and pathlib.Path(args.cage).exists() and output.samefile(args.cage):
        raise InputError(
            f"-o {output} is the cage at rest itself, which is needed beside a posed one: name another file"
        )

    cage, found = read_cage(args)
    stepped(cage, args).save(output, up=args.cage_up or found.get(ending(str(output))))
    print(f"wrote {output}: {steps_text(args)}")


def read_cage(args: argparse.Namespace) -> tuple[Cage, dict[str, str]]:
    """The cage of the command, and the axis that points up in files of its ending.
    With --object the axis is found by that field, and `args.up` becomes the field's unless --up is given too."""
    field = None if args.object is None else load_field(require_file(splat_path(args.object), "field file"))
    if field is not None and args.up is None:
        args.up = tuple(field.up)
    args.straightening = None if field is None else field.straightening  # for cameras of its scene
    return read_rest(args.cage, args.cage_up, field, part=True, name=args.cage_object)


def stepped(cage: Cage, args: argparse.Namespace) -> Cage:
    """A cage after the steps of the command, usable."""
    for name, value in args.steps or ():
        cage = getattr(cage, name)(*_arguments(name, value), **_options(name, cage, args))
    cage.require_usable("the posed cage")
    return cage


def steps_text(args: argparse.Namespace) -> str:
    """The steps of the command in words."""
    steps = args.steps or ()
    return ", ".join(f"{name} {value if isinstance(value, float) else tuple(value)}" for name, value in steps)


def _arguments(name: str, value: Any) -> tuple:
    """Positional arguments of the step's method of Cage."""
    if name != "scale":
        return (value,)
    if len(value) not in (1, 3):
        raise InputError(f"--scale takes one factor or three, got {len(value)}")
    return (value[0] if len(value) == 1 else tuple(value),)


def _options(name: str, cage: Cage, args: argparse.Namespace) -> dict:
    """Keyword arguments of the step's method of Cage."""
    if name == "translate":
        return {}
    chosen = {"center": args.center}
    if name != "scale":
        chosen["axis"] = axis_of(with_up(args.axis, args.up))
    if name == "bend":
        chosen["towards"] = default_towards(cage, chosen["axis"])
        if args.towards is not None:
            chosen["towards"] = axis_of(with_up(args.towards, args.up))
    if name in ("bend", "twist", "taper", "stretch"):
        chosen["limits"] = tuple(args.limits)
    return chosen
