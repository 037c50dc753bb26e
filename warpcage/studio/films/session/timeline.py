"""The film of a document: poses and views at a time, the times of its frames, and its keys as a pose file."""

from __future__ import annotations

import bisect
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np

from ....cage.cage import Cage
from ....cage.pose_file import PoseFile, known_easing
from ....core.arrays import box_corners
from ....core.checks import checked_number
from ....core.names import MOVE_HELP, named_errors
from ....edits.place import PlaceFile
from ....edits.stage_file import free_name
from ....errors import InputError
from ....view import motion as between
from ....view.camera import Camera, CameraKey
from ....view.camera_path import timed_keys, up_frame
from ..checks import MAX_KEYS, MAX_NAME, MAX_SECONDS, checked_name, frozen_vertices
from ..document import FOVS, Document, Key, Timeline, View, by_time
from ..moves import CameraMove, MovingCamera, camera_moves, within_sight
from .scene import Fields, view_camera

#: Keys and what each of them holds of one edit, object or camera.
_Track: TypeAlias = Sequence[tuple[Key, np.ndarray]]

#: Width and height of the pictures of cameras in pose files, pixels.
PICTURE = (800, 600)

#: Parts of a drawn way from key to key; a smooth one is a cubic, for which few do.
PARTS, SMOOTH_PARTS = 32, 8

#: Keys whose ways are drawn: more lie too close to be seen apart, and take long.
MAX_DRAWN = 200

#: Most degrees between two keys of a turn, of which those between are exact; and parts of one there and back.
TURN_PART, TURN_BACK_PARTS = 45.0, 16

#: Keys of moves that go no even way: a hand-held camera sways up to 2.3 times a second, the last of these little.
KEYS_A_SECOND = {"hand-held": 6.0, "follow": 3.0}

#: Room around what the camera of a key is made to see, as the page's "Frame all" leaves it.
FRAME_MARGIN = 1.15


def place_files(document: Document) -> dict[int, PlaceFile]:
    """The places of objects that keys hold, by the number of the object; none where all keys are of a field in its own
    place."""
    keys, loop = document.timeline.keys, document.timeline.loop
    if all(key.places is None for key in keys):
        return {}
    found = {}
    for scene_object in document.objects:
        held = [key for key in keys if scene_object.id in key.held_places]
        if held:
            places = {key.time: key.held_places[scene_object.id] for key in held}
            found[scene_object.id] = PlaceFile(places, {key.time: key.easing for key in held}, loop)
    return found


def placed_at(document: Document, time: float) -> Document:
    """The document with the places of objects that its film has at a time, seconds; what is still stays as it is."""
    for number, file in place_files(document).items():
        scene_object = document.scene_object(number)
        if (place := file.at(time)) != scene_object.place:
            document = document.with_object(dataclasses.replace(scene_object, place=place))
    return document


def state_at(document: Document, time: float) -> tuple[dict[int, np.ndarray], View | None]:
    """Posed vertices (v, 3), read-only, by the number of the edit, and the view of a film at a time, seconds.
    Edits that no key holds are left out; the view is None where there is no key of cameras."""
    # The earlier key's easing says the way (`view.motion.value_at`); a loop does not stop where its ends are equal.
    poses = {
        number: _value_at(track, time, _closes(document.timeline, track))
        for number, track in _pose_tracks(document).items()
    }
    views = _view_track(document.timeline.keys)
    closed = bool(views) and _closes(document.timeline, views)
    return poses, _view_at(views, time, closed) if views else None


def ways(document: Document) -> dict[int, tuple[float, list[float]]]:
    """By the number of a key with poses or places: the time of the next ones, and how far they have gone to these, 0 to
    1, at even times. That of the edit or object that moves most; keys from which nothing moves are left out."""
    farthest: dict[int, float] = {}
    found = {}
    for track, value_at in _moving(document):
        if len(track) > MAX_DRAWN:
            continue
        for (key, begin), (after, end) in itertools.pairwise(track):
            step = end - begin
            far = float(np.vdot(step, step))
            if far <= farthest.get(key.id, 0.0):
                continue
            farthest[key.id] = far
            moments = np.linspace(key.time, after.time, SMOOTH_PARTS + 1 if key.easing == "smooth" else PARTS + 1)
            values = [value_at(float(time)) for time in moments]
            found[key.id] = (after.time, [float(np.vdot(value - begin, step)) / far for value in values])
    return found


