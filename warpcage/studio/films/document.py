"""What is edited: objects, edits, poses, keys, view and settings; a command makes a new document from the old one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...core.checks import checked_easing, checked_flag, checked_number, checked_whole, shown
from ...core.names import LOOPS, Easing, checked_choice, renamed_keys
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


@dataclasses.dataclass(frozen=True)
class View:
    """Where the person looks from; (3,) world units."""

    eye: tuple[float, float, float]  # centre of projection
    target: tuple[float, float, float]  # in the middle of the picture
    up: tuple[float, float, float]  # unit vector
    fov: float = 40.0  # vertical, degrees


def checked_view(content: Any) -> View:
    """A view from eye, target, up and fov of a dictionary, others ignored; its `up` gets the length 1."""
    eye, target, up = (checked_triple(content[name], name) for name in ("eye", "target", "up"))
    length = float(np.linalg.norm(up))
    if not 1e-12 < length < 1e12:
        raise InputError("a view needs a direction `up` that is not zero")
    if not 1e-12 < np.linalg.norm(np.subtract(eye, target)) < 1e12:
        raise InputError("a view needs an eye some way from its target")
    forward = np.subtract(target, eye)
    if np.linalg.norm(np.cross(forward, up)) < 1e-6 * np.linalg.norm(forward) * length:
        raise InputError("a view cannot look along its own `up`")
    x, y, z = (float(value / length) for value in up)
    return View(eye, target, (x, y, z), checked_number(content["fov"], "fov", 1.0, 150.0))


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


#: The number of the object that a session begins with: the field that it is of.
MAIN = 0


@dataclasses.dataclass(frozen=True)
class SceneObject:
    """One field of the scene, in a place of its own; its edits are in its own coordinates."""

    id: int  # that no other object, edit or key of the session has had; MAIN for the session's own field
    name: str
    file: str | None = None  # of its field, seen from the session's folder; None is the session's own field
    place: Place = dataclasses.field(default_factory=Place)
    visible: bool = True
    locked: bool = False  # whether its place may not be changed


@dataclasses.dataclass(frozen=True)
class Edit:
    """One cage and what becomes of its content."""

    id: int  # that no other edit of the session has had
    name: str
    kind: str  # one of KINDS; a copy is a duplicate: the source stays
    visible: bool  # whether it acts on the picture
    faces: np.ndarray  # (f, 3) int32
    rest: np.ndarray  # (v, 3) float64, the cage around the captured object, world units; so is `posed`
    posed: np.ndarray
    falloff: float = 0.0  # width of the band at held walls in which the edit fades to rest, world units; see `CageEdit`
    held: str = "cut"  # the walls that are held: "cut" or "still"
    fragments: float = 0.0  # size of the fragments that go with the part, world units
    object_id: int = MAIN  # the number of the object that it deforms, in whose coordinates it is
    moved_sliders: Sliders | None = dataclasses.field(default=None, compare=False)  # the last ones; not in files

    @property
    def sliders(self) -> Sliders | None:
        """The sliders that the pose comes from, or None where something else has changed it since."""
        return self.moved_sliders if self.moved_sliders and self.moved_sliders.posed is self.posed else None

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
        return CageEdit(
            rest,
            keep_source=self.kind == "copy",
            remove=removes,
            falloff=0.0 if removes else self.falloff,
            held=self.held,
            fragments=self.fragments,
        )


@dataclasses.dataclass(frozen=True)
class Selection:
    """What the next tool acts on."""

    edit: int | None = None
    mode: str = "vertex"  # what a click picks, one of PICKS
    vertices: tuple[int, ...] = ()  # numbers of those of the active edit, ascending
    object_id: int = MAIN  # the active object, of which the edit is one


@dataclasses.dataclass(frozen=True)
class Key:
    """A moment of the film; None as poses, view or places: it is no key of those."""

    id: int  # that no other key of the session has had
    time: float  # seconds from the film's start
    name: str
    easing: Easing = "smooth"  # how the way from here to the next key goes
    poses: Mapping[int, np.ndarray] | None = None  # posed vertices (v, 3) by the number of the edit
    view: View | None = None
    places: Mapping[int, Place] | None = None  # by the number of the object

    @property
    def is_empty(self) -> bool:
        """Whether it holds nothing."""
        return self.poses is None and self.view is None and self.places is None

    @property
    def held_places(self) -> Mapping[int, Place]:
        """The places that it holds. A pose without places is of a time when the only object stood in its own place."""
        return self.places if self.places is not None else {} if self.poses is None else {MAIN: Place()}


@dataclasses.dataclass(frozen=True)
class Timeline:
    """The film; its length is in seconds."""

    keys: tuple[Key, ...] = ()  # by time
    length: float = 4.0
    fps: float = 24.0
    loop: str = "once"  # one of LOOPS
    follows_keys: bool = False  # whether the length is the last key's time, until another is set


@dataclasses.dataclass(frozen=True)
class Document:
    """All that a session edits."""

    edits: tuple[Edit, ...]  # of all objects; those of each in the order in which they act
    selection: Selection
    settings: Settings
    view: View
    timeline: Timeline
    time: float = 0.0  # where the timeline stands, seconds
    next_id: int = 1  # of the next object, edit or key
    objects: tuple[SceneObject, ...] = (SceneObject(MAIN, "scene"),)  # the session's own field first

    def edit(self, number: int) -> Edit:
        """An edit by its number. Raises ValueError where there is none."""
        if number is None:  # what is selected where there is none
            raise InputError("no edit is selected: add or select one first")
        checked_id(number, "the number of an edit")
        for edit in self.edits:
            if edit.id == number:
                return edit
        raise InputError(f"there is no edit {number!r}: it may have been deleted")

    def scene_object(self, number: int) -> SceneObject:
        """An object by its number. Raises ValueError where there is none."""
        checked_whole(number, "the number of an object", MAIN, MAX_ID)
        for scene_object in self.objects:
            if scene_object.id == number:
                return scene_object
        raise InputError(f"there is no object {number!r}: it may have been removed")

    def edits_of(self, number: int) -> tuple[Edit, ...]:
        """The edits of an object, in the order in which they act."""
        return tuple(edit for edit in self.edits if edit.object_id == number)

    @property
    def is_staged(self) -> bool:
        """Whether there is more than the session's own field in its own place."""
        return [one.place for one in self.objects] != [Place()]

    def key(self, number: int) -> Key:
        """A key by its number. Raises ValueError where there is none."""
        checked_id(number, "the number of a key")
        for key in self.timeline.keys:
            if key.id == number:
                return key
        raise InputError(f"there is no key {number!r}: it may have been deleted")

    @property
    def free_id(self) -> int:
        """The number of the next object, edit or key. Raises ValueError where a foreign session has used them up."""
        if self.next_id > MAX_ID // 2:
            raise InputError("this session has no numbers left for new objects, edits and keys: begin a new session")
        return self.next_id

    def with_edit(self, edit: Edit) -> Document:
        """The document with an edit in the place of the one of the same number."""
        return dataclasses.replace(self, edits=tuple(edit if old.id == edit.id else old for old in self.edits))

    def with_object(self, scene_object: SceneObject) -> Document:
        """The document with an object in the place of the one of the same number."""
        return dataclasses.replace(
            self, objects=tuple(scene_object if old.id == scene_object.id else old for old in self.objects)
        )

    def with_key(self, key: Key) -> Document:
        """The document with a key added, or in the place of the one of the same number."""
        keys = [old for old in self.timeline.keys if old.id != key.id] + [key]
        return self.with_timeline(keys=tuple(sorted(keys, key=lambda one: (one.time, one.id))))

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
        content = {
            "edits": [_without_main(edit_json(edit)) for edit in self.edits],
            "selection": _without_main(selection_json(self.selection)),
            "settings": self.settings.to_json(),
            "view": dataclasses.asdict(self.view),
            "timeline": {
                "keys": [key_json(key) for key in self.timeline.keys],
                "length": self.timeline.length,
                "fps": self.timeline.fps,
                "loop": self.timeline.loop,
                **({"follows_keys": True} if self.timeline.follows_keys else {}),
            },
            "time": self.time,
            "next_id": self.next_id,
        }
        if self.objects != (SceneObject(MAIN, own),):
            content["objects"] = [dataclasses.asdict(one) for one in self.objects]
        return content

    @classmethod
    def from_json(
        cls,
        content: Any,
        edit: Callable[[Any], Edit] | None = None,
        key: Callable[[Any, Mapping[int, int]], Key] | None = None,
    ) -> Document:
        """A document from what `to_json`, or another program, made. `edit`, `key`: what reads an edit and a key."""
        try:
            return _document(content, edit or checked_edit, key or checked_key)
        except KeyError as error:
            raise InputError(f"the session lacks {error.args[0]!r}") from None
        except (TypeError, AttributeError, OverflowError, IndexError) as error:
            raise InputError(f"the session is damaged: {error}") from None


