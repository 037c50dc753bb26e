"""A session of the editor: the newest document, its history, its file, and a film that plays."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import logging
import os
import pathlib
import threading
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...core.arrays import box_corners
from ...core.checks import listed
from ...core.files import DAMAGED, PathLike, atomic_path, damage, read_json, require_file
from ...core.names import error_line, renamed_keys
from ...errors import InputError
from ...render.surface_mesh import AnyObject, object_size
from ...splats.splat_field import AnyField
from ...view.camera import framing_orbit
from ...view.motion import frame_count
from . import commands, objects, timeline
from .checks import MAX_LINE, MAX_NAME, frozen_vertices
from .document import (
    MAIN,
    OLD_KEYS,
    Document,
    Edit,
    SceneObject,
    Selection,
    Settings,
    Sliders,
    Timeline,
    View,
    edit_json,
    new_edit,
    selection_json,
)
from .pictures.scene import Fields
from .steps.history import History, seen_as
from .steps.losses import losses

#: The step of leaving a pose that no key holds.
SCRUB = "scrub"


#: Version 2 has several objects, 3 has them and fragments by these names; all are read.
FORMAT, VERSION = "warpcage session", 3

#: How the name of a field's session ends: `lego.npz` has `lego.session.json`.
ENDING = ".session.json"

#: What tells versions of a file apart: its time in nanoseconds, its bytes and its number.
Stamp = tuple[int, int, int]


def session_path(field: PathLike) -> pathlib.Path:
    """Where the session of a field's file is kept: beside it."""
    path = pathlib.Path(field)
    return path.with_name(path.stem + ENDING)


def free_session_path(path: pathlib.Path) -> pathlib.Path:
    """The first name of NAME.1.session.json, NAME.2.session.json, ... that no file beside a session's file has."""
    stem = path.name.removesuffix(ENDING) if path.name.endswith(ENDING) else path.stem
    number = 1
    while os.path.lexists(other := path.with_name(f"{stem}.{number}{ENDING}")):
        number += 1
    return other


def file_stamp(path: pathlib.Path) -> Stamp | None:
    """What tells versions of a file apart. None where there is no file."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


@dataclasses.dataclass(frozen=True)
class Export:
    """A file, or a folder of pictures, that a session wrote into its folder."""

    name: str
    text: str  # what it is, in a line
    size: int | None  # bytes of a file
    time: int | None  # when it was changed last, nanoseconds, by which another file of its name is known

    @classmethod
    def of(cls, path: pathlib.Path, text: str) -> Export:
        """What is noted of a file that was just written."""
        stamp = None if path.is_dir() else file_stamp(path)
        return cls(path.name, text, *((None, None) if stamp is None else (stamp[1], stamp[0])))

    def is_there(self, path: pathlib.Path) -> bool:
        """Whether a path is still that file, or a folder where it was one."""
        return path.is_dir() if self.size is None else path.is_file() and Export.of(path, self.text) == self


#: Exports that a session's file keeps, the newest.
MAX_EXPORTS = 40


def read_exports(content: Any) -> tuple[Export, ...]:
    """The exports of a session's file, the oldest first; what is no export is left out."""
    exports = []
    for entry in content[-MAX_EXPORTS:] if isinstance(content, list) else ():
        with contextlib.suppress(*DAMAGED, ValueError):
            one = Export(**entry)
            if all(isinstance(text, str) for text in (one.name, one.text)):
                exports.append(dataclasses.replace(one, text=one.text[:MAX_LINE]))
    return tuple(exports)


