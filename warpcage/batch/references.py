"""What the words of items name: cages, poses (drawn ones too), cameras, fields that stay loaded; what is missing."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import pathlib
import stat
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import warp as wp

from ..cage.axes import with_up
from ..cage.cage import Cage
from ..cage.motion import MOVING_ENDINGS, file_poses, gltf_shown
from ..cage.pose_file import PoseFile, Preset, cage_hash, is_preset
from ..cage.random_poses import PoseProbe, RandomPoses
from ..cage.up_axis import load_standing
from ..core.arrays import array_bytes
from ..core.checks import shown
from ..core.files import DAMAGED, NpyFile, PathLike, file_stamp, require_file
from ..core.memory import LRUCache, free_bytes
from ..edits.words import RANDOM, EditWords, split_reference
from ..errors import InputError
from ..scene.formats.transforms import TransformsCameras
from ..splats.splat_field import AnyField, read_field
from ..view.camera import Camera, CameraFile, camera_from_json, fitted
from .items import FrameItem, Item, canonical
from .job_file import references_of

#: Cages whose poses can be measured at once, and poses, that are kept: items of one pose follow each other.
MOST_PROBES, MOST_POSES = 8, 16


Thing = TypeVar("Thing")

#: Files that are kept open to view: their headers, keyframes and cameras.
MOST_FILES = 32

#: Cameras in the words of items that are kept.
INLINE_CAMERAS = 64


class RestCage(NamedTuple):
    """A cage at rest, its hash, and the axis that points up in files of its ending, as it was found for its own."""

    cage: Cage
    hash: str
    ups: dict[str, str]


class References:
    """Reads what items refer to. What was read from a file is kept while the file stays as it is."""

    def __init__(self, base: str | os.PathLike[str]):
        self.base = pathlib.Path(base)
        self._files: LRUCache[Any] = LRUCache(MOST_FILES)
        self._probes: LRUCache[PoseProbe] = LRUCache(MOST_PROBES)
        self._drawn: LRUCache[np.ndarray] = LRUCache(MOST_POSES)

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

    def rest_cage(self, edit: EditWords, field: AnyField) -> RestCage:
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

    def posed_cage(self, edit: EditWords, rest_cage: RestCage, field: AnyField) -> Cage | None:
        """The posed cage of an edit, in the order of the cage at rest; None for an edit that removes.
        field: says what is up in the words of a preset."""
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
        if name.lower().endswith(".json"):
            file = self._kept(name, "pose file", lambda path: PoseFile.load(path, rest), rest_cage.hash)
            return _keyframe(file, name, place)
        if name.lower().endswith(MOVING_ENDINGS):
            if (moving := self._moving(name, place, edit, rest_cage)) is not None:
                return moving
        return self._kept(name, "cage file", lambda path: _posed_file(path, edit, rest_cage), (rest_cage.hash, edit.up))

    def _drawn_pose(self, posed: dict[str, Any], rest_cage: RestCage) -> np.ndarray:
        """The vertices (v, 3) float64, world units, of a pose that is drawn: those of `RandomPoses`, to the bit."""
        words = dict(posed[RANDOM])
        number = words.pop("number")

        def draw() -> np.ndarray:
            probe = self._probes.get(rest_cage.hash, lambda: PoseProbe(rest_cage.cage))
            return RandomPoses(probe.rest, **words, probe=probe).vertices(number)

        return self._drawn.get((rest_cage.hash, canonical(posed)), draw)

    def _moving(self, name: str, place: str, edit: EditWords, rest_cage: RestCage) -> Cage | None:
        """The keyframe or shape that is named of a file that moves, or what its shapes show. None for a still one."""

        def read(path: pathlib.Path) -> tuple[PoseFile | None, Cage | None]:
            rest = rest_cage.cage
            return file_poses(path, rest, up=edit.up), gltf_shown(path, rest, up=edit.up)

        moving, shown_pose = self._kept(name, "cage file", read, ("moving", rest_cage.hash, edit.up))
        if moving is None:
            if place:
                raise InputError(f"{name}: there is no keyframe {place!r}: nothing moves in it")
            return None
        return shown_pose if shown_pose is not None and not place else _keyframe(moving, name, place)

    # -- cameras

    def camera(self, item: FrameItem, field: AnyField) -> Camera:
        """The camera of a frame, at its size and in the world of its field."""
        try:
            camera = self._camera(item, field)  # that of a scene is turned with a straightened field
            return fitted(camera, item.size)
        except DAMAGED as error:
            raise InputError(f"'camera' cannot be used: {error}") from None

    def _camera(self, item: FrameItem, field: AnyField) -> Camera:
        value = item.camera
        if isinstance(value, dict):
            return _read_inline(canonical(value))
        name, place = split_reference(value)
        size = (item.size[0], item.size[1]) if len(item.size) == 2 else None
        if not name.lower().endswith(".json"):
            cameras = self._kept(name, "camera file", lambda path: CameraFile.load(path, size=size), size)
            return _named(cameras, place, name)
        cameras = self._kept(name, "camera file", _read_cameras)
        if isinstance(cameras, CameraFile):
            return _named(cameras, place, name)
        if not place:
            raise InputError(f"{name} holds {len(cameras)} cameras: name one, {name}#0")
        camera = cameras.camera(place, size)
        return camera if field.straightening is None else camera.moved(field.straightening)

    def _kept(self, name: str, what: str, read: Callable[[pathlib.Path], Thing], more: Hashable = None) -> Thing:
        """What was read from a file, read again where the file has changed."""
        path, stamp = self.stamped(name, what)
        return self._files.get((path, stamp, what, more), lambda: read(pathlib.Path(path)))


def _posed_file(path: pathlib.Path, edit: EditWords, rest_cage: RestCage) -> Cage:
    """The posed cage of a cage file, in the order of the cage at rest."""
    expected = rest_cage.ups.get(path.suffix.lower())
    posed = load_standing(Cage, path, up=edit.up, reference=rest_cage.cage, expected=expected)[0]
    try:
        return rest_cage.cage.match(posed)
    except ValueError as error:
        raise InputError(f"cage {edit.posed!r} does not fit its rest cage: {error}") from None


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


@functools.lru_cache(maxsize=INLINE_CAMERAS)
def _read_inline(value: str) -> Camera:
    """`inline_camera` of JSON text: many frames have the same."""
    return inline_camera(json.loads(value))


def _read_cameras(path: pathlib.Path) -> CameraFile | TransformsCameras:
    """The cameras of a JSON file of ours, or of a scene."""
    with path.open("rb") as file:
        is_ours = b'"warpcage cameras"' in file.read(1 << 12)
    return CameraFile.load(path) if is_ours else TransformsCameras(path)


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
        raise InputError(f"{name}: {error}") from None


def _row_hint(value: Any, vertices: np.ndarray, rest: Cage) -> str:
    if isinstance(value, str) and vertices.ndim == 3 and vertices.shape[1:] == rest.vertices.shape:
        return f": it holds {len(vertices)} poses, write {value}#0 for the first"
    return ""


#: Most fields that stay loaded, and the share of the memory that is free at first for them and what is bound to them.
MOST_FIELDS, MEMORY_SHARE = 8, 0.5


class LoadedFields:
    """Fields by their files, of which those stay loaded that were used last.
    memory: bytes that they may take together, but one stays whatever it takes; None is a quarter of what is free."""

    def __init__(self, references: References, device: wp.Device, memory: int | None = None):
        self.references, self.device, self.read_count = references, device, 0
        self.dropped: Callable[[AnyField], Any] = lambda field: None  # called with a field that is let go, before it is
        limit = int(MEMORY_SHARE * free_bytes(device)) // 2 if memory is None else memory
        self.kept: LRUCache[AnyField] = LRUCache(MOST_FIELDS, limit, array_bytes, lambda field: self.dropped(field))

    def get(self, name: str, scene_scale: float) -> tuple[Hashable, AnyField]:
        """A key that is another where the file has changed, and the field; scene_scale: as `VoxelField.load` has it."""
        path, stamp = self.references.stamped(name, "field file")

        def load() -> AnyField:
            self.read_count += 1
            return read_field(path, scene_scale=scene_scale)(self.device)

        key = path, stamp, scene_scale
        return key, self.kept.get(key, load)


#: Files that are remembered: each is looked at once, however many items name it.
MOST_KNOWN = 100_000


class Missing:
    """Looks for files and rows that items name; base: folder that their paths are relative to."""

    def __init__(self, base: PathLike):
        self.base = base
        self._files: LRUCache[NpyFile | str | None] = LRUCache(MOST_KNOWN)

    def of(self, item: Item) -> str | None:
        """One line on the first that an item names and is not there; None where all is there."""
        found = (self._wrong(reference) for reference in references_of(item))  # whether it can be used shows later
        return next((line for line in found if line), None)

    def _wrong(self, reference: str) -> str | None:
        name, place = split_reference(reference)
        file = self._files.get(name, lambda: self._looked_at(name))
        if isinstance(file, str) or file is None or not place:
            return file if isinstance(file, str) else None
        rows = file.shape[0] if file.shape else 0
        if place.isdigit() and int(place) >= rows:
            return f"{file.path} has rows 0 to {rows - 1}, got {place}" if rows else f"{file.path} has no rows"
        return None

    def _looked_at(self, name: str) -> NpyFile | str | None:
        """The array in a .npy file, None for another that is there, or a line on what is wrong."""
        path = os.path.join(self.base, name)
        try:
            if os.path.isdir(path) or is_preset(name, self.base):
                return None
            return NpyFile(path) if name.lower().endswith(".npy") else require_file(path, "file") and None
        except (OSError, ValueError) as error:
            return str(error)
