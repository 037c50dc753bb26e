"""Moves of a film's camera by name: turns, dollies, cranes, hand-held shake, and following a part."""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Callable, Sequence

import numpy as np

from ...core.names import MOVE_HELP, MOVES
from ...errors import InputError
from ...scene.coverage import elevations, find_coverage
from ...view.camera import Camera
from ...view.motion import axis_rotation


@dataclasses.dataclass(frozen=True)
class CameraMove:
    """A move of a film's camera, from a spec such as turn, turn:90, dolly:0.6, crane:20, hand-held:7 or follow:PART."""

    kind: str
    amount: float | None = None  # degrees of a turn and a crane, share of the distance of a dolly, seed; None: default
    part: str = ""  # what is followed; "" for the first edit
    arc: tuple[float, float] | None = None  # of a turn there and back instead of an amount, degrees from the camera
    reach: np.ndarray | None = None  # (360,) shares of its distance to which it goes nearer, by degrees from the camera


#: Nearest that a crane comes to straight above or below, degrees.
STEEPEST = 89.0

#: Hand-held shake: frequencies, per second, their shares, and the largest sizes: degrees of turns to the side, up and
#: about the axis, and shares of the distance to the side and up.
SWAY_RATES = np.array([0.31, 0.73, 1.31, 2.3])
SWAY_SHARES = np.array([0.45, 0.3, 0.17, 0.08])
SWAYS = (0.5, 0.4, 0.3, 0.006, 0.006)


def camera_moves(text: str) -> list[CameraMove] | None:
    """The moves of a spec, joined by "+"; None for other texts, such as names of files."""
    if not isinstance(text, str):
        return None
    specs = [spec.partition(":") for spec in text.split("+")]
    if specs[0][0] not in MOVES or pathlib.Path(text).exists():
        return None
    return [_move(kind, value, text) for kind, _, value in specs]


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


def within_sight(
    moving: MovingCamera, cameras: Sequence[Camera], *, anywhere: bool = False
) -> tuple[MovingCamera, list[str]]:
    """A film's camera whose turns and cranes without an amount stay within what cameras saw, and notes on them.
    anywhere: the camera may start in the middle of what was seen."""
    moves, camera, notes = list(moving.moves), moving.start, []
    if not cameras or all(move.amount is not None or move.kind not in ("turn", "crane") for move in moves):
        return moving, notes
    seen = find_coverage(cameras, moving.pivot, moving.up)
    arc, highest = seen.arc(camera.center), seen.elevation[1]
    for index, move in enumerate(moves):
        if move.kind == "turn" and move.amount is None and arc is not None:
            low, high = arc
            if anywhere and not low <= 0.0 <= high:
                camera = turned(camera, moving.pivot, moving.up, math.radians(0.5 * (low + high)))
                low, high = 0.5 * (low - high), 0.5 * (high - low)
            low, high = min(low, 0.0), max(high, 0.0)
            moves[index] = dataclasses.replace(move, arc=(low, high), reach=seen.reach(camera.center))
            notes.append(
                f"the camera goes there and back through {high - low:.0f} degrees, as no picture shows "
                f"{seen.around:.0f} of 360 around the object: --full-turn goes all the way round"
            )
        elif move.kind == "crane" and move.amount is None:
            rise = float(elevations(((camera.center - moving.pivot) @ seen.frame)[None])[0])
            amount = min(MOVES["crane"], max(highest - rise, 0.0))
            moves[index] = dataclasses.replace(move, amount=amount)
            if amount < MOVES["crane"]:
                notes.append(
                    f"the crane rises by {amount:.0f} degrees, to the highest picture: crane:{MOVES['crane']:g} goes on"
                )
    return dataclasses.replace(moving, start=camera, moves=moves), notes