def write_session(
    path: PathLike,
    document: Document,
    field: AnyField,
    field_name: str | None,
    history: dict[str, Any] | None = None,
    exports: Iterable[Export] = (),
) -> None:
    """Write a session's file, whole or not at all; the name of a field without a file is None.
    history: its steps, see `History.to_json`; exports: what it wrote into its folder."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "field": {"name": field_name, "bounds": field.bounds.tolist()},
        "document": document.to_json("scene" if field_name is None else object_name(field_name)),
    } | ({} if history is None else {"history": history})
    if exports:
        content["exports"] = [dataclasses.asdict(export) for export in exports]
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")


def read_session(path: PathLike, field: AnyField | None = None) -> Document:
    """Read a session's file, which should belong to the field; None takes any."""
    return read_kept(path, field)[0]


def read_kept(path: PathLike, field: AnyField | None = None) -> tuple[Document, Any, tuple[Export, ...]]:
    """As `read_session`, what the file holds of its steps, see `read_history`, None where it holds nothing, and its
    exports."""
    path = require_file(path, "session file")
    try:
        content: Any = read_json(path, "session file")
        if content.get("format") != FORMAT:
            raise InputError(f"it is no {FORMAT}")
        version = content.get("version")
        if type(version) is not int or version < 1:
            raise InputError(f"its version must be a whole number from 1, got {str(version)[:40]!r}")
        if version > VERSION:
            raise InputError(f"its version is {version}, this warpcage reads up to {VERSION}: upgrade")
        if field is not None and content["field"]["bounds"] != field.bounds.tolist():
            name = listed([str(content["field"].get("name"))])
            raise InputError(f"it belongs to another field, {name}, with other bounds")
        document = _named(Document.from_json(content["document"]), content)
        return document, content.get("history"), read_exports(content.get("exports"))
    except DAMAGED as error:
        raise InputError(f"{path}: {damage('session file', error)}") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _named(document: Document, content: Any) -> Document:
    """The document of a file's content; one that says nothing of objects names its only one as its field."""
    name = content.get("field", {}).get("name")
    if "objects" in renamed_keys(content["document"], OLD_KEYS) or not isinstance(name, str):
        return document
    return document.with_object(dataclasses.replace(document.objects[0], name=object_name(name)))


def object_name(path: PathLike) -> str:
    """What an object is called by the file of its field: its name without endings."""
    name = pathlib.PurePath(path).name.split(".")[0][:MAX_NAME]
    return name if name.strip() and name.isprintable() else "scene"


#: Parts of the document that pages are told of.
PARTS = ("edits", "selection", "settings", "view", "timeline", "objects")

#: Where a new session looks from, degrees, and its vertical field of view.
ELEVATION, AZIMUTH, FOV = 25.0, -60.0, 40.0

_log = logging.getLogger(__name__)


