"""Pictures that commands write: formats, opacity, overlays."""

from __future__ import annotations

import argparse
import functools
import os
import pathlib
import sys
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..cage.cage import Cage
from ..deform.deformer import Deformer
from ..errors import InputError
from ..mesh.mesh import ClosedMesh
from ..view import frame_parts
from ..view.camera import Camera
from ..view.exr import require_openexr, write_picture
from ..view.film import film_size, require_clear_film
from ..view.frame import Frame, depth_along_view
from ..view.frame_parts import MASKS, picture
from ..view.motion import frame_places
from ..view.opacity import rgba_picture
from . import shared
from .films import FilmFrame
from .shared import Deformation


def colors(frame: Frame, camera: Camera, cages: Sequence[ClosedMesh], transparent: bool) -> np.ndarray:
    """The colours of a frame, (h, w, 3), or with straight opacity (h, w, 4); the edges of cages are drawn into it."""
    if transparent:
        return rgba_picture(frame, camera, cages)
    return picture(frame, "rgb", camera, cages)


def finished(image: np.ndarray) -> np.ndarray:
    """A picture that nobody changes any more: a film takes it without a copy."""
    image.flags.writeable = False
    return image


def checked_opacity(args: argparse.Namespace, output: pathlib.Path) -> bool:
    """Whether many pictures have opacity. Raises ValueError where their film or folder cannot hold what was asked."""
    if output.suffix and args.format is not None:
        raise InputError("--format is for folders of pictures: the ending of a film says what it is")
    require_format(args.format or "")
    transparent = shared.is_transparent(args)
    if transparent:
        require_clear_film(output)
    return transparent


def require_format(path: str | os.PathLike[str]) -> None:
    """Raises ValueError for an OpenEXR file where its library is not installed, before any long work."""
    if os.fspath(path).lower().endswith("exr"):
        require_openexr()


def picture_task(
    path: str | os.PathLike[str], image: np.ndarray, frame: Frame, camera: Camera
) -> tuple[Callable[[], None], int]:
    """What writes a picture of a frame, .png, or .exr with its depth, in any thread, and the bytes that it holds."""
    # It needs neither the frame any more, nor what that has on a device.
    depth = depth_along_view(frame, camera) if os.fspath(path).lower().endswith(".exr") else None
    return functools.partial(write_picture, path, image, depth), image.nbytes + (0 if depth is None else depth.nbytes)


def size_text(width: int, height: int, output: pathlib.Path) -> str:
    """The size of what is written, in words, and why it is not that of the pictures where it is not."""
    written = film_size(width, height, output.suffix.lower())
    cut = f" (cut from {width}x{height}: an MP4 has even sides)" if written != (width, height) else ""
    return f"{written[0]}x{written[1]}{cut}"


def warn_of_masks(shares: dict[str, float], where: str = "the picture") -> None:
    """Print a line on stderr for each mask that marks anything; where: how the line calls the picture."""
    for name, share in shares.items():
        if share > 0:
            print(f"warpcage: warning: {100 * share:.2f} % of {where} {MASKS[name][1]}", file=sys.stderr)


class Shot:
    """Renders frames by index, so that a folder can be continued anywhere."""

    def __init__(
        self,
        field: shared.AnyField,
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
            raise InputError(f"frame {index}, between the poses: {error}") from error

    def frame(self, index: int) -> tuple[Frame, list[Cage]]:
        """The frame, and the cages that it shows."""
        camera = self.cameras[index]
        if self.deformer is None or self.deformation is None:
            return shared.render_view(self.field, camera, self.args), []
        place = self.places[index]
        cages = self.cages(index)
        try:
            if place != self.held:
                self.deformer.pose(cages)
                self.held = place
        except ValueError as error:
            raise InputError(f"frame {index}, between the poses: {error}") from error
        frame = shared.render_view(self.deformer, camera, self.args)
        return frame, self.deformation.drawn(self.deformer.deformed or cages)

    def picture(self, index: int) -> np.ndarray:
        """What the film shows of a frame, (h, w, 3), (h, w) or, with opacity, (h, w, 4); not to be written to."""
        return finished(self._shown(*self.frame(index), self.cameras[index]))

    def task(self, index: int, path: pathlib.Path) -> tuple[Callable[[], None], int]:
        """Render a frame. Returns what writes its picture to a file, in any thread, and the bytes that it holds."""
        (frame, cages), camera = self.frame(index), self.cameras[index]
        return picture_task(path, self._shown(frame, cages, camera), frame, camera)

    def _shown(self, frame: Frame, cages: Sequence[Cage], camera: Camera) -> np.ndarray:
        if self.args.show == "masks":
            for name, share in frame_parts.mask_shares(frame).items():
                self.shares.setdefault(name, []).append(share)
        drawn = cages if self.args.overlay else ()
        if self.args.show == "rgb":
            return colors(frame, camera, drawn, shared.is_transparent(self.args))
        return frame_parts.picture(frame, self.args.show, camera, drawn, self.scale)

    def _scale(self) -> tuple[float, float]:
        """From a few frames, always the same ones, so that a folder that is continued keeps its colours."""
        probes = sorted({round(share * (self.args.frames - 1)) for share in (0.0, 0.25, 0.5, 0.75)})
        return frame_parts.disparity_scale([self.frame(index)[0] for index in probes])

    def described(self) -> Iterator[FilmFrame]:
        """The frames as items of a job describe them."""
        for index, camera in enumerate(self.cameras):
            yield FilmFrame(index, camera, [None if cage is None else cage.vertices for cage in self.cages(index)])

    def warn(self) -> None:
        """Print what the masks marked on average, if they were asked for."""
        warn_of_masks({name: sum(shares) / len(shares) for name, shares in self.shares.items()}, "the film")
