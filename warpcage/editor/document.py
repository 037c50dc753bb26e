"""What is edited: edits, poses, keys, view and settings; a command makes a new document from the old one."""

from __future__ import annotations

import dataclasses
import json
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from ..cage.cage import Cage
from ..core.checks import checked_easing, checked_number, shown
from ..core.names import COORDINATES, DENSITIES, FIELD_COORDINATES, FRAGMENTS_WORD, LOOPS, PLANES, Easing, edit_fields
from ..edits.edits import HELD, MAX_EDITS, CageEdit
from ..errors import InputError
from ..mesh.mesh import ClosedMesh
from ..view.frame import MAX_SUPERSAMPLING, parse_background

#: Most vertices of a cage, letters of a name, keys of a timeline and seconds of a film: more is not a person's work.
MAX_VERTICES, MAX_NAME, MAX_KEYS, MAX_SECONDS = 20_000, 100, 5_000, 3_600.0

#: Frames per second that a film may have.
MAX_RATE = 240.0

#: Cells of a lattice along the longest side.
RESOLUTIONS = (8, 512)

#: Largest number of a place, world units, either way from zero: its squares and cubes can be held in float32 too.
MAX_PLACE = 1e12

#: Largest number of an edit or a key: a message holds it in 32 bits. New ones are given up to half of it.
MAX_ID = 2**32 - 1

#: Letters of an error's line, and places of a stroke of the brush.
MAX_LINE, MAX_PLACES = 500, 64


