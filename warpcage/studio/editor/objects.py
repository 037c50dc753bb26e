"""The objects of a scene: what a page may do with them, the files of their fields, and stage files."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ...cage.cage import Cage
from ...core.arrays import box_corners
from ...core.checks import checked_flag
from ...core.names import Easing, counted
from ...deform.stage import Stage
from ...edits.edits import CageEdit
from ...edits.place import Place, PlaceFile, near_turn, seen_from
from ...edits.stage_file import STAGE_ENDING, free_name, is_stage, read_deformation, read_stage_file
from ...errors import InputError
from ...render.surface_file import SURFACE_ENDINGS
from ...render.surface_mesh import AnyObject, SurfaceMesh, is_mesh_file, load_object
from ...scene.scene import rotation_to
from ...select.objects import select_object
from ...select.selection import NodeSelection
from ...splats.io import is_splat_file
from ..films.checks import MAX_KEYS, MAX_OBJECTS, changed_names, checked_click, checked_name, checked_triple
from ..films.document import MAIN, Document, Edit, Key, Message, SceneObject, Selection, Step, checked_place, new_edit
from ..films.session.scene import Fields, PosedScene, clicked_pixel
from ..films.session.timeline import place_files
from ..spec.settings import RESOLUTIONS

if TYPE_CHECKING:
    from .tasks import Tasks

#: How far a new object stands from the others, as a share of the larger size.
BESIDE = 0.05

# -- Commands, as those of `commands`: from a document and a message to the step's name and the new document


def activate_object(document: Document, message: Message) -> Step:
    """Make an object the active one, with the first of its edits."""
    scene_object = document.scene_object(message["id"])
    edits = document.edits_of(scene_object.id)
    selection = Selection(edits[0].id if edits else None, document.selection.mode, object_id=scene_object.id)
    return "select", dataclasses.replace(document, selection=selection)


def change_object(document: Document, message: Message) -> Step:
    """Rename an object, show or hide it, lock it or let it go, or put it elsewhere."""
    scene_object, changes = document.scene_object(message["id"]), {}
    if "name" in message:
        changes["name"] = checked_name(message["name"])
        if changes["name"] in [other.name for other in document.objects if other.id != scene_object.id]:
            raise InputError(f"there is an object named {changes['name']!r} already: give another name")
    for flag in ("visible", "locked"):
        if flag in message:
            changes[flag] = checked_flag(message[flag], flag)
    if "place" in message:
        if changes.get("locked", scene_object.locked):
            raise locked_error(scene_object)
        changes["place"] = checked_place(message["place"])
    if not changes:
        raise InputError("nothing to change: give a name, visible, locked or a place")
    return f"{changed_names(changes)} of {scene_object.name}", document.with_object(
        dataclasses.replace(scene_object, **changes)
    )


def copy_object(document: Document, message: Message) -> Step:
    """A second object of the same field, with its edits, poses and keys, moved by an offset."""
    scene_object = document.scene_object(message["id"])
    offset = np.array(checked_triple(message.get("offset", (0, 0, 0)), "offset"))

    def moved(place: Place) -> Place:
        return dataclasses.replace(place, position=np.asarray(place.position) + offset)

    document = with_new_object(document, scene_object.name, scene_object.file, moved(scene_object.place))[1]
    number = document.selection.object_id
    numbers, edits = {}, []
    for edit in document.edits_of(scene_object.id):
        numbers[edit.id] = document.free_id
        edits.append(dataclasses.replace(edit, id=document.free_id, object_id=number))
        document = dataclasses.replace(document, next_id=document.next_id + 1)
    keys = []
    for key in document.timeline.keys:
        held = {numbers[old]: pose for old, pose in (key.poses or {}).items() if old in numbers}
        poses = {**(key.poses or {}), **held} or None
        places = key.places
        if scene_object.id in key.held_places:
            places = {**key.held_places, number: moved(key.held_places[scene_object.id])}
        keys.append(dataclasses.replace(key, poses=poses, places=places))
    selection = Selection(edits[0].id if edits else None, document.selection.mode, object_id=number)
    document = dataclasses.replace(document, edits=(*document.edits, *edits), selection=selection)
    return f"copy {scene_object.name}", document.with_timeline(keys=tuple(keys))


def remove_object(document: Document, message: Message) -> Step:
    """Take an object out of the scene, with its edits and its part of all keys."""
    gone = document.scene_object(message["id"])
    if gone.id == MAIN:
        raise InputError(f"{gone.name!r} is the object that this session is kept for: hide it instead")
    if gone.locked:
        raise locked_error(gone)
    own = {edit.id for edit in document.edits_of(gone.id)}
    keys = []
    for key in document.timeline.keys:
        poses = {number: pose for number, pose in (key.poses or {}).items() if number not in own} or None
        places = None if key.places is None else {n: place for n, place in key.places.items() if n != gone.id}
        key = dataclasses.replace(key, poses=poses, places=places or None)
        keys += [] if key.is_empty else [key]
    objects = tuple(one for one in document.objects if one.id != gone.id)
    edits = tuple(edit for edit in document.edits if edit.object_id != gone.id)
    document = dataclasses.replace(document, objects=objects, edits=edits).with_timeline(keys=tuple(keys))
    if document.selection.object_id == gone.id:
        document = activate_object(document, {"id": MAIN})[1]
    return f"remove {gone.name}", document


COMMANDS: dict[str, Callable[[Document, Message], Step]] = {
    "object.select": activate_object,
    "object.change": change_object,
    "object.copy": copy_object,
    "object.remove": remove_object,
}


def with_new_object(document: Document, name: str, file: str | None, place: Place) -> Step:
    """A document with one more object, which becomes the active one."""
    if len(document.objects) >= MAX_OBJECTS:
        raise InputError(f"a scene takes at most {MAX_OBJECTS} objects: remove one first")
    number = document.free_id
    name = free_name(checked_name(name), [one.name for one in document.objects])
    objects = (*document.objects, SceneObject(number, name, file, place))
    selection = Selection(None, document.selection.mode, object_id=number)
    return f"add {name}", dataclasses.replace(document, objects=objects, selection=selection, next_id=number + 1)


def with_place(document: Document, number: int, matrix: Any) -> Document:
    """A document in which an object is where a similarity (4, 4) takes it; turns go on from the degrees that it has."""
    scene_object = document.scene_object(number)
    if scene_object.locked:
        raise locked_error(scene_object)
    place = Place.from_matrix(matrix)
    place = dataclasses.replace(place, turn=near_turn(np.array(place.turn), np.array(scene_object.place.turn)))
    return document.with_object(dataclasses.replace(scene_object, place=checked_place(dataclasses.asdict(place))))


def locked_error(scene_object: SceneObject) -> InputError:
    """The error where a locked object would be moved."""
    return InputError(f"{scene_object.name!r} is locked: unlock it first")


# -- Files


def field_files(folder: pathlib.Path) -> list[str]:
    """The names of fields in a folder, of voxels and of splats, and behind them those of meshes."""

    def holds_field(path: pathlib.Path) -> bool:
        if path.name.startswith(".") or not path.is_file():
            return False
        try:
            return path.suffix.lower() == ".npz" or is_splat_file(path)
        except (OSError, ValueError):
            return False  # an ending that is one of splats, and another content

    files = sorted(folder.iterdir())
    fields = [path.name for path in files if holds_field(path)]
    others = [path for path in files if path.name not in fields and not path.name.startswith(".") and path.is_file()]
    return fields + [path.name for path in others if path.suffix.lower() in SURFACE_ENDINGS]


def place_beside(document: Document, fields: Fields, field: AnyObject) -> Place:
    """Where a field stands upright on the ground of all objects, beside them."""
    up, own = np.asarray(fields.main.up, np.float64), np.asarray(field.up, np.float64)
    turn = rotation_to(own / np.linalg.norm(own), up / np.linalg.norm(up))
    upright = Place() if turn is None else Place.from_matrix(turn)
    box = upright.moved(box_corners(field.bounds))
    there = box_corners(fields.bounds(document))
    side = np.eye(3)[0 if abs(up[0]) < 0.9 * np.linalg.norm(up) else 1]
    side = side - up * (side @ up) / (up @ up)
    side /= np.linalg.norm(side)
    gap = BESIDE * max(np.ptp(box @ side), np.ptp(there @ side))
    move = side * ((there @ side).max() - (box @ side).min() + gap)
    move += up * ((there @ up).min() - (box @ up).min()) / (up @ up)
    across = np.cross(up, side) / np.linalg.norm(up)
    move += across * ((there @ across).mean() - (box @ across).mean())
    return dataclasses.replace(upright, position=move)


def stage_field(path: pathlib.Path) -> pathlib.Path:
    """The file of the first field of a stage file, which a session of the stage is of."""
    file = path.parent / read_stage_file(path)[0]["field"]
    if is_mesh_file(file):
        raise InputError(
            f"{path}: its first object is a mesh, and a session of the editor is of a field: put one first"
        )
    return file


def with_stage(document: Document, path: pathlib.Path, folder: pathlib.Path) -> Document:
    """A new document with the objects of a stage file, whose first field is the session's own."""
    objects, edits, keys = [], [], list[Key]()
    number, settings, loop, length = 1, document.settings, "once", 0.0
    for entry in read_stage_file(path):
        places: PlaceFile = entry["place"]
        first = not objects
        object_id = MAIN if first else number
        number += not first
        file = None if first else pathlib.PurePath(os.path.relpath(path.parent / entry["field"], folder)).as_posix()
        name = free_name(checked_name(entry["name"]), [other.name for other in objects])
        place = checked_place(dataclasses.asdict(places.at(0.0)))
        objects.append(SceneObject(object_id, name, file, place, not entry.get("hidden", False)))
        if places.length > 0.0:
            loop, length = places.loop or loop, max(length, places.length)
            for time, at in places.places.items():
                easing = places.easings.get(time, "smooth")
                number += _hold(keys, number, object_id, time, at, easing)
        if "deformation" in entry:
            options, cages, poses = read_deformation(entry["deformation"])
            given = {name: options[name] for name in ("coordinates", "resolution", "density") if options.get(name)}
            if edits and any(given.get(name) != getattr(settings, name) for name in ("coordinates", "density")):
                warnings.warn(
                    f"{path}: {name!r} is posed by other coordinates or densities than the objects before it: the "
                    f"editor shows all by {settings.coordinates}",
                    stacklevel=2,
                )
            elif not edits:
                cells = min(max(given.get("resolution", settings.resolution), RESOLUTIONS[0]), RESOLUTIONS[1])
                settings = dataclasses.replace(settings, **{**given, "resolution": cells})
            for cage, posed in zip(cages, poses, strict=True):
                edits.append(_edit(number, object_id, cage, posed, len(edits) + 1))
                number += 1
    if len(keys) > MAX_KEYS:
        raise InputError(f"{path}: a film has at most {MAX_KEYS} keys, this one would have {len(keys)}")
    film = dataclasses.replace(
        document.timeline,
        keys=tuple(sorted(keys, key=lambda key: (key.time, key.id))),
        length=length or document.timeline.length,
        follows_keys=document.timeline.follows_keys and not length,
        loop=loop,
    )
    selected = next((edit.id for edit in edits if edit.object_id == MAIN), None)
    return dataclasses.replace(
        document,
        objects=tuple(objects),
        edits=tuple(edits),
        settings=settings,
        timeline=film,
        selection=Selection(selected),
        next_id=number,
    )


