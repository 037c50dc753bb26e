"""The words of --posed: cage files, keyframes of pose files (poses.json:wave), and presets such as bend:40:x:z."""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from ..cage.cage import Cage
from ..cage.motion import gltf_poses, gltf_shown, numbered_files, sequence_poses
from ..cage.pose_file import PoseFile
from ..cage.presets import Preset, is_preset
from ..cage.up_axis import load_standing
from ..core.checks import listed
from ..view.motion import pose_along, value_along
from .film_keys import gltf_file as gltf_file
from .film_keys import pose_file as pose_file
from .film_keys import read_film
from .standing import ending, say_standing


def read_poses(
    rest: Cage, text: str, up: str | None = None, usable: bool = True, expected: Mapping[str, str] | None = None
) -> list[Cage]:
    """The posed cages that a word of --posed names: one, or all of a file, a folder or a pattern in their order.
    up: "y" or "z", None finds it from the rest cage; expected: axis by ending where nothing speaks for another."""
    # A word is a cage file, a preset, a pose file or a glTF file that moves, one keyframe of either, a folder or a
    # pattern (walk_####.obj) of numbered cage files.
    if is_preset(text):
        preset = Preset(text)
        poses = [preset.at(rest, preset.amount)]
    elif named := pose_file(text):
        path, name = named
        file = PoseFile.load(path, rest)
        if not len(file):
            raise ValueError(f"pose file {path!r} holds no keyframes")
        if name and name not in file:
            raise ValueError(f"pose file {path!r}: there is no keyframe {name!r}, only {listed(file)}")
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


def read_pose(
    rest: Cage, text: str, up: str | None = None, usable: bool = True, expected: Mapping[str, str] | None = None
) -> Cage:
    """The one posed cage that a word of --posed names; see `read_poses`."""
    poses = read_poses(rest, text, up, usable, expected)
    return poses[0] if len(poses) == 1 else only_pose(rest, text, up, poses)


def only_pose(rest: Cage, text: str, up: str | None, poses: Sequence[Cage]) -> Cage:
    """The pose that a file of several shows by itself, as glTF files do. Raises ValueError where it shows none."""
    if named := gltf_file(text):
        shown = None if named[1] else gltf_shown(named[0], rest, up=up)
        if shown is not None:
            return shown
        file = gltf_poses(named[0], rest, name=named[1], up=up)
        if file is not None and file.times:
            raise ValueError(
                f"{text!r} holds an animation of {len(file)} frames: `warpcage animate` makes a film of it"
            )
    raise ValueError(f"{text!r} holds {len(poses)} keyframes: name one, as in {text}:NAME")


def _moving_poses(rest: Cage, text: str, up: str | None, expected: Mapping[str, str] | None) -> list[Cage]:
    """The poses of a word that names a glTF file that moves, or numbered files; none for other words."""
    if named := gltf_file(text):
        file = gltf_poses(named[0], rest, name=named[1], up=up)
        if file is None and named[1]:
            raise ValueError(f"{named[0]}: there is no animation or shape {named[1]!r}: nothing moves in it")
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
        raise ValueError(f"cage {name!r} does not fit its rest cage: {error}") from None
    if not np.array_equal(posed.faces, rest.faces) or len(posed.vertices) != len(rest.vertices):
        print(f"warpcage: cage {name!r} has another order than its rest cage: matched", file=sys.stderr)
    return found


def expected_ups(rest: Cage, texts: Sequence[str], expected: Mapping[str, str] | None = None) -> dict[str, str]:
    """The axis that points up in files of poses, by ending: what is sure of one holds for those that say nothing."""
    found = dict(expected or {})
    files = [text for text in texts if pathlib.Path(text).is_file() and not pose_file(text)]
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
        # words that say themselves when each pose is reached make a film of their own: see `read_film`
        timed: bool = False,
        fps: Fraction | None = None,  # rate of numbered cage files in such a film; None is the usual one
    ):
        self.rest, self.interpolation = rest, interpolation
        self.preset: Preset | None = None  # whose amount is interpolated
        self.amounts: list[tuple[float, ...]] = []  # one per cage
        # keys at times, of which the poses are; None where the poses follow one another evenly
        self.film = read_film(rest, texts, up, expected, fps) if timed else None
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