class Session:
    """What is edited, by one or several pages. All methods are called from one thread, the server's, but for `save`.
    Without a path nothing is kept. `stamp`: of its file where the document was read from it; no other is replaced."""

    # A gesture (a drag, a slider) becomes one step (`change`) when it ends. Views, scrubbing and playing are no steps.

    def __init__(
        self,
        field: AnyField | Fields,
        document: Document,
        path: PathLike | None = None,
        field_path: PathLike | None = None,
        stamp: Stamp | None = None,
        scene_scale: float = 1.0,
        history: History | None = None,
        lost: str | None = None,  # see `read_history`, as of the history
        exports: tuple[Export, ...] = (),
    ):
        self.fields = Fields.of(field)
        self.field = self.fields.main  # that the session is of
        self.document, self.settled = document, document  # settled: without what a gesture moves
        self.scene_scale = scene_scale  # the factor that the field's file was loaded with
        self.field_path = None if field_path is None else pathlib.Path(field_path)
        self.path = None if path is None else pathlib.Path(path)  # changes where a program wrote there: not saved over
        self.history = history or History()
        self.exports = exports  # what was written into the folder and is still there, the oldest first
        self.lost = lost  # what became of steps that the file held, for the first page
        self.notify: Callable[[str], None] = lambda text: None  # told what somebody should know who works here
        self.saved: str | None = None  # when it was saved last, ISO 8601
        self.save_error: str | None = None  # why it could not be saved
        self.listeners: list[Callable[[set[str]], None]] = []  # told the sections that changed; "vertices": a gesture's
        self._gesture: Gesture | None = None
        self._steps = 0
        self._saving = threading.Lock()
        self._stamp = stamp
        self._on_disk: tuple[Document | None, int, tuple[Export, ...]]
        self._on_disk = None if stamp is None or lost else document, 0, exports
        if stamp is not None:
            self.saved = _iso(datetime.datetime.fromtimestamp(stamp[0] / 1e9))

    @property
    def active_field(self) -> AnyObject:
        """The field of the active object, in whose coordinates its cages are."""
        return self.fields.field(self.document.scene_object(self.document.selection.object_id))

    # -- Changes

    def run(self, message: dict[str, Any]) -> None:
        """Carry out a command of `commands`, as one step. Raises ValueError in one line."""
        self.change(lambda document: commands.run_command(document, message))

    def move_camera(self, message: dict[str, Any]) -> dict[str, str]:
        """Keys of the moves of the film's camera that words name, as one step; what held them back, or ""."""
        refined, notes = getattr(self.fields.main, "refined_cameras", None), [""]

        def step(document: Document) -> tuple[str, Document]:
            words, seen = message["move"], refined.cameras if refined else []
            made, notes[0] = timeline.with_camera_moves(document, words, seen)
            return f"camera {words}", made

        self.change(step)
        return {"note": notes[0]}

    def frame_keys(self, message: dict[str, Any]) -> None:
        """Make the cameras of all keys see all shown objects, as one step; see `timeline.framed_views`."""
        aspect = message["aspect"]
        self.change(lambda now: ("move camera keys", timeline.with_framed_views(now, self.fields, aspect)))

    def change(self, step: Callable[[Document], tuple[str, Document]]) -> None:
        """Take what a function makes of the document as one step of the history; what it raises changes nothing."""
        self.end_gesture()
        label, document = step(self.document)
        self._apply(label, document, losses(self.document, document))

    def adopt(self, before: Document, label: str, document: Document, lost: str | None = None) -> bool:
        """Take a document that another thread has made of `before`, a `settled` one, as one step of the history.
        False, and nothing is changed, where somebody has changed the scene since, or is about to; see `losses`."""
        shared = (part for part in PARTS if part != "view")
        if self.moving or any(getattr(before, part) is not getattr(self.document, part) for part in shared):
            return False
        self._apply(label, seen_as(document, self.document), lost)
        return True

    def _apply(self, label: str, document: Document, lost: str | None) -> None:
        if _same(document, self.document):
            return
        self.history.push(label, self.document)
        self._take(document, {"history"})
        if lost:
            self.notify(lost)

    def undo(self) -> str:
        """Undo a step, or what is under way. Returns its name; raises ValueError where there is none."""
        self.end_gesture()
        label, document = self.history.undo(self.document)
        self._take(document, {"history"})
        return label

    def redo(self) -> str:
        """Do an undone step again. Returns its name; raises ValueError where there is none."""
        self.end_gesture()
        label, document = self.history.redo(self.document)
        self._take(document, {"history"})
        return label

    def look(self, view: View) -> None:
        """Look from somewhere else."""
        self._take(dataclasses.replace(self.document, view=view))

    def begin_gesture(self, owner: object, number: int, label: str, chosen: tuple[int, ...] | None = None) -> None:
        """Begin to move an edit's cage; another gesture that is under way ends. Only the same owner goes on with it.
        `chosen`: vertices that a preset acts on, None for all."""
        self.end_gesture()
        self._gesture = Gesture(owner, self.document, self.document.edit(number), label, chosen)

    def move(self, owner: object, number: int, vertices: Any, rest: bool = False) -> bool:
        """Move the cage of a gesture: (v, 3) all its posed vertices, or all at rest.
        False, and nothing is moved, where this owner has no gesture: another page's change has ended it."""
        if not self.is_moved_by(owner):
            return False
        gesture = self._gesture
        assert gesture is not None
        if gesture.edit is None or gesture.edit.id != number:
            raise InputError(f"edit {number} is not being moved")
        if rest:
            gesture.rest = True
            document = commands.moved_rest(self.document, gesture.edit, vertices)
        else:
            edit = self.document.edit(number)
            places = frozen_vertices(vertices, len(edit.posed))
            document = self.document.with_edit(dataclasses.replace(edit, posed=places))
        self._take(document, {"vertices"}, without={"edits"})
        return True

    def move_preset(self, owner: object, message: dict[str, Any]) -> bool:
        """Bend, twist, taper or stretch the cage of a gesture; see `move` and `commands.slide`."""
        if not self.is_moved_by(owner):
            return False
        gesture = self._gesture
        if gesture is None or gesture.edit is None:
            raise InputError("no cage is being moved")
        edit = commands.slide(gesture.edit, gesture.chosen, message)
        gesture.label = str(message["preset"])
        self._take(self.document.with_edit(edit))
        return True

    def begin_placing(self, owner: object, number: int, label: str) -> None:
        """Begin to move an object as a whole; see `begin_gesture`."""
        self.end_gesture()
        scene_object = self.document.scene_object(number)
        if scene_object.locked:
            raise objects.locked_error(scene_object)
        self._gesture = Gesture(owner, self.document, None, label, None)

    def place(self, owner: object, number: int, matrix: Any) -> bool:
        """Put the object of a gesture where a similarity (4, 4) takes it; see `move`."""
        if not self.is_moved_by(owner):
            return False
        self._take(objects.with_place(self.document, number, matrix), {"places"})
        return True

    def end_gesture(self, owner: object = None, cancel: bool = False) -> None:
        """Make a step of the gesture that is under way, or take it back; of this owner alone, None ends any."""
        gesture = self._gesture
        if gesture is None or (owner is not None and gesture.owner is not owner):
            return
        self._gesture = None
        if cancel:
            before = dataclasses.replace(gesture.before, view=self.document.view)
            self._take(before, {"edits"})
            return
        moved = gesture.edit if gesture.rest else None
        document = self.document if moved is None else commands.moved_keys(self.document, moved)
        if not _same(document, gesture.before):
            self.history.push(gesture.label, gesture.before)
        self._take(document, {"edits", "history"})

    @property
    def moving(self) -> bool:
        """Whether a gesture is under way."""
        return self._gesture is not None

    def is_moved_by(self, owner: object) -> bool:
        """Whether a gesture of this owner is under way."""
        return self._gesture is not None and self._gesture.owner is owner

    def scrub(self, time: float) -> bool:
        """Go to a time of the film, seconds: poses and camera are those of the keys around it.
        Returns whether a pose is left that no key holds; it is a step of the history."""
        self.end_gesture()
        told = {"playback", "vertices"}
        leaves = self.unkeyed and not (self.history.undo_steps and _same(self.history.undo_steps[-1][1], self.document))
        if leaves:
            self.history.push(SCRUB, self.document, looks=True)
            told.add("history")
            self.notify(f"No key holds the pose that was left at {self.document.time:.2f} s. Undo goes back to it.")
        poses, view = timeline.state_at(self.document, time)
        document = timeline.placed_at(self.document, time)
        document = dataclasses.replace(document, time=time, view=view or self.document.view)
        for edit in self.document.edits:
            if edit.id in poses:
                posed = frozen_vertices(poses[edit.id], len(edit.rest))
                document = document.with_edit(dataclasses.replace(edit, posed=posed))
        if not any(edit.sliders for edit in self.document.edits):  # pages show where sliders are
            self._take(document, told, without={"edits"})
        else:
            self._take(document, told)
        return leaves

    @property
    def unkeyed(self) -> bool:
        """Whether something that keys move is not where the film has it at the present time."""
        document = self.document
        poses, _ = timeline.state_at(document, document.time)
        return timeline.placed_at(document, document.time).objects != document.objects or any(
            edit.id in poses and not np.array_equal(edit.posed, poses[edit.id]) for edit in document.edits
        )

    @property
    def left_time(self) -> float | None:
        """When in the film a pose was left that no key holds and that one undo brings back, seconds; None: none was."""
        steps = self.history.undo_steps
        return steps[-1][1].time if steps and steps[-1][0] == SCRUB else None

    def _take(self, document: Document, more: Iterable[str] = (), without: Iterable[str] = ()) -> None:
        """Take a document as the newest one and tell listeners what changed."""
        changed = {part for part in PARTS if getattr(document, part) is not getattr(self.document, part)}
        if document.time != self.document.time:
            changed.add("playback")
        if document.selection.object_id != self.document.selection.object_id:
            changed.add("edits")  # pages are told of those of the active object
        self.document = document
        changed = (changed - set(without)) | set(more)
        if changed & {"edits", "timeline", "objects", "history"}:
            changed.add("playback")  # which says whether keys hold what is seen
        if self._gesture is None:
            self.settled = document
        self._steps += "history" in changed
        for listener in self.listeners:
            listener(changed)

    # -- What pages are told

    def section(self, name: str) -> Any:
        """One section of the document or the history, as JSON takes it."""
        document = self.document
        if name == "edits":
            edits = document.edits_of(document.selection.object_id)
            return [edit_json(edit) | {"sliders": _sliders_json(edit.sliders)} for edit in edits]
        if name == "objects":
            return [self._object_section(scene_object) for scene_object in document.objects]
        if name == "timeline":
            film, ways = document.timeline, timeline.ways(document)
            keys = [
                {"id": key.id, "time": key.time, "name": key.name, "easing": key.easing, "way": ways.get(key.id)}
                | {"pose": bool(key.held_places) or key.poses is not None, "camera": key.view is not None}
                | {"edits": sorted(key.poses or {}), "objects": sorted(key.held_places)}
                for key in film.keys
            ]
            told = {name: getattr(film, name) for name in ("length", "fps", "loop")}
            return {"keys": keys, "frames": frame_count(**told), "follows_keys": film.follows_keys, **told}
        if name == "history":
            return self.history.summary()
        if name == "selection":
            return selection_json(document.selection)
        return dataclasses.asdict(getattr(document, name))

    def _object_section(self, scene_object: SceneObject) -> dict[str, Any]:
        """An object as pages are told of it, with the box and the kind of its field."""
        field = self.fields.field(scene_object)
        told = {
            "bounds": field.bounds.tolist(),
            "size": object_size(field),
            "matrix": scene_object.place.matrix.tolist(),
        }
        return dataclasses.asdict(scene_object) | told

    # -- The file

    @property
    def unsaved(self) -> bool:
        """Whether the session's file is behind the document, but for a gesture under way."""
        (kept, _, exports), document = self._on_disk, self.settled
        return self.path is not None and not (
            kept is not None
            and exports == self.exports
            and all(getattr(kept, part) is getattr(document, part) for part in ("edits", "timeline"))
            and all(
                getattr(kept, part) == getattr(document, part)
                for part in ("selection", "settings", "view", "time", "objects")
            )
        )

    @property
    def unsaved_steps(self) -> bool:
        """Whether steps are not in the session's file yet, looks and times left out: a film that plays changes both."""
        return self.path is not None and self._on_disk[1] != self._steps

    def save_changes(self) -> None:
        """Write the session's file where it is behind."""
        if self.unsaved:
            self.save()

    def save(self) -> None:
        """Write the session's file; any thread may call it, and several. What went wrong is in `save_error`."""
        with self._saving:
            if self.path is None:
                return
            steps, document, exports = self._steps, self.settled, self.exports
            try:
                stamp = file_stamp(self.path)
                if stamp is not None and stamp != self._stamp:  # another program's: ours goes beside it
                    self.path, self._stamp = free_session_path(self.path), None
                name = self.field_path.name if self.field_path else None
                history = self.history.to_json(document, self.fields)
                write_session(self.path, document, self.field, name, history, exports)
            except Exception as error:
                if not isinstance(error, OSError | ValueError | MemoryError):
                    _log.exception("the session could not be saved")
                self.save_error = error_line(error, MAX_LINE, folders=False)
                return
            self._stamp, self._on_disk, self.save_error = file_stamp(self.path), (document, steps, exports), None
            self.saved = _iso(datetime.datetime.now())