def _without_main(content: dict[str, Any]) -> dict[str, Any]:
    """An edit or a selection as a file holds it: without the object where that is the session's own field."""
    return {name: value for name, value in content.items() if (name, value) != ("object", MAIN)}


#: What a page sends, JSON values that were not checked; and a step: its name, and the document on its other side.
Message = Mapping[str, Any]
Step = tuple[str, Document]


def selection_json(selection: Selection) -> dict[str, Any]:
    """A selection as JSON takes it."""
    content = dataclasses.asdict(selection)
    return content | {"object": content.pop("object_id")}


def edit_json(edit: Edit, rows: Callable[[np.ndarray], Any] = np.ndarray.tolist) -> dict[str, Any]:
    """An edit as JSON takes it. `rows`: what an array of it becomes."""
    return {
        "id": edit.id,
        "name": edit.name,
        "kind": edit.kind,
        "visible": edit.visible,
        "faces": rows(edit.faces),
        "rest": rows(edit.rest),
        "posed": rows(edit.posed),
        "falloff": edit.falloff,
        "held": edit.held,
        "fragments": edit.fragments,
        "object": edit.object_id,
    }


def new_edit(number: int, cage: ClosedMesh, name: str, kind: str = "move", posed: Any = None) -> Edit:
    """An edit around a cage at rest; `posed` (v, 3) None is at rest too."""
    if len(cage.vertices) > MAX_VERTICES:
        raise InputError(
            f"a cage of {len(cage.vertices)} vertices is too large to edit interactively: at most {MAX_VERTICES}"
        )
    rest = frozen_vertices(cage.vertices)
    faces = np.array(cage.faces, np.int32)
    faces.setflags(write=False)
    moved = rest if posed is None else frozen_vertices(posed, len(rest))
    return Edit(number, checked_name(name), checked_choice(kind, "kind", KINDS), True, faces, rest, moved)


