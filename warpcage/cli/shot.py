"""Frames of `warpcage animate`, by their numbers."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..cage.cage import Cage
from ..deform.deformer import Deformer
from ..view.camera import Camera
from ..view.frame import Frame
from ..view.motion import frame_places
from . import inputs, outputs
from .deformation import Deformation
from .film_jobs import FilmFrame


class Shot:
    """Renders frames by index, so that a folder can be continued anywhere."""

    def __init__(
        self,
        field: inputs.AnyField,
        deformer: Deformer | None,  # None where the field is shown as it is, or where others render
        deformation: Deformation | None,  # None where the field is shown as it is
        cameras: list[Camera],  # one a frame
        args: argparse.Namespace,
        times: list[float] | None = None,  # seconds of each frame, where there are keys at times
    ):
        self.times = times
        self.field, self.deformer, self.deformation = field, deformer, deformation
        self.cameras, self.args = cameras, args
        count = 1 if deformation is None else deformation.pose_count
        places = frame_places(args.frames, count, args.motion, args.interpolation) if times is None else times
        self.places = [float(place) for place in places]
        self.held: float | None = None  # the place that the deformer is posed at
        self.shares: dict[str, list[float]] = {}
        self.scale = self._scale() if args.show in ("depth", "disparity") else None  # low and high disparity

    def cages(self, index: int) -> list[Cage | None]:
        """The posed cages of a frame, one an edit; None for what is removed."""
        if self.deformation is None:
            return []
        place = self.places[index]
        try:
            return self.deformation.at(place) if self.times is None else self.deformation.at_time(place)
        except ValueError as error:
            raise ValueError(f"frame {index}, between the poses: {error}") from error

    def frame(self, index: int) -> tuple[Frame, list[Cage]]:
        """The frame, and the cages that it shows."""
        camera = self.cameras[index]
        if self.deformer is None or self.deformation is None:
            return inputs.render_view(self.field, camera, self.args), []
        place = self.places[index]
        cages = self.cages(index)
        try:
            if place != self.held:
                self.deformer.pose(cages)
                self.held = place
        except ValueError as error:
            raise ValueError(f"frame {index}, between the poses: {error}") from error
        frame = inputs.render_view(self.deformer, camera, self.args)
        return frame, self.deformation.drawn(self.deformer.deformed or cages)

    def picture(self, index: int) -> np.ndarray:
        """What the film shows of a frame, (h, w, 3), (h, w) or, with opacity, (h, w, 4); not to be written to."""
        return outputs.finished(self._shown(*self.frame(index), self.cameras[index]))

    def task(self, index: int, path: pathlib.Path) -> tuple[Callable[[], None], int]:
        """Render a frame. Returns what writes its picture to a file, in any thread, and the bytes that it holds."""
        (frame, cages), camera = self.frame(index), self.cameras[index]
        return outputs.picture_task(path, self._shown(frame, cages, camera), frame, camera)

    def _shown(self, frame: Frame, cages: Sequence[Cage], camera: Camera) -> np.ndarray:
        if self.args.show == "masks":
            for name, share in outputs.mask_shares(frame).items():
                self.shares.setdefault(name, []).append(share)
        drawn = cages if self.args.overlay else ()
        if self.args.show == "rgb":
            return outputs.colours(frame, camera, drawn, inputs.is_transparent(self.args))
        return outputs.picture(frame, self.args.show, camera, drawn, self.scale)

    def _scale(self) -> tuple[float, float]:
        """From a few frames, always the same ones, so that a folder that is continued keeps its colours."""
        probes = sorted({round(share * (self.args.frames - 1)) for share in (0.0, 0.25, 0.5, 0.75)})
        return outputs.disparity_scale([self.frame(index)[0] for index in probes])

    def described(self) -> Iterator[FilmFrame]:
        """The frames as items of a job describe them."""
        for index, camera in enumerate(self.cameras):
            yield FilmFrame(index, camera, [None if cage is None else cage.vertices for cage in self.cages(index)])

    def warn(self) -> None:
        """Print what the masks marked on average, if they were asked for."""
        outputs.warn_of_masks({name: sum(shares) / len(shares) for name, shares in self.shares.items()}, "the film")