def _moving(document: Document) -> Iterator[tuple[_Track, Callable[[float], np.ndarray]]]:
    """Keys with the poses of each edit and the matrices of each object's places, and what gives these at a time."""
    for track in _pose_tracks(document).values():
        yield track, functools.partial(_value_at, track, closed=_closes(document.timeline, track))
    for number, file in place_files(document).items():
        held = [key for key in document.timeline.keys if number in key.held_places]
        places = [(key, key.held_places[number].matrix) for key in held]
        yield places, lambda time, file=file: file.at(time).matrix


def document_at(document: Document, time: float) -> Document:
    """The document with the poses and the view that its film has at a time, seconds."""
    poses, view = state_at(document, time)
    now = dataclasses.replace(placed_at(document, time), view=view or document.view, time=time)
    for number, pose in poses.items():  # as arrays of their own: pages are sent those that are new
        now = now.with_edit(dataclasses.replace(now.edit(number), posed=frozen_vertices(pose)))
    return now


def looped_time(timeline: Timeline, elapsed: float) -> float:
    """Where a film is, 0 to its length, that has been played from its start for so many seconds."""
    return between.looped_time(timeline.loop, timeline.length, elapsed)


def frame_times(timeline: Timeline) -> list[float]:
    """The times of a film's frames, at least one, seconds from its start."""
    # Once: the last frame is at the film's length, where one falls on it. Loops have each moment of their round once.
    return between.frame_times(timeline.length, timeline.fps, timeline.loop)


def frame_rate(timeline: Timeline) -> Fraction:
    """The frames per second of a film as the nearest fraction of denominator 1001 at most: 30000/1001 for 29.97003."""
    return between.frame_rate(timeline.fps)


def pose_file(document: Document, number: int) -> PoseFile:
    """The keys of an edit as a pose file, with times, easings, and the keys of cameras."""
    edit = document.edit(number)
    file = PoseFile(edit.rest_cage)
    for key in document.timeline.keys:
        if key.poses is None or number not in key.poses:
            continue
        name = free_name(key.name, file)
        file[name] = key.poses[number]
        file.times[name], file.easings[name] = key.time, key.easing
    if not len(file):
        raise InputError(f"no key holds a pose of {edit.name!r}: add one first")
    file.fps, file.loop = float(document.timeline.fps), document.timeline.loop
    for key in document.timeline.keys:
        if key.view is not None and not (file.cameras and file.cameras[-1].time == key.time):
            looking, target = view_camera(key.view, *PICTURE), np.array(key.view.target)
            file.cameras.append(CameraKey(looking, key.time, key.name, key.easing, target))
    return file


