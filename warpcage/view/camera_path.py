"""Camera keys in time and the camera between them; moves of a camera by name; the cameras that a fit refined."""

from __future__ import annotations

import dataclasses
import itertools
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_number, require_type
from ..core.files import PathLike
from ..core.names import MOVE_HELP, MOVES, agreed
from ..errors import InputError
from .alignment import Similarity, moved_along
from .camera import Camera, CameraFile, CameraKey, camera_from_json, camera_json, common_up
from .motion import axis_rotation, evenly, value_at

#: Directions in which the axes of cameras say this little, of what they say in others, are taken to say nothing.
_MIN_CONDITION = 1e-4

#: A common point nearer to a camera than this share of its middle distance is not what the cameras look at.
_MIN_SHARE = 0.1


def timed_keys(keys: Sequence[CameraKey], length: float | None = None) -> list[CameraKey]:
    """Keys that all have a time, in the order of their times.
    Where none has one, they are spread over `length` seconds; None takes a second from each to the next."""
    require_type(keys, Sequence, "keys of a camera path must be")
    for key in keys:
        require_type(key, CameraKey, "a key of a camera path must be")
    if not keys:
        raise InputError("a camera path needs at least one camera")
    untimed = [key for key in keys if key.time is None]
    if len(untimed) == len(keys):
        spread = np.linspace(0.0, len(keys) - 1.0 if length is None else length, len(keys)).tolist()
        keys = [dataclasses.replace(key, time=time) for key, time in zip(keys, spread, strict=True)]
    elif untimed:
        raise InputError(
            f"{len(untimed)} of {len(keys)} cameras {agreed(len(untimed), 'has', 'have')} no time: give "
            "all of them one, or none"
        )
    ordered = sorted(keys, key=lambda key: key.time or 0.0)
    for one, two in itertools.pairwise(ordered):
        if one.time == two.time:
            names = f" ({one.name!r} and {two.name!r})" if one.name and two.name else ""
            raise InputError(f"two cameras of a path{names} are at {one.time:g} s: give each a time of its own")
    return ordered


def camera_at(keys: Sequence[CameraKey], time: float, *, closed: bool = False) -> Camera:
    """The camera of a path at a time. Before the first and after the last key it stands still.

    Where the cameras look at a point in common, or keys name targets, a camera goes around its target: the target, the
    distance, the angles about what is up for all of them, and the roll go as `warpcage.view.motion.value_at` says. So
    it keeps its distance where that of the keys is the same. Otherwise, as in a pan, the eye goes so, and the angles of
    what it looks along. At a key it is the key's own camera.

    Args:
        keys: The keys, all with times, all of one picture size; see `timed_keys`.
        time: Seconds.
        closed: Whether the last key is the first one again: a loop, which goes through it without stopping.

    Returns:
        The camera.

    Raises:
        ValueError: For no keys, keys without times, or pictures of several sizes.
    """
    time, ordered = checked_number(time, "the time of a camera path"), timed_keys(keys)
    sizes = sorted({(key.camera.width, key.camera.height) for key in ordered})
    if len(sizes) > 1:
        raise InputError(f"cameras of a path must have one picture size, got {sizes}")
    times, easings = [key.time or 0.0 for key in ordered], [key.easing for key in ordered]
    for key, at in zip(ordered, times, strict=True):
        if at == time or (time < at and key is ordered[0]) or (time > at and key is ordered[-1]):
            return key.camera
    distances = _target_distances(ordered)
    frame = _frame(common_up([key.camera for key in ordered]))
    points, angles, lenses = _track(ordered, distances, frame)
    point, (azimuth, elevation, roll, reach), (fx, fy, cx, cy) = (
        value_at(times, values, time, easings, closed=closed) for values in (points, angles, lenses)
    )
    rotation = frame @ _held(azimuth, elevation, roll)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = point[0] if distances is None else point[0] - math.exp(reach) * rotation[:, 2]
    return dataclasses.replace(ordered[0].camera, fx=fx, fy=fy, cx=cx, cy=cy, camera_to_world=pose)


def path_cameras(keys: Sequence[CameraKey], count: int, frames: ArrayLike | None = None) -> list[Camera]:
    """Cameras evenly over a path, the first and the last key included; keys may have times or not.
    frames: (n,) which of them, or between which, as numbers from 0 on; None is all."""
    if count < 1:
        raise InputError(f"a film needs at least one camera, got {count}")
    ordered = timed_keys(keys)
    times = evenly(ordered[0].time or 0.0, ordered[-1].time or 0.0, count, frames)
    return [camera_at(ordered, float(time)) for time in times]


