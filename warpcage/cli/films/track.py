"""Where the camera of a film is at each frame, and between two, by the options of `warpcage animate`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

import numpy as np

from ...cage.cage import Cage
from ...cage.pose_file import PoseFile
from ...coordinates.coordinates import deform_points
from ...errors import InputError
from ...field.selection import NodeSelection
from ...films.edits import Deformation
from ...films.words import read_rest
from ...scene.coverage import within_sight
from ...view.camera import Camera
from ...view.camera_path import CameraMove, MovingCamera, camera_at, camera_moves, path_cameras
from ...view.motion import cameras_along
from .. import shared
from ..arguments import options
from ..cameras import (
    camera_file,
    camera_keys,
    chosen_camera,
    chosen_target,
    fitted_to,
    middle,
    seen_cameras,
    sized_cameras,
)

#: Frames of a film, or places between them, counted from 0, to the camera of each.
CameraTrack = Callable[[Sequence[float]], list[Camera]]


def camera_track(
    args: argparse.Namespace,
    field: shared.AnyField,
    deformation: Deformation | None,
    points: np.ndarray,  # (n, 3) around what the film shows, world units
    film: PoseFile | None,  # keys that hold cameras too
    time_of: Callable[[float], float] | None,  # seconds of a frame where there are keys at times
    cages_at: Callable[[float], Sequence[Cage | None]],  # of a frame
) -> CameraTrack:
    """The camera of a film; that of the film's keys where no option names another."""
    named = (args.cameras, args.turn, args.camera, args.view, args.eye, args.target)
    if film is not None and time_of is not None and all(one is None for one in named):
        return lambda frames: [fitted_to(film.camera_at(time_of(frame)), args) for frame in frames]
    moves = None if args.cameras is None else camera_moves(args.cameras)
    if args.cameras is None or moves is not None:
        if moves is not None and args.turn is not None:
            raise InputError("--cameras turn:DEGREES says how far the camera turns: leave --turn and --full-turn out")
        moves = moves or [CameraMove("turn", args.turn)]
        axis = np.asarray(args.up, np.float64)
        if np.linalg.norm(axis) == 0:
            raise InputError("--up must not be 0 0 0")
        camera, pivot = chosen_camera(args, points), chosen_target(args, points)
        moving = MovingCamera(camera, pivot, axis / np.linalg.norm(axis), moves, args.frames, float(args.fps))
        anywhere = all(one is None for one in (args.camera, args.view, args.eye, args.target))
        moving, notes = within_sight(moving, seen_cameras(args, field), anywhere=anywhere)
        for note in notes:
            print(f"warpcage: {note}", file=sys.stderr)
        followed = {move.part: Followed(move.part, field, deformation) for move in moves if move.kind == "follow"}
        return lambda frames: [
            moving.at(frame, lambda part, frame=frame: followed[part].at(cages_at(frame))) for frame in frames
        ]
    if any(given is not None for given in (args.turn, args.camera, args.view, args.frame, args.eye, args.target)):
        raise InputError("--cameras cannot be combined with --turn, --camera, --view, --frame, --eye or --target")
    if camera_file(args.cameras):
        keys = camera_keys(args, args.cameras)
        if time_of is not None and all(key.time is not None for key in keys):
            # of one film with the keys of the poses
            return lambda frames: [camera_at(keys, time_of(frame)) for frame in frames]
        return lambda frames: path_cameras(keys, args.frames, frames)
    cameras = sized_cameras(args, args.cameras)
    return lambda frames: cameras_along(cameras, args.frames, args.interpolation, frames)


class Followed:
    """Where a part is that a film's camera follows: the cage of an edit, or a region that cages carry."""

    def __init__(self, part: str, field: shared.AnyField, deformation: Deformation | None):
        self._edits = [] if deformation is None else deformation.edits
        self._number = 0
        self._points: np.ndarray | None = None  # (n, 3) of a region at rest
        if part == "" or part.isdigit():
            self._number = int(part or 1) - 1
            if not 0 <= self._number < len(self._edits):
                raise InputError(f"follow:{part}: there is no such edit, the film has {len(self._edits)}")
        elif part.lower().endswith(options.SELECTION_ENDINGS):
            self._points = NodeSelection.load(part, field).points
        else:
            self._points = read_rest(part, None, field, part=True)[0].vertices

    def at(self, cages: Sequence[Cage | None]) -> np.ndarray:
        """(3,) its middle, where the cages are posed so."""
        if self._points is None:
            posed = cages[self._number] if cages else None
            return middle((self._edits[self._number].cage if posed is None else posed).vertices)
        points = self._points.copy()
        for edit, posed in zip(self._edits, cages, strict=True):
            inside = edit.cage.contains(self._points)
            if posed is not None and inside.any():
                points[inside] = deform_points(self._points[inside], edit.cage, posed)
        return middle(points)