def with_pose_file(document: Document, number: int, file: PoseFile) -> Document:
    """A document whose keys hold the poses and cameras of a file, in the place of those that they held of the edit.
    The film gets longer where the file's is."""
    # A keyframe goes into the key of its time, if there is one; those without times are spread evenly over the film.
    edit = document.edit(number)
    if not np.array_equal(file.rest.face_array, edit.faces):
        raise InputError(f"the pose file is of another cage than {edit.name!r}: load it with this cage")
    if not len(file) and not file.cameras:
        raise InputError("the pose file holds no keyframes")
    others = document.with_key_poses(number, lambda pose: None) if len(file) else document
    keys = [dataclasses.replace(key, view=None) if file.cameras else key for key in others.timeline.keys]
    keys = [key for key in keys if not key.is_empty]
    count = len(keys) + len(file) + len(file.cameras)
    if count > MAX_KEYS:
        raise InputError(f"a film has at most {MAX_KEYS} keys, this one would have {count}")
    kept, at = {key.id: key for key in keys}, {key.time: key for key in keys}
    spread = [float(time) for time in np.linspace(0.0, document.timeline.length, len(file))]
    next_id = document.next_id
    for name, evenly in zip(file.names, spread, strict=True):
        time = file.times.get(name, evenly)
        if not 0.0 <= time <= MAX_SECONDS:
            raise InputError(f"keyframe {name!r} is at {time:g} s: a film goes from 0 to {MAX_SECONDS:g} s")
        easing = known_easing(name, file.easings.get(name, "smooth"))
        held = at.get(time)
        if held is None or number in (held.poses or {}):  # two keyframes of one time: a jump
            held = Key(next_id, time, "", easing)
            next_id += 1
        poses = dict(sorted([*(held.poses or {}).items(), (number, frozen_vertices(file[name].vertices))]))
        shown = " ".join(name.split())[:MAX_NAME]
        kept[held.id] = at[time] = dataclasses.replace(held, name=shown, easing=easing, poses=poses)
    for looking in timed_keys(file.cameras) if file.cameras else []:
        time = looking.time or 0.0
        if time > MAX_SECONDS:
            raise InputError(f"camera {looking.name!r} is at {time:g} s: a film goes from 0 to {MAX_SECONDS:g} s")
        held = at.get(time)
        if held is None:
            held = Key(next_id, time, " ".join(looking.name.split())[:MAX_NAME] or f"camera {next_id}", looking.easing)
            next_id += 1
        view = view_of(looking, edit.rest_cage.bounds.mean(axis=0), document.view.up)
        kept[held.id] = at[time] = dataclasses.replace(held, view=view)
    return _with_keys(document, [*kept.values()], next_id)


def with_camera_moves(document: Document, text: str, seen: Sequence[Camera]) -> tuple[Document, str]:
    """A document whose film's camera goes through moves (a text as for `--cameras`) from the present view and about its
    target, by keys in the place of its own; and a line on what limited them, or "". seen: cameras of the pictures."""
    film, view, moves = document.timeline, document.view, camera_moves(checked_name(text))
    if moves is None:
        raise InputError(f"camera {text!r} is not a move: {MOVE_HELP}")
    closes = any(move.kind == "turn" and (move.amount or 360.0) % 360.0 == 0.0 for move in moves)
    frames = max(1, round(film.length * film.fps))
    pivot, up = np.array(view.target), np.array(view.up)
    start, rate = view_camera(view, *PICTURE), frames / film.length
    moving, _ = within_sight(MovingCamera(start, pivot, up, moves, frames + (not closes), rate), seen)
    parts, easing = max(_parts(move, film.length) for move in moving.moves), "smooth"
    if len(moves) == 1:
        easing = {"turn": "linear", "dolly": "ease-in-out", "crane": "ease-in-out"}.get(moves[0].kind, easing)
    if (arc := moving.moves[0].arc) is not None:
        easing = "smooth"
    follows = any(move.kind == "follow" for move in moves)
    keys = [key for key in (dataclasses.replace(key, view=None) for key in film.keys) if not key.is_empty]
    if len(keys) + parts + 1 > MAX_KEYS:
        raise InputError(f"a film has at most {MAX_KEYS} keys, this one would have {len(keys) + parts + 1}")
    for number in range(parts + 1):  # keys of their own: those of poses there have easings of theirs
        time = film.length * number / parts
        place = _followed_place(document, time) if follows else pivot
        camera = moving.at(frames * number / parts, lambda part, place=place: place)
        looking = view_of(CameraKey(camera, target=place), place, view.up)
        keys.append(Key(document.next_id + number, time, f"{moves[0].kind} {number + 1}", easing, view=looking))
    span = 0.0 if arc is None else arc[1] - arc[0]
    note = f"The camera goes there and back through {span:.0f} degrees: no picture shows the rest." if span else ""
    return _with_keys(document, keys, document.next_id + parts + 1), note


