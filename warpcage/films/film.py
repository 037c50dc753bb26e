"""One film: its frames by their numbers, written to a file, or to a folder which goes on after an interrupt."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..core.files import PathLike
from ..core.overlap import BackgroundWriter
from ..deform.stage import Stage
from ..view import frame_parts
from ..view.camera import Camera
from ..view.exr import mean_picture
from ..view.film import write_film
from ..view.frame import Frame
from .folder import frame_path, make_folder
from .render import Look, Scene, finished, picture_task
from .timeline import CameraTrack

#: What renders a frame, or what is between two, and the cages that an overlay shows then.
Moment = Callable[[float], tuple[Scene, Sequence[Cage]]]


class Film:
    """Renders frames by their numbers, so that a folder can be continued anywhere."""

    def __init__(
        self,
        count: int,
        track: CameraTrack,
        moment: Moment,
        look: Look,
        shutter: tuple[float, int] | None = None,  # share of a frame that it is open for, and moments of it
    ):
        self.count, self.track, self.moment, self.look, self.shutter = count, track, moment, look, shutter
        self.cameras = track(range(count))  # one a frame
        self._shares: dict[str, list[float]] = {}  # what each mask marked of the frames so far
        self._scale: tuple[float, float] | None = None
        self._seen: tuple[Any, ...] | None = None  # what `picture` showed last, and that
        self._picture: np.ndarray | None = None

    @property
    def stands(self) -> bool:
        """Whether the camera of all frames stands in one place."""
        first = self.cameras[0].camera_to_world
        return all(np.array_equal(camera.camera_to_world, first) for camera in self.cameras)

    @property
    def mask_shares(self) -> dict[str, float]:
        """What each mask marked of the frames so far, on average, where masks are shown."""
        return {name: sum(shares) / len(shares) for name, shares in self._shares.items()}

    @property
    def scale(self) -> tuple[float, float] | None:
        """Low and high disparity of pictures of depth and disparity, one for the whole film; None for others."""
        # by a few frames, always the same ones, so that a folder that is continued keeps its colours
        if self._scale is None and self.look.show in ("depth", "disparity"):
            probes = sorted({round(share * (self.count - 1)) for share in (0.0, 0.25, 0.5, 0.75)})
            frames = [self._frame(index, self.cameras[index])[0] for index in probes]
            self._scale = frame_parts.disparity_scale(frames)
        return self._scale

    def taken(self, index: int) -> tuple[np.ndarray, Frame, Camera]:
        """What the film shows of a frame, (h, w, 3), (h, w) or, with opacity, (h, w, 4), and the frame itself."""
        camera = self.cameras[index]
        if self.shutter is None:
            return self._shown(index, camera)
        share, count = self.shutter
        moments = index + share * ((np.arange(count) + 0.5) / count - 0.5)  # the frame is in the middle of them
        pictures, middle = [], None
        for number, (moment, moved) in enumerate(zip(moments, self.track(moments), strict=True)):
            image, *taken = self._shown(float(moment), moved)
            pictures.append(image)
            middle = taken if number == count // 2 else middle
        assert middle is not None
        return mean_picture(pictures), *middle

    def picture(self, index: int) -> np.ndarray:
        """What the film shows of a frame, read-only; where that is what it showed last, the same array."""
        seen = self._looks(index)
        if self._picture is None or seen is None or seen != self._seen:
            self._picture, self._seen = finished(self.taken(index)[0]), seen
        return self._picture

    def _looks(self, index: int) -> tuple[Any, ...] | None:
        """All that decides how a frame looks, None where that is not known, or where each is to be looked at."""
        if self.shutter is not None or self.look.show == "masks":
            return None
        scene, cages = self.moment(index)
        if isinstance(scene, Stage):
            return None
        camera = self.cameras[index]
        lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        return id(scene), lens, camera.camera_to_world.tobytes(), *(cage.vertices.tobytes() for cage in cages)

    def _frame(self, frame: float, camera: Camera) -> tuple[Frame, Sequence[Cage]]:
        scene, cages = self.moment(frame)
        return self.look.render(scene, camera), cages

    def _shown(self, number: float, camera: Camera) -> tuple[np.ndarray, Frame, Camera]:
        scale = self.scale
        frame, cages = self._frame(number, camera)
        if self.look.show == "masks":
            for name, share in frame_parts.mask_shares(frame).items():
                self._shares.setdefault(name, []).append(share)
        return self.look.picture(frame, camera, cages, scale), frame, camera

    def write(self, path: PathLike, fps: float | Fraction, *, loop: bool, numbers: Iterable[int] | None = None) -> None:
        """Write a film, whole or not at all; loop: of a GIF; numbers: those of its frames, for a bar."""
        write_film(path, map(self.picture, range(self.count) if numbers is None else numbers), fps, loop=loop)

    def write_pictures(self, paths: Iterable[pathlib.Path]) -> None:
        """Write the frames to a file each."""
        with BackgroundWriter() as beside:
            for index, path in enumerate(paths):
                task = picture_task(path, *self.taken(index))
                beside.run(*task)
                del task  # what is rendered next may take its place

    def write_folder(
        self,
        folder: pathlib.Path,
        settings: dict[str, Any],  # as `make_folder` has them
        *,
        overwrite: bool = False,
        told: Callable[[Sequence[int]], Any],  # with numbers of frames, a block that goes through them
    ) -> int:
        """Write the frames that a folder does not have yet, and return how many it had."""

        def make(missing: list[int], begin: Callable[[], None]) -> None:
            with told(missing) as frames, BackgroundWriter() as beside:
                for index in frames:
                    task = picture_task(frame_path(folder, index, settings["format"]), *self.taken(index))
                    if index == missing[0]:
                        begin()
                    beside.run(*task)
                    del task  # what is rendered next may take its place

        return make_folder(folder, self.cameras, make, settings, overwrite=overwrite)
