"""What words name: presets, files and keys of poses, what is up; and edits files."""

from __future__ import annotations

import itertools
import pathlib
import re
import sys
from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from ..cage.cage import Cage
from ..cage.motion import (
    MOVING_ENDINGS,
    USUAL_RATE,
    are_numbered,
    file_poses,
    gltf_shown,
    numbered_files,
    sequence_poses,
)
from ..cage.pose_file import PoseFile, Preset, is_preset
from ..cage.up_axis import UpAxis, load_standing
from ..core.checks import listed
from ..core.names import EASINGS, counted
from ..errors import InputError
from ..mesh.io import ENDINGS
from ..view.camera_path import timed_keys


def read_rest(
    path: str, up: str | None, thing: object = None, *, part: bool = False, name: str | None = None
) -> tuple[Cage, dict[str, str]]:
    """A cage at rest around a field or mesh, usable, and the axis to expect in files of its ending; name: its object's.
    up: "y" or "z"; None finds it by what the cage holds of `thing`, without which it is that of the format."""
    rest, standing = load_standing(Cage, path, up=up, reference=thing, object=name)
    rest.require_usable(f"cage {path!r}")
    # A cage that may hold a part alone, as one of several, is told of only where another axis would hold far more.
    if standing.turned or standing.doubtful or standing.likelier or not part:
        say_standing(path, standing, "--cage-up")
    return rest, {ending(path): standing.up}


def say_standing(name: str, standing: UpAxis, option: str) -> None:
    """Print a line on stderr on how a cage file stands, if there is anything to say."""
    if standing.turned:
        before = "z" if standing.up == "y" else "y"
        print(f"warpcage: cage {name!r} {standing.note} ({option} {before} keeps it as it was)", file=sys.stderr)
    elif standing.doubtful:
        print(f"warpcage: warning: cage {name!r} {standing.note} (see {option})", file=sys.stderr)
    elif standing.note:
        print(f"warpcage: cage {name!r} {standing.note}", file=sys.stderr)


def ending(text: str) -> str:
    """The ending of a file, lower case."""
    return pathlib.Path(text).suffix.lower()


def pose_file(text: str) -> tuple[str, str] | None:
    """File and keyframe ("" for all) of a word of --posed that names a pose file, or None for other words."""
    return file_and_name(text, "json")


def moving_file(text: str) -> tuple[str, str] | None:
    """File and animation, shape or frame ("" for all) of a word that names a file that a cage may move in, or None."""
    return file_and_name(text, "|".join(each[1:] for each in MOVING_ENDINGS))


def file_and_name(text: str, endings: str) -> tuple[str, str] | None:
    """A file of some endings ("json|glb") and what is named of it, "" for all; None for other words."""
    found = re.fullmatch(rf"(.+\.(?:{endings}))(?::(.*))?", text, re.IGNORECASE)
    return (found[1], found[2] or "") if found else None


def read_film(
    rest: Cage, texts: list[str], up: str | None, expected: Mapping[str, str] | None, fps: Fraction | None
) -> PoseFile | None:
    """The keys of words of --posed that say themselves when each pose is reached; None for other words.
    up: "y" or "z", None finds it; expected: axis by ending of cage files where nothing speaks for another."""
    # A pose file with times, an animated glTF file, a folder or pattern of numbered cage files, or files so named.
    rate = USUAL_RATE if fps is None else float(fps)
    if len(texts) == 1:
        (text,) = texts
        if (named := pose_file(text)) and not named[1]:
            return _timed(PoseFile.load(named[0], rest), named[0])
        if named := moving_file(text):
            file = file_poses(named[0], rest, name=named[1], up=up, fps=rate)
            return file if file is not None and file.times else None
        files = numbered_files(text)
    else:
        cages = all(ending(text) in ENDINGS for text in texts)
        files = [pathlib.Path(text) for text in texts] if cages and are_numbered(texts) else None
        if files:
            print(
                f"warpcage: {files[0]} to {files[-1].name}: one cage a frame (--motion swing goes from rest through "
                "them and back)",
                file=sys.stderr,
            )
    if not files:
        return None
    likely = (expected or {}).get(ending(str(files[0])))
    return sequence_poses(files, rest, fps=rate, up=up, expected=likely)


def _timed(file: PoseFile, path: str) -> PoseFile | None:
    """The file where its keyframes have times."""
    if not file.times and not (file.cameras and not len(file)):
        return None
    without = [name for name in file.names if name not in file.times]
    if without:
        raise InputError(
            f"{path}: keyframe {without[0]!r} has no time, {file.timed[0]!r} has one: give it one, as in "
            f"warpcage pose CAGE -o {path} --key {without[0]!r} --at SECONDS"
        )
    if min(file.times.values(), default=0.0) < 0.0:
        raise InputError(
            f"{path}: keyframe {file.timed[0]!r} is at {file.times[file.timed[0]]:g} s: a film begins at 0"
        )
    for name, easing in file.easings.items():
        if easing not in EASINGS:
            raise InputError(
                f"{path}: keyframe {name!r} has the easing {easing[:40]!r}, known are {', '.join(EASINGS)}"
            )
    if file.cameras:
        try:
            timed_keys(file.cameras)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
    note_jumps(file, path)
    return file