def _parts(move: CameraMove, length: float) -> int:
    """Between how many keys a move is cut: what lies between two is a way about the target. length: seconds."""
    if move.kind == "turn":
        return TURN_BACK_PARTS if move.arc else math.ceil(abs(move.amount or 360.0) / TURN_PART)
    return math.ceil(length * KEYS_A_SECOND[move.kind]) if move.kind in KEYS_A_SECOND else 1


def _followed_place(document: Document, time: float) -> np.ndarray:
    """(3,) where the middle of the active edit's cage is at a time, world units."""
    now = document_at(document, time)
    if now.selection.edit is None:
        raise InputError("choose the cage to follow first")
    edit = now.edit(now.selection.edit)
    return now.scene_object(edit.object_id).place.moved(edit.posed).mean(axis=0)


def framed_views(document: Document, fields: Fields, aspect: float) -> dict[int, View]:
    """For each key whose camera does not see all shown objects at its time, by its number: the view that does.
    It looks the same way, from farther back. aspect: width of the picture by its height."""
    found, aspect = {}, checked_number(aspect, "aspect", 0.05, 20.0)
    for key in document.timeline.keys:
        objects = [one for one in placed_at(document, key.time).objects if one.visible]
        if key.view is None or not objects:
            continue
        places = np.concatenate([one.place.moved(box_corners(fields.field(one).bounds)) for one in objects])
        pose = view_camera(key.view, *PICTURE).camera_to_world
        tall = math.tan(math.radians(key.view.fov) / 2)
        slopes = np.array([tall * aspect, tall])

        def seen_as(places: np.ndarray, center: np.ndarray, pose: np.ndarray = pose) -> np.ndarray:
            return (places - center) @ pose[:3, :3]  # right, down, ahead

        at = seen_as(places, pose[:3, 3])
        if np.all(np.abs(at[:, :2]) <= slopes * at[:, 2:]):
            continue
        target = (places.min(axis=0) + places.max(axis=0)) / 2.0
        at = seen_as(places, target)
        far = max(float(np.max(FRAME_MARGIN * np.abs(at[:, :2]) / slopes - at[:, 2:])), 1e-6)
        eye = target - far * pose[:3, 2]
        found[key.id] = array_view(eye, target, np.array(key.view.up), key.view.fov)
    return found


def with_framed_views(document: Document, fields: Fields, aspect: float) -> Document:
    """A document in which the cameras of all keys see all shown objects, see `framed_views`."""
    found = framed_views(document, fields, aspect)
    if not found:
        raise InputError("all camera keys see everything already")
    keys = (dataclasses.replace(key, view=found.get(key.id, key.view)) for key in document.timeline.keys)
    return document.with_timeline(keys=tuple(keys))


def _with_keys(document: Document, keys: list[Key], next_id: int) -> Document:
    """The document with these keys, by time; the film gets longer where they go on."""
    length = max(document.timeline.length, *(key.time for key in keys))
    document = document.with_timeline(keys=by_time(keys), length=length)
    return dataclasses.replace(document, next_id=next_id)


def view_of(key: CameraKey, middle: np.ndarray, up: Sequence[float]) -> View:
    """The view that looks as a camera does: from its place, along its axis, with its height of picture.
    `middle` (3,): what it looks at where it names no target. `up` (3,): unit, kept where the camera stands upright."""
    # Where the camera's axis leaves the middle of its picture, or pixels are not square, that is left out.
    pose = key.camera.camera_to_world
    eye, right, upward, forward = pose[:3, 3], pose[:3, 0], -pose[:3, 1], pose[:3, 2]
    ahead = float(((middle if key.target is None else key.target) - eye) @ forward)
    if ahead <= 0.0:
        ahead = max(float(np.linalg.norm(middle - eye)), 1e-6)
    target = eye + ahead * forward
    if key.target is not None and np.linalg.norm(key.target - target) < 1e-9 * ahead:
        target = key.target  # to the bit
    given = np.asarray(up, dtype=np.float64)
    stands = abs(given @ right) < 1e-6 and given @ upward > 1e-3
    fov = math.degrees(2.0 * math.atan(0.5 * key.camera.height / key.camera.fy))
    chosen = given if stands else upward / np.linalg.norm(upward)
    return array_view(eye, target, chosen, fov)