@dataclasses.dataclass
class Gesture:
    """A drag or a slider that is being moved by `owner`."""

    owner: object
    before: Document  # the document before it; so is the edit
    edit: Edit | None  # None where an object is moved as a whole
    label: str  # of the step that it becomes
    chosen: tuple[int, ...] | None  # vertices that a preset acts on, None for all
    rest: bool = False  # whether the cage at rest was moved


def new_document(field: AnyField, cages: Iterable[Cage] = (), resolution: int = 64, name: str = "scene") -> Document:
    """The document of a new session, with an edit for each cage; it looks at the whole field."""
    edits = tuple(new_edit(number, cage, f"Move {number}") for number, cage in enumerate(cages, start=1))
    view = view_of_box(field.bounds, np.asarray(field.up, np.float64))
    selection = Selection(edits[0].id if edits else None)
    settings, own = Settings(resolution=resolution), SceneObject(MAIN, name)
    film = Timeline(follows_keys=True)
    return Document(edits, selection, settings, view, film, next_id=len(edits) + 1, objects=(own,))


def view_of_box(bounds: np.ndarray, up: np.ndarray) -> View:
    """The view that a new session has of a box (2, 3), world units; up: (3,)."""
    angles: dict[str, Any] = {"elevation_degrees": ELEVATION, "start_degrees": AZIMUTH, "fov_degrees": FOV}
    camera = framing_orbit(box_corners(bounds), 1, up=up, **angles)[0]
    return View(_triple(camera.center), _triple(bounds.mean(axis=0)), _triple(up / np.linalg.norm(up)), FOV)


