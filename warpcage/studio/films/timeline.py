"""A film in time: its poses, its camera, and what stands beside its field, at each frame and between two."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...cage.pose_file import PoseFile
from ...coordinates.coordinates import deform_points
from ...core.arrays import box_corners
from ...core.names import named_errors
from ...deform.deformer import Deformer
from ...deform.stage import Stage
from ...edits.edits import CageEdit
from ...edits.place import PlaceFile
from ...errors import InputError
from ...select.selection import NodeSelection
from ...select.selection_file import SELECTION_ENDINGS
from ...splats.splat_field import AnyField, SplatField
from ...view.camera import Camera, CameraKey, framing_orbit
from ...view.camera_path import camera_at
from ...view.motion import frame_rate, time_at
from ..spec.film import FilmSpec
from .edits import Deformation
from .motion import frame_places, path_cameras
from .moves import MovingCamera
from .render import HeldPose, Scene, drawn_cages
from .resolve import AssetResolver

#: Where a camera stands for each side that it looks from, degrees: above the ground, and around from +x to +y where z
#: is up. Not quite straight above, so that what is behind the object is above it in the picture.
SIDES = {
    "corner": (25.0, -60.0),
    "front": (0.0, -90.0),
    "right": (0.0, 0.0),
    "back": (0.0, 90.0),
    "left": (0.0, 180.0),
    "top": (89.99, -90.0),
    "bottom": (-89.99, -90.0),
}


def side_camera(points: np.ndarray, side: str = "corner", **view: Any) -> Camera:
    """The camera that sees all points (n, 3) from a side; view: of `framing_orbit`."""
    elevation, azimuth = SIDES[side]
    return framing_orbit(points, 1, elevation_degrees=elevation, start_degrees=azimuth, **view)[0]


#: Frames of a film, or places between them, counted from 0, to the camera of each.
CameraTrack = Callable[[Sequence[float]], list[Camera]]


class Objects:
    """What stands beside a film's own field in one scene, the first of a stage; with what moves.
    of_file: whether the first stays as the stage has it; moving: Deformers on it, and what poses them."""

    def __init__(self, stage: Stage, *, of_file: bool = False, moving: Sequence[tuple[Deformer, Deformation]] = ()):
        self.stage, self.of_file = stage, of_file
        self.moving = [(HeldPose(deformer), deformation) for deformer, deformation in moving]
        self.main = next(iter(stage.items))

    def points(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) points around what a picture shows, world units; points: those around the film's own field."""
        seen = [] if self.of_file else [points]
        times = {0.0, *(time for item in self.stage.items.values() for time in item.places.places)}
        for self.stage.time in sorted(times, reverse=True):  # last the first, where pictures are made
            seen.append(self.stage.shown_points)
        return np.concatenate(seen)

    def with_main(self, renderer: AnyField | Deformer) -> Stage:
        """The stage with what renders the film's own field; the objects of a stage file stay as they are."""
        if not self.of_file and self.stage[self.main] is not renderer:
            self.stage.replace(self.main, renderer)
        return self.stage

    def at(self, seconds: float) -> None:
        """Move all to a time of the film, but for its own field, which its own poses move."""
        self.stage.time = seconds
        for deformer, deformation in self.moving:
            deformer.pose(deformation.at_time(seconds))

    def longest(self, film: PoseFile | PlaceFile | None) -> PoseFile | PlaceFile | None:
        """The keys at times, of poses and of places, that last longest; None where there are none."""
        films: list[PoseFile | PlaceFile] = [] if film is None else [film]
        films += [each.film for _, each in self.moving if each.film is not None]
        films += [item.places for item in self.stage.items.values() if item.places.length > 0.0]
        return max(films, key=lambda each: each.length, default=None)

    def fingerprints(self) -> list[Any]:
        """All that decides how the scene looks besides the film's own field and its poses."""
        items = self.stage.items.items()
        paths = [item.path for _, item in items if item.path is not None and item.path.is_file()]
        files = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
        places = [[name, item.places.to_json()] for name, item in items]
        return [places, files, [deformation.fingerprints() for _, deformation in self.moving]]