def checked_walls(content: Mapping[str, Any]) -> dict[str, Any]:
    """What a message or a session says of falloff, held and fragments of an edit: those of them that it has."""
    lengths = {
        name: checked_number(content[name], name, 0.0, LARGEST_LENGTH)
        for name in ("falloff", "fragments")
        if name in content
    }
    return lengths | ({"held": checked_choice(content["held"], "held", HELD)} if "held" in content else {})


def key_json(key: Key, rows: Callable[[np.ndarray], Any] = np.ndarray.tolist) -> dict[str, Any]:
    """A key as JSON takes it. `rows`: what an array of it becomes."""
    poses = None if key.poses is None else {str(number): rows(array) for number, array in key.poses.items()}
    view = None if key.view is None else dataclasses.asdict(key.view)
    held = {"id": key.id, "time": key.time, "name": key.name, "easing": key.easing, "poses": poses, "view": view}
    if key.places is not None:
        held["places"] = {str(number): dataclasses.asdict(place) for number, place in key.places.items()}
    return held


def _document(
    content: Mapping[str, Any], edit: Callable[[Any], Edit], key: Callable[[Any, Mapping[int, int]], Key]
) -> Document:
    if not isinstance(content, Mapping):
        raise InputError(f"a session must be a dictionary, got {type(content).__name__}")
    content = renamed_keys(content, OLD_KEYS)
    objects = tuple(_object(one) for one in checked_items(content.get("objects", _ONE_OBJECT), MAX_OBJECTS, "objects"))
    edits = tuple(edit(one) for one in checked_items(content["edits"], MAX_EDITS * len(objects), "edits"))
    sizes = {one.id: len(one.rest) for one in edits}
    if (
        not objects
        or objects[0].id != MAIN
        or not {one.object_id for one in edits} <= {scene_object.id for scene_object in objects}
    ):
        raise InputError("the objects of the session must begin with its own scene file, and hold all of its edits")
    film = content["timeline"]
    keys = tuple(key(one, sizes) for one in checked_items(film["keys"], MAX_KEYS, "keys"))
    numbers = [one.id for one in (*edits, *keys, *objects)]
    if len(set(numbers)) < len(numbers):
        raise InputError("two objects, edits or keys of the session have the same number")
    length = checked_number(film["length"], "length", 0.0, MAX_SECONDS)
    return Document(
        edits,
        checked_selection(content["selection"], edits, objects),
        checked_settings(Settings(), content["settings"]),
        checked_view(content["view"]),
        Timeline(
            tuple(sorted(keys, key=lambda one: (one.time, one.id))),
            length,
            checked_number(film["fps"], "fps", 0.01, MAX_RATE),
            checked_choice(film["loop"], "loop", LOOPS),
            checked_flag(film.get("follows_keys", False), "follows_keys"),  # older files have a length of their own
        ),
        checked_number(content["time"], "time", 0.0, MAX_SECONDS),
        max([checked_whole(content["next_id"], "next_id", 1, MAX_ID + 1), *(number + 1 for number in numbers)]),
        objects,
    )