def _track(
    keys: Sequence[CameraKey], distances: np.ndarray | None, frame: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """What goes from key to key: points (1, 3), angles with the logarithm of the distance (4,), lenses (4,)."""
    cameras = [key.camera for key in keys]
    points = np.array([camera.center for camera in cameras])
    reach = np.zeros(len(keys))
    if distances is not None:
        points = points + distances[:, None] * np.array([camera.rotation[:, 2] for camera in cameras])
        reach = np.log(distances)
    angles = np.array([_angles(frame.T @ camera.rotation) for camera in cameras])
    angles[:, [0, 2]] = np.unwrap(angles[:, [0, 2]], axis=0)  # by the shorter way
    lenses = np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras])
    return list(points[:, None]), list(np.column_stack([angles, reach])), list(lenses)


def _angles(rotation: np.ndarray) -> tuple[float, float, float]:
    """Azimuth and elevation of where a camera looks from, about +z, and its roll; radians."""
    backward, up = -rotation[:, 2], -rotation[:, 1]
    elevation = math.asin(min(max(backward[2], -1.0), 1.0))
    # seen from straight above or below, its upward axis tells the side that it stands on
    across = backward if math.hypot(*backward[:2]) > 1e-3 else -math.copysign(1.0, elevation) * up
    azimuth = math.atan2(across[1], across[0])
    level = _held(azimuth, elevation, 0.0)
    return azimuth, elevation, math.atan2(up @ level[:, 0], -(up @ level[:, 1]))


def _held(azimuth: float, elevation: float, roll: float) -> np.ndarray:
    """The rotation (3, 3) of a camera that has these angles: right, down and forward as columns."""
    aside, above = (np.array([math.cos(angle), math.sin(angle)]) for angle in (azimuth, elevation))
    forward = -np.array([above[0] * aside[0], above[0] * aside[1], above[1]])
    level = np.array([-aside[1], aside[0], 0.0])
    up = np.cross(level, forward)
    right = math.cos(roll) * level - math.sin(roll) * up
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _target_distances(keys: Sequence[CameraKey]) -> np.ndarray | None:
    """(n,) distance of each camera's target ahead of it, None where the cameras look at nothing in common."""
    centers = np.stack([key.camera.center for key in keys])
    axes = np.stack([key.camera.rotation[:, 2] for key in keys])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(axis=0)
    middle = centers.mean(axis=0)  # where the axes say nothing of a direction, the point is as far along as this
    pull = (across @ (centers - middle)[:, :, None])[..., 0].sum(axis=0)
    # the target is on the axis, nearest to the key's point, or to the one that is nearest to all axes (least squares)
    common = middle + np.linalg.pinv(system, rcond=_MIN_CONDITION, hermitian=True) @ pull
    offsets = np.array([common if key.target is None else key.target for key in keys]) - centers
    distances = (offsets * axes).sum(axis=1)
    least = _MIN_SHARE * float(np.median(np.linalg.norm(offsets, axis=1)))
    return distances if distances.min() > max(least, 0.0) else None


def _frame(up: np.ndarray) -> np.ndarray:
    """(3, 3) columns: two directions across `up`, and `up`."""
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    across = np.cross(up, side)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up], axis=1)


@dataclasses.dataclass(frozen=True)
class CameraMove:
    """A move of a film's camera, as words name it: turn, turn:90, dolly:0.6, crane:20, hand-held:7, follow:PART."""

    kind: str
    amount: float | None = None  # degrees of a turn and a crane, share of the distance of a dolly, seed; None: usual
    part: str = ""  # what is followed; "" for the first edit
    arc: tuple[float, float] | None = None  # of a turn there and back instead of an amount, degrees from the camera
    reach: np.ndarray | None = None  # (360,) shares of its distance to which it goes nearer, by degrees from the camera


#: Nearest that a crane comes to straight above or below, degrees.
STEEPEST = 89.0

#: What a hand does: rates of its sways, per second, and their largest sizes: degrees of turns to the side, up and
#: about the axis, and shares of the distance to the side and up.
SWAY_RATES = np.array([0.31, 0.73, 1.31, 2.3])
SWAY_SHARES = np.array([0.45, 0.3, 0.17, 0.08])
SWAYS = (0.5, 0.4, 0.3, 0.006, 0.006)


def camera_moves(text: str) -> list[CameraMove] | None:
    """The moves that words joined by "+" name; None for other words, such as names of files."""
    words = [word.partition(":") for word in text.split("+")]
    if words[0][0] not in MOVES or pathlib.Path(text).exists():
        return None
    return [_move(kind, value, text) for kind, _, value in words]


