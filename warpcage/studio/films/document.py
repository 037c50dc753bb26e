"""What is edited: objects, edits, poses, keys, view and settings; a command makes a new document from the old one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...core.checks import checked_easing, checked_number, checked_whole, shown
from ...core.names import LOOPS, Easing, checked_choice, renamed_keys
from ...core.spec import Values, anything, flag, number, one_of, option, options_of, whole
from ...edits.edits import HELD, MAX_EDITS, CageEdit
from ...edits.place import Place
from ...errors import InputError
from ...mesh.mesh import ClosedMesh
from ..spec.settings import Settings, checked_settings
from .checks import (
    MAX_ID,
    MAX_KEYS,
    MAX_OBJECTS,
    MAX_RATE,
    MAX_SECONDS,
    MAX_VERTICES,
    checked_id,
    checked_items,
    checked_name,
    checked_triple,
    checked_vertices,
    frozen_vertices,
)

#: Keys of sessions up to version 2, by their names now.
OLD_KEYS = {"fragments": "crumbs", "object": "thing", "objects": "things"}


#: Keys in JSON of fields that have another name.
KEYS = {"object_id": "object"}


def part_json(part: Any, inner: Callable[[Any], Any] | None = None) -> Any:
    """A part of a document as JSON takes it; numbers keep all their digits. inner: what becomes of what it holds."""
    inner = inner or part_json
    if isinstance(part, np.ndarray):
        return part.tolist()
    if isinstance(part, Settings):
        return part.to_json()
    if isinstance(part, tuple):
        return [inner(each) for each in part]
    if isinstance(part, Mapping):
        return {str(key): inner(value) for key, value in part.items()}
    if not dataclasses.is_dataclass(part):
        return part
    fields = [field.name for field in dataclasses.fields(part) if field.compare]
    values = ((KEYS.get(name, name), getattr(part, name)) for name in fields)
    return {key: inner(value) for key, value in values if (key, value) != ("places", None)}


def checked_fields(kind: type, content: Any, only: Sequence[str] = ()) -> dict[str, Any]:
    """The fields of a part of a document from JSON, checked; those that came with a later version may be missing.
    only: the fields that a message may have."""
    content, found, fields = renamed_keys(content, OLD_KEYS), {}, options_of(kind)
    for name in only or fields:
        key = KEYS.get(name, name)
        if (not only and fields[name].since == 1) or key in content:
            found[name] = fields[name].values.check(content[key], key)
    return found


def _part(check: Callable[[Any], Any], *, optional: bool = False) -> Values:
    """Values whose check needs no name; optional: or None."""
    return Values(lambda value, name: None if optional and value is None else check(value))


def _parts(check: Callable[[Any], Any], most: int) -> Values:
    """Lists of at most so many parts, from JSON or as a `History` has made them."""

    def made(content: Any) -> Any:
        return content if dataclasses.is_dataclass(content) else check(content)

    return Values(lambda value, name: tuple(map(made, checked_items(value, most, name))))


def _numbered(parts: Iterable[Any], number: Any, what: str = "an edit", verb: str = "deleted") -> Any:
    """The part of a number. Raises ValueError where there is none."""
    checked_whole(number, f"the number of {what}", MAIN if what == "an object" else 1, MAX_ID)
    found = next((part for part in parts if part.id == number), None)
    if found is None:
        raise InputError(f"there is no {what.split()[1]} {number!r}: it may have been {verb}")
    return found


_TRIPLE, _ID, _NAME, _ANY = Values(checked_triple), Values(checked_id), _part(checked_name), Values(anything)


#: Fields of view, degrees.
FOVS = (1.0, 150.0)


@dataclasses.dataclass(frozen=True)
class View:
    """Where the person looks from; (3,) world units."""

    eye: tuple[float, float, float] = option(MISSING, _TRIPLE)  # centre of projection
    target: tuple[float, float, float] = option(MISSING, _TRIPLE)  # in the middle of the picture
    up: tuple[float, float, float] = option(MISSING, _TRIPLE)  # unit vector
    fov: float = option(40.0, number(*FOVS))  # vertical, degrees


def checked_view(content: Any) -> View:
    """A view from eye, target, up and fov of a dictionary, others ignored; its `up` gets the length 1."""
    view = View(**checked_fields(View, content))
    length = float(np.linalg.norm(view.up))
    if not 1e-12 < length < 1e12:
        raise InputError("a view needs a direction `up` that is not zero")
    if not 1e-12 < np.linalg.norm(np.subtract(view.eye, view.target)) < 1e12:
        raise InputError("a view needs an eye some way from its target")
    forward = np.subtract(view.target, view.eye)
    if np.linalg.norm(np.cross(forward, view.up)) < 1e-6 * np.linalg.norm(forward) * length:
        raise InputError("a view cannot look along its own `up`")
    x, y, z = (float(value / length) for value in view.up)
    return dataclasses.replace(view, up=(x, y, z))


KINDS = ("move", "copy", "remove")

PICKS = ("vertex", "edge", "face")

#: How many times as small or large an object may be made.
SCALES = (1e-6, 1e6)

#: Largest width of a falloff and size of fragments, world units.
LARGEST_LENGTH = 1e9


@dataclasses.dataclass(frozen=True)
class Sliders:
    """What sliders have made of a cage: they go on from it as long as the edit has this very pose."""

    before: np.ndarray  # (v, 3) float64, the pose that they started from, world units
    posed: np.ndarray  # (v, 3) what became of it
    chosen: tuple[int, ...] | None  # vertices that they act on, None for all
    way: Mapping[str, Any]  # axis, towards and limits
    amounts: Mapping[str, float]  # by preset, in the order in which they act


@dataclasses.dataclass(frozen=True, eq=False)
class Landmarks:
    """Places of an object and where a pose is to have them: drags go on from it as long as the edit has this pose."""

    before: np.ndarray  # (v, 3) float64, the pose that counts as rigid, in the object's coordinates
    posed: np.ndarray  # (v, 3) what became of it
    places: np.ndarray  # (k, 3) at rest
    targets: np.ndarray  # (k, 3) where the posed object is to have them
    added: np.ndarray  # (k, 3) what the map of the pose adds to mean value weights there


#: The number of the object that a session begins with: the field that it is of.
MAIN = 0


def checked_place(content: Any) -> Place:
    """A place from what JSON has of its position, turn and scale."""
    if not isinstance(content, Mapping):
        raise InputError(f"a place must be an object with a position, a turn or a scale, got {shown(content)}")
    triples = {name: checked_triple(content[name], name) for name in ("position", "turn") if name in content}
    return Place(**triples, scale=checked_number(content.get("scale", 1.0), "scale", *SCALES))


@dataclasses.dataclass(frozen=True)
class SceneObject:
    """One field of the scene, in a place of its own; its edits are in its own coordinates."""

    id: int = option(MISSING, whole(MAIN, MAX_ID))  # that no other object, edit or key of the session has had
    name: str = option(MISSING, _NAME)
    file: str | None = option(None, _ANY, since=2)  # of its field, seen from the session's folder
    place: Place = option(Place(), _part(checked_place), since=2)
    visible: bool = option(True, flag(), since=2)
    locked: bool = option(False, flag(), since=2)  # whether its place may not be changed


def _object(content: Any) -> SceneObject:
    found = SceneObject(**checked_fields(SceneObject, content))
    if not isinstance(found.file, str | None) or (found.id == MAIN and found.file is not None):
        raise InputError(f"the file of object {found.id} of the session must be a name; the first one has none")
    return found


@dataclasses.dataclass(frozen=True)
class Edit:
    """One cage and what becomes of its content."""

    id: int = option(MISSING, _ID)  # that no other edit of the session has had
    name: str = option(MISSING, _NAME)
    kind: str = option(MISSING, one_of(*KINDS))  # a copy is a duplicate: the source stays
    visible: bool = option(MISSING, flag())  # whether it acts on the picture
    faces: np.ndarray = option(MISSING, _ANY)  # (f, 3) int32, or polygons as `ClosedMesh.face_array` has them
    rest: np.ndarray = option(MISSING, _ANY)  # (v, 3) float64, the cage around the captured object, world units
    posed: np.ndarray = option(MISSING, _ANY)  # (v, 3) float64
    falloff: float = option(0.0, number(0.0, LARGEST_LENGTH), since=2)  # see `EditSpec`, as for those below
    held: str = option("cut", one_of(*HELD), since=2)
    fragments: float = option(0.0, number(0.0, LARGEST_LENGTH), since=2)
    object_id: int = option(  # the number of the object that it deforms, in whose coordinates it is
        MAIN, _part(lambda value: checked_whole(value, "the number of an object", MAIN, MAX_ID)), since=2
    )
    moved_sliders: Sliders | None = dataclasses.field(default=None, compare=False)  # the last ones; not in files
    pulled_landmarks: Landmarks | None = dataclasses.field(default=None, compare=False)  # the last ones; not in files

    @property
    def sliders(self) -> Sliders | None:
        """The sliders that the pose comes from, or None where something else has changed it since."""
        return self.moved_sliders if self.moved_sliders and self.moved_sliders.posed is self.posed else None

    @property
    def landmarks(self) -> Landmarks | None:
        """The landmarks that the pose has, or None where something else has changed it since."""
        found = self.pulled_landmarks
        return found if found is not None and found.posed is self.posed and len(found.places) else None

    @property
    def rest_cage(self) -> Cage:
        """The cage at rest."""
        return Cage(self.rest, self.faces)

    @property
    def posed_cage(self) -> Cage:
        """The posed cage."""
        return Cage(self.posed, self.faces)

    @property
    def cage_edit(self) -> CageEdit:
        """The edit as a Deformer takes it. Raises ValueError where the rest cage cannot be used."""
        return self.edit_of(self.rest_cage)

    def edit_of(self, rest: Cage) -> CageEdit:
        """The same with a rest cage that is there already. What is removed has no falloff."""
        removes = self.kind == "remove"
        return CageEdit(rest, self.kind == "copy", removes, 0.0 if removes else self.falloff, self.held, self.fragments)


@dataclasses.dataclass(frozen=True)
class Selection:
    """What the next tool acts on."""

    edit: int | None = None
    mode: str = "vertex"  # what a click picks, one of PICKS
    vertices: tuple[int, ...] = ()  # numbers of those of the active edit, ascending
    object_id: int = MAIN  # the active object, of which the edit is one


def _by_number(check: Callable[[Any], Any]) -> Values:
    return _part(lambda held: {int(number): check(value) for number, value in held.items()}, optional=True)


@dataclasses.dataclass(frozen=True)
class Key:
    """A moment of the film; None as poses, view or places: it is no key of those."""

    id: int = option(MISSING, _ID)  # that no other key of the session has had
    time: float = option(MISSING, number(0.0, MAX_SECONDS))  # seconds from the film's start
    name: str = option(MISSING, _NAME)
    easing: Easing = option("smooth", Values(checked_easing))  # how the way from here to the next key goes
    poses: Mapping[int, np.ndarray] | None = option(None, _by_number(frozen_vertices))  # (v, 3), by that of the edit
    view: View | None = option(None, _part(checked_view, optional=True))
    places: Mapping[int, Place] | None = option(None, _by_number(checked_place), since=2)  # by that of the object

    @property
    def is_empty(self) -> bool:
        """Whether it holds nothing."""
        return self.poses is None and self.view is None and self.places is None

    @property
    def held_places(self) -> Mapping[int, Place]:
        """The places that it holds. A pose without places is of a time when the only object stood in its own place."""
        return self.places if self.places is not None else {} if self.poses is None else {MAIN: Place()}


def checked_key(content: Any) -> Key:
    """A key from JSON."""
    return Key(**checked_fields(Key, content))


def by_time(keys: Iterable[Key]) -> tuple[Key, ...]:
    """Keys in their order."""
    return tuple(sorted(keys, key=lambda one: (one.time, one.id)))


_KEYS = _parts(checked_key, MAX_KEYS)


@dataclasses.dataclass(frozen=True)
class Timeline:
    """The film; its length is in seconds."""

    keys: tuple[Key, ...] = option((), _part(lambda value: by_time(_KEYS.check(value, "keys"))))
    length: float = option(4.0, number(0.0, MAX_SECONDS))
    fps: float = option(24.0, number(0.01, MAX_RATE))
    loop: str = option("once", one_of(*LOOPS))
    follows_keys: bool = option(False, flag(), since=2)  # whether the length is the last key's time, until it is set


def new_edit(number: int, cage: ClosedMesh, name: str, kind: str = "move", posed: Any = None) -> Edit:
    """An edit around a cage at rest; `posed` (v, 3) None is at rest too."""
    if len(cage.vertices) > MAX_VERTICES:
        raise InputError(
            f"a cage of {len(cage.vertices)} vertices is too large to edit interactively: at most {MAX_VERTICES}"
        )
    rest = frozen_vertices(cage.vertices)
    faces = np.array(cage.face_array, np.int32)
    faces.setflags(write=False)
    moved = rest if posed is None else frozen_vertices(posed, len(rest))
    return Edit(number, checked_name(name), checked_choice(kind, "kind", KINDS), True, faces, rest, moved)


def checked_edit(content: Any) -> Edit:
    """An edit from JSON, or with arrays in it."""
    found = checked_fields(Edit, content)
    rest = frozen_vertices(checked_items(found.pop("rest"), MAX_VERTICES, "rest"))
    cage = Cage(rest, checked_items(found.pop("faces"), 4 * MAX_VERTICES, "faces"))
    return dataclasses.replace(new_edit(found["id"], cage, found["name"], posed=found.pop("posed")), **found)


@dataclasses.dataclass(frozen=True)
class Document:
    """All that a session edits; the first object is its own field."""

    edits: tuple[Edit, ...] = option(MISSING, _parts(checked_edit, MAX_EDITS * MAX_OBJECTS))  # of all objects; those of
    selection: Selection = option(MISSING, _ANY)  # each in the order in which they act
    settings: Settings = option(MISSING, _part(lambda value: checked_settings(Settings(), value)))
    view: View = option(MISSING, _part(checked_view))
    timeline: Timeline = option(MISSING, _part(lambda value: Timeline(**checked_fields(Timeline, value))))
    time: float = option(0.0, number(0.0, MAX_SECONDS))  # where the timeline stands, seconds
    next_id: int = option(1, whole(1, MAX_ID + 1))  # of the next object, edit or key
    objects: tuple[SceneObject, ...] = option((SceneObject(MAIN, "scene"),), _parts(_object, MAX_OBJECTS), since=2)

    def edit(self, number: int) -> Edit:
        """An edit by its number. Raises ValueError where there is none."""
        if number is None:  # what is selected where there is none
            raise InputError("no edit is selected: add or select one first")
        return _numbered(self.edits, number)

    def scene_object(self, number: int) -> SceneObject:
        """An object by its number. Raises ValueError where there is none."""
        return _numbered(self.objects, number, "an object", "removed")

    def key(self, number: int) -> Key:
        """A key by its number. Raises ValueError where there is none."""
        return _numbered(self.timeline.keys, number, "a key")

    def checked_selection(self, content: Any) -> Selection:
        """A selection from edit, mode and vertices, and object where there is no edit; else the object stays active."""
        content, number, size = renamed_keys(content, OLD_KEYS), content["edit"], 0
        if number is None:
            object_id = self.scene_object(content.get("object", self.selection.object_id)).id
        else:
            edit = self.edit(number)
            object_id, size = edit.object_id, len(edit.rest)
        mode = checked_choice(content["mode"], "mode", PICKS)
        return Selection(number, mode, checked_vertices(content["vertices"], size), object_id)

    def edits_of(self, number: int) -> tuple[Edit, ...]:
        """The edits of an object, in the order in which they act."""
        return tuple(edit for edit in self.edits if edit.object_id == number)

    @property
    def is_staged(self) -> bool:
        """Whether there is more than the session's own field in its own place."""
        return [one.place for one in self.objects] != [Place()]

    @property
    def free_id(self) -> int:
        """The number of the next object, edit or key. Raises ValueError where a foreign session has used them up."""
        if self.next_id > MAX_ID // 2:
            raise InputError("this session has no numbers left for new objects, edits and keys: begin a new session")
        return self.next_id

    def with_edit(self, edit: Edit) -> Document:
        """The document with an edit in the place of the one of the same number."""
        return dataclasses.replace(self, edits=tuple(edit if old.id == edit.id else old for old in self.edits))

    def with_object(self, one: SceneObject) -> Document:
        """The document with an object in the place of the one of the same number."""
        return dataclasses.replace(self, objects=tuple(one if old.id == one.id else old for old in self.objects))

    def with_key(self, key: Key) -> Document:
        """The document with a key added, or in the place of the one of the same number."""
        return self.with_timeline(keys=by_time([*(old for old in self.timeline.keys if old.id != key.id), key]))

    def with_key_poses(self, number: int, change: Callable[[np.ndarray], np.ndarray | None]) -> Document:
        """The document with the poses of one edit changed in all keys; None takes them out."""
        keys = []
        for key in self.timeline.keys:
            if key.poses is not None and number in key.poses:
                changed = change(key.poses[number])
                poses = {other: pose for other, pose in key.poses.items() if other != number}
                poses |= {} if changed is None else {number: changed}
                key = dataclasses.replace(key, poses=poses or None)
            if not key.is_empty:
                keys.append(key)
        return self.with_timeline(keys=tuple(keys))

    def with_timeline(self, **changes: Any) -> Document:
        """The document with another film; one that is shorter takes the head to its end."""
        film = dataclasses.replace(self.timeline, **changes)
        if film.follows_keys:
            last = max((key.time for key in film.keys), default=0.0)
            film = dataclasses.replace(film, length=last or Timeline.length)
        # Beyond the last key nothing moves: only the time changes.
        time = min(self.time, film.length) if film.length < self.timeline.length else self.time
        return dataclasses.replace(self, timeline=film, time=time)

    def to_json(self, own: str = "scene") -> dict[str, Any]:
        """The document as JSON takes it. Numbers keep all their digits.
        own: what the session's field is called where a file says nothing of objects; such a file is that of before."""
        content = part_json(self)
        for entry in (*content["edits"], content["selection"]):
            if entry["object"] == MAIN:
                del entry["object"]
        if not self.timeline.follows_keys:
            del content["timeline"]["follows_keys"]
        if self.objects == (SceneObject(MAIN, own),):
            del content["objects"]
        return content

    @classmethod
    def from_json(cls, content: Any) -> Document:
        """A document from what `to_json`, or another program, made; edits and keys may be there already."""
        try:
            if not isinstance(content, Mapping):
                raise InputError(f"a session must be a dictionary, got {type(content).__name__}")
            made = dataclasses.replace(cls(**checked_fields(cls, content)), selection=Selection())
            edits, objects, keys = made.edits, made.objects, made.timeline.keys
            checked_items(edits, MAX_EDITS * len(objects), "edits")
            known, sizes = {one.id for one in objects}, {one.id: len(one.rest) for one in edits}
            if not objects or objects[0].id != MAIN or not {one.object_id for one in edits} <= known:
                raise InputError(
                    "the objects of the session must begin with its own scene file, and hold all of its edits"
                )
            numbers = [one.id for one in (*edits, *keys, *objects)]
            if len(set(numbers)) < len(numbers):
                raise InputError("two objects, edits or keys of the session have the same number")
            for edit, pose in (each for key in keys for each in (key.poses or {}).items()):
                if len(pose) != sizes.get(edit, len(pose)):
                    raise InputError(f"vertices must be ({sizes[edit]}, 3) numbers, got shape {pose.shape}")
            selection = made.checked_selection(content["selection"])
            return dataclasses.replace(made, selection=selection, next_id=max(made.next_id, max(numbers) + 1))
        except KeyError as error:
            raise InputError(f"the session lacks {error.args[0]!r}") from None
        except (TypeError, AttributeError, OverflowError, IndexError) as error:
            raise InputError(f"the session is damaged: {error}") from None


def same(one: Any, two: Any) -> bool:
    """Whether parts of documents are equal. They share what did not change, and keys are equal to themselves alone."""
    if one is two or isinstance(one, Key):
        return one is two
    if isinstance(one, np.ndarray):
        return np.array_equal(one, two)
    if isinstance(one, tuple) and isinstance(two, tuple):
        return len(one) == len(two) and all(map(same, one, two))
    if not dataclasses.is_dataclass(one) or type(one) is not type(two):
        return one == two
    names = (each.name for each in dataclasses.fields(one) if each.compare)
    return all(same(getattr(one, name), getattr(two, name)) for name in names)


#: What a page sends, JSON values that were not checked; and a step: its name, and the document on its other side.
Message = Mapping[str, Any]
Step = tuple[str, Document]