def _hold(keys: list[Key], number: int, object_id: int, time: float, place: Place, easing: Easing) -> bool:
    """Put a place into the key of its time and easing; whether a new key, of this number, was made for it."""
    for index, key in enumerate(keys):
        if (key.time, key.easing) == (time, easing):
            keys[index] = dataclasses.replace(key, places={**(key.places or {}), object_id: place})
            return False
    keys.append(Key(number, time, f"key {len(keys) + 1}", easing, places={object_id: place}))
    return True


def _edit(number: int, object_id: int, edit: CageEdit, posed: Cage | None, count: int) -> Edit:
    """An edit of a stage file as documents have it."""
    kind = "remove" if edit.remove else "copy" if edit.keep_source else "move"
    made = new_edit(number, edit.cage, f"{kind.title()} {count}", kind, None if posed is None else posed.vertices)
    walls = {"falloff": edit.falloff, "held": edit.held, "fragments": edit.fragments}
    return dataclasses.replace(made, object_id=object_id, **walls)


def stage_of(document: Document, fields: Fields, main: pathlib.Path | None, folder: pathlib.Path) -> Stage:
    """The stage of a document: objects, places with their keys, cages and the poses of now.
    main: the file of the session's own field; folder: the session's, which other files are seen from."""
    settings = dataclasses.replace(document.settings, mode="pose")
    shown = tuple(dataclasses.replace(one, visible=True) for one in document.objects)
    scene = PosedScene(fields)
    scene.prepare(dataclasses.replace(document, settings=settings, objects=shown))
    keyed, stage = place_files(document), Stage(device=fields.main.device)
    for scene_object in document.objects:
        file = main if scene_object.file is None else folder / scene_object.file
        stage.add(
            scene_object.name,
            scene.posed(scene_object.id),
            place=keyed.get(scene_object.id, scene_object.place),
            path=file,
        )
        stage.hide(scene_object.name, not scene_object.visible)
    return stage