def frozen_vertices(vertices: Any, count: int | None = None) -> np.ndarray:
    """Vertices (v, 3), an array or lists of numbers, as a document holds them: float64, read-only, an array of its own.
    `count`: how many there must be; None takes any number."""
    if not isinstance(vertices, np.ndarray):
        if not isinstance(vertices, list | tuple) or not all(map(_is_row, vertices)):
            raise InputError("vertices must be a list of three numbers each")
    try:
        array = np.array(vertices, dtype=np.float64)
    except OverflowError:
        raise InputError("vertices must be finite") from None
    if array.ndim != 2 or array.shape[1:] != (3,) or (count is not None and len(array) != count):
        wanted = "(v, 3)" if count is None else f"({count}, 3)"
        raise InputError(f"vertices must be {wanted} numbers, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise InputError("vertices must be finite")
    if array.size and np.abs(array).max() > MAX_PLACE:
        raise InputError(f"vertices must be within {MAX_PLACE:g} of zero")
    array.setflags(write=False)
    return array


def checked_name(name: Any) -> str:
    """A name in one line. Raises ValueError for another type, an empty one, a long one, or what cannot be printed."""
    if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
        raise InputError(f"a name must be 1 to {MAX_NAME} letters")
    name = " ".join(name.split())
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
        raise InputError("a name must be letters that can be printed")
    return name


def checked_choice(value: Any, choices: Sequence[str], what: str) -> str:
    """A value that is one of some words. Raises ValueError for another one."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{what} must be one of {', '.join(choices)}, got {shown(value)}")
    return value


def checked_whole(value: Any, low: int, high: int, what: str) -> int:
    """A whole number in a range. Raises ValueError for another one."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InputError(f"{what} must be a whole number from {low} to {high}, got {shown(value)}")
    return value


def checked_id(value: Any, what: str) -> int:
    """The number of an edit, a key or a job. Raises ValueError for anything else; True is no number."""
    return checked_whole(value, 1, MAX_ID, what)


def checked_flag(value: Any, what: str) -> bool:
    """True or False. Raises ValueError for anything else."""
    if type(value) is not bool:
        raise InputError(f"{what} must be true or false, got {shown(value)}")
    return value


def checked_between(value: Any, low: float, high: float, what: str) -> float:
    """A number in a range. Raises ValueError for another one; True is no number."""
    if isinstance(value, bool | list | dict | str | None):
        raise InputError(f"{what} must be a number, got {shown(value)}")
    number = checked_number(value, what)
    if not low <= number <= high:
        raise InputError(f"{what} must be {low:g} to {high:g}, got {number:g}")
    return number


def checked_vertices(numbers: Any, count: int) -> tuple[int, ...]:
    """Numbers of vertices of a cage that has `count`, ascending, each once."""
    given = checked_items(numbers, MAX_VERTICES, "vertices")
    if not all(type(number) is int and 0 <= number < count for number in given):
        raise InputError(f"vertices must be whole numbers from 0 to {count - 1}")
    return tuple(sorted(set(given)))


def checked_triple(values: Any, what: str) -> tuple[float, float, float]:
    """Three numbers. Raises ValueError for anything else."""
    if not isinstance(values, list | tuple) or len(values) != 3:
        raise InputError(f"{what} must be three numbers")
    x, y, z = (checked_between(value, -MAX_PLACE, MAX_PLACE, what) for value in values)
    return x, y, z


def checked_items(values: Any, most: int, what: str) -> list[Any]:
    """A list of at most so many items. Raises ValueError for anything else."""
    if not isinstance(values, list | tuple) or len(values) > most:
        raise InputError(f"{what} must be a list of at most {most}")
    return list(values)


def checked_click(content: Any) -> tuple[list[tuple[float, float]], float, str | None]:
    """Where a person clicked or painted: places (shares of the picture across and down), its aspect, and the plane."""
    if not isinstance(content, dict):
        raise InputError("click must hold across, down, aspect and plane")
    given = content.get("places", [[content.get("across"), content.get("down")]])
    places = []
    for place in checked_items(given, MAX_PLACES, "places"):
        if len(checked_items(place, 2, "a place")) != 2:
            raise InputError("a place in the picture must be two numbers, across and down")
        across, down = place
        places.append((checked_between(across, 0.0, 1.0, "across"), checked_between(down, 0.0, 1.0, "down")))
    aspect = checked_between(content.get("aspect"), 0.05, 20.0, "aspect")
    plane = checked_choice(content.get("plane"), (*PLANES, "none"), "plane")
    return places, aspect, None if plane == "none" else plane


def parsed_json(text: str) -> Any:
    """What a text in JSON says; NaN and Infinity, which Python writes, are no JSON."""
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError:
        raise InputError("lists within lists within lists go too deep") from None


def _is_row(row: Any) -> bool:
    return isinstance(row, list | tuple | np.ndarray) and not any(
        isinstance(x, bool | str | list | dict | None) for x in row
    )


def _refuse_constant(name: str) -> NoReturn:
    raise InputError(f"{name} is no number in JSON")


SHOWN = ("rgb", "disparity", "alpha", "masks")

MODES = ("pose", "rest")


@dataclasses.dataclass(frozen=True)
class View:
    """Where the person looks from; (3,) world units."""

    eye: tuple[float, float, float]  # centre of projection
    target: tuple[float, float, float]  # in the middle of the picture
    up: tuple[float, float, float]  # unit vector
    fov: float = 40.0  # vertical, degrees


#: The colour behind a scene: a name, three numbers in [0, 1], or None for the field's own.
Background = str | Sequence[float] | None


@dataclasses.dataclass(frozen=True)
class Settings:
    """How the scene is deformed and shown."""

    coordinates: str = FIELD_COORDINATES
    resolution: int = 64  # cells of the map's lattice along the longest side of a cage, in pictures that rest
    density: str = "opacity"  # see `Deformer`
    background: Background = None  # a name, three numbers in [0, 1]; None: the field's own
    supersampling: int = 1  # rays along each side of a pixel, in pictures that rest
    show: str = "rgb"  # one of SHOWN
    mode: str = "pose"  # "pose": the posed cage and deformed scene; "rest": the cage at rest and the scene as captured
    fill: bool = False  # background that no picture showed, in pictures that rest; see `fill_unseen`


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
    return View(eye, target, (x, y, z), checked_between(content["fov"], 1.0, 150.0, "fov"))


def checked_settings(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Settings with new values by name, checked."""
    known = {field.name for field in dataclasses.fields(Settings)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise InputError(f"there is no setting {unknown[0][:40]!r}, only {', '.join(sorted(known))}")
    good: dict[str, Any] = {}
    for name, value in changes.items():
        if name == "background":
            good[name] = checked_background(value)
        elif name == "fill":
            good[name] = checked_flag(value, name)
        elif name == "resolution":
            good[name] = checked_whole(value, *RESOLUTIONS, name)
        elif name == "supersampling":
            good[name] = checked_whole(value, 1, min(4, MAX_SUPERSAMPLING), name)
        else:
            choices = {"coordinates": COORDINATES, "density": DENSITIES, "show": SHOWN, "mode": MODES}[name]
            good[name] = checked_choice(value, choices, name)
    return dataclasses.replace(settings, **good)


def checked_background(value: Any) -> Background:
    if value is None:
        return None
    if isinstance(value, str):
        if len(value) == 7 and value[0] == "#":
            try:
                r, g, b = bytes.fromhex(value[1:])
            except ValueError:
                raise InputError(f"background {value!r} is no colour: #rrggbb") from None
            return r / 255, g / 255, b / 255
        parse_background(value)  # raises ValueError where there is no such name
        return value
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise InputError("background must be a name, #rrggbb, or three numbers in [0, 1]")
    r, g, b = (checked_between(part, 0.0, 1.0, "background") for part in value)
    return r, g, b


KINDS = ("move", "copy", "remove")

PICKS = ("vertex", "edge", "face")

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


@dataclasses.dataclass(frozen=True)
class Key:
    """A moment of the film; None as poses or view: it is no key of those."""

    id: int  # that no other key of the session has had
    time: float  # seconds from the film's start
    name: str
    easing: Easing = "smooth"  # how the way from here to the next key goes
    poses: Mapping[int, np.ndarray] | None = None  # posed vertices (v, 3) by the number of the edit
    view: View | None = None


@dataclasses.dataclass(frozen=True)
class Timeline:
    """The film; its length is in seconds."""

    keys: tuple[Key, ...] = ()  # by time
    length: float = 4.0
    fps: float = 24.0
    loop: str = "once"  # one of LOOPS


@dataclasses.dataclass(frozen=True)
class Document:
    """All that a session edits."""

    edits: tuple[Edit, ...]  # in the order in which they act
    selection: Selection
    settings: Settings
    view: View
    timeline: Timeline
    time: float = 0.0  # where the timeline stands, seconds
    next_id: int = 1  # of the next edit or key

    def edit(self, number: int) -> Edit:
        """An edit by its number. Raises ValueError where there is none."""
        checked_id(number, "the number of an edit")
        for edit in self.edits:
            if edit.id == number:
                return edit
        raise InputError(f"there is no edit {number!r}: it may have been deleted")

    def key(self, number: int) -> Key:
        """A key by its number. Raises ValueError where there is none."""
        checked_id(number, "the number of a key")
        for key in self.timeline.keys:
            if key.id == number:
                return key
        raise InputError(f"there is no key {number!r}: it may have been deleted")

    @property
    def free_id(self) -> int:
        """The number of the next edit or key. Raises ValueError where a foreign session has used them up."""
        if self.next_id > MAX_ID // 2:
            raise InputError("this session has no numbers left for new edits and keys: begin a new session")
        return self.next_id

    def with_edit(self, edit: Edit) -> Document:
        """The document with an edit in the place of the one of the same number."""
        return dataclasses.replace(self, edits=tuple(edit if old.id == edit.id else old for old in self.edits))

    def with_key(self, key: Key) -> Document:
        """The document with a key added, or in the place of the one of the same number."""
        keys = [old for old in self.timeline.keys if old.id != key.id] + [key]
        return self.with_timeline(keys=tuple(sorted(keys, key=lambda one: (one.time, one.id))))

    def with_timeline(self, **changes: Any) -> Document:
        """The document with another film."""
        return dataclasses.replace(self, timeline=dataclasses.replace(self.timeline, **changes))

    def to_json(self) -> dict[str, Any]:
        """The document as JSON takes it. Numbers keep all their digits."""
        return {
            "edits": [edit_json(edit) for edit in self.edits],
            "selection": dataclasses.asdict(self.selection),
            "settings": dataclasses.asdict(self.settings),
            "view": dataclasses.asdict(self.view),
            "timeline": {
                "keys": [_key_json(key) for key in self.timeline.keys],
                "length": self.timeline.length,
                "fps": self.timeline.fps,
                "loop": self.timeline.loop,
            },
            "time": self.time,
            "next_id": self.next_id,
        }

    @classmethod
    def from_json(cls, content: Any) -> Document:
        """A document from what `to_json` made, or somebody else."""
        try:
            return _document(content)
        except KeyError as error:
            raise InputError(f"the session lacks {error.args[0]!r}") from None
        except (TypeError, AttributeError, OverflowError, IndexError) as error:
            raise InputError(f"the session is damaged: {error}") from None


def edit_json(edit: Edit) -> dict[str, Any]:
    """An edit as JSON takes it."""
    return {
        "id": edit.id,
        "name": edit.name,
        "kind": edit.kind,
        "visible": edit.visible,
        "faces": edit.faces.tolist(),
        "rest": edit.rest.tolist(),
        "posed": edit.posed.tolist(),
        "falloff": edit.falloff,
        "held": edit.held,
        FRAGMENTS_WORD: edit.fragments,
    }


def new_edit(number: int, cage: ClosedMesh, name: str, kind: str = "move", posed: Any = None) -> Edit:
    """An edit around a cage at rest; `posed` (v, 3) None is at rest too."""
    if len(cage.vertices) > MAX_VERTICES:
        raise InputError(
            f"a cage of {len(cage.vertices)} vertices is too large to edit by hand: at most {MAX_VERTICES}"
        )
    rest = frozen_vertices(cage.vertices)
    faces = np.array(cage.faces, np.int32)
    faces.setflags(write=False)
    moved = rest if posed is None else frozen_vertices(posed, len(rest))
    return Edit(number, checked_name(name), checked_choice(kind, KINDS, "kind"), True, faces, rest, moved)


def checked_walls(content: Mapping[str, Any]) -> dict[str, Any]:
    """What a message or a session says of falloff, held and fragments of an edit: those of them that it has."""
    lengths = {
        word: checked_between(content[word], 0.0, LARGEST_LENGTH, word)
        for word in ("falloff", FRAGMENTS_WORD)
        if word in content
    }
    return edit_fields(lengths) | ({"held": checked_choice(content["held"], HELD, "held")} if "held" in content else {})


def _key_json(key: Key) -> dict[str, Any]:
    poses = None if key.poses is None else {str(number): array.tolist() for number, array in key.poses.items()}
    view = None if key.view is None else dataclasses.asdict(key.view)
    return {"id": key.id, "time": key.time, "name": key.name, "easing": key.easing, "poses": poses, "view": view}


def _document(content: Mapping[str, Any]) -> Document:
    if not isinstance(content, Mapping):
        raise InputError(f"a session must be a dictionary, got {type(content).__name__}")
    edits = tuple(_edit(one) for one in checked_items(content["edits"], MAX_EDITS, "edits"))
    sizes = {edit.id: len(edit.rest) for edit in edits}
    film = content["timeline"]
    keys = tuple(_key(one, sizes) for one in checked_items(film["keys"], MAX_KEYS, "keys"))
    numbers = [edit.id for edit in edits] + [key.id for key in keys]
    if len(set(numbers)) < len(numbers):
        raise InputError("two edits or keys of the session have the same number")
    length = checked_between(film["length"], 0.0, MAX_SECONDS, "length")
    return Document(
        edits,
        checked_selection(content["selection"], sizes),
        checked_settings(Settings(), content["settings"]),
        checked_view(content["view"]),
        Timeline(
            tuple(sorted(keys, key=lambda key: (key.time, key.id))),
            length,
            checked_between(film["fps"], 0.01, MAX_RATE, "fps"),
            checked_choice(film["loop"], LOOPS, "loop"),
        ),
        checked_between(content["time"], 0.0, MAX_SECONDS, "time"),
        max([checked_whole(content["next_id"], 1, MAX_ID + 1, "next_id"), *(number + 1 for number in numbers)]),
    )


def checked_selection(content: Mapping[str, Any], sizes: Mapping[int, int]) -> Selection:
    """A selection from edit, mode and vertices; `sizes` are the vertices of each edit by its number."""
    number = content["edit"]
    if number is not None and checked_id(number, "the number of an edit") not in sizes:
        raise InputError(f"there is no edit {number!r}: it may have been deleted")
    size = 0 if number is None else sizes[number]
    return Selection(
        number, checked_choice(content["mode"], PICKS, "mode"), checked_vertices(content["vertices"], size)
    )


def _edit(content: Mapping[str, Any]) -> Edit:
    vertices = checked_items(content["rest"], MAX_VERTICES, "rest")
    cage = Cage(frozen_vertices(vertices), np.asarray(checked_items(content["faces"], 4 * MAX_VERTICES, "faces")))
    number = checked_id(content["id"], "id")
    edit = new_edit(number, cage, content["name"], content["kind"], content["posed"])
    return dataclasses.replace(edit, visible=checked_flag(content["visible"], "visible"), **checked_walls(content))


def _key(content: Mapping[str, Any], sizes: Mapping[int, int]) -> Key:
    poses, view = content["poses"], content["view"]
    if poses is not None:
        poses = {int(number): frozen_vertices(array, sizes.get(int(number))) for number, array in poses.items()}
    return Key(
        checked_id(content["id"], "id"),
        checked_between(content["time"], 0.0, MAX_SECONDS, "time"),
        checked_name(content["name"]),
        checked_easing(content["easing"], "easing"),
        poses,
        None if view is None else checked_view(view),
    )
