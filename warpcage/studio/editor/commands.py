"""What a page may ask for that changes the document: one function per command, from document to document."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...cage import poses
from ...cage.cage import Cage
from ...coordinates.coordinates import deform_points
from ...core.checks import AXES, checked_flag, checked_number, checked_whole
from ...core.names import checked_choice, named_errors
from ...edits.edits import MAX_EDITS
from ...errors import InputError
from ..films.checks import (
    MAX_KEYS,
    MAX_NAME,
    MAX_PLACE,
    MAX_SECONDS,
    MAX_VERTICES,
    changed_names,
    checked_items,
    checked_name,
    checked_triple,
    checked_vertices,
    frozen_vertices,
)
from ..films.document import (
    KINDS,
    Document,
    Edit,
    Key,
    Landmarks,
    Message,
    Selection,
    Sliders,
    Step,
    Timeline,
    checked_fields,
    checked_settings,
    new_edit,
)
from . import objects

# A command takes the document and the message, JSON values that were not checked, and returns the step's name for
# undo and the new document; ValueError in one line for what cannot be. No lock is held and no file touched.

#: Words for the kinds of edits in names.
KIND_NAMES = {"move": "Move", "copy": "Copy", "remove": "Remove"}
PRESETS = {"bend": 0.0, "twist": 0.0, "taper": 1.0, "stretch": 1.0}


def select(document: Document, message: Message) -> Step:
    """Select vertices of an edit, which becomes the active one, as does its object; or an object alone."""
    return "select", dataclasses.replace(document, selection=document.checked_selection(message))


def change_settings(document: Document, message: Message) -> Step:
    """Change how the scene is deformed and shown."""
    changes = {name: value for name, value in message.items() if name not in ("do", "n")}
    if not changes:
        raise InputError("nothing to change: give a setting and its value")
    settings = checked_settings(document.settings, changes)
    return f"change {changed_names(changes)}", dataclasses.replace(document, settings=settings)


# -- Poses


def set_pose(document: Document, message: Message) -> Step:
    """Put the vertices of a posed cage somewhere."""
    edit = document.edit(message["edit"])
    vertices = frozen_vertices(message["vertices"], len(edit.posed))
    label = checked_name(message.get("label", "move"))
    return label, document.with_edit(dataclasses.replace(edit, posed=vertices))


def reset_pose(document: Document, message: Message) -> Step:
    """Bring vertices, or all, back to where they are at rest."""
    edit = document.edit(message["edit"])
    given = message.get("vertices")
    if given is None:
        return "reset all", document.with_edit(dataclasses.replace(edit, posed=edit.rest))
    vertices = edit.posed.copy()
    chosen = list(checked_vertices(given, len(vertices)))
    if not chosen:
        raise InputError("nothing is selected: select the vertices to reset")
    vertices[chosen] = edit.rest[chosen]
    return "reset", document.with_edit(dataclasses.replace(edit, posed=frozen_vertices(vertices)))


def preset_pose(edit: Edit, chosen: Sequence[int] | None, message: Message) -> np.ndarray:
    """Vertices (v, 3) float64, read-only, of an edit's pose after a preset; see `warpcage.cage.poses` for the message.
    `edit`: as it was before the slider was touched. `chosen`: vertices that follow, None takes all."""
    name = checked_choice(message["preset"], "preset", list(PRESETS))
    amount = checked_number(message["amount"], "amount", -1440.0, 1440.0)
    if amount == PRESETS[name]:
        return edit.posed
    limits = [checked_number(x, "limits", -1e3, 1e3) for x in checked_items(message.get("limits", (0, 1)), 2, "limits")]
    options: dict[str, Any] = {"axis": message.get("axis", "z"), "limits": limits}
    if name == "bend":
        options["towards"] = message.get("towards", "z" if options["axis"] == "x" else "x")
    vertices = edit.posed.copy()
    rows = np.arange(len(vertices)) if chosen is None else np.asarray(chosen, np.int64)
    if not len(rows):
        raise InputError("nothing is selected: select vertices, or deselect all to pose the whole cage")
    vertices[rows] = getattr(poses, name)(vertices[rows], amount, **options)
    return frozen_vertices(vertices)


def slide(edit: Edit, chosen: tuple[int, ...] | None, message: Message) -> Edit:
    """The edit with a preset at another amount; see `preset_pose`. Presets that were set before keep theirs, where they
    have the same vertices, axis and limits and nothing else has changed the pose."""
    way = {"axis": message.get("axis", "z"), "towards": message.get("towards"), "limits": message.get("limits", [0, 1])}
    kept = edit.sliders
    if kept is None or (kept.chosen, kept.way) != (chosen, way):
        kept = Sliders(edit.posed, edit.posed, chosen, way, {})
    amounts = {**kept.amounts, str(message["preset"]): message["amount"]}
    given = {name: value for name, value in way.items() if value is not None}
    posed = kept.before
    for preset, amount in amounts.items():
        posed = preset_pose(
            dataclasses.replace(edit, posed=posed), chosen, {"preset": preset, "amount": amount, **given}
        )
    moved = dataclasses.replace(kept, posed=posed, amounts=amounts)
    return dataclasses.replace(edit, posed=posed, moved_sliders=moved)


def delete_landmark(document: Document, message: Message) -> Step:
    """Delete a landmark, or all; the pose stays."""
    edit = document.edit(message["edit"])
    held, number = edit.landmarks, message.get("landmark")
    if number is None and held is None:
        raise InputError("there are no landmarks to delete")
    if number is None:
        return "delete landmarks", document.with_edit(dataclasses.replace(edit, pulled_landmarks=None))
    held = require_landmark(held, number)
    kept = {name: np.delete(getattr(held, name), number, axis=0) for name in ("places", "targets", "added")}
    left = dataclasses.replace(held, **kept)
    return "delete a landmark", document.with_edit(dataclasses.replace(edit, pulled_landmarks=left))


def require_landmark(held: Landmarks | None, number: Any) -> Landmarks:
    """The landmarks of an edit, which have one of this number."""
    if held is None:
        raise InputError("there is no such landmark: something else has changed the pose since")
    checked_whole(number, "landmark", 0, len(held.places) - 1)
    return held


# -- Edits


def add_edit(document: Document, message: Message) -> Step:
    """A new edit with a simple cage between two corners; a box may have axes of its own, in which its corners are."""
    kind = checked_choice(message.get("kind", "move"), "kind", KINDS)
    low, high = (frozen_vertices([message[name]])[0] for name in ("lower", "upper"))
    shape, center, size = message.get("shape", "box"), (low + high) / 2, high - low
    if not (size > 0).all():
        raise InputError("a cage needs a lower corner below its upper corner")
    if shape == "box":
        cage = Cage.box(low, high, segments=checked_whole(message.get("segments", 2), "segments", 1, 8))
        cage = cage.with_vertices(cage.vertices @ _checked_axes(message.get("axes", np.eye(3).tolist())))
    elif shape == "cylinder":
        cage = Cage.cylinder(center, 0.5 * float(np.hypot(size[0], size[1])), float(size[2]), rings=3)
    elif shape == "icosphere":
        cage = Cage.icosphere(center, 0.5 * float(np.linalg.norm(size)), 1)
    else:
        raise InputError("shape must be one of box, cylinder, icosphere")
    return with_new_edit(document, cage, kind)


def _checked_axes(rows: Any) -> np.ndarray:
    """(3, 3) unit vectors at right angles to each other, right-handed, one a row."""
    axes = np.array([checked_triple(row, "axes") for row in checked_items(rows, 3, "axes")])
    if axes.shape != (3, 3) or np.abs(axes @ axes.T - np.eye(3)).max() > 1e-6 or np.linalg.det(axes) < 0.0:
        raise InputError("axes must be three unit vectors at right angles to each other, right-handed")
    return axes


def box_selection(document: Document, message: Message) -> Step:
    """A new edit: a box around vertices of another one, as they are at rest."""
    edit = document.edit(message["edit"])
    chosen = list(checked_vertices(message["vertices"], len(edit.rest)))
    if not chosen:
        raise InputError("nothing is selected: select the vertices to put a box around")
    low, high = edit.rest[chosen].min(axis=0), edit.rest[chosen].max(axis=0)
    size = float(np.ptp(edit.rest, axis=0).max())
    margin = checked_number(message.get("margin", 0.02), "margin", 0.0, 1.0) * size
    cage = Cage.box(low - max(margin, 1e-4 * size), high + max(margin, 1e-4 * size))
    return with_new_edit(document, cage, object_id=edit.object_id)


def mirror_edit(document: Document, message: Message) -> Step:
    """A new edit that mirrors another one, its pose and those in keys, across the plane where an axis has a value."""
    edit = document.edit(message["edit"])
    axis = AXES.index(checked_choice(message["axis"], "axis", list(AXES)))
    place = checked_number(message["place"], "place", -MAX_PLACE, MAX_PLACE)

    def mirrored(vertices: np.ndarray) -> np.ndarray:
        turned = vertices.copy()
        turned[:, axis] = 2.0 * place - turned[:, axis]
        return frozen_vertices(turned)

    name = f"{edit.name[: MAX_NAME - 10]} mirrored"
    _, document = with_new_edit(
        document,
        Cage(mirrored(edit.rest), [face[::-1] for face in edit.rest_cage.polygons]),
        edit.kind,
        name,
        edit.object_id,
    )
    number = document.edits[-1].id
    keys = [
        dataclasses.replace(key, poses={**key.poses, number: mirrored(key.poses[edit.id])})
        if key.poses is not None and edit.id in key.poses
        else key
        for key in document.timeline.keys
    ]
    fresh, posed = document.edits[-1], mirrored(edit.posed)
    fresh = dataclasses.replace(edit, id=number, name=fresh.name, faces=fresh.faces, rest=fresh.rest, posed=posed)
    return "mirror an edit", document.with_edit(fresh).with_timeline(keys=tuple(keys))


def with_new_edit(
    document: Document, cage: Cage, kind: str = "move", name: str | None = None, object_id: int | None = None
) -> Step:
    """A document with one more edit, the active one now; object_id: of what it deforms, None is the active object."""
    owner = document.scene_object(document.selection.object_id if object_id is None else object_id).id
    count = len(document.edits_of(owner))
    if count >= MAX_EDITS:
        raise InputError(f"a scene takes at most {MAX_EDITS} edits: delete one first")
    number = document.free_id
    edit = new_edit(number, cage, name or f"{KIND_NAMES[kind]} {count + 1}", kind)
    edits = (*document.edits, dataclasses.replace(edit, object_id=owner))
    selection = Selection(number, document.selection.mode, object_id=owner)
    return f"add {edit.name}", dataclasses.replace(document, edits=edits, selection=selection, next_id=number + 1)


def delete_edit(document: Document, message: Message) -> Step:
    """Delete an edit and its part of all keys."""
    gone = document.edit(message["id"])
    edits = tuple(edit for edit in document.edits if edit.id != gone.id)
    selection = document.selection
    if selection.edit == gone.id:
        others = [edit.id for edit in edits if edit.object_id == gone.object_id]
        selection = Selection(others[-1] if others else None, selection.mode, object_id=gone.object_id)
    document = dataclasses.replace(document, edits=edits, selection=selection)
    return f"delete {gone.name}", document.with_key_poses(gone.id, lambda pose: None)


def change_edit(document: Document, message: Message) -> Step:
    """Rename an edit, show or hide it, make it another kind, or say what becomes of its walls and fragments."""
    edit = document.edit(message["id"])
    changes = checked_fields(Edit, message, ("falloff", "fragments", "held", "name", "kind", "visible"))
    if not changes:
        raise InputError("nothing to change: give a name, a kind, visible, falloff, held or fragments")
    label = f"{changed_names(changes)} of {edit.name}"
    return label, document.with_edit(dataclasses.replace(edit, **changes))


def order_edits(document: Document, message: Message) -> Step:
    """Put the edits of the active object in another order."""
    numbers, own = message["ids"], document.edits_of(document.selection.object_id)
    if not isinstance(numbers, list) or sorted(map(repr, numbers)) != sorted(repr(edit.id) for edit in own):
        raise InputError("ids must name every edit once")
    others = tuple(edit for edit in document.edits if edit not in own)
    return "order edits", dataclasses.replace(document, edits=(*others, *map(document.edit, numbers)))


# -- Cages


def subdivide_cage(document: Document, message: Message) -> Step:
    """Cut every face of a cage in four, or those at some vertices. Poses follow, by the same means of vertices."""
    edit = document.edit(message["edit"])
    rest, chosen = edit.rest_cage, None
    if "vertices" in message:
        chosen = np.array(checked_vertices(message["vertices"], len(edit.rest)), dtype=np.int64)
        if not len(chosen):
            raise InputError("nothing is selected: select the vertices whose faces are cut")
    finer = rest.subdivide(vertices=chosen)
    if len(finer.vertices) > MAX_VERTICES:
        raise InputError(f"the cage would have {len(finer.vertices)} vertices: at most {MAX_VERTICES} can be edited")

    def posed(pose: np.ndarray) -> np.ndarray:
        return rest.with_vertices(pose).subdivide(vertices=chosen).vertices

    return "subdivide", _with_cage(document, edit, finer, posed)


def with_cage(document: Document, number: int | None, cage: Cage, label: str, object_id: int) -> Step:
    """A cage for an edit, as `replace_cage` does it, or for a new one of an object where the number is None."""
    if number is None:
        return with_new_edit(document, cage, object_id=object_id)
    return replace_cage(document, number, cage, label)


def replace_cage(document: Document, number: int, cage: Cage, label: str) -> Step:
    """Another cage at rest for an edit, as a step. Poses follow: those of the same mesh keep their distance, other
    vertices go where the old cage carries them."""
    edit = document.edit(number)
    with contextlib.suppress(ValueError):  # another mesh
        places = edit.rest_cage.match(cage).vertices
        return label, moved_keys(moved_rest(document, edit, places), edit)

    def posed(pose: np.ndarray) -> np.ndarray:
        if np.array_equal(pose, edit.rest):
            return cage.vertices
        with named_errors("the pose cannot be carried over to the new cage"):
            return np.asarray(deform_points(cage.vertices, edit.rest_cage, Cage(pose, edit.faces), device="cpu"))

    return label, _with_cage(document, edit, cage, posed)


def moved_rest(document: Document, before: Edit, rest: Any) -> Document:
    """A document whose cage at rest has new places (v, 3) since `before`; poses keep their distance, keys are left."""
    places = frozen_vertices(rest, len(before.rest))
    edit = dataclasses.replace(
        document.edit(before.id), rest=places, posed=frozen_vertices(before.posed + (places - before.rest))
    )
    return document.with_edit(edit)


def moved_keys(document: Document, before: Edit) -> Document:
    """A document whose keys keep their distance from a cage at rest that was moved since `before`."""
    offset = document.edit(before.id).rest - before.rest
    return document.with_key_poses(before.id, lambda pose: frozen_vertices(pose + offset))


# -- Film


def add_key(document: Document, message: Message) -> Step:
    """Keep the pose, the camera or both at a time. A key that is there is filled up."""
    time = checked_number(message["time"], "time", 0.0, MAX_SECONDS)
    near = 0.5 / document.timeline.fps
    key = next((key for key in document.timeline.keys if abs(key.time - time) < near), None)
    if key is None:
        if len(document.timeline.keys) >= MAX_KEYS:
            raise InputError(f"a film takes at most {MAX_KEYS} keys: delete some first")
        name = checked_name(message.get("name") or free_name(document))
        key = Key(document.free_id, time, name)
        document = dataclasses.replace(document, next_id=document.next_id + 1)
    key = _filled(document, key, message)
    if key.is_empty:
        raise InputError("a key needs a pose, a camera or both")
    document = document.with_key(key)
    return f"add {_called(key)}", document.with_timeline(length=max(document.timeline.length, key.time))


def change_key(document: Document, message: Message) -> Step:
    """Move a key in time, rename it, ease it otherwise, or take the present pose or camera for it."""
    key, changes = document.key(message["id"]), checked_fields(Key, message, ("time", "easing", "name"))
    key = _filled(document, dataclasses.replace(key, **changes) if changes else key, message)
    if key is document.key(message["id"]):
        raise InputError("nothing to change: give time, easing, name, pose or camera")
    document = document.with_key(key)
    return f"change {_called(key)}", document.with_timeline(length=max(document.timeline.length, key.time))


def delete_key(document: Document, message: Message) -> Step:
    """Delete a key."""
    gone = document.key(message["id"])
    keys = tuple(key for key in document.timeline.keys if key.id != gone.id)
    return f"delete {_called(gone)}", document.with_timeline(keys=keys)


def change_timeline(document: Document, message: Message) -> Step:
    """Change the length, the frame rate or the loop of the film."""
    changes: dict[str, Any] = {}
    if "length" in message:
        last = max((key.time for key in document.timeline.keys), default=0.0)
        changes["length"] = checked_number(message["length"], "length (not before the last key)", last, MAX_SECONDS)
    changes |= checked_fields(Timeline, message, ("fps", "loop"))
    if not changes:
        raise InputError("nothing to change: give length, fps or loop")
    follows = document.timeline.follows_keys and "length" not in changes
    return f"film {changed_names(changes)}", document.with_timeline(**changes, follows_keys=follows)


def free_name(document: Document) -> str:
    """A name that no key has."""
    names = {key.name for key in document.timeline.keys}
    return next(name for name in (f"key {number}" for number in range(1, MAX_KEYS + 2)) if name not in names)


#: Commands by their names, in `do`.
COMMANDS: dict[str, Callable[[Document, Message], Step]] = {
    "select": select,
    "settings": change_settings,
    "pose.set": set_pose,
    "pose.reset": reset_pose,
    "landmark.delete": delete_landmark,
    "edit.add": add_edit,
    "edit.delete": delete_edit,
    "edit.change": change_edit,
    "edit.order": order_edits,
    "cage.subdivide": subdivide_cage,
    "cage.box": box_selection,
    "cage.mirror": mirror_edit,
    "key.add": add_key,
    "key.change": change_key,
    "key.delete": delete_key,
    "timeline": change_timeline,
    **objects.COMMANDS,
}


def run_command(document: Document, message: Message) -> Step:
    """Carry out the one of COMMANDS that `do` names; ValueError for values that are missing or wrong, in one line."""
    try:
        return COMMANDS[message["do"]](document, message)
    except KeyError as error:
        raise InputError(f"{message['do']}: {error.args[0]!r} is missing") from None
    except (TypeError, AttributeError, OverflowError, IndexError) as error:
        raise InputError(f"{message['do']}: a value has the wrong type: {error}") from None


def _with_cage(document: Document, edit: Edit, cage: Cage, posed: Callable[[np.ndarray], np.ndarray]) -> Document:
    """The document with another cage for an edit; posed: carries vertices of a pose over."""
    fresh = new_edit(edit.id, cage, edit.name, edit.kind, posed(edit.posed))
    changed = dataclasses.replace(edit, faces=fresh.faces, rest=fresh.rest, posed=fresh.posed)
    document = document.with_edit(changed)
    document = document.with_key_poses(edit.id, lambda pose: frozen_vertices(posed(pose), len(cage.vertices)))
    if document.selection.edit == edit.id:
        document = dataclasses.replace(document, selection=dataclasses.replace(document.selection, vertices=()))
    return document


def _called(key: Key) -> str:
    """What a key is called in the name of a step."""
    return key.name if key.name.startswith("key ") else f"key {key.name}"


def _filled(document: Document, key: Key, message: Message) -> Key:
    """The key with the present pose and camera where the message asks for them."""
    if checked_flag(message.get("pose", False), "pose"):
        key = dataclasses.replace(key, poses={edit.id: edit.posed for edit in document.edits} or None)
        if document.is_staged or any(one.places is not None for one in document.timeline.keys):
            key = dataclasses.replace(key, places={one.id: one.place for one in document.objects})
    if checked_flag(message.get("camera", False), "camera"):
        key = dataclasses.replace(key, view=document.view)
    return key
