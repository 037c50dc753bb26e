"""Where an object stands in a stage: a place, places at times, and their files."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_easing, checked_number, checked_positive, checked_vector, real_array, shown
from ..core.files import PathLike, atomic_path, errors_of, read_document, require_file
from ..core.names import LOOPS, Easing, checked_choice
from ..core.spec import Checker, anything, checked_keys
from ..errors import InputError
from ..view.camera import Camera
from ..view.motion import axis_rotation, value_at

_FORMAT, _VERSION = "warpcage place", 1

#: Keys of a place, and those of a place file.
_KEYS: dict[str, Checker] = dict.fromkeys(("position", "turn", "scale", "matrix"), anything)
PLACE_KEYS = frozenset((*_KEYS, "keys"))


@dataclasses.dataclass(frozen=True)
class Place:
    """Where an object stands: it is scaled, then turned, about the origin of its own coordinates, then moved.

    Args:
        position: (3,) where the origin of its coordinates goes, world units of the stage.
        turn: (3,) degrees about x, then y, then z, the axes of the stage: "XYZ Euler" in Blender.
        scale: How many times as large it is, above 0.

    Raises:
        ValueError: For places and turns that are not 3 finite numbers, or a scale that is not positive.
    """

    position: ArrayLike = (0.0, 0.0, 0.0)
    turn: ArrayLike = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("position", "turn"):
            vector = checked_vector(getattr(self, name), f"the {name} of a place")
            object.__setattr__(self, name, tuple(float(number) for number in vector))
        object.__setattr__(self, "scale", checked_positive(self.scale, "the scale of a place"))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Place:
        """The place of a similarity, as other programs have it.

        Args:
            matrix: (4, 4), from the coordinates of the object to those of the stage.

        Returns:
            The place.

        Raises:
            ValueError: For a matrix that mirrors, shears or scales by axes, or is not finite.
        """
        whole = real_array(matrix, "the matrix of a place")
        if whole.shape != (4, 4) or not np.isfinite(whole).all() or not np.allclose(whole[3], [0.0, 0.0, 0.0, 1.0]):
            raise InputError(f"the matrix of a place must be (4, 4), with 0 0 0 1 below, got {shown(matrix)}")
        scale = float(np.cbrt(max(np.linalg.det(whole[:3, :3]), 0.0)))
        turn = whole[:3, :3] / (scale or 1.0)
        if scale == 0.0 or not np.allclose(turn.T @ turn, np.eye(3), atol=1e-4):
            raise InputError("the matrix of a place must turn and scale alike along all axes, and not mirror")
        y = np.arcsin(np.clip(-turn[2, 0], -1.0, 1.0))
        if abs(turn[2, 0]) < 1.0 - 1e-9:
            x, z = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
        else:  # y points along z: x and z turn about one axis
            x, z = 0.0, np.arctan2(-turn[0, 1], turn[1, 1])
        return cls(whole[:3, 3], np.degrees([x, y, z]), scale)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) float64 of `turn`."""
        x, y, z = (axis_rotation(axis, angle) for axis, angle in zip(np.eye(3), np.radians(self.turn), strict=True))
        return z @ y @ x

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) float64 from the coordinates of the object to those of the stage."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.position
        return matrix

    def moved(self, points: ArrayLike) -> np.ndarray:
        """Where points of the object are in the stage.

        Args:
            points: (n, 3), in the coordinates of the object.

        Returns:
            (n, 3) float64, world units of the stage.
        """
        return self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + np.asarray(self.position)


