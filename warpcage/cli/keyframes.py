"""Poses as words: cage files, keyframes of pose files (poses.json:wave), or presets such as bend:40:x:z."""

from __future__ import annotations

import pathlib
import re
import sys

from ..cage.cage import Cage
from ..cage.pose_file import PoseFile
from ..view.film import keyframe_weights, pose_along

#: Preset -> what it takes, the amount that changes nothing, and how many names of axes it may have.
PRESETS = {"rest": (0.0, 0), "bend": (0.0, 2), "twist": (0.0, 1), "taper": (1.0, 1), "stretch": (1.0, 1),
           "scale": (1.0, 0), "rotate": (0.0, 1), "translate": (0.0, 0)}  # fmt: skip
PRESET_HELP = (
    "rest, bend:DEGREES[:AXIS[:TOWARDS]], twist:DEGREES[:AXIS], taper:FACTOR[:AXIS], "
    "stretch:FACTOR[:AXIS], scale:FACTOR, rotate:DEGREES[:AXIS] or translate:X:Y:Z"
)


class Preset:
    """A pose by its name: `family` (its kind and axes) and `amount`, a tuple of numbers."""

    def __init__(self, text: str):
        kind, *words = text.split(":")
        neutral, axis_count = PRESETS[kind]
        number_count = {"rest": 0, "translate": 3}.get(kind, 1)
        try:
            amount = [float(word) for word in words[:number_count]]
        except ValueError:
            amount = []
        axes = words[number_count:]
        good = len(amount) == number_count and all(abs(number) < float("inf") for number in amount)
        good = good and len(axes) <= axis_count and all(re.fullmatch("-?[xyz]", axis) for axis in axes)
        good = good and not any(axis.startswith("-") for axis in axes[:1])
        if not good:
            raise ValueError(f"pose {text!r} is no preset: {PRESET_HELP}")
        self.kind, self.amount = kind, tuple(amount)
        self.family = (kind, *axes)
        self.neutral = neutral

    def at(self, rest, amount):
        """`rest` posed by another amount of the same."""
        kind, *axes = self.family
        named = dict(zip(("axis", "towards"), axes, strict=False))
        if kind == "rest":
            return rest
        if kind == "bend" and named.get("axis") == "x" and "towards" not in named:
            named["towards"] = "z"
        return getattr(rest, kind)(tuple(amount) if kind == "translate" else float(amount[0]), **named)


def is_preset(text: str) -> bool:
    return text.split(":")[0] in PRESETS and not pathlib.Path(text).exists()


def pose_file(text: str) -> tuple[str, str] | None:
    """File and keyframe ("" for all) of a word that names a pose file, or None for another."""
    found = re.fullmatch(r"(.+\.json)(?::(.*))?", text, re.IGNORECASE)
    return (found[1], found[2] or "") if found else None


def read_poses(rest, text: str, up: str | None = None, usable: bool = True) -> list:
    """The posed cages that a word of --posed names, those of a whole pose file in their order; up: of --cage-up, the
    axis that points up in a cage file. Unusable ones are refused unless `usable` is False."""
    if is_preset(text):
        preset = Preset(text)
        poses = [preset.at(rest, preset.amount)]
    elif pose_file(text):
        path, name = pose_file(text)
        file = PoseFile.load(path, rest)
        if not len(file):
            raise ValueError(f"pose file {path!r} holds no keyframes")
        poses = [file[name] for name in ([name] if name else file.names)]
    else:
        poses = [matched(rest, Cage.load(text, up=up), text)]
    for posed in poses if usable else ():
        posed.require_usable(f"cage {text!r}")
    return poses


def read_pose(rest, text: str, up: str | None = None, usable: bool = True):
    """The one posed cage that a word of --posed names."""
    poses = read_poses(rest, text, up, usable)
    if len(poses) > 1:
        raise ValueError(f"pose file {text!r} holds {len(poses)} keyframes: name one, as in {text}:NAME")
    return poses[0]


def matched(rest, posed, name: str):
    """`posed` with the vertices and faces of `rest` in their order, saying so where they came in another."""
    import numpy as np

    try:
        found = rest.match(posed)
    except ValueError as error:
        raise ValueError(f"cage {name!r} does not fit its rest cage: {error}") from None
    if not np.array_equal(posed.faces, rest.faces) or len(posed.vertices) != len(rest.vertices):
        print(f"warpcage: cage {name!r} comes in another order than its rest cage: matched", file=sys.stderr)
    if lies_on_its_side(rest.vertices, found.vertices):
        print(
            f"warpcage: warning: cage {name!r} would lie much nearer to its rest cage with another axis up: write "
            "both with the same one (see --cage-up)",
            file=sys.stderr,
        )
    return found


def lies_on_its_side(rest, posed) -> bool:
    """Whether vertices (v, 3) halve their root mean square distance to those at rest when y and z up are exchanged."""
    import numpy as np

    x, y, z = posed.T
    exchanged = [np.stack(turned, axis=1) for turned in ((x, -z, y), (x, z, -y))]
    here, *there = (np.linalg.norm(vertices - rest) for vertices in (posed, *exchanged))
    return min(there) < 0.5 * here


class Keyframes:
    """Rest and the poses after it; `at` says how the cage stands between two of them.

    Where all poses are one preset by several amounts it is the amount that changes, so that a bend stays an arc;
    otherwise each vertex goes its own way from pose to pose.
    """

    def __init__(self, rest, texts: list[str], interpolation: str, up: str | None = None):
        self.rest, self.interpolation = rest, interpolation
        self.cages = [rest] + [pose for text in texts for pose in read_poses(rest, text, up)]
        self.preset, self.amounts = None, []
        presets = [Preset(text) if is_preset(text) else None for text in texts]
        families = {preset.family for preset in presets if preset and preset.kind != "rest"}
        if all(presets) and len(families) == 1:
            self.preset = next(preset for preset in presets if preset.kind != "rest")
            still = (self.preset.neutral,) * len(self.preset.amount)
            self.amounts = [still] + [still if preset.kind == "rest" else preset.amount for preset in presets]

    def at(self, place: float):
        """The cage at a place, 0 rest, 1 the first pose, and so on."""
        if self.preset is None:
            return pose_along(self.cages, place, self.interpolation)
        weights = keyframe_weights(place, len(self.amounts), self.interpolation)
        columns = zip(*self.amounts, strict=True)
        return self.preset.at(self.rest, [float(weights @ list(column)) for column in columns])

    @property
    def vertices(self):
        """(n, 3) of all cages, so that a camera can hold them all."""
        import numpy as np

        return np.concatenate([cage.vertices for cage in self.cages])
