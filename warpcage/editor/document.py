"""Document: all that an editor session edits. It is immutable; a change makes a new one that shares what stays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..core.names import EASINGS, LOOPS
from ..deform.edits import HELD, MAX_EDITS, CageEdit
from ..mesh.mesh import ClosedMesh
from .checked import (
    MAX_ID,
    MAX_KEYS,
    MAX_RATE,
    MAX_SECONDS,
    MAX_VERTICES,
    checked_between,
    checked_choice,
    checked_flag,
    checked_id,
    checked_items,
    checked_name,
    checked_vertices,
    checked_whole,
    frozen_vertices,
)
from .looks import MODES as MODES
from .looks import SHOWN as SHOWN
from .looks import Settings as Settings
from .looks import View as View
from .looks import checked_settings as checked_settings
from .looks import checked_view as checked_view

KINDS = ("move", "copy", "remove")
PICKS = ("vertex", "edge", "face")

#: Largest width of a falloff and size of crumbs, world units.
LARGEST_LENGTH = 1e9


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
    # width of the band inside held walls in which the edit fades to rest, world units; see `CageEdit`
    falloff: float = 0.0
    held: str = "cut"  # the walls that are held: "cut" or "still"
    crumbs: float = 0.0  # size of the crumbs that go with the part, world units

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
            crumbs=self.crumbs,
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
    easing: str = "smooth"  # how the way from here to the next key goes, one of EASINGS
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
        raise ValueError(f"there is no edit {number!r}: it may have been deleted")

    def key(self, number: int) -> Key:
        """A key by its number. Raises ValueError where there is none."""
        checked_id(number, "the number of a key")
        for key in self.timeline.keys:
            if key.id == number:
                return key
        raise ValueError(f"there is no key {number!r}: it may have been deleted")

    @property
    def free_id(self) -> int:
        """The number of the next edit or key. Raises ValueError where a foreign session has used them up."""
        if self.next_id > MAX_ID // 2:
            raise ValueError("this session has no numbers left for new edits and keys: begin a new session")
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
            raise ValueError(f"the session lacks {error.args[0]!r}") from None
        except (TypeError, AttributeError, OverflowError, IndexError) as error:
            raise ValueError(f"the session is damaged: {error}") from None


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
        "crumbs": edit.crumbs,
    }


def new_edit(number: int, cage: ClosedMesh, name: str, kind: str = "move", posed: Any = None) -> Edit:
    """An edit around a cage at rest; `posed` (v, 3) None is at rest too."""
    if len(cage.vertices) > MAX_VERTICES:
        raise ValueError(
            f"a cage of {len(cage.vertices)} vertices is too large to edit by hand: at most {MAX_VERTICES}"
        )
    rest = frozen_vertices(cage.vertices)
    faces = np.array(cage.faces, np.int32)
    faces.setflags(write=False)
    moved = rest if posed is None else frozen_vertices(posed, len(rest))
    return Edit(number, checked_name(name), checked_choice(kind, KINDS, "kind"), True, faces, rest, moved)


def checked_walls(content: Mapping[str, Any]) -> dict[str, Any]:
    """What a message or a session says of falloff, held and crumbs of an edit: those of them that it has."""
    lengths = {
        name: checked_between(content[name], 0.0, LARGEST_LENGTH, name)
        for name in ("falloff", "crumbs")
        if name in content
    }
    return lengths | ({"held": checked_choice(content["held"], HELD, "held")} if "held" in content else {})


def _key_json(key: Key) -> dict[str, Any]:
    poses = None if key.poses is None else {str(number): array.tolist() for number, array in key.poses.items()}
    view = None if key.view is None else dataclasses.asdict(key.view)
    return {"id": key.id, "time": key.time, "name": key.name, "easing": key.easing, "poses": poses, "view": view}


def _document(content: Mapping[str, Any]) -> Document:
    if not isinstance(content, Mapping):
        raise ValueError(f"a session must be a dictionary, got {type(content).__name__}")
    edits = tuple(_edit(one) for one in checked_items(content["edits"], MAX_EDITS, "edits"))
    sizes = {edit.id: len(edit.rest) for edit in edits}
    film = content["timeline"]
    keys = tuple(_key(one, sizes) for one in checked_items(film["keys"], MAX_KEYS, "keys"))
    numbers = [edit.id for edit in edits] + [key.id for key in keys]
    if len(set(numbers)) < len(numbers):
        raise ValueError("two edits or keys of the session have the same number")
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
        raise ValueError(f"there is no edit {number!r}: it may have been deleted")
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
        checked_choice(content["easing"], EASINGS, "easing"),
        poses,
        None if view is None else checked_view(view),
    )
