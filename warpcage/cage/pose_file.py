"""Files of poses: keys in time, cages, cameras; and those of other programs: glTF, USD, vertex caches, cage files."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import os
import pathlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_easing, checked_number, checked_path, checked_positive, listed, require_type, shown
from ..core.files import PathLike, atomic_path, errors_of, read_document, require_file
from ..core.names import CURVE, EASINGS, LOOPS, Easing, checked_choice, counted
from ..errors import InputError
from ..mesh.io import (
    ALL_OBJECTS,
    ENDINGS,
    MOTION_ENDINGS,
    file_up,
    object_names,
    read_object,
    turned_up,
    write_shown_mesh,
)
from ..mesh.io.gltf_animation import read_gltf_motion
from ..mesh.io.usd import USD_ENDINGS, read_usd_motion
from ..mesh.io.vertex_cache import CACHE_ENDINGS, read_vertex_cache, write_vertex_cache
from ..mesh.match import in_order, matched_order, posed_mesh
from ..mesh.mesh import require_mesh
from ..view.camera import Camera, CameraKey, camera_from_json, camera_json
from ..view.camera_path import camera_at, timed_keys
from ..view.motion import frame_times, value_along, value_at
from .cage import Cage
from .up_axis import is_pose, load_standing, standing_of_pose

_FORMAT, _VERSION = "warpcage poses", 1

#: Frames per second where nothing says another rate.
DEFAULT_RATE = 24.0

#: Endings of files that hold moving cages.
GLTF_ENDINGS = (".glb", ".gltf")
MOVING_ENDINGS = (*MOTION_ENDINGS, *CACHE_ENDINGS)

#: Most files of a sequence, and frames of a cache.
MAX_FILES = 20_000


class PoseFile:
    """Named keyframes of a rest cage.

    The file is JSON: format, version, cage (sha256 over its faces and float64 vertices, and both in full) and
    keyframes (name, vertices with all their digits, and optionally time and easing); optionally fps, loop and cameras
    (as in `warpcage.view.camera.CameraFile`, with times). Readers ignore unknown keys, so later versions may add some.
    A version that changes the meaning of these keys has a higher number.

    Args:
        rest: The cage that is posed.
        keyframes: Pose by name, each a Cage in any order that `Cage.match` takes, or vertices (v, 3) in world units.
            There may be none; `file[name] = pose` adds one, and `file[name]` is the pose as a Cage.

    Raises:
        ValueError: For a pose that does not match, or an empty name.

    Attributes:
        rest: The cage that is posed.
        times: Time of a keyframe, by name, seconds. Optional; `at` ignores it.
        easings: Easing from a keyframe to the next, by name: "smooth", "linear", "hold" or another of its names, or
            {"bezier": [x1, y1, x2, y2]}.
        fps: Frames per second of its film. None leaves it open.
        loop: How its film repeats, "once", "loop" or "ping-pong". None leaves it open.
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
        """The cage between keyframes, by a smooth interpolation that never overshoots them.

        Args:
            time: Number of a keyframe, from 0, or between two: 0.5 is halfway from the first to the second.
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
            The pose, interpolated as `warpcage.view.motion.value_at` describes.

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

    def subdivide(
        self, times: int = 1, *, faces: ArrayLike | None = None, vertices: ArrayLike | None = None
    ) -> PoseFile:
        """The same film of a finer cage: the cage at rest and all keyframes are cut alike; see `Cage.subdivide`.

        Args:
            times: How often, 1 to 4.
            faces: (k,) numbers of the faces that are cut. None chooses none.
            vertices: (k,) numbers of the vertices whose faces are cut. None chooses none; with neither, all are cut.

        Returns:
            The finer keyframes, with the same times, easings and cameras.

        Raises:
            ValueError: As `Cage.subdivide`.
        """

        def finer(pose: Cage) -> Cage:
            return pose.subdivide(times, faces=faces, vertices=vertices)

        file = PoseFile(finer(self.rest), ((name, finer(pose).vertices) for name, pose in self._poses.items()))
        file.times, file.easings, file.cameras = dict(self.times), dict(self.easings), list(self.cameras)
        file.fps, file.loop = self.fps, self.loop
        return file

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
            ValueError: For a time or an easing of no keyframe, a time that is not finite, an easing that is no name or
                curve, a rate that is not positive, an unknown loop, a camera without a time, or no keyframes to write.
        """
        self._check_moments()
        if pathlib.Path(path).suffix.lower() in (*CACHE_ENDINGS, *MOTION_ENDINGS):
            self._save_frames(path)
            return
        document = {
            "format": _FORMAT, "version": _VERSION,
            "cage": {"sha256": cage_hash(self.rest), "faces": self.rest.polygons,
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
        rate = self.fps or DEFAULT_RATE
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
            write_shown_mesh(
                path, self.rest.vertices, self.rest.faces, polygons=self.rest.polygons, frames=frames, fps=rate
            )

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
                raise InputError(f"the easing of keyframe {name!r} must be a name or {CURVE}, got {easing!r}")
        if self.fps is not None:
            self.fps = checked_positive(self.fps, "fps")
        if self.loop is not None:
            checked_choice(self.loop, "loop", LOOPS)
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
    """The easing of a keyframe, checked; files of a later version may have others."""
    if isinstance(easing, str) and easing not in EASINGS:
        known = f"{', '.join(EASINGS)} and {CURVE}"
        raise InputError(f"keyframe {name!r} has the easing {easing[:40]!r}, known are {known}")
    return checked_easing(easing, f"the easing of keyframe {name!r}")


def cage_hash(cage: Cage) -> str:
    """sha256 digits of the counts, the faces (little-endian int32) and the vertices (little-endian float64)."""
    digest = hashlib.sha256(f"{len(cage.vertices)} {cage.face_count}\n".encode())
    digest.update(np.ascontiguousarray(cage.face_array, dtype="<i4").tobytes())
    digest.update(np.ascontiguousarray(cage.vertices + 0.0, dtype="<f8").tobytes())
    return digest.hexdigest()


def posed_cage(rest: Cage, pose: Any, what: str) -> Cage:
    """A pose as callers give it: a Cage, vertices (v, 3) of any library in the order of `rest`, or a file of one pose.
    `what` begins the message where it is none of them."""
    if isinstance(pose, str | os.PathLike):
        return read_pose(pose, rest)
    posed = posed_mesh(rest, pose, what)
    require_type(posed, Cage, what)
    return posed


def read_pose(path: PathLike, rest: Cage) -> Cage:
    """The one pose that a file shows, of all that `PoseFile.load` reads."""
    shown = gltf_shown(path, rest)
    file = PoseFile(rest, {"shown": shown}) if shown else PoseFile.load(path, rest)
    if len(file) != 1:
        names = listed(file, 4, none="none")
        raise InputError(
            f"{str(path)!r} holds {counted(len(file), 'pose')} ({names}): take one, PoseFile.load(path, rest)[name]"
        )
    return file[file.names[0]]


def read_motion(
    path: PathLike, rest: Cage | None, *, name: str = "", up: str | None = None, fps: float | None = None
) -> PoseFile:
    """Keyframes in files of other programs: glTF, USD, a vertex cache, numbered cage files, or a posed cage alone.
    name: of an animation or shape, "" takes all; up: None finds the axis."""
    path = checked_path(path, "the file of poses")
    ending = path.suffix.lower()
    if ending in MOTION_ENDINGS and rest is None:
        rest = Cage.load(path, up=up)
    if rest is None:
        raise InputError(f"{str(path)!r} holds poses alone: give the cage at rest, or a pose file (.json) that has it")
    files = numbered_files(path)
    moving = sequence_poses(files, rest, fps=fps or DEFAULT_RATE, up=up) if files else None
    if ending in MOVING_ENDINGS:
        moving = file_poses(path, rest, name=name, up=up, fps=fps)
    if moving is not None:
        return moving
    if name:
        raise InputError(f"{str(path)!r}: there is no animation or shape key {name!r}: the file has no motion")
    return PoseFile(rest, {path.stem: Cage.load(path, up=up, reference=rest)})


def file_poses(
    path: PathLike, rest: Cage, *, name: str = "", up: str | None = None, fps: float | None = None
) -> PoseFile | None:
    """The motion in a glTF or USD file or a vertex cache as keyframes of a cage, as `gltf_poses` and `cache_poses`."""
    if pathlib.Path(path).suffix.lower() not in CACHE_ENDINGS:
        return gltf_poses(path, rest, name=name, up=up)
    file = cache_poses(path, rest, up=up, fps=fps)
    if name and name not in file:
        raise InputError(f"{path}: there is no frame {name!r}, only {listed(file)}")
    return file if not name else PoseFile(rest, {name: file[name]})


def cache_poses(path: PathLike, rest: Cage, *, up: str | None = None, fps: float | None = None) -> PoseFile:
    """The frames of a vertex cache as keyframes of the cage whose vertices it holds, in their order.
    `up` None finds the axis by the first frame; fps: of .pc2 files, which have frames, None is DEFAULT_RATE."""
    cache = read_vertex_cache(path)
    count, points = cache.vertices.shape[:2]
    if points != len(rest.vertices):
        raise InputError(
            f"{path} has {points} vertices, its cage at rest {len(rest.vertices)}: a vertex cache has no faces, and "
            "takes the vertices as they are in the file of the cage"
        )
    if count > MAX_FILES:
        raise InputError(f"{path}: {count} frames, at most {MAX_FILES} are read")
    was = up or standing_of_pose(rest.with_vertices(cache.vertices[0]), "z", rest).up
    rate = DEFAULT_RATE if fps is None else checked_positive(fps, "fps")
    times = cache.moments / rate if cache.in_frames else cache.moments
    file = PoseFile(rest)
    for index, (time, vertices) in enumerate(zip(times.tolist(), cache.vertices, strict=True)):
        key = f"frame {index}"
        file[key] = turned_up(vertices, was, "z")
        file.times[key], file.easings[key] = time, "linear"
    # on average: seconds of float32 lose digits
    file.fps = rate if cache.in_frames or count < 2 else round((count - 1) / float(times[-1]), 3)
    return file


def gltf_poses(path: PathLike, rest: Cage, *, name: str = "", up: str | None = None) -> PoseFile | None:
    """The motion in a glTF or USD file as keyframes of a cage, its vertices in any order; None where nothing moves.
    `name` "" takes the only animation, or all shapes; `up` None is that of the format."""
    # An animation is a keyframe for each frame, straight between; shapes (Blender's keys) alone are ones without times.
    path = require_file(path, "cage file")
    chosen = _object_of(path, rest)
    read = read_usd_motion if path.suffix.lower() in USD_ENDINGS else read_gltf_motion
    motion = read(path, name, chosen)
    if motion is None:
        return None
    was = up or file_up(path)
    base = Cage.load(path, up=was, object=chosen or ALL_OBJECTS)
    order = _order(rest, base, str(path))
    file = PoseFile(rest)
    for key, vertices in zip(motion.names, motion.vertices, strict=True):
        file[key] = in_order(rest, turned_up(vertices, was, "z"), order)
        if motion.times is not None:
            file.times[key], file.easings[key] = motion.times[len(file) - 1], "linear"
    file.fps = motion.fps
    return file


def gltf_shown(path: PathLike, rest: Cage, *, up: str | None = None) -> Cage | None:
    """The pose that the shapes of a glTF file show together, as a program that opens it does.
    None where the file has no shape on, or an animation, or is another one."""
    if pathlib.Path(path).suffix.lower() not in GLTF_ENDINGS:
        return None
    path = require_file(path, "cage file")
    chosen = _object_of(path, rest)
    motion = read_gltf_motion(path, object=chosen)
    if motion is None or motion.shown is None:
        return None
    was = up or "y"
    order = _order(rest, Cage.load(path, up=was, object=chosen or ALL_OBJECTS), str(path))
    return rest.with_vertices(in_order(rest, turned_up(motion.shown, was, "z"), order))


def _object_of(path: pathlib.Path, rest: Cage) -> str:
    """The object of a glTF or USD file that is called as the cage at rest, or alone has its mesh, "" for all of it."""
    names = object_names(path)
    if rest.object_name in names or len(names) < 2:
        return rest.object_name if rest.object_name in names else ""
    return read_object(path, fits=functools.partial(is_pose, rest)).name


def sequence_poses(
    paths: Sequence[PathLike], rest: Cage, *, fps: float = 24.0, up: str | None = None, expected: str | None = None
) -> PoseFile:
    """One cage file a frame as keyframes, each at the time of the number in its name, counted from the first.
    `up` None finds the axis from the first file and the cage at rest, or else takes `expected` (None: the format's)."""
    # A number that is missing leaves its time to the way between, which is straight.
    rate = checked_positive(fps, "fps")
    numbers = [number for path in paths if (number := _number(pathlib.Path(path))) is not None]
    if not numbers or len(set(numbers)) < len(paths):
        raise InputError("a sequence of cage files needs a number at the end of each name, another one for each")
    first, standing = load_standing(Cage, paths[0], up=up, reference=rest, expected=expected)
    order = _order(rest, first, str(paths[0]))  # vertices may come in another order, the same in all files
    file = PoseFile(rest)
    for path, number in zip(paths, numbers, strict=True):
        cage = first if path is paths[0] else Cage.load(path, up=standing.up, object=first.object_name or None)
        if not np.array_equal(cage.face_array, first.face_array):
            raise InputError(f"cage {str(path)!r} has other faces than {str(paths[0])!r}: one cage moves in a sequence")
        name = pathlib.Path(path).stem
        file[name] = in_order(rest, cage.vertices, order)
        file.times[name], file.easings[name] = (number - numbers[0]) / rate, "linear"
    file.fps = rate
    return file


def numbered_files(text: PathLike) -> list[pathlib.Path] | None:
    """The cage files of a folder, or of a name with # for the digits of its number (walk_####.obj), by their numbers.
    None where the text is neither."""
    path = pathlib.Path(text)
    if path.is_dir():
        found = [file for file in path.iterdir() if file.suffix.lower() in ENDINGS and _number(file) is not None]
    elif "#" in path.name and not path.exists():
        pattern = re.compile(re.sub(r"(?:\\?#)+", r"(\\d+)", re.escape(path.name)))
        found = [file for file in path.parent.glob("*") if pattern.fullmatch(file.name)]
    else:
        return None
    if not found:
        raise InputError(f"{str(text)!r}: no cage file with a number at the end of its name is there")
    if len(found) > MAX_FILES:
        raise InputError(f"{str(text)!r}: {len(found)} cage files, at most {MAX_FILES} are read")
    return sorted(found, key=lambda file: (_number(file) or 0, file.name))


def are_numbered(paths: Sequence[PathLike]) -> bool:
    """Whether files are named alike but for a number at the end, each with another one, ascending."""
    files = [pathlib.Path(path) for path in paths]
    numbers = [_number(file) for file in files]
    heads = {(file.parent, re.sub(r"\d+$", "", file.stem), file.suffix.lower()) for file in files}
    alike = len(files) > 1 and None not in numbers and len(heads) == 1
    return alike and all(one < two for one, two in itertools.pairwise(numbers))  # pyright: ignore[reportOperatorIssue]


def _number(path: pathlib.Path) -> int | None:
    """The number at the end of a file's name."""
    found = re.search(r"(\d{1,9})$", path.stem)
    return int(found[1]) if found else None


def _order(rest: Cage, mesh: Cage, name: str) -> np.ndarray:
    """(v,) numbers of a mesh's vertices in the order of a cage. It is found once: a symmetric cage could be laid over
    its poses in several ways."""
    try:
        return matched_order(rest, mesh)
    except ValueError as error:
        raise InputError(f"cage {name!r} does not fit its rest cage: {error}") from None