def load_poses(document: Document, number: int, path: str) -> Document:
    """`with_pose_file` of a file on disk, matched to the edit's cage."""
    edit = document.edit(number)
    file = PoseFile.load(path, Cage(edit.rest, edit.faces))
    with named_errors(path):
        return with_pose_file(document, number, file)


def _pose_tracks(document: Document) -> dict[int, list[tuple[Key, np.ndarray]]]:
    """Keys and the poses (v, 3) that they hold, by the number of the edit; edits that no key holds are left out."""
    tracks = {}
    for edit in document.edits:
        # a key may be older than the cage and hold vertices that it no longer has
        held = [(key, (key.poses or {}).get(edit.id)) for key in document.timeline.keys]
        track = [(key, pose) for key, pose in held if pose is not None and pose.shape == edit.posed.shape]
        if track:
            tracks[edit.id] = track
    return tracks


def _value_at(track: _Track, time: float, closed: bool = False) -> np.ndarray:
    """The value of keys at a time, read-only. At a key it is the key's own array."""
    times, easings = [key.time for key, _ in track], [key.easing for key, _ in track]
    return between.value_at(times, [value for _, value in track], time, easings, closed=closed)


def _closes(film: Timeline, track: _Track) -> bool:
    """Whether a film goes on at its end as it began, so that smooth ways go through it without stopping."""
    (first, begin), (last, end) = track[0], track[-1]
    whole = first.time == 0.0 and last.time == film.length
    return film.loop == "loop" and whole and np.array_equal(begin, end)


def _view_track(moments: Sequence[Key]) -> list[tuple[Key, np.ndarray]]:
    """Keys of cameras as numbers (10,), such that a camera turns about its target by the shorter way."""
    # Target, log of the distance, angle about the first key's up, angle above the plane across it, up, field of view.
    views = [(key, key.view) for key in moments if key.view is not None]
    if not views:
        return []
    frame = up_frame(np.array(views[0][1].up))
    offsets = np.array([np.subtract(view.eye, view.target) for _, view in views])
    distances = np.linalg.norm(offsets, axis=1)
    x, y, z = (offsets / distances[:, None] @ frame).T
    azimuths = np.unwrap(np.arctan2(y, x))
    elevations = np.arcsin(np.clip(z, -1.0, 1.0))
    return [
        (key, np.array([*view.target, math.log(distance), azimuth, elevation, *view.up, view.fov]))
        for (key, view), distance, azimuth, elevation in zip(views, distances, azimuths, elevations, strict=True)
    ]


def _view_at(track: Sequence[tuple[Key, np.ndarray]], time: float, closed: bool) -> View:
    """The view at a time."""
    place = max(bisect.bisect_right([key.time for key, _ in track], time) - 1, 0)
    value = _value_at(track, time, closed)
    first, held = track[0][0].view, track[place][0].view
    assert first is not None and held is not None
    if value is track[place][1]:
        return held
    target, up, fov = value[:3], value[6:9], float(value[9])
    azimuth, elevation = value[4:6].tolist()
    direction = [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    eye = target + math.exp(value[3]) * (up_frame(np.array(first.up)) @ direction)
    length = float(np.linalg.norm(up))
    up = up / length if length > 1e-9 else np.array(held.up)  # half-way between opposite ones
    return array_view(eye, target, up, fov)


def array_view(eye: np.ndarray, target: np.ndarray, up: np.ndarray, fov: float = View.fov) -> View:
    """The view of arrays (3,); its field of view may have swung beyond those that there are."""
    triples: list[Any] = [tuple(each.tolist()) for each in (eye, target, up)]
    return View(*triples, fov=min(max(fov, FOVS[0]), FOVS[1]))