@dataclasses.dataclass(eq=False)
class MovingScene:
    """What renders the frames of a film, a field or a Deformer of it, alone or among objects, and its poses in time."""

    field: AnyField
    spec: FilmSpec
    deformation: Deformation
    keys: PoseFile | PlaceFile | None = None  # keys at times that say how long the film is, where there are any
    objects: Objects | None = None
    _posed: HeldPose | None = dataclasses.field(default=None, init=False)

    def render_by(self, deformer: Deformer) -> None:
        """Have the field rendered by a Deformer, which may be made late: for other frames than these none is needed."""
        self._posed = HeldPose(deformer)

    def time(self, frame: float) -> float:
        """Seconds of a frame, or between two."""
        if self.keys is None:
            return frame / float(self.spec.fps)
        return time_at(frame, self.keys.length, frame_rate(self.spec.fps), self.spec.loop or "once")

    def cages(self, frame: float) -> list[Cage | None]:
        """The posed cages of a frame, or between two, one an edit; None for what is removed."""
        with named_errors(f"frame {frame:g}, between the poses"):
            if self.keys is not None:
                return self.deformation.at_time(self.time(frame))
            return self.deformation.at(self._place(frame))

    def is_still(self) -> bool:
        """Whether nothing moves but the camera."""
        place = self._place if self.keys is None else self.time
        held = self.deformation.is_still or len({place(frame) for frame in range(self.spec.frames)}) == 1
        return held and (self.objects is None or self.objects.longest(None) is None)

    def _place(self, frame: float) -> float:
        """Where a frame is among poses without times."""
        spec, count = self.spec, self.deformation.pose_count
        return float(frame_places(spec.frames, count, spec.motion, spec.interpolation, [frame])[0])

    def __call__(self, frame: float) -> tuple[Scene, list[Cage]]:
        """What renders a frame, or what is between two, and the cages that an overlay shows."""
        renderer, cages = self.field, list[Cage]()
        if self._posed is not None:
            posed, renderer = self.cages(frame), self._posed.deformer
            with named_errors(f"frame {frame:g}, between the poses"):
                self._posed.pose(posed)
            cages = drawn_cages(renderer)
        if self.objects is None:
            return renderer, cages
        self.objects.at(self.time(frame))
        return self.objects.with_main(renderer), cages


def moving_track(
    moving: MovingCamera,
    field: AnyField,
    edits: Sequence[CageEdit],
    cages_at: Callable[[float], Sequence[Cage | None]],  # posed cages of a frame, one an edit
    resolver: AssetResolver,
) -> CameraTrack:
    """The track of a camera that moves; it may follow the edits and what they carry."""
    parts = [move.part for move in moving.moves if move.kind == "follow"]
    followed = {part: _followed(part, field, edits, resolver) for part in parts}
    return lambda frames: [
        moving.at(frame, lambda part, frame=frame: followed[part](cages_at(frame))) for frame in frames
    ]


def keyed_track(keys: Sequence[CameraKey], count: int, time: Callable[[float], float] | None) -> CameraTrack:
    """The track of camera keys: at their times where they have some, or else evenly over so many frames.
    time: gives the seconds of a frame; None: the film has no times of its own."""
    if time is not None and all(key.time is not None for key in keys):
        return lambda frames: [camera_at(keys, time(frame)) for frame in frames]
    return lambda frames: path_cameras(keys, count, frames)


def _followed(
    part: str, field: AnyField, edits: Sequence[CageEdit], resolver: AssetResolver
) -> Callable[[Sequence[Cage | None]], np.ndarray]:
    """What finds the middle (3,) of a part, the cage of an edit or a region that cages carry, where they are posed."""
    if part == "" or part.isdigit():
        number = int(part or 1) - 1
        if not 0 <= number < len(edits):
            raise InputError(f"follow:{part}: there is no such edit, the film has {len(edits)}")
        return lambda cages: middle(((cages[number] if cages else None) or edits[number].cage).vertices)
    if part.lower().endswith(SELECTION_ENDINGS):
        rest = NodeSelection.load(part, field).points
    else:
        rest = resolver.rest(part, None, field, part=True).cage.vertices

    def region(cages: Sequence[Cage | None]) -> np.ndarray:
        points = rest.copy()
        for edit, posed in zip(edits, cages, strict=True):
            inside = edit.cage.contains(rest)
            if posed is not None and inside.any():
                points[inside] = deform_points(rest[inside], edit.cage, posed)
        return middle(points)

    return region


def middle(points: np.ndarray) -> np.ndarray:
    """(3,) middle of the bounding box of points (n, 3)."""
    return (points.min(axis=0) + points.max(axis=0)) / 2


def shown_corners(field: AnyField) -> np.ndarray:
    """(8, 3) corners of the box of what a field shows, world units."""
    return box_corners(field.shown_bounds if isinstance(field, SplatField) else field.bounds)
