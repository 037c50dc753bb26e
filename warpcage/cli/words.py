"""What words name: presets, files, keys and random poses, what is up; and edits, in words and in edits files."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import pathlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

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
from ..cage.pose_file import PoseFile, Preset, is_preset, known_easing
from ..cage.up_axis import UpAxis, load_standing
from ..core.checks import listed, warn_caller
from ..core.files import PathLike, atomic_path, path_from, read_json, require_file
from ..core.names import counted, edit_words
from ..edits.place import PlaceFile
from ..edits.words import EditWords, held_walls
from ..errors import InputError
from ..view.camera_path import timed_keys
from ..view.motion import frame_rate, frame_times, pose_along, value_along
from .arguments.options import CAGE_ENDINGS, positive_float


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


def posed_up(args: argparse.Namespace) -> str | None:
    """The axis that points up in posed cage files, None where it is to be found."""
    return getattr(args, "posed_up", None) or args.cage_up


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
        cages = all(ending(text) in CAGE_ENDINGS for text in texts)
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
    try:
        for name, easing in file.easings.items():
            known_easing(name, easing)
        if file.cameras:
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


def set_frames(args: argparse.Namespace, film: PoseFile | PlaceFile | None, given: set[str]) -> list[float] | None:
    """Set number, rate and loop of the frames in `args` by the keys of a film; given: names of the options given.
    Returns the times of the frames, seconds; None, the frames being as they were asked for, without a film."""
    if film is None:
        if args.loop is not None:
            raise InputError("--loop is for keys at times (a pose file with times, an animation): see --motion")
        return None
    if "frames" in given:
        raise InputError("--frames does not go with keys at times, which say how long the film is: see --fps")
    args.loop = args.loop or film.loop or "once"
    if "fps" not in given:
        args.fps = frame_rate(USUAL_RATE if film.fps is None else film.fps)
    times = frame_times(film.length, args.fps, args.loop)
    args.frames = len(times)
    return times


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
    files = [text for text in texts if pathlib.Path(text).is_file() and ending(text) in CAGE_ENDINGS]
    for text in files if len(files) > 1 else ():
        standing = load_standing(Cage, text, reference=rest, expected=found.get(ending(text)))[1]
        if standing.turned:
            found[ending(text)] = standing.up
    return found


class Keyframes:
    """A cage at rest, the poses that follow it, and all poses between them."""

    def __init__(
        self,
        rest: Cage,
        texts: list[str],  # words of --posed, in order
        interpolation: str,  # "smooth" or "linear"
        up: str | None = None,  # "y" or "z"; None finds it from the rest cage, file by file
        expected: Mapping[str, str] | None = None,  # axis by ending of cage files where nothing speaks for another
        *,
        timed: bool = False,  # words that say when each pose is reached make a film of their own: see `read_film`
        fps: Fraction | None = None,  # rate of numbered cage files in such a film; None is the usual one
    ):
        self.rest, self.interpolation = rest, interpolation
        self.preset: Preset | None = None  # whose amount is interpolated
        self.amounts: list[tuple[float, ...]] = []  # one per cage
        self.film = read_film(rest, texts, up, expected, fps) if timed else None  # None: the poses follow evenly
        if self.film is not None:
            self.cages = [rest, *(self.film[name] for name in self.film.timed)]
            for name in self.film.timed:
                self.film[name].require_usable(f"keyframe {name!r} of {texts[0]!r}")
            return
        likely = expected_ups(rest, texts, expected) if up is None else None
        self.cages = [rest] + [pose for text in texts for pose in read_poses(rest, text, up, expected=likely)]
        presets = [Preset(text) for text in texts if is_preset(text)]
        moving = [preset for preset in presets if preset.kind != "rest"]
        if len(presets) == len(texts) and len({preset.family for preset in moving}) == 1:
            self.preset = moving[0]
            still = (self.preset.neutral,) * len(self.preset.amount)
            self.amounts = [still] + [still if preset.kind == "rest" else preset.amount for preset in presets]

    def at(self, place: float) -> Cage:
        """The cage at a place: 0 at rest, 1 the first pose, and so on, or between them."""
        # Each vertex by itself; of one preset with different amounts the amount, so that a bend stays an arc.
        if self.preset is None:
            return pose_along(self.cages, place, self.interpolation)
        amount = value_along([np.array(amount) for amount in self.amounts], place, self.interpolation)
        return self.preset.at(self.rest, amount.tolist())

    @property
    def vertices(self) -> np.ndarray:
        """(n, 3) vertices of all cages, world units."""
        return np.concatenate([cage.vertices for cage in self.cages])


FORMAT, VERSION = "warpcage edits", 1

#: How an edit is written in one word.
EDIT_SHAPE = "CAGE:POSED, CAGE:POSED:keep, CAGE:POSED:falloff=WIDTH or CAGE:remove"

#: Words after the cages.
_LAST_WORD = re.compile(r"(keep|remove)|(falloff|fragments|crumbs|held|object)=([^:]*)")

#: A word that is none of them, after a posed cage: only glTF and pose files hold things with names.
_SLIP = re.compile(r".+\.(?:obj|ply|off):([^:/\\]+)", re.IGNORECASE | re.DOTALL)

#: The cage is what goes up to the first ending of a cage file that a colon or the end follows: so the colon of a
#: Windows drive (C:\cage.obj) separates nothing.
_CAGE = re.compile(rf"(.+?(?:{'|'.join(map(re.escape, CAGE_ENDINGS))}))(?::(.*))?", re.IGNORECASE | re.DOTALL)


def parse_edit(text: str) -> EditWords:
    """An edit of --edit: CAGE:POSED, then ":keep", ":remove", ":falloff=WIDTH", ":held=WALLS", ":fragments=SIZE",
    ":object=NAME"."""
    found = _CAGE.fullmatch(text)
    if found is None:
        raise InputError(f"--edit {text!r} names no cage file ({' '.join(CAGE_ENDINGS)}): write {EDIT_SHAPE}")
    cage, rest = found[1], found[2]
    words: dict[str, Any] = {}
    while rest is not None:
        before, _, last = rest.rpartition(":")
        word = _LAST_WORD.fullmatch(last)
        if word is None or pathlib.Path(rest).exists():
            break
        name = word[1] or word[2]
        if name == "crumbs":
            warn_caller("crumbs= is called fragments= now: the next version knows that name alone")
            name = "fragments"
        words[name] = word[3] if word[2] else True
        rest = before or None
    try:
        if rest is not None and (slip := _SLIP.fullmatch(rest)) and not pathlib.Path(rest).exists():
            raise InputError(
                f"{slip[1]!r} is no word of an edit, only keep, remove, falloff=, held=, fragments= and object="
            )
        words |= {name: positive_float(words[name]) for name in ("falloff", "fragments") if name in words}
        words |= {"held": held_walls(words["held"], "held")} if "held" in words else {}
        if not rest and not words.get("remove"):
            raise InputError(f"there is no posed cage: write {EDIT_SHAPE}")
        return EditWords(cage, rest or None, **words)
    except (ValueError, argparse.ArgumentTypeError) as error:
        raise InputError(f"--edit {text!r}: {error}") from None


def parse_add(text: str) -> tuple[str, str | None, str | None]:
    """Field, place file and edits file of a word of --add: FIELD, FIELD:PLACE or FIELD:PLACE:EDITS; "" is none."""
    # the colon of a Windows drive (C:\field.npz) separates nothing
    parts = re.split(r":(?![\\/])|(?<!^[A-Za-z])(?<!:[A-Za-z]):", text)
    if len(parts) > 3 or not parts[0]:
        raise InputError(f"--add {text!r} must be FIELD, FIELD:PLACE.json or FIELD:PLACE.json:EDITS.json")
    field, place, edits = (*parts, "", "")[:3]
    return field, place or None, edits or None


def read_edits_file(path: PathLike) -> list[EditWords]:
    """The edits of an edits file in their order; paths, relative to its folder there, as this process opens them."""
    path = require_file(path, "edits file")
    try:
        content = read_json(path, "edits file")
        if content.get("format") != FORMAT:
            raise InputError(f"its format is {str(content.get('format'))[:40]!r}, not {FORMAT!r}")
        version, edits = content.get("version"), content.get("edits")
        if type(version) is not int or version < 1:
            raise InputError(f"its version must be a whole number from 1, got {str(version)[:40]!r}")
        if version > VERSION:
            raise InputError(f"its version is {version}, this warpcage reads up to {VERSION}: upgrade")
        if not isinstance(edits, list) or not edits:
            raise InputError("its edits must be a list of at least one edit")
        return [_words(edit, number, path.parent) for number, edit in enumerate(edits, 1)]
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def write_edits_file(path: PathLike, edits: list[EditWords]) -> None:
    """Write an edits file, whole or not at all; paths are kept relative to its folder where there is a way."""
    folder = pathlib.Path(path).absolute().parent
    content = {"format": FORMAT, "version": VERSION, "edits": [_json(edit, folder) for edit in edits]}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _words(entry: Any, number: int, folder: pathlib.Path) -> EditWords:
    """One edit of a file."""
    # what a later version adds has a higher version: an unknown word is a slip, and would be lost in silence
    edit = EditWords.from_json(entry, f"edit {number}")
    if not isinstance(edit.cage, str) or not isinstance(edit.posed, str | None):
        raise InputError(f"edit {number}: its cage and its pose must be named in a text, as for --edit")
    return _replaced(edit, lambda path: os.path.join(folder, path))


def _json(edit: EditWords, folder: pathlib.Path) -> dict[str, Any]:
    """An edit as JSON takes it: what differs from the default, a width of 0 too."""
    words = edit_words({name: getattr(edit, name) for name in ("falloff", "fragments")})
    content = _replaced(edit, lambda path: path_from(folder, path)).to_json()
    content |= {name: value for name, value in words.items() if value is not None}
    return content | ({"held": edit.held_text} if "held" in content else {})


def _replaced(edit: EditWords, named: Callable[[str], str]) -> EditWords:
    """An edit whose files have other names."""
    posed = edit.posed if edit.posed is None or is_preset(edit.posed) else named(edit.posed)
    return dataclasses.replace(edit, cage=named(edit.cage), posed=posed)
