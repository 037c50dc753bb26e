"""A session of the editor: the newest document, its history, its file, and a film that plays."""

from __future__ import annotations

import dataclasses
import datetime
import logging
import pathlib
import threading
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...core.arrays import box_corners
from ...core.files import PathLike
from ...core.names import error_line
from ...errors import InputError
from ...render.surface_mesh import AnyObject, object_size
from ...splats.splat_field import AnyField
from ...view.motion import frame_count
from ..films.checks import MAX_LINE, frozen_vertices
from ..films.document import (
    MAIN,
    Document,
    Edit,
    SceneObject,
    Selection,
    Settings,
    Sliders,
    Timeline,
    View,
    new_edit,
    part_json,
    same,
)
from ..films.session import timeline
from ..films.session.scene import Fields
from ..films.session.session_file import Export, Stamp, file_stamp, free_session_path, write_session
from ..films.timeline import side_camera
from . import commands, objects
from .steps.history import History, seen_as
from .steps.losses import losses

#: The step of leaving a pose that no key holds.
SCRUB = "scrub"


#: Parts of the document that are sent to pages.
PARTS = ("edits", "selection", "settings", "view", "timeline", "objects")

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
        self.notify: Callable[[str], None] = lambda text: None  # called with lines for all pages
        self.saved: str | None = None  # when it was saved last, ISO 8601
        self.save_error: str | None = None  # why it could not be saved
        self.listeners: list[Callable[[set[str]], None]] = []  # called with changed sections; "vertices": a gesture's
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
        """Make keys of moves of the film's camera, as one step. Returns a note on what limited them, or ""."""
        refined, notes = getattr(self.fields.main, "refined_cameras", None), [""]

        def step(document: Document) -> tuple[str, Document]:
            moves, seen = message["move"], refined.cameras if refined else []
            made, notes[0] = timeline.with_camera_moves(document, moves, seen)
            return f"camera {moves}", made

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
        False, and nothing is changed, where the scene has changed since, or is being changed; see `losses`."""
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
        return self.move_edit(owner, edit, str(message["preset"]))

    def move_edit(self, owner: object, edit: Edit, label: str, *, only_vertices: bool = False) -> bool:
        """Take the edit of a gesture as it has become, and the label of its step; see `move`.
        `only_vertices`: pages get these alone, and all else once the gesture ends."""
        gesture = self._gesture
        if gesture is None or not self.is_moved_by(owner) or gesture.edit is None or gesture.edit.id != edit.id:
            return False
        gesture.label = label
        document = self.document.with_edit(edit)
        self._take(document, *(({"vertices"}, {"edits"}) if only_vertices else ()))
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
        changed = {"playback", "vertices"}
        leaves = self.unkeyed and not (self.history.undo_steps and _same(self.history.undo_steps[-1][1], self.document))
        if leaves:
            self.history.push(SCRUB, self.document, looks=True)
            changed.add("history")
            self.notify(f"No key holds the pose that was left at {self.document.time:.2f} s. Undo goes back to it.")
        # pages show where sliders and landmarks are
        slid = any(edit.sliders or edit.landmarks for edit in self.document.edits)
        self._take(timeline.document_at(self.document, time), changed, without=() if slid else {"edits"})
        return leaves

    @property
    def unkeyed(self) -> bool:
        """Whether something that keys move is not where the film has it at the present time."""
        document = timeline.document_at(self.document, self.document.time)
        return not all(same(getattr(document, part), getattr(self.document, part)) for part in ("edits", "objects"))

    @property
    def left_time(self) -> float | None:
        """When in the film a pose was left that no key holds and that one undo brings back, seconds; None: none was."""
        steps = self.history.undo_steps
        return steps[-1][1].time if steps and steps[-1][0] == SCRUB else None

    def _take(self, document: Document, more: Iterable[str] = (), without: Iterable[str] = ()) -> None:
        """Take a document as the newest one and call listeners with what changed."""
        changed = {part for part in PARTS if getattr(document, part) is not getattr(self.document, part)}
        if document.time != self.document.time:
            changed.add("playback")
        if document.selection.object_id != self.document.selection.object_id:
            changed.add("edits")  # pages have those of the active object
        self.document = document
        changed = (changed - set(without)) | set(more)
        if changed & {"edits", "timeline", "objects", "history"}:
            changed.add("playback")  # which says whether keys hold what is seen
        if self._gesture is None:
            self.settled = document
        self._steps += "history" in changed
        for listener in self.listeners:
            listener(changed)

    # -- What pages show

    def section(self, name: str) -> Any:
        """One section of the document or the history, as JSON takes it."""
        document = self.document
        if name == "edits":
            edits = document.edits_of(document.selection.object_id)
            return [
                part_json(edit)
                | {"sliders": _sliders_json(edit.sliders)}
                | {"landmarks": [] if edit.landmarks is None else edit.landmarks.targets.tolist()}
                for edit in edits
            ]
        if name == "objects":
            return [self._object_section(one) for one in document.objects]
        if name == "timeline":
            film, ways = document.timeline, timeline.ways(document)
            keys = [
                {"id": key.id, "time": key.time, "name": key.name, "easing": key.easing, "way": ways.get(key.id)}
                | {"pose": bool(key.held_places) or key.poses is not None, "camera": key.view is not None}
                | {"edits": sorted(key.poses or {}), "objects": sorted(key.held_places)}
                for key in film.keys
            ]
            kept = {name: getattr(film, name) for name in ("length", "fps", "loop")}
            return {"keys": keys, "frames": frame_count(**kept), "follows_keys": film.follows_keys, **kept}
        if name == "history":
            return self.history.summary()
        return part_json(getattr(document, name))

    def _object_section(self, scene_object: SceneObject) -> dict[str, Any]:
        """An object as pages show it, with the box and the kind of its field."""
        field = self.fields.field(scene_object)
        content = dataclasses.asdict(scene_object) | {"bounds": field.bounds.tolist(), "size": object_size(field)}
        return content | {"matrix": scene_object.place.matrix.tolist()}

    # -- The file

    @property
    def unsaved(self) -> bool:
        """Whether the session's file is behind the document, but for a gesture under way."""
        (kept, _, exports), document = self._on_disk, self.settled
        return self.path is not None and not (
            kept is not None
            and exports == self.exports
            and all(getattr(kept, part) is getattr(document, part) for part in ("edits", "timeline"))
            and all(same(getattr(kept, part), getattr(document, part)) for part in (*PARTS, "time"))
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
    camera = side_camera(box_corners(bounds), up=up, fov_degrees=View.fov)
    return timeline.array_view(camera.center, bounds.mean(axis=0), up / np.linalg.norm(up))


def _sliders_json(sliders: Sliders | None) -> dict[str, Any] | None:
    """Where sliders are, as pages show them."""
    if sliders is None:
        return None
    return {"vertices": sliders.chosen, "amounts": dict(sliders.amounts), **sliders.way}


def _iso(moment: datetime.datetime) -> str:
    return moment.isoformat(timespec="seconds")


def _same(one: Document, two: Document) -> bool:
    """Whether two documents are equal in all that the history keeps."""
    kept = all(same(getattr(one, part), getattr(two, part)) for part in PARTS if part != "view")
    return kept and [edit.landmarks for edit in one.edits] == [edit.landmarks for edit in two.edits]
