"""The frames of a film, by their numbers."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ...cage.cage import Cage
from ...cage.pose_file import PoseFile
from ...deform.deformer import Deformer
from ...deform.stage import Stage
from ...edits.place import PlaceFile
from ...errors import InputError
from ...films.edits import Deformation
from ...films.render import HeldPose, drawn_cages, finished, picture_task
from ...view import frame_parts
from ...view.camera import Camera
from ...view.exr import mean_picture
from ...view.frame import Frame
from ...view.motion import frame_places, frame_rate, time_at
from .. import shared
from ..render import seen_points, warn_of_masks
from .jobs import FilmFrame
from .staging import Staging
from .track import camera_track


class Shot:
    """Renders frames by index, so that a folder can be continued anywhere."""

    def __init__(
        self,
        field: shared.AnyField,
        deformation: Deformation | None,  # None where the field is shown as it is
        args: argparse.Namespace,
        film: PoseFile | PlaceFile | None = None,  # keys at times, where there are any
        staging: Staging | None = None,  # what stands beside the field
    ):
        self.staging = staging
        self.field, self.deformation, self.args, self.film = field, deformation, args, film
        self.look = shared.chosen_look(args)
        self.posed: HeldPose | None = None  # None where the field is shown as it is, or where others render
        keys = None if film is None or deformation is None else deformation.camera_film
        points, time_of = seen_points(field, deformation, args, staging), None if film is None else self.time
        self.track = camera_track(args, field, deformation, points, keys, time_of, self.cages)
        self.cameras = self.track(range(args.frames))  # one a frame
        self.shares: dict[str, list[float]] = {}
        self.scale: tuple[float, float] | None = None  # low and high disparity

    def prepare(self) -> None:
        """Make what renders here."""
        if self.deformation is not None:
            self.posed = HeldPose(shared.make_deformer(self.field, self.deformation, self.args))
        self.scale = self._scale() if self.args.show in ("depth", "disparity") else None

    def is_still(self) -> bool:
        """Whether several frames are one picture."""
        poses = [camera.camera_to_world for camera in self.cameras]
        if len(poses) < 2 or any(not np.array_equal(pose, poses[0]) for pose in poses):
            return False
        if self.staging is not None and self.staging.longest(None) is not None:
            return False
        if self.deformation is None or self.deformation.is_still:
            return True
        return len({self.place(frame) for frame in range(len(poses))}) == 1

    def time(self, frame: float) -> float:
        """Seconds of a frame, or between two, where there are keys at times."""
        assert self.film is not None
        return time_at(frame, self.film.length, frame_rate(self.args.fps), self.args.loop)

    def place(self, frame: float) -> float:
        """Where the poses are at a frame, or between two: a time, or a place among them."""
        if self.film is not None:
            return self.time(frame)
        count = 1 if self.deformation is None else self.deformation.pose_count
        return float(frame_places(self.args.frames, count, self.args.motion, self.args.interpolation, [frame])[0])

    def cages(self, frame: float) -> list[Cage | None]:
        """The posed cages of a frame, or between two, one an edit; None for what is removed."""
        if self.deformation is None:
            return []
        place = self.place(frame)
        try:
            return self.deformation.at(place) if self.film is None else self.deformation.at_time(place)
        except ValueError as error:
            raise InputError(f"frame {frame:g}, between the poses: {error}") from error

    def frame(self, frame: float, camera: Camera) -> tuple[Frame, list[Cage]]:
        """A frame, or what is between two, and the cages that it shows."""
        if self.posed is None:
            return self.look.render(self._scene(self.field, frame), camera), []
        cages = self.cages(frame)
        try:
            self.posed.pose(cages)
        except ValueError as error:
            raise InputError(f"frame {frame:g}, between the poses: {error}") from error
        deformer = self.posed.deformer
        return self.look.render(self._scene(deformer, frame), camera), drawn_cages(deformer)

    def _scene(self, renderer: shared.AnyField | Deformer, frame: float) -> shared.AnyField | Deformer | Stage:
        """What a frame shows: what renders the field, alone or among others as they are then."""
        if self.staging is None:
            return renderer
        self.staging.at(frame / float(self.args.fps) if self.film is None else self.time(frame))
        return self.staging.with_main(renderer)

    def taken(self, index: int) -> tuple[np.ndarray, Frame, Camera]:
        """What the film shows of a frame, (h, w, 3), (h, w) or, with opacity, (h, w, 4), and the frame itself."""
        camera = self.cameras[index]
        if self.args.shutter is None:
            frame, cages = self.frame(index, camera)
            return self._shown(frame, cages, camera), frame, camera
        share, count = self.args.shutter
        moments = index + share * ((np.arange(count) + 0.5) / count - 0.5)  # the frame is in the middle of them
        pictures, middle = [], None
        for number, (moment, moved) in enumerate(zip(moments, self.track(moments), strict=True)):
            frame, cages = self.frame(float(moment), moved)
            pictures.append(self._shown(frame, cages, moved))
            middle = (frame, moved) if number == count // 2 else middle
        assert middle is not None
        return mean_picture(pictures), *middle

    def picture(self, index: int) -> np.ndarray:
        """What the film shows of a frame; not to be written to."""
        return finished(self.taken(index)[0])

    def task(self, index: int, path: pathlib.Path) -> tuple[Callable[[], None], int]:
        """Render a frame. Returns what writes its picture to a file, in any thread, and the bytes that it holds."""
        return picture_task(path, *self.taken(index))

    def _shown(self, frame: Frame, cages: Sequence[Cage], camera: Camera) -> np.ndarray:
        if self.args.show == "masks":
            for name, share in frame_parts.mask_shares(frame).items():
                self.shares.setdefault(name, []).append(share)
        return self.look.picture(frame, camera, cages, self.scale)

    def _scale(self) -> tuple[float, float]:
        """From a few frames, always the same ones, so that a folder that is continued keeps its colours."""
        probes = sorted({round(share * (self.args.frames - 1)) for share in (0.0, 0.25, 0.5, 0.75)})
        return frame_parts.disparity_scale([self.frame(index, self.cameras[index])[0] for index in probes])

    def described(self) -> Iterator[FilmFrame]:
        """The frames as items of a job describe them."""
        for index, camera in enumerate(self.cameras):
            yield FilmFrame(index, camera, [None if cage is None else cage.vertices for cage in self.cages(index)])

    def warn(self) -> None:
        """Print what the masks marked on average, if they were asked for."""
        warn_of_masks({name: sum(shares) / len(shares) for name, shares in self.shares.items()}, "the film")