class PlaceFile:
    """A place, or places at times between which an object moves, as a place file (.json) has it.

    A file of one place is `{"position": [1, 0, 0], "turn": [0, 0, 90], "scale": 0.5}`, each of them optional, or
    `{"matrix": ...}`, (4, 4). A file of several is `{"keys": [{"time": 0, "position": ..., "easing": "smooth"}, ...]}`,
    with `loop` where it was given. Positions move along smooth curves; turns by their degrees: 0 to 360 is once around.

    Args:
        places: A Place, or Places by their times, seconds.
        easings: The easing from a key to the next, by its time: a name or a curve, as in pose files. A key without
            one has "smooth".
        loop: What the film does at its end, "once", "loop" or "ping-pong". None leaves it open.

    Raises:
        ValueError: For no place, times below 0, or easings that are not known.

    Attributes:
        places: The Places by their times, in the order of these.
        easings: As given.
        loop: As given.
        fps: None: a place file says nothing of frames.
    """

    fps: float | None = None

    def __init__(
        self,
        places: Place | Mapping[float, Place],
        easings: Mapping[float, Easing] | None = None,
        loop: str | None = None,
    ):
        given = {0.0: places} if isinstance(places, Place) else places
        if not isinstance(given, Mapping) or not given or not all(isinstance(each, Place) for each in given.values()):
            raise InputError(f"places must be a Place, or Places by their times, got {shown(places)}")
        times = sorted(checked_number(time, "the time of a place") for time in given)
        if times[0] < 0.0:
            raise InputError(f"a place is at {times[0]:g} s: a film begins at 0")
        self.places = {time: given[time] for time in times}
        self.easings = dict(easings or {})
        for time, easing in self.easings.items():
            if time not in self.places:
                raise InputError(f"an easing is of {time!r} s, at which there is no place")
            self.easings[time] = checked_easing(easing, "the easing of a place")
        self.loop = None if loop is None else checked_choice(loop, "loop", LOOPS)

    @property
    def length(self) -> float:
        """Seconds from 0 to the last time, 0 for one place at 0."""
        return max(self.places)

    def at(self, seconds: float) -> Place:
        """The place at a time. Before the first time and after the last one it stays.

        Args:
            seconds: The time.

        Returns:
            The place, interpolated by `warpcage.view.motion.value_at`.
        """
        seconds, times, places = checked_number(seconds, "the time of a stage"), [*self.places], [*self.places.values()]
        easings = [self.easings.get(time, "smooth") for time in times]
        closed = self.loop == "loop" and len(places) > 2 and places[0] == places[-1] and times[0] == 0.0

        def between(values: list[np.ndarray]) -> np.ndarray:
            return value_at(times, values, seconds, easings, closed=closed)

        position = between([np.array([place.position]) for place in places])[0]
        turn = between([np.array(place.turn) for place in places])
        return Place(position, turn, float(between([np.array([place.scale]) for place in places])[0]))

    def to_json(self) -> dict[str, Any]:
        """The file's content, but for its format.

        Returns:
            What `json.dumps` takes.
        """
        if len(self.places) == 1 and not self.length and not self.easings and self.loop is None:
            return dataclasses.asdict(self.places[0.0])
        keys = [
            {"time": time, **dataclasses.asdict(place), "easing": self.easings.get(time, "smooth")}
            for time, place in self.places.items()
        ]
        return {"keys": keys} | ({} if self.loop is None else {"loop": self.loop})

    @classmethod
    def from_json(cls, content: Any) -> PlaceFile:
        """The places of the content of a file.

        Args:
            content: What JSON held.

        Returns:
            The places.

        Raises:
            ValueError: For keys that are not known, or values out of range.
        """
        if not isinstance(content, Mapping):
            raise InputError(f"a place must be an object with a position, a turn or a scale, got {shown(content)}")
        content = {key: value for key, value in content.items() if key not in ("format", "version")}
        if "keys" not in content:
            return cls(_place(content, {}))
        given = checked_keys(content, {"keys": anything, "loop": anything}, "a place file")
        if not isinstance(given["keys"], list) or not given["keys"]:
            raise InputError(f"'keys' must be a list of at least one place, got {shown(given['keys'])}")
        places, easings = {}, {}
        for number, key in enumerate(given["keys"], 1):
            if not isinstance(key, Mapping) or "time" not in key:
                raise InputError(f"key {number} must be an object with a 'time', got {shown(key)}")
            time = checked_number(key["time"], f"the time of key {number}")
            if time in places:
                raise InputError(f"two keys are at {time:g} s")
            places[time] = _place(key, {"time": anything, "easing": anything})
            easings |= {time: key["easing"]} if "easing" in key else {}
        return cls(places, easings, given.get("loop"))

    @classmethod
    def load(cls, path: PathLike) -> PlaceFile:
        """Read a place file.

        Args:
            path: The file.

        Returns:
            The places.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: What is wrong in which file.
        """
        path = require_file(path, "place file")
        with errors_of(path, "place file"):  # one without format and version is read too
            content = read_document(path, "place file", _FORMAT, _VERSION, format=_FORMAT, version=_VERSION)
            return cls.from_json(content)

    def save(self, path: PathLike) -> None:
        """Write a place file, whole or not at all.

        Args:
            path: The file, usually .json.
        """
        with atomic_path(path) as temporary:
            content = {"format": _FORMAT, "version": _VERSION, **self.to_json()}
            temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def seen_from(place: Place, camera: Camera) -> Camera:
    """A camera of the stage in the coordinates of an object there: the same rays, depths shorter by the scale."""
    if place == Place():
        return camera
    pose = np.eye(4)
    pose[:3, :3] = place.rotation.T @ camera.rotation
    pose[:3, 3] = place.rotation.T @ (camera.center - place.position) / place.scale
    return dataclasses.replace(camera, camera_to_world=pose)


def near_turn(turn: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(3,) the degrees of the same turn that are nearest to those of another one, for a continuous motion."""
    other = np.array([turn[0] + 180.0, 180.0 - turn[1], turn[2] + 180.0])  # the same rotation
    near = [each + 360.0 * np.round((before - each) / 360.0) for each in (turn, other)]
    return min(near, key=lambda each: float(np.abs(each - before).sum()))


def _place(content: Mapping[str, Any], beside: dict[str, Checker]) -> Place:
    """A place from JSON; beside: other keys that its object may have."""
    given = {key: value for key, value in checked_keys(content, _KEYS | beside, "a place").items() if key in _KEYS}
    if "matrix" not in given:
        return Place(**given)
    if len(given) > 1:
        raise InputError("a place has a matrix, or a position, a turn and a scale: give one of them")
    return Place.from_matrix(given["matrix"])


def as_places(place: Place | PlaceFile | ArrayLike | PathLike | None) -> PlaceFile:
    """The places of an argument: a Place, a PlaceFile, a matrix (4, 4) or a file; None is the origin of the stage."""
    if isinstance(place, PlaceFile):
        return place
    if place is None or isinstance(place, Place):
        return PlaceFile(place or Place())
    if isinstance(place, str) or hasattr(place, "__fspath__"):
        return PlaceFile.load(place)  # pyright: ignore[reportArgumentType]
    return PlaceFile(Place.from_matrix(place))  # pyright: ignore[reportArgumentType]