def clicked(document: Document, field: AnyObject, click: Any) -> Callable[[], AnyObject | NodeSelection]:
    """What finds what a cage of the active object, of this field, goes around: the object at places of a picture, see
    `checked_click`; None is all of it, and a mesh is one object."""
    if click is None or isinstance(field, SurfaceMesh):
        return lambda: field
    places, aspect, plane = checked_click(click)
    found = [clicked_pixel(document.view, across, down, aspect) for across, down in places]
    seen = seen_from(document.scene_object(document.selection.object_id).place, found[0][1])
    return lambda: select_object(field, pixel=[pixel for pixel, _ in found], camera=seen, plane=plane)


class ObjectTasks:
    """What pages may do with objects that touches files; part of `Tasks`."""

    def __init__(self, tasks: Tasks):
        self._tasks = tasks
        self.commands: dict[str, Callable[[dict[str, Any]], Any]] = {
            "object.files": self._files,
            "object.add": self._add,
            "stage.save": self._save,
        }

    async def _files(self, message: dict[str, Any]) -> dict[str, Any]:
        return {"files": await self._tasks.read(lambda: field_files(self._tasks.folder))}

    async def _add(self, message: dict[str, Any]) -> None:
        """Another field or mesh of the session's folder, in its own place or a given one."""
        tasks, session = self._tasks, self._tasks.session
        path, place = tasks.uploads.find(message["file"]), checked_place(message.get("place", {}))
        beside = checked_flag(message.get("beside", False), "beside")
        name = checked_name(message.get("name") or message["file"].split(".")[0])
        fields = session.fields
        added = fields.files.get(path.name)
        if added is None:
            added = await tasks.read(lambda: load_object(path, device=session.field.device))

        def add(document: Document) -> Step:
            where = place_beside(document, fields, added) if beside else place
            return with_new_object(document, name, kept.name, where)

        with tasks.uploads.taken(path) as kept:
            fields.files[kept.name] = added
            await tasks.change(add)

    async def _save(self, message: dict[str, Any]) -> dict[str, str | None]:
        """Write the scene as a stage file."""
        tasks, session, document = self._tasks, self._tasks.session, self._tasks.session.document
        if session.scene_scale != 1.0:
            raise InputError("a scene opened with --scene-scale cannot be saved in one file: open it without")
        name = message["file"]
        if not isinstance(name, str) or not is_stage(name):
            raise InputError(f"a stage file must end in {STAGE_ENDING}")
        path = tasks.free_path(name, (".json",))

        def save() -> None:
            stage_of(document, session.fields, session.field_path, tasks.folder).save(path)

        await tasks.read(save)
        return tasks.note_done(path, f"{path.name}: a scene of {counted(len(document.objects), 'object')}")
