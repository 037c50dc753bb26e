"""What texts of poses name: presets, files and keys, and which axis is up; and edits files."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import os
import pathlib
import re
import stat
import sys
from collections.abc import Callable, Hashable, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ...cage.axes import with_up
from ...cage.cage import Cage
from ...cage.pose_file import (
    DEFAULT_RATE,
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
from ...core.files import DAMAGED, errors_of, file_stamp, read_json, require_file
from ...core.memory import LRUCache
from ...core.names import counted
from ...core.npz import NpyFile
from ...edits.spec import RANDOM, EditSpec, canonical, split_reference
from ...errors import InputError
from ...mesh.io import ENDINGS
from ...scene.formats.transforms import TransformsCameras
from ...splats.splat_field import AnyField
from ...view.camera import Camera, CameraFile, camera_from_json, fitted
from ...view.camera_file import camera_program
from ...view.camera_path import timed_keys


def read_rest(
    path: str, up: str | None, reference: object = None, *, part: bool = False, name: str | None = None
) -> tuple[Cage, dict[str, str]]:
    """A cage at rest around a field or mesh, usable, and the axis to expect in files of its ending; name: its object's.
    up: "y" or "z"; None finds it by what the cage holds of `reference`, without which it is that of the format."""
    rest, standing = load_standing(Cage, path, up=up, reference=reference, object=name)
    rest.require_usable(f"cage {path!r}")
    # A cage that may hold a part alone, as one of several, is reported only where another axis would hold far more.
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
    """File and keyframe ("" for all) of a value of --posed that names a pose file, else None."""
    return file_and_name(text, "json")


def moving_file(text: str) -> tuple[str, str] | None:
    """File and animation, shape or frame ("" for all) of a text that names a file with motion, else None."""
    return file_and_name(text, "|".join(each[1:] for each in MOVING_ENDINGS))


def file_and_name(text: str, endings: str) -> tuple[str, str] | None:
    """A file of some endings ("json|glb") and what is named of it, "" for all; None for any other text."""
    found = re.fullmatch(rf"(.+\.(?:{endings}))(?::(.*))?", text, re.IGNORECASE)
    return (found[1], found[2] or "") if found else None


def read_film(
    rest: Cage, texts: list[str], up: str | None, expected: Mapping[str, str] | None, fps: Fraction | None
) -> PoseFile | None:
    """The keys of values of --posed that have times of their own; None for any others.
    up: "y" or "z", None finds it; expected: axis by ending of cage files where nothing speaks for another."""
    # A pose file with times, an animated glTF file, a folder or pattern of numbered cage files, or files so named.
    rate = DEFAULT_RATE if fps is None else float(fps)
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
        poses = [_keyframe(file, path, name)] if name else [file[each] for each in file.names]
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
    """The poses of an animated glTF file or of numbered files that a text names; none for any other text."""
    if named := moving_file(text):
        file = file_poses(named[0], rest, name=named[1], up=up)
        if file is None and named[1]:
            raise InputError(f"{named[0]}: there is no animation or shape key {named[1]!r}: the file has no motion")
    elif files := numbered_files(text):
        likely = (expected or {}).get(ending(str(files[0])))
        file = sequence_poses(files, rest, up=up, expected=likely)
    else:
        return []
    return [] if file is None else [file[name] for name in file.names]


def in_order(rest: Cage, posed: Cage, name: str) -> Cage:
    """A posed cage in the order of the cage at rest, vertices and faces."""
    try:
        return rest.match(posed)
    except ValueError as error:
        raise InputError(f"cage {name!r} does not fit its rest cage: {error}") from None


def matched(rest: Cage, posed: Cage, name: str) -> Cage:
    """The same; a line on stderr says where the order was another."""
    found = in_order(rest, posed, name)
    if not np.array_equal(posed.faces, rest.faces) or len(posed.vertices) != len(rest.vertices):
        print(f"warpcage: cage {name!r} has another order of vertices than its rest cage: matched", file=sys.stderr)
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


#: What is kept at most of items, which name the same files again and again: files that are open to view, cages whose
#: poses can be measured at once, drawn poses, and cameras of numbers.
MAX_FILES, MAX_PROBES, MAX_POSES, MAX_CAMERAS = 32, 8, 16, 64

Value = TypeVar("Value")


class RestCage(NamedTuple):
    """A cage at rest, its hash, and the axis that points up in files of its ending, as it was found for its own."""

    cage: Cage
    hash: str
    ups: dict[str, str]


class References:
    """Reads what items refer to. What was read from a file is kept while the file stays as it is."""

    def __init__(self, base: str | os.PathLike[str]):
        self.base = pathlib.Path(base)
        self._files: LRUCache[Any] = LRUCache(MAX_FILES)
        self._probes: LRUCache[PoseProbe] = LRUCache(MAX_PROBES)
        self._drawn: LRUCache[np.ndarray] = LRUCache(MAX_POSES)

    def path(self, name: str) -> pathlib.Path:
        return self.base / name

    def stamped(self, name: str, what: str) -> tuple[str, tuple[int, int]]:
        """A file and its stamp, by which what was made of it is known. Raises FileNotFoundError."""
        path = os.path.join(self.base, name)
        with contextlib.suppress(OSError):  # one look at each file of each item
            status = os.stat(path)
            if stat.S_ISREG(status.st_mode):
                return path, (status.st_size, status.st_mtime_ns)
        return path, file_stamp(require_file(path, what))

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
        name, place = split_reference(value)
        if not name.lower().endswith(".npy"):
            raise InputError(f"{what} must be an .npy file, a row of one (file.npy#17) or nested lists, got {value!r}")
        file = self._kept(name, "array file", NpyFile)
        if not place:
            return file.read()
        if not place.isdigit():
            raise InputError(f"{what}: {value!r} names no row: write {name}#17")
        return file.row(int(place))

    def rest_cage(self, edit: EditSpec, field: AnyField) -> RestCage:
        """The cage at rest of an edit, usable; field: by which the axis of its file is found."""
        if isinstance(edit.cage, str):
            path = self.path(edit.cage)
            file = require_file(path, "cage file")
            cage, standing = load_standing(Cage, file, up=edit.up, reference=field, object=edit.object)
            ups = {path.suffix.lower(): standing.up}
        else:
            vertices = self.array(edit.cage["vertices"], "'vertices' of 'cage'")
            faces = self.array(edit.cage["faces"], "'faces' of 'cage'")
            cage, ups = Cage(vertices, faces), {}
        cage.require_usable(f"cage {edit.cage!r}" if isinstance(edit.cage, str) else "'cage'")
        return RestCage(cage, cage_hash(cage), ups)

    def posed_cage(self, edit: EditSpec, rest_cage: RestCage, field: AnyField) -> Cage | None:
        """The posed cage of an edit, in the order of the cage at rest; None for an edit that removes.
        field: gives the up axis of a preset."""
        if edit.remove:
            return None
        value, rest = edit.posed, rest_cage.cage
        if edit.is_drawn:
            return rest.with_vertices(self._drawn_pose(value, rest_cage))
        if not isinstance(value, str) or split_reference(value)[0].lower().endswith(".npy"):
            vertices = self.array(value, "'posed'")
            if vertices.shape != rest.vertices.shape:
                raise InputError(
                    f"'posed' must be {rest.vertices.shape} as the cage at rest, got {vertices.shape} of "
                    f"{shown(value)}{_row_hint(value, vertices, rest)}"
                )
            return rest.with_vertices(vertices)
        if is_preset(value, self.base):
            preset = Preset(with_up(value, field.up.tolist()))
            return preset.at(rest, preset.amount)
        name, place = split_reference(value)
        if name.lower().endswith((".json", *MOVING_ENDINGS)):
            file, shown_pose = self._keyframes(name, edit, rest_cage)
            if shown_pose is not None and not place:
                return shown_pose
            if file is not None:
                return _keyframe(file, name, place)
            if place:
                raise InputError(f"{name}: there is no keyframe {place!r}: the file has no motion")
        return self._kept(name, "cage file", lambda path: _posed_file(path, edit, rest_cage), (rest_cage.hash, edit.up))

    def _drawn_pose(self, posed: dict[str, Any], rest_cage: RestCage) -> np.ndarray:
        """The vertices (v, 3) float64, world units, of a pose that is drawn: those of `RandomPoses`, to the bit."""
        options = dict(posed[RANDOM])
        number = options.pop("number")

        def draw() -> np.ndarray:
            probe = self._probes.get(rest_cage.hash, lambda: PoseProbe(rest_cage.cage))
            return RandomPoses(probe.rest, **options, probe=probe).vertices(number)

        return self._drawn.get((rest_cage.hash, canonical(posed)), draw)

    def _keyframes(self, name: str, edit: EditSpec, rest_cage: RestCage) -> tuple[PoseFile | None, Cage | None]:
        """The keyframes of a file, None where nothing moves in it, and what its shapes show together."""
        rest = rest_cage.cage

        def read(path: pathlib.Path) -> tuple[PoseFile | None, Cage | None]:
            if ending(name) == ".json":
                return PoseFile.load(path, rest), None
            return file_poses(path, rest, up=edit.up), gltf_shown(path, rest, up=edit.up)

        what = "pose file" if ending(name) == ".json" else "cage file"
        return self._kept(name, what, read, ("moving", rest_cage.hash, edit.up))

    # -- cameras

    def camera(self, value: Any, size: Sequence[int], field: AnyField) -> Camera:
        """The camera that a word or numbers name, in the world of a field.
        size: its width, or width and height; its own where it is empty."""
        try:
            camera = self._camera(value, size, field)  # that of a scene is turned with a straightened field
            return fitted(camera, tuple(size))
        except DAMAGED as error:
            raise InputError(f"'camera' cannot be used: {error}") from None

    def _camera(self, value: Any, size: Sequence[int], field: AnyField) -> Camera:
        if isinstance(value, dict):
            return _read_inline(canonical(value))
        name, place = split_reference(value)
        own = (size[0], size[1]) if len(size) == 2 else None
        if not name.lower().endswith(".json"):
            cameras = self._kept(name, "camera file", lambda path: CameraFile.load(path, size=own), own)
            return _named(cameras, place, name)
        cameras = self._kept(name, "camera file", _read_cameras)
        if isinstance(cameras, CameraFile):
            return _named(cameras, place, name)
        if not place:
            raise InputError(f"{name} holds {len(cameras)} cameras: name one, {name}#0")
        camera = cameras.camera(place, own)
        return camera if field.straightening is None else camera.moved(field.straightening)

    def _kept(self, name: str, what: str, read: Callable[[pathlib.Path], Value], more: Hashable = None) -> Value:
        """What was read from a file, read again where the file has changed."""
        path, stamp = self.stamped(name, what)
        return self._files.get((path, stamp, what, more), lambda: read(pathlib.Path(path)))


def _posed_file(path: pathlib.Path, edit: EditSpec, rest_cage: RestCage) -> Cage:
    """The posed cage of a cage file, in the order of the cage at rest."""
    expected = rest_cage.ups.get(path.suffix.lower())
    posed = load_standing(Cage, path, up=edit.up, reference=rest_cage.cage, expected=expected)[0]
    return in_order(rest_cage.cage, posed, str(edit.posed))


def inline_camera(value: dict[str, Any]) -> Camera:
    """A camera of an object of numbers: fx, fy, cx, cy, width, height and camera_to_world, as camera files have them;
    or eye, target, width and height, and up and fov_degrees if they are not usual."""
    if "eye" in value:
        return Camera.look_at(**value)
    try:
        return camera_from_json(value, 0).camera
    except KeyError as error:
        raise InputError(f"'camera' lacks {error.args[0]!r}") from None
    except DAMAGED as error:
        raise InputError(f"'camera' cannot be used: {error}") from None


@functools.lru_cache(maxsize=MAX_CAMERAS)
def _read_inline(value: str) -> Camera:
    """`inline_camera` of JSON text: many frames have the same."""
    return inline_camera(json.loads(value))


def _read_cameras(path: pathlib.Path) -> CameraFile | TransformsCameras:
    """The cameras of a JSON file of ours or another program's, or of a scene."""
    with errors_of(path, "camera file"):
        content = read_json(path, "camera file", (dict, list))
    is_path = camera_program(content) or content.get("format") == "warpcage cameras"
    return CameraFile.load(path) if is_path else TransformsCameras(path)


def _named(cameras: CameraFile, place: str, name: str) -> Camera:
    try:
        return cameras.named(place)
    except ValueError as error:
        raise InputError(f"{name}: {error}") from None


def _keyframe(file: PoseFile, name: str, place: str) -> Cage:
    if place.isdigit() and place not in file and int(place) < len(file):
        return file[file.names[int(place)]]
    if not place and len(file) == 1:
        return file[file.names[0]]
    if not place:
        raise InputError(f"{name} holds {len(file)} poses: name one, {name}#{file.names[0]}")
    try:
        return file[place]
    except ValueError as error:
        raise InputError(f"{name!r}: {error}") from None


def _row_hint(value: Any, vertices: np.ndarray, rest: Cage) -> str:
    if isinstance(value, str) and vertices.ndim == 3 and vertices.shape[1:] == rest.vertices.shape:
        return f": it holds {len(vertices)} poses, write {value}#0 for the first"
    return ""