def note_jumps(file: PoseFile, path: str) -> None:
    """Say in a line where two keyframes of a film have one time."""
    names = file.timed
    jumps = [(a, b) for a, b in itertools.pairwise(names) if file.times[a] == file.times[b]]
    if jumps:
        (one, two), more = jumps[0], len(jumps) - 1
        print(
            f"warpcage: {path}: keyframes {one!r} and {two!r} are both at {file.times[one]:g} s: the film jumps there"
            + (f", and at {counted(more, 'other time')}" if more else ""),
            file=sys.stderr,
        )


def read_poses(
    rest: Cage, text: str, up: str | None = None, usable: bool = True, expected: Mapping[str, str] | None = None
) -> list[Cage]:
    """The posed cages that a word of --posed names: one, or all of a file, a folder or a pattern in their order.
    up: "y" or "z", None finds it from the rest cage; expected: axis by ending where nothing speaks for another."""
    # A cage file, a preset, a pose or moving glTF file, a keyframe of either, a folder or a pattern (walk_####.obj).
    if is_preset(text):
        preset = Preset(text)
        poses = [preset.at(rest, preset.amount)]
    elif named := pose_file(text):
        path, name = named
        file = PoseFile.load(path, rest)
        if not len(file):
            raise InputError(f"pose file {path!r} holds no keyframes")
        if name and name not in file:
            raise InputError(f"pose file {path!r}: there is no keyframe {name!r}, only {listed(file)}")
        poses = [file[name] for name in ([name] if name else file.names)]
    elif moving := _moving_poses(rest, text, up, expected):
        poses = moving
    else:
        likely = (expected or {}).get(ending(text))
        posed, standing = load_standing(Cage, text, up=up, reference=rest, expected=likely)
        say_standing(text, standing, "--posed-up")
        poses = [matched(rest, posed, text)]
    for posed in poses if usable else ():
        posed.require_usable(f"cage {text!r}")
    return poses


def read_pose(rest: Cage, text: str, up: str | None = None, usable: bool = True) -> Cage:
    """The one posed cage that a word of --posed names; see `read_poses`."""
    poses = read_poses(rest, text, up, usable)
    return poses[0] if len(poses) == 1 else only_pose(rest, text, up, poses)


def only_pose(rest: Cage, text: str, up: str | None, poses: Sequence[Cage]) -> Cage:
    """The pose that a file of several shows by itself, as glTF files do. Raises ValueError where it shows none."""
    if named := moving_file(text):
        shown = None if named[1] else gltf_shown(named[0], rest, up=up)
        if shown is not None:
            return shown
        file = file_poses(named[0], rest, name=named[1], up=up)
        if file is not None and file.times:
            raise InputError(
                f"{text!r} holds an animation of {len(file)} frames: `warpcage animate` makes a film of it"
            )
    raise InputError(f"{text!r} holds {len(poses)} keyframes: name one, as in {text}:NAME")


def _moving_poses(rest: Cage, text: str, up: str | None, expected: Mapping[str, str] | None) -> list[Cage]:
    """The poses of a word that names a glTF file that moves, or numbered files; none for other words."""
    if named := moving_file(text):
        file = file_poses(named[0], rest, name=named[1], up=up)
        if file is None and named[1]:
            raise InputError(f"{named[0]}: there is no animation or shape {named[1]!r}: nothing moves in it")
    elif files := numbered_files(text):
        likely = (expected or {}).get(ending(str(files[0])))
        file = sequence_poses(files, rest, up=up, expected=likely)
    else:
        return []
    return [] if file is None else [file[name] for name in file.names]


def matched(rest: Cage, posed: Cage, name: str) -> Cage:
    """A posed cage in the order of the cage at rest, vertices and faces; a line on stderr says where it was another."""
    try:
        found = rest.match(posed)
    except ValueError as error:
        raise InputError(f"cage {name!r} does not fit its rest cage: {error}") from None
    if not np.array_equal(posed.faces, rest.faces) or len(posed.vertices) != len(rest.vertices):
        print(f"warpcage: cage {name!r} has another order than its rest cage: matched", file=sys.stderr)
    return found


def expected_ups(rest: Cage, texts: Sequence[str], expected: Mapping[str, str] | None = None) -> dict[str, str]:
    """The axis that points up in files of poses, by ending: what is sure of one holds for those that say nothing."""
    found = dict(expected or {})
    files = [text for text in texts if pathlib.Path(text).is_file() and ending(text) in ENDINGS]
    for text in files if len(files) > 1 else ():
        standing = load_standing(Cage, text, reference=rest, expected=found.get(ending(text)))[1]
        if standing.turned:
            found[ending(text)] = standing.up
    return found