def _move(kind: str, value: str, text: str) -> CameraMove:
    if kind == "follow":
        return CameraMove(kind, part=value)
    try:
        amount = float(value) if value else None
        good = kind in MOVES and (amount is None or abs(amount) < math.inf)
        good = good and not (kind == "dolly" and amount is not None and amount <= 0.0)
        good = good and not (kind == "hand-held" and amount is not None and (amount < 0 or amount != int(amount)))
    except ValueError:
        good = False
    if not good:
        raise InputError(f"camera {text!r} is not a move: {MOVE_HELP}; shares are above 0, seeds whole numbers")
    return CameraMove(kind, amount)


@dataclasses.dataclass(frozen=True, eq=False)
class MovingCamera:
    """A camera that moves about what it looks at."""

    start: Camera
    pivot: np.ndarray  # (3,) what it turns around, world units
    up: np.ndarray  # (3,) unit vector
    moves: Sequence[CameraMove]  # one after the other
    count: int  # frames of the film
    rate: float = 24.0  # frames per second

    def at(self, frame: float, place_of: Callable[[str], np.ndarray] | None = None) -> Camera:
        """The camera at a frame, or between two; place_of: where a part that is followed is there, (3,)."""
        camera = self.start
        for move in self.moves:
            if move.kind == "turn":
                angle = self._angle(move, frame)
                camera = turned(camera, self.pivot, self.up, angle)
                if move.reach is not None:
                    share = float(np.interp(math.degrees(angle), np.arange(360.0), move.reach, period=360.0))
                    camera = _brought(camera, (share - 1.0) * (camera.center - self.pivot))
            elif move.kind == "dolly":
                camera = self._nearer(camera, move, frame)
            elif move.kind == "crane":
                camera = self._raised(camera, MOVES["crane"] if move.amount is None else move.amount, frame)
            elif move.kind == "hand-held":
                camera = self._swayed(camera, int(move.amount or 0), frame)
            elif place_of is not None:
                camera = looking(camera, place_of(move.part), self.up)
        return camera

    def _eased(self, frame: float) -> float:
        """From 0 at the first frame to 1 at the last one, gently at both."""
        share = min(max(frame / max(1, self.count - 1), 0.0), 1.0)
        return share * share * (3.0 - 2.0 * share)

    def _angle(self, move: CameraMove, frame: float) -> float:
        """Radians."""
        if move.arc is not None:  # through both ends and back, so that the film loops
            middle, half = 0.5 * (move.arc[0] + move.arc[1]), 0.5 * (move.arc[1] - move.arc[0])
            begin = math.asin(min(max(-middle / half, -1.0), 1.0)) if half > 0.0 else 0.0
            return math.radians(middle + half * math.sin(begin + 2.0 * math.pi * frame / self.count))
        degrees = MOVES["turn"] if move.amount is None else move.amount
        steps = self.count if degrees % 360 == 0 else max(1, self.count - 1)  # after a full turn comes the first again
        return float(np.radians(degrees) * frame / steps)

    def _nearer(self, camera: Camera, move: CameraMove, frame: float) -> Camera:
        ahead = float((self.pivot - camera.center) @ camera.rotation[:, 2])
        if ahead <= 0.0:
            raise InputError("dolly goes towards what the camera looks at, which is behind it: give another camera")
        share = MOVES["dolly"] if move.amount is None else move.amount
        return _brought(camera, self._eased(frame) * (1.0 - share) * ahead * camera.rotation[:, 2])

    def _raised(self, camera: Camera, degrees: float, frame: float) -> Camera:
        offset = camera.center - self.pivot
        level = np.cross(self.up, offset)
        if np.linalg.norm(level) < 1e-9 * np.linalg.norm(offset):
            raise InputError("crane goes up or down beside its target, and the camera is straight above or below it")
        rise = math.degrees(math.asin(np.clip(offset @ self.up / np.linalg.norm(offset), -1.0, 1.0)))
        goal = min(max(rise + degrees, -STEEPEST), STEEPEST)
        # about a level axis a positive angle goes down
        angle = -math.radians(goal - rise) * self._eased(frame)
        return turned(camera, self.pivot, level / np.linalg.norm(level), angle)

    def _swayed(self, camera: Camera, seed: int, frame: float) -> Camera:
        phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (len(SWAYS), len(SWAY_RATES)))
        waves = np.sin(2.0 * np.pi * SWAY_RATES * (1.0 + 0.1 * np.sin(phases)) * frame / self.rate + phases)
        aside, above, roll, across, along = (waves @ SWAY_SHARES) * SWAYS
        axes = camera.rotation
        rotation = axes
        for axis, degrees in ((1, aside), (0, above), (2, roll)):
            rotation = axis_rotation(axes[:, axis], math.radians(degrees)) @ rotation
        distance = float(np.linalg.norm(self.pivot - camera.center))
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = camera.center + distance * (across * axes[:, 0] + along * axes[:, 1])
        return dataclasses.replace(camera, camera_to_world=pose)


