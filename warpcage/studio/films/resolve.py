"""Loads what names in edits and shots refer to: cages at rest, poses, arrays and cameras."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import os
import pathlib
import re
import stat
from collections.abc import Callable, Hashable, Mapping, Sequence
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np

from ...cage.axes import with_up
from ...cage.cage import Cage
from ...cage.pose_file import (
    DEFAULT_RATE,
    GLTF_ENDINGS,
    MOVING_ENDINGS,
    PoseFile,
    are_numbered,
    cage_hash,
    file_poses,
    gltf_shown,
    known_easing,
    numbered_files,
    sequence_poses,
)
from ...cage.presets import Preset, is_preset
from ...cage.random_poses import PoseProbe, RandomPoses
from ...cage.up_axis import UpAxis, load_standing
from ...core.checks import shown
from ...core.files import DAMAGED, PathLike, errors_of, file_stamp, read_json, require_file
from ...core.memory import LRUCache
from ...core.names import counted, named_errors
from ...core.npz import NpyFile
from ...edits.spec import RANDOM, canonical, split_reference
from ...errors import InputError
from ...mesh.io import ENDINGS, file_up
from ...mesh.io.vertex_cache import CACHE_ENDINGS
from ...scene.formats.transforms import TransformsCameras
from ...splats.splat_field import AnyField
from ...view.camera import Camera, CameraFile, camera_from_json, fitted
from ...view.camera_file import camera_program
from ...view.camera_path import timed_keys

#: Most entries that are kept: files, cages whose poses can be measured at once, drawn poses, and cameras of numbers.
MAX_FILES, MAX_PROBES, MAX_POSES, MAX_CAMERAS = 32, 8, 16, 64

Value = TypeVar("Value")


def ending(text: str) -> str:
    """The ending of a file, lower case."""
    return pathlib.Path(text).suffix.lower()


def file_and_name(text: str, endings: str) -> tuple[str, str] | None:
    """A file of some endings ("json|glb") and what is named of it, "" for all; None for any other text."""
    found = re.fullmatch(rf"(.+\.(?:{endings}))(?::(.*))?", text, re.IGNORECASE)
    return (found[1], found[2] or "") if found else None


@dataclasses.dataclass(frozen=True)
class RestCage:
    """A cage at rest, and what is known from its file and its field for reading poses."""

    cage: Cage
    ups: Mapping[str, str] = dataclasses.field(default_factory=dict)  # axis that points up in cage files, by ending
    field_up: Sequence[float] | None = None  # (3,) what "up" means in presets

    @functools.cached_property
    def hash(self) -> str:
        return cage_hash(self.cage)


class AssetResolver:
    """Loads what names refer to: "file:key" of the command line, or "file#key", arrays and random poses of JSON.
    What was read is kept while its file stays as it is. An argument `up` of None finds the axis that points up."""

    def __init__(
        self, base: PathLike = "", *, in_json: bool = False, report: Callable[[str], Any] = lambda message: None
    ):
        """base: folder of relative paths; in_json: whether names are those of JSON.
        report: takes a line about a file that was read differently than its user may expect."""
        self.base, self.in_json, self.report = pathlib.Path(base), in_json, report
        self._files: LRUCache[Any] = LRUCache(MAX_FILES)
        self._probes: LRUCache[PoseProbe] = LRUCache(MAX_PROBES)
        self._drawn: LRUCache[np.ndarray] = LRUCache(MAX_POSES)

    def path(self, name: str) -> pathlib.Path:
        return self.base / name

    def split(self, text: str) -> tuple[str, str]:
        """A file and the key that a text names in it, "" for all of the file."""
        by_mark = split_reference(text)
        by_colon = file_and_name(text, "|".join(each[1:] for each in (".json", *MOVING_ENDINGS))) or (text, "")
        found, other, mark = (by_mark, by_colon, "#") if self.in_json else (by_colon, by_mark, ":")
        if not found[1] and other[1] and not self.path(text).exists() and self.path(other[0]).is_file():
            where = "job files" if self.in_json else "flags and edits"
            raise InputError(f"{text!r}: in {where} a keyframe of a file is named so: {other[0]}{mark}{other[1]}")
        return found

    def stamped(self, name: str, what: str) -> tuple[str, tuple[int, int]]:
        """A file and its stamp, by which what was made of it is known. Raises FileNotFoundError."""
        path = os.path.join(self.base, name)
        with contextlib.suppress(OSError):  # one look at each file of each item
            status = os.stat(path)
            if stat.S_ISREG(status.st_mode):
                return path, (status.st_size, status.st_mtime_ns)
        return path, file_stamp(require_file(self.path(name), what))

    def _kept(self, name: str, what: str, read: Callable[[pathlib.Path], Value], more: Hashable = None) -> Value:
        """What was read from a file, read again where the file has changed."""
        path, stamp = self.stamped(name, what)
        return self._files.get((path, stamp, what, more), lambda: read(pathlib.Path(path)))

    def array(self, value: Any, what: str) -> np.ndarray:
        """The numbers of an array as they are in its file: "file.npy", "file.npy#17" (its row 17), or nested lists.
        what: how messages call it."""
        if not isinstance(value, str):
            try:
                found = np.asarray(value)
            except ValueError:
                found = np.empty(0, object)
            if found.dtype.kind not in "fiu":
                raise InputError(f"{what} must hold numbers, in lists of equal length, got {shown(value)}")
            return found
        name, key = split_reference(value)
        if ending(name) != ".npy":
            raise InputError(f"{what} must be an .npy file, a row of one (file.npy#17) or nested lists, got {value!r}")
        file = self._kept(name, "array file", NpyFile)
        if not key:
            return file.read()
        if not key.isdigit():
            raise InputError(f"{what}: {value!r} names no row: write {name}#17")
        return file.row(int(key))

    # -- cages at rest

    def rest(
        self, cage: Any, up: str | None = None, around: Any = None, *, object: str | None = None, part: bool = False
    ) -> RestCage:
        """The cage at rest of a file, or of arrays `vertices` and `faces`, usable; object: as `load_standing` has it.
        around: field or mesh by which the axis is found, None takes the format's; part: it may hold only a part."""
        ups = {}
        if isinstance(cage, str):
            found, standing = load_standing(Cage, self.path(cage), up=up, reference=around, object=object)
            found.require_usable(f"cage {cage!r}")
            if standing.turned or standing.doubtful or standing.likelier or not part:
                self.report_standing(cage, standing, "--cage-up")
            ups[ending(cage)] = standing.up
        else:
            vertices = self.array(cage["vertices"], "'vertices' of 'cage'")
            faces = cage["faces"]
            if isinstance(faces, str) or len({len(face) for face in faces if isinstance(face, list)}) < 2:
                faces = self.array(faces, "'faces' of 'cage'")  # others have different numbers of corners
            found = Cage(vertices, faces)
            found.require_usable("'cage'")
        field_up = getattr(around, "up", None)
        return RestCage(found, ups, None if field_up is None else np.asarray(field_up).tolist())

    def with_ups(self, rest: RestCage, texts: Sequence[str]) -> RestCage:
        """A cage at rest that knows the axis of files of poses: where one is sure, it holds for others that are not."""
        ups = dict(rest.ups)
        files = [text for text in texts if self.path(text).is_file() and ending(text) in ENDINGS]
        for text in files if len(files) > 1 else ():
            standing = load_standing(Cage, self.path(text), reference=rest.cage, expected=ups.get(ending(text)))[1]
            if standing.turned:
                ups[ending(text)] = standing.up
        return dataclasses.replace(rest, ups=ups)

    def report_standing(self, name: str, standing: UpAxis, option: str) -> None:
        """Report how a cage file stands, if there is anything to say; option: that sets its axis."""
        if standing.turned:
            before = "z" if standing.up == "y" else "y"
            self.report(f"cage {name!r} {standing.note} ({option} {before} keeps it as it was)")
        elif standing.doubtful:
            self.report(f"warning: cage {name!r} {standing.note} (see {option})")
        elif standing.note:
            self.report(f"cage {name!r} {standing.note}")

    # -- poses

    def pose(self, rest: RestCage, value: Any, up: str | None = None) -> Cage:
        """The one pose that a value names; of a file of several that which it shows by itself, as glTF files do."""
        name, key = self.split(value) if isinstance(value, str) else ("", "")
        if ending(name) in GLTF_ENDINGS and not key:
            read = functools.partial(gltf_shown, rest=rest.cage, up=up)
            if (found := self._kept(name, "cage file", read, (rest.hash, up, "shown"))) is not None:
                return found
        poses = self.poses(rest, value, up)
        if len(poses) == 1:
            return poses[0]
        file, _ = self.keyframes(rest, value, up)
        assert file is not None
        if file.times and ending(name) != ".json" and not (self.in_json and ending(name) in MOVING_ENDINGS):
            raise InputError(
                f"{value!r} holds an animation of {len(file)} frames: `warpcage animate` makes a film of it"
            )
        named = f"{value}{'#' if self.in_json else ':'}{file.names[0]}"
        raise InputError(f"{value!r} holds {len(poses)} keyframes: name one, as in {named}")

    def poses(self, rest: RestCage, value: Any, up: str | None = None) -> list[Cage]:
        """The poses that a value names: one, or all of a file, a folder or a pattern in their order."""
        if self.in_json and (vertices := self._vertices(rest, value)) is not None:
            return [rest.cage.with_vertices(vertices)]
        if is_preset(value, self.base):
            preset = Preset(with_up(value, rest.field_up))
            return [preset.at(rest.cage, preset.amount)]
        name, _ = self.split(value)
        file, key = self.keyframes(rest, value, up)
        if file is None:
            return [self._cage_file(rest, name, up)]
        if not len(file):
            raise InputError(f"pose file {name!r} holds no keyframes")
        if key.isdigit() and key not in file and int(key) < len(file):
            key = file.names[int(key)]
        with named_errors(repr(name)):
            return [file[each] for each in ([key] if key else file.names)]

    def film(
        self, rest: RestCage, texts: Sequence[str], up: str | None = None, fps: Fraction | None = None
    ) -> PoseFile | None:
        """The keyframes of texts whose poses have times of their own, None for any others.
        fps: rate of numbered cage files, None is DEFAULT_RATE."""
        rate = DEFAULT_RATE if fps is None else float(fps)
        if len(texts) != 1:
            if not (all(ending(text) in ENDINGS for text in texts) and are_numbered(texts)):
                return None
            files = [self.path(text) for text in texts]
            self.report(
                f"{files[0]} to {files[-1].name}: one cage a frame (--motion swing goes from rest through them and "
                "back)"
            )
            return sequence_poses(files, rest.cage, fps=rate, up=up, expected=rest.ups.get(ending(texts[0])))
        name, _ = self.split(texts[0])
        file, key = self.keyframes(rest, texts[0], up, rate)
        if file is None or key:
            return None
        return self._timed(file, name) if ending(name) == ".json" else file if file.times else None

    def keyframes(
        self, rest: RestCage, text: str, up: str | None = None, fps: float = DEFAULT_RATE
    ) -> tuple[PoseFile | None, str]:
        """The keyframes of a pose file, a file that moves, a folder or a pattern of cage files (walk_####.obj), and
        the key that the text names among them, "" for all; None where it names something else."""
        name, key = self.split(text)
        kind = ending(name)
        if kind == ".json":
            return self._kept(name, "pose file", functools.partial(PoseFile.load, rest=rest.cage), rest.hash), key
        if kind in MOVING_ENDINGS:
            chosen, key = ("", key) if self.in_json else (key, "")  # an animation or a shape
            read = functools.partial(file_poses, rest=rest.cage, name=chosen, up=up, fps=fps)
            what = "vertex cache" if kind in CACHE_ENDINGS else "cage file"
            file = self._kept(name, what, read, (rest.hash, chosen, up, fps))
            if file is None and (chosen or key):
                raise InputError(
                    f"{name}: there is no animation or shape key {chosen or key!r}: the file has no motion"
                )
            return file, key
        files = numbered_files(self.path(text))
        if files is None:
            return None, ""
        likely = rest.ups.get(ending(str(files[0])))
        return sequence_poses(files, rest.cage, fps=fps, up=up, expected=likely), ""

    def _vertices(self, rest: RestCage, value: Any) -> np.ndarray | None:
        """The vertices of a pose that is an array, or drawn at random; None for the text of another."""
        if isinstance(value, dict):
            return self._drawn_pose(rest, value)
        if isinstance(value, str) and ending(split_reference(value)[0]) != ".npy":
            return None
        vertices, expected = self.array(value, "'posed'"), rest.cage.vertices.shape
        if vertices.shape == expected:
            return vertices
        several = isinstance(value, str) and vertices.ndim == 3 and vertices.shape[1:] == expected
        hint = f": it holds {len(vertices)} poses, write {value}#0 for the first" if several else ""
        raise InputError(
            f"'posed' must be {expected} as the cage at rest, got {vertices.shape} of {shown(value)}{hint}"
        )

    def _drawn_pose(self, rest: RestCage, posed: dict[str, Any]) -> np.ndarray:
        """The vertices (v, 3) float64, world units, of a pose that is drawn: those of `RandomPoses`, to the bit."""
        options = dict(posed[RANDOM])
        number = options.pop("number")

        def draw() -> np.ndarray:
            probe = self._probes.get(rest.hash, lambda: PoseProbe(rest.cage))
            return RandomPoses(probe.rest, **options, probe=probe).vertices(number)

        return self._drawn.get((rest.hash, canonical(posed)), draw)

    def _cage_file(self, rest: RestCage, name: str, up: str | None) -> Cage:
        """The pose of a cage file, in the order of the cage at rest."""
        expected = rest.ups.get(ending(name))

        def read(path: pathlib.Path) -> Cage:
            posed, standing = load_standing(Cage, path, up=up, reference=rest.cage, expected=expected)
            self.report_standing(name, standing, "--posed-up")
            with named_errors(f"cage {name!r} does not fit its rest cage"):
                found = rest.cage.match(posed)
            if not np.array_equal(posed.face_array, rest.cage.face_array) or len(posed.vertices) != len(
                rest.cage.vertices
            ):
                self.report(f"cage {name!r} has another order of vertices than its rest cage: matched")
            return found

        file_up(self.path(name))  # raises ValueError for other endings
        return self._kept(name, "cage file", read, (rest.hash, up, expected))

    def _timed(self, file: PoseFile, path: str) -> PoseFile | None:
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
        with named_errors(path):
            for name, easing in file.easings.items():
                known_easing(name, easing)
            if file.cameras:
                timed_keys(file.cameras)
        self.report_jumps(file, path)
        return file

    def report_jumps(self, file: PoseFile, path: str) -> None:
        """Report where two keyframes of a film have one time."""
        jumps = [(a, b) for a, b in itertools.pairwise(file.timed) if file.times[a] == file.times[b]]
        if jumps:
            (one, two), more = jumps[0], len(jumps) - 1
            self.report(
                f"{path}: keyframes {one!r} and {two!r} are both at {file.times[one]:g} s: the film jumps there"
                + (f", and at {counted(more, 'other time')}" if more else "")
            )

    # -- cameras

    def camera(self, value: Any, size: Sequence[int], field: AnyField) -> Camera:
        """The camera of a name or of numbers, in the world of a field.
        size: width, or width and height of its pictures; () keeps its own."""
        try:
            camera = self._camera(value, size, field)  # that of a scene is turned with a straightened field
            return fitted(camera, tuple(size))
        except DAMAGED as error:
            raise InputError(f"'camera' cannot be used: {error}") from None

    def _camera(self, value: Any, size: Sequence[int], field: AnyField) -> Camera:
        if isinstance(value, dict):
            return _inline_camera(canonical(value))  # many frames have the same
        name, key = split_reference(value)
        own = (size[0], size[1]) if len(size) == 2 else None
        if ending(name) == ".json":
            cameras = self._kept(name, "camera file", _read_cameras)
        else:
            cameras = self._kept(name, "camera file", lambda path: CameraFile.load(path, size=own), own)
        if isinstance(cameras, CameraFile):
            with named_errors(name):
                return cameras.named(key)
        if not key:
            raise InputError(f"{name} holds {len(cameras)} cameras: name one, {name}#0")
        camera = cameras.camera(key, own)
        return camera if field.straightening is None else camera.moved(field.straightening)


@functools.lru_cache(maxsize=MAX_CAMERAS)
def _inline_camera(text: str) -> Camera:
    """A camera of JSON numbers: fx, fy, cx, cy, width, height and camera_to_world, as camera files have them; or eye,
    target, width and height, and up and fov_degrees if they are not the defaults."""
    value = json.loads(text)
    if "eye" in value:
        return Camera.look_at(**value)
    try:
        return camera_from_json(value, 0).camera
    except KeyError as error:
        raise InputError(f"'camera' lacks {error.args[0]!r}") from None


def _read_cameras(path: pathlib.Path) -> CameraFile | TransformsCameras:
    """The cameras of a JSON file of ours or another program's, or of a scene."""
    with errors_of(path, "camera file"):
        content = read_json(path, "camera file", (dict, list))
    is_path = camera_program(content) or content.get("format") == "warpcage cameras"
    return CameraFile.load(path) if is_path else TransformsCameras(path)