def _sliders_json(sliders: Sliders | None) -> dict[str, Any] | None:
    """Where sliders are, as pages are told."""
    if sliders is None:
        return None
    return {"vertices": sliders.chosen, "amounts": dict(sliders.amounts), **sliders.way}


def _iso(moment: datetime.datetime) -> str:
    return moment.isoformat(timespec="seconds")


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = map(float, vector)
    return x, y, z


def _same(one: Document, two: Document) -> bool:
    """Whether two documents are equal in all that the history keeps."""
    return all(getattr(one, part) is getattr(two, part) for part in PARTS if part != "view") or (
        all(getattr(one, part) == getattr(two, part) for part in ("selection", "settings", "objects"))
        and len(one.edits) == len(two.edits)
        and all(map(_same_edit, one.edits, two.edits))
        and _same_film(one.timeline, two.timeline)
    )


def _same_film(one: Timeline, two: Timeline) -> bool:
    return (
        all(getattr(one, name) == getattr(two, name) for name in ("length", "fps", "loop", "follows_keys"))
        and len(one.keys) == len(two.keys)
        and all(a is b for a, b in zip(one.keys, two.keys, strict=True))
    )


#: What an edit holds besides arrays and where sliders are.
_PLAIN = tuple(
    field.name for field in dataclasses.fields(Edit) if field.compare and field.name not in ("faces", "rest", "posed")
)


def _same_edit(one: Edit, two: Edit) -> bool:
    return one is two or (
        all(getattr(one, name) == getattr(two, name) for name in _PLAIN)
        and all(np.array_equal(getattr(one, part), getattr(two, part)) for part in ("faces", "rest", "posed"))
    )