def turned(camera: Camera, pivot: np.ndarray, axis: np.ndarray, angle: float) -> Camera:
    """A camera carried around an axis, a unit vector (3,), through pivot (3,), world units, by an angle, radians."""
    turn = np.eye(4)
    turn[:3, :3] = axis_rotation(axis, angle)
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return camera.moved(turn)


def _brought(camera: Camera, way: np.ndarray) -> Camera:
    """A camera moved along a way (3,), world units, looking as before."""
    pose = camera.camera_to_world.copy()
    pose[:3, 3] += way
    return dataclasses.replace(camera, camera_to_world=pose)


def looking(camera: Camera, place: np.ndarray, up: np.ndarray) -> Camera:
    """A camera turned where it stands, so that a place (3,) comes to the middle of its picture; it stands level."""
    there = Camera.look_at(camera.center, place, up=up)
    return dataclasses.replace(camera, camera_to_world=there.camera_to_world)


@dataclasses.dataclass(frozen=True, eq=False)
class RefinedCameras:
    """The cameras of a fit's pictures as it refined them."""

    names: list[str]
    cameras: list[Camera]  # in the field's world
    gains: np.ndarray  # (n, 3) float64, what the field's red, green and blue are multiplied by in each picture
    offsets: np.ndarray  # (n, 3) float64, what is added to them then
    given: list[Camera] = dataclasses.field(default_factory=list)  # as they were before; left out, the same

    def __post_init__(self) -> None:
        if not self.given:
            object.__setattr__(self, "given", list(self.cameras))

    def __len__(self) -> int:
        return len(self.cameras)

    def save(self, path: PathLike) -> pathlib.Path:
        """Write them as a camera file, whole or not at all, which `load_scene(path, cameras=...)` takes for its
        pictures."""
        keys = [CameraKey(camera, name=name) for name, camera in zip(self.names, self.cameras, strict=True)]
        # an `exposure` with gain and offset for each, which readers of cameras pass over
        CameraFile(keys).save(path, extras=[{"exposure": exposure} for exposure in self._exposures()])
        return pathlib.Path(path)

    def moved_along(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Other cameras of the same capture, moved as those near them: by the medians of the six nearest ones' turns
        and shifts, focal lengths with those of their lens."""
        return moved_along(cameras, self.given, self.cameras)

    def shrunk(self, divisor: float) -> RefinedCameras:
        """Those of a smaller world; divisor: old lengths over new ones."""
        moved = Similarity(1.0 / divisor, np.eye(3), np.zeros(3)).moved
        return dataclasses.replace(self, cameras=moved(self.cameras), given=moved(self.given))

    def entries(self) -> list[dict[str, Any]]:
        """All of it as JSON takes it, a picture an entry, as files of fields hold it."""
        rows = zip(self.names, self.cameras, self.given, self._exposures(), strict=True)
        return [
            camera_json(CameraKey(camera, name=name)) | {"given": camera_json(CameraKey(given)), "exposure": exposure}
            for name, camera, given, exposure in rows
        ]

    @classmethod
    def from_entries(cls, entries: Sequence[dict[str, Any]]) -> RefinedCameras:
        """What `entries` says. ValueError, KeyError or TypeError where they do not hold it."""
        keys, given = (
            [camera_from_json(entry, index) for index, entry in enumerate(rows)]
            for rows in (entries, [entry["given"] for entry in entries])
        )
        gains, offsets = (
            np.array([entry["exposure"][name] for entry in entries], np.float64) for name in ("gain", "offset")
        )
        for values in (gains, offsets):
            if values.shape != (len(keys), 3) or not np.isfinite(values).all():
                raise InputError("refined cameras have exposures that are not three finite numbers each")
        return cls(
            [key.name for key in keys], [key.camera for key in keys], gains, offsets, [key.camera for key in given]
        )

    def _exposures(self) -> list[dict[str, list[float]]]:
        pairs = zip(self.gains.tolist(), self.offsets.tolist(), strict=True)
        return [{"gain": gain, "offset": offset} for gain, offset in pairs]
