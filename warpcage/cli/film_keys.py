"""Keys at times: which words of --posed make a film of their own, and the times of its frames."""

from __future__ import annotations

import argparse
import pathlib
import re
import sys
from collections.abc import Mapping
from fractions import Fraction

from ..cage.cage import Cage
from ..cage.motion import are_numbered, gltf_poses, numbered_files, sequence_poses
from ..cage.pose_file import PoseFile
from ..core.names import EASINGS, counted
from ..view.camera_path import timed_keys
from ..view.motion import frame_rate, frame_times
from .options import CAGE_ENDINGS
from .standing import ending

#: Frames per second where neither the keys nor --fps say another rate.
USUAL_RATE = Fraction(24)


def pose_file(text: str) -> tuple[str, str] | None:
    """File and keyframe ("" for all) of a word of --posed that names a pose file, or None for other words."""
    return _file_and_name(text, "json")


def gltf_file(text: str) -> tuple[str, str] | None:
    """File and animation or shape ("" for all) of a word that names a glTF file, or None for other words."""
    return _file_and_name(text, "glb|gltf")


def _file_and_name(text: str, endings: str) -> tuple[str, str] | None:
    found = re.fullmatch(rf"(.+\.(?:{endings}))(?::(.*))?", text, re.IGNORECASE)
    return (found[1], found[2] or "") if found else None


def read_film(
    rest: Cage, texts: list[str], up: str | None, expected: Mapping[str, str] | None, fps: Fraction | None
) -> PoseFile | None:
    """The keys of words of --posed that say themselves when each pose is reached; None for other words.
    up: "y" or "z", None finds it; expected: axis by ending of cage files where nothing speaks for another."""
    # They are a pose file whose keyframes have times, an animated glTF file, a folder or a pattern of numbered cage
    # files, and cage files that are named alike but for their numbers.
    rate = float(USUAL_RATE if fps is None else fps)
    if len(texts) == 1:
        (text,) = texts
        if (named := pose_file(text)) and not named[1]:
            return _timed(PoseFile.load(named[0], rest), named[0])
        if named := gltf_file(text):
            file = gltf_poses(named[0], rest, name=named[1], up=up)
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
        raise ValueError(
            f"{path}: keyframe {without[0]!r} has no time, {file.timed[0]!r} has one: give it one, as in "
            f"warpcage pose CAGE -o {path} --key {without[0]!r} --at SECONDS"
        )
    if min(file.times.values(), default=0.0) < 0.0:
        raise ValueError(
            f"{path}: keyframe {file.timed[0]!r} is at {file.times[file.timed[0]]:g} s: a film begins at 0"
        )
    for name, easing in file.easings.items():
        if easing not in EASINGS:
            raise ValueError(
                f"{path}: keyframe {name!r} has the easing {easing[:40]!r}, known are {', '.join(EASINGS)}"
            )
    if file.cameras:
        try:
            timed_keys(file.cameras)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    note_jumps(file, path)
    return file


def note_jumps(file: PoseFile, path: str) -> None:
    """Say in a line where two keyframes of a film have one time."""
    names = file.timed
    jumps = [(a, b) for a, b in zip(names, names[1:], strict=False) if file.times[a] == file.times[b]]
    if jumps:
        (one, two), more = jumps[0], len(jumps) - 1
        print(
            f"warpcage: {path}: keyframes {one!r} and {two!r} are both at {file.times[one]:g} s: the film jumps there"
            + (f", and at {counted(more, 'other time')}" if more else ""),
            file=sys.stderr,
        )


def set_frames(args: argparse.Namespace, film: PoseFile | None, given: set[str]) -> list[float] | None:
    """Set number, rate and loop of the frames in `args` by the keys of a film; given: names of the options given.
    Returns the times of the frames, seconds; None, the frames being as they were asked for, without a film."""
    if film is None:
        if args.loop is not None:
            raise ValueError("--loop is for keys at times (a pose file with times, an animation): see --motion")
        return None
    if "frames" in given:
        raise ValueError("--frames does not go with keys at times, which say how long the film is: see --fps")
    args.loop = args.loop or film.loop or "once"
    if "fps" not in given:
        args.fps = USUAL_RATE if film.fps is None else frame_rate(film.fps)
    times = frame_times(film.length, args.fps, args.loop)
    args.frames = len(times)
    return times
