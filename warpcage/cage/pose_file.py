"""Poses by their names (bend:40:x:z, twist:60) and files of poses: keys in time, cages and cameras."""

from __future__ import annotations

import hashlib
import json
import pathlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_easing, checked_number, checked_path, checked_positive, listed, shown
from ..core.files import PathLike, atomic_path, errors_of, read_document, require_file
from ..core.names import CURVE, EASINGS, LOOPS, Easing, require_name
from ..errors import InputError
from ..mesh.io import ENDINGS, MOTION_ENDINGS, write_shown_mesh
from ..mesh.io.vertex_cache import CACHE_ENDINGS, write_vertex_cache
from ..mesh.mesh import require_mesh
from ..view.camera import Camera, CameraKey, camera_from_json, camera_json
from ..view.camera_path import camera_at, timed_keys
from ..view.motion import frame_times, value_along, value_at
from .axes import AXIS_WORDS, axis_of, default_towards, is_axis
from .cage import Cage

_FORMAT, _VERSION = "warpcage poses", 1


class PoseFile:
    """Named keyframes of a rest cage.

    The file is JSON: format, version, cage (sha256 over its faces and float64 vertices, and both in full) and
    keyframes (name and vertices, each number with all its digits; where it was given one, time and easing); where they
    were given, fps, loop and cameras (as `warpcage.view.camera.CameraFile` has them, with times). Readers ignore
    keys that they do not know, so later versions may add some. A version that changes the meaning of these keys has a
    higher number.

    Args:
        rest: The cage that is posed.
        keyframes: Pose by name, each a Cage in any order that `Cage.match` takes, or vertices (v, 3) in world units.
            There may be none; `file[name] = pose` adds one, and `file[name]` is the pose as a Cage.

    Raises:
        ValueError: For a pose that does not match, or an empty name.

    Attributes:
        rest: The cage that is posed.
        times: When a keyframe is reached, by name, seconds. A keyframe need not have one, and `at` does not ask for it.
        easings: How the way from a keyframe to the next goes, by name: a word such as "smooth", "linear" or "hold", or
            {"bezier": [x1, y1, x2, y2]}.
        fps: Frames per second of its film. None leaves it open.
        loop: What its film does at its end, "once", "loop" or "ping-pong". None leaves it open.
        cameras: Keys of the camera of its film, each with a time; there may be none.
    """

    def __init__(self, rest: Cage, keyframes: Mapping[str, Cage | ArrayLike] | Iterable[tuple[str, Any]] = ()):
        require_mesh(rest, "the rest cage must be")
        self.rest = rest
        self._poses: dict[str, Cage] = {}
        self.times: dict[str, float] = {}
        self.easings: dict[str, Easing] = {}
        self.fps: float | None = None
        self.loop: str | None = None
        self.cameras: list[CameraKey] = []
        for name, pose in dict(keyframes).items():
            self[name] = pose

    def __setitem__(self, name: str, pose: Cage | ArrayLike) -> None:
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"a keyframe needs a name, got {name!r}")
        try:
            self._poses[name] = self.rest.match(pose) if isinstance(pose, Cage) else self.rest.with_vertices(pose)
        except ValueError as error:
            raise InputError(f"keyframe {name!r}: {error}") from None

    def __delitem__(self, name: str) -> None:
        self[name]
        for held in (self._poses, self.times, self.easings):
            held.pop(name, None)

    def __getitem__(self, name: str) -> Cage:
        if name not in self._poses:
            raise InputError(f"there is no keyframe {name!r}, only {listed(self._poses, none='the rest cage')}")
        return self._poses[name]

    def __len__(self) -> int:
        return len(self._poses)

    def __iter__(self) -> Iterator[str]:
        return iter(self._poses)

    def __contains__(self, name: object) -> bool:
        return name in self._poses

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order in which they were added."""
        return tuple(self._poses)

    def blend(self, weights: Mapping[str, float]) -> Cage:
        """The rest cage plus weighted displacements of keyframes: v = rest + sum w (pose - rest).

        Args:
            weights: Weight by name, any finite number. {} is the rest cage.

        Returns:
            The pose.

        Raises:
            ValueError: For unknown names or weights that are not finite.
        """
        vertices = self.rest.vertices.copy()
        if not isinstance(weights, Mapping):
            raise InputError(f"weights must be numbers by names of keyframes, got {shown(weights)}")
        for name, weight in weights.items():
            weight = checked_number(weight, f"the weight of keyframe {name!r}")
            vertices += weight * (self[name].vertices - self.rest.vertices)
        return self.rest.with_vertices(vertices)

    def at(self, time: float, names: Iterable[str] | None = None) -> Cage:
        """The cage at a place among keyframes, on a smooth way that never goes beyond them.

        Args:
            time: Keyframes from the first one: 0 is the first, 0.5 halfway to the second.
            names: Names of the keyframes in their order. None takes all in the order in which they were added.

        Returns:
            The pose.

        Raises:
            ValueError: For a time outside the sequence or unknown names.
        """
        if names is not None and (isinstance(names, str) or not isinstance(names, Iterable)):
            raise InputError(f"names must be a list of keyframes, got {shown(names)}")
        names, time = list(self.names if names is None else names), checked_number(time, "time")
        if not names or not 0.0 <= time <= len(names) - 1:
            raise InputError(f"time must be 0 to {len(names) - 1} for {len(names)} keyframes, got {time}")
        return self.rest.with_vertices(value_along([self[name].vertices for name in names], time))

    @property
    def timed(self) -> tuple[str, ...]:
        """Names of the keyframes that have a time, by their times. Those of one time keep their order."""
        return tuple(sorted((name for name in self._poses if name in self.times), key=lambda name: self.times[name]))

    @property
    def length(self) -> float:
        """Seconds from 0 to the last time of a keyframe or a camera, 0 where there is none."""
        return max([0.0, *self.times.values(), *(key.time or 0.0 for key in self.cameras)])

    def at_time(self, seconds: float) -> Cage:
        """The cage at a time of its film. Before the first time and after the last one it is still.

        A keyframe without an easing has "smooth". Where the film loops, from a keyframe at 0 to an equal one at its
        end, it goes through them without stopping. Without keyframes it is the cage at rest.

        Args:
            seconds: The time.

        Returns:
            The pose; `warpcage.view.motion.value_at` says how it goes.

        Raises:
            ValueError: If no keyframe has a time, or one has an easing that is not known.
        """
        seconds, names = checked_number(seconds, "a time of the film"), self.timed
        if not len(self):
            return self.rest
        if not names:
            raise InputError("no keyframe has a time")
        times, values = [self.times[name] for name in names], [self._poses[name].vertices for name in names]
        easings = [self.easings.get(name, "smooth") for name in names]
        for name, easing in zip(names, easings, strict=True):
            known_easing(name, easing)
        whole = times[0] == 0.0 and times[-1] == self.length
        closed = self.loop == "loop" and whole and np.array_equal(values[0], values[-1])
        return self.rest.with_vertices(value_at(times, values, seconds, easings, closed=closed))

    def camera_at(self, seconds: float) -> Camera:
        """The camera at a time of its film; see `warpcage.view.camera_path.camera_at`.

        Args:
            seconds: The time.

        Returns:
            The camera.

        Raises:
            ValueError: If the file has no cameras, or pictures of several sizes.
        """
        keys = timed_keys(self.cameras)
        first, last = keys[0], keys[-1]
        closed = self.loop == "loop" and first.time == 0.0 and last.time == self.length
        closed = closed and np.array_equal(first.camera.camera_to_world, last.camera.camera_to_world)
        return camera_at(keys, seconds, closed=closed)

    def save(self, path: PathLike) -> None:
        """Write the file, whole or not at all.

        Args:
            path: The file, usually .json. A vertex cache, .pc2 or .mdd, holds the vertices alone, z up, of each frame
                of the film (24 a second where `fps` is None), or of one keyframe after the other where none has a time.
                glTF (.glb, .gltf) and USD (.usd, .usda, .usdc) hold the cage at rest and the same frames.

        Raises:
            ValueError: For a time or an easing of no keyframe, a time that is not finite, an easing that is no word, a
                rate that is not positive, a loop that is not known, a camera without a time, or frames of no keyframe.
        """
        self._check_moments()
        if pathlib.Path(path).suffix.lower() in (*CACHE_ENDINGS, *MOTION_ENDINGS):
            self._save_frames(path)
            return
        document = {
            "format": _FORMAT, "version": _VERSION,
            "cage": {"sha256": cage_hash(self.rest), "faces": self.rest.faces.tolist(),
                     "vertices": self.rest.vertices.tolist()},
            "keyframes": [
                {"name": name, "vertices": pose.vertices.tolist(), **self._moment(name)}
                for name, pose in self._poses.items()
            ],
        }  # fmt: skip
        document |= {key: value for key, value in (("fps", self.fps), ("loop", self.loop)) if value is not None}
        document |= {"cameras": [camera_json(key) for key in self.cameras]} if self.cameras else {}
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(document) + "\n", encoding="utf-8")

    def _save_frames(self, path: PathLike) -> None:
        rate = self.fps or 24.0
        if not len(self):
            raise InputError(f"{path}: a file of frames needs a keyframe")
        if self.timed:
            cages = [self.at_time(time) for time in frame_times(self.length, rate, self.loop or "once")]
        else:
            cages = list(self._poses.values())
        frames = np.stack([cage.vertices for cage in cages])
        if pathlib.Path(path).suffix.lower() in CACHE_ENDINGS:
            write_vertex_cache(path, frames, rate)
        else:
            write_shown_mesh(path, self.rest.vertices, self.rest.faces, frames=frames, fps=rate)

    def _moment(self, name: str) -> dict[str, Any]:
        """What the file holds of a keyframe besides its vertices."""
        parts = (("time", self.times), ("easing", self.easings))
        return {key: values[name] for key, values in parts if name in values}

    def _check_moments(self) -> None:
        """Raise ValueError for times and easings that cannot be, and make all times floats."""
        for name in (*self.times, *self.easings):
            self[name]
        self.times = {name: checked_number(time, f"the time of keyframe {name!r}") for name, time in self.times.items()}
        for name, easing in self.easings.items():
            if isinstance(easing, Mapping):
                self.easings[name] = known_easing(name, easing)
            elif not isinstance(easing, str) or not easing.strip():
                raise InputError(f"the easing of keyframe {name!r} must be a word or {CURVE}, got {easing!r}")
        if self.fps is not None:
            self.fps = checked_positive(self.fps, "fps")
        if self.loop is not None:
            require_name(self.loop, LOOPS, "loop")
        for index, key in enumerate(self.cameras):
            if key.time is None:
                raise InputError(f"camera {key.name or index} needs a time")

    @classmethod
    def load(
        cls,
        path: PathLike,
        rest: Cage | None = None,
        *,
        name: str = "",
        up: str | None = None,
        fps: float | None = None,
    ) -> PoseFile:
        """Read a file of keyframes, its own or that of another program.

        An animation of glTF or USD has a keyframe for each frame, shapes have one each; so has each frame of a vertex
        cache (.pc2, .mdd), whose vertices come in the order of the cage at rest, and each of numbered cage files (a
        folder, or `walk_####.obj`). A posed cage alone is one keyframe.

        Args:
            path: The file.
            rest: The cage to be posed; its order may differ from the file's. None takes the cage in the file, which
                pose files (.json), glTF and USD have.
            name: The animation or the shape of a glTF file that is taken. "" takes the only one, or all shapes.
            up: The axis that points up in files of other programs, "z" or "y". None finds it.
            fps: Frames per second of numbered files and of .pc2 files. None is 24.

        Returns:
            The keyframes.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: For another kind of file, a newer version, a damaged cage, a rest cage that does not match, or
                none where the file has none.
        """
        path = checked_path(path, "the pose file")
        ending = path.suffix.lower()
        if ending in (*ENDINGS, *CACHE_ENDINGS) or "#" in path.name or path.is_dir():
            from .motion import read_motion  # which makes pose files

            return read_motion(path, rest, name=name, up=up, fps=fps)
        path = require_file(path, "pose file")
        with errors_of(path, "pose file"):
            document = read_document(path, "pose file", _FORMAT, _VERSION)
            keyframes = document["keyframes"]
            if not isinstance(keyframes, list):
                raise InputError(f"its keyframes must be a list, got {type(keyframes).__name__}")
            own = Cage(document["cage"]["vertices"], document["cage"]["faces"])
            if cage_hash(own) != document["cage"]["sha256"]:
                raise InputError("its cage does not have the hash it names: the file was changed")
            poses = {frame["name"]: own.with_vertices(frame["vertices"]) for frame in keyframes}
            if len(poses) < len(keyframes):
                names = [frame["name"] for frame in keyframes]
                twice = next(name for name in names if names.count(name) > 1)
                raise InputError(f"two of its keyframes are named {twice!r}")
            file = cls(own if rest is None else rest, poses)
            file.times = {frame["name"]: frame["time"] for frame in keyframes if "time" in frame}
            file.easings = {frame["name"]: frame["easing"] for frame in keyframes if "easing" in frame}
            file.fps, file.loop = document.get("fps"), document.get("loop")
            file.cameras = [camera_from_json(entry, index) for index, entry in enumerate(document.get("cameras", []))]
            file._check_moments()
            return file


def known_easing(name: str, easing: Easing) -> Easing:
    """The easing of a keyframe, which films know; files of a later version may have words that none knows."""
    if isinstance(easing, str) and easing not in EASINGS:
        known = f"{', '.join(EASINGS)} and {CURVE}"
        raise InputError(f"keyframe {name!r} has the easing {easing[:40]!r}, known are {known}")
    return checked_easing(easing, f"the easing of keyframe {name!r}")


def cage_hash(cage: Cage) -> str:
    """sha256 digits of the counts, the faces (little-endian int32) and the vertices (little-endian float64)."""
    digest = hashlib.sha256(f"{len(cage.vertices)} {len(cage.faces)}\n".encode())
    digest.update(np.ascontiguousarray(cage.faces, dtype="<i4").tobytes())
    digest.update(np.ascontiguousarray(cage.vertices + 0.0, dtype="<f8").tobytes())
    return digest.hexdigest()


#: Preset -> the amount that changes nothing, and how many axes it may name.
PRESETS = {"rest": (0.0, 0), "bend": (0.0, 2), "twist": (0.0, 1), "taper": (1.0, 1), "stretch": (1.0, 1),
           "scale": (1.0, 0), "rotate": (0.0, 1), "translate": (0.0, 0)}  # fmt: skip

PRESET_HELP = (
    "rest, bend:DEGREES[:AXIS[:TOWARDS]], twist:DEGREES[:AXIS], taper:FACTOR[:AXIS], "
    "stretch:FACTOR[:AXIS], scale:FACTOR, rotate:DEGREES[:AXIS] or translate:X:Y:Z; "
    f"an AXIS is {AXIS_WORDS}"
)


class Preset:
    """A pose by its name, such as "bend:40:x:z"."""

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
        good = good and len(axes) <= axis_count and all(map(is_axis, axes))
        good = good and not any(re.fullmatch("[-+][xyz]", axis) for axis in axes[:1])
        if not good:
            raise InputError(f"pose {text!r} is not a preset: {PRESET_HELP}")
        self.kind, self.amount = kind, tuple(amount)
        self.family = (kind, *axes)  # presets of one family differ in the amount alone
        self.neutral = neutral  # the number that changes nothing

    def at(self, rest: Cage, amount: Sequence[float]) -> Cage:
        """A cage posed by this preset with another amount."""
        kind, *axes = self.family
        named = dict(zip(("axis", "towards"), map(axis_of, axes), strict=False))
        if kind == "rest":
            return rest
        if kind == "bend" and "axis" in named and "towards" not in named:
            named["towards"] = default_towards(rest, named["axis"])
        return getattr(rest, kind)(tuple(amount) if kind == "translate" else float(amount[0]), **named)


def is_preset(text: str, folder: PathLike = "") -> bool:
    """Whether a word for a pose begins as a preset and no file of the folder has this name."""
    return text.split(":")[0] in PRESETS and not pathlib.Path(folder, text).exists()