#: The objects of a session that says nothing of them.
_ONE_OBJECT = ({"id": MAIN, "name": "scene"},)


def checked_selection(
    content: Mapping[str, Any], edits: Sequence[Edit], objects: Sequence[SceneObject], before: int = MAIN
) -> Selection:
    """A selection from edit, mode and vertices, and object where there is no edit; `before` where it names none."""
    content = renamed_keys(content, OLD_KEYS)
    number = content["edit"]
    if number is None:
        object_id, size = content.get("object", before), 0
        if checked_whole(object_id, "the number of an object", MAIN, MAX_ID) not in [one.id for one in objects]:
            raise InputError(f"there is no object {object_id!r}: it may have been removed")
    else:
        edit = next((edit for edit in edits if edit.id == checked_id(number, "the number of an edit")), None)
        if edit is None:
            raise InputError(f"there is no edit {number!r}: it may have been deleted")
        object_id, size = edit.object_id, len(edit.rest)
    mode = checked_choice(content["mode"], "mode", PICKS)
    return Selection(number, mode, checked_vertices(content["vertices"], size), object_id)


def checked_place(content: Any) -> Place:
    """A place from what JSON has of its position, turn and scale."""
    if not isinstance(content, Mapping):
        raise InputError(f"a place must be an object with a position, a turn or a scale, got {shown(content)}")
    triples = {name: checked_triple(content[name], name) for name in ("position", "turn") if name in content}
    return Place(**triples, scale=checked_number(content.get("scale", 1.0), "scale", *SCALES))


def _object(content: Mapping[str, Any]) -> SceneObject:
    number, file = checked_whole(content["id"], "id", MAIN, MAX_ID), content.get("file")
    if not isinstance(file, str | None) or (number == MAIN and file is not None):
        raise InputError(f"the file of object {number} of the session must be a name; the first one has none")
    flags = {name: checked_flag(content[name], name) for name in ("visible", "locked") if name in content}
    return SceneObject(number, checked_name(content["name"]), file, checked_place(content.get("place", {})), **flags)


def checked_edit(content: Mapping[str, Any]) -> Edit:
    """An edit from what `edit_json`, or another program, made."""
    content = renamed_keys(content, OLD_KEYS)
    vertices = checked_items(content["rest"], MAX_VERTICES, "rest")
    cage = Cage(frozen_vertices(vertices), np.asarray(checked_items(content["faces"], 4 * MAX_VERTICES, "faces")))
    number = checked_id(content["id"], "id")
    edit = new_edit(number, cage, content["name"], content["kind"], content["posed"])
    object_id = checked_whole(content.get("object", MAIN), "the number of an object", MAIN, MAX_ID)
    visible = checked_flag(content["visible"], "visible")
    return dataclasses.replace(edit, visible=visible, object_id=object_id, **checked_walls(content))


def checked_key(content: Mapping[str, Any], sizes: Mapping[int, int]) -> Key:
    """A key from what `key_json`, or another program, made. `sizes`: of cages, vertices by the number of the edit."""
    poses, view, places = content["poses"], content["view"], content.get("places")
    if poses is not None:
        poses = {int(number): frozen_vertices(array, sizes.get(int(number))) for number, array in poses.items()}
    return Key(
        checked_id(content["id"], "id"),
        checked_number(content["time"], "time", 0.0, MAX_SECONDS),
        checked_name(content["name"]),
        checked_easing(content["easing"], "easing"),
        poses,
        None if view is None else checked_view(view),
        None if places is None else {int(number): checked_place(place) for number, place in places.items()},
    )
