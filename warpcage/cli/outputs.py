"""Pictures of the parts of a frame, and warnings about what its masks mark."""

from __future__ import annotations

import argparse
import functools
import os
import pathlib
import sys
from collections.abc import Callable, Sequence

import numpy as np

from ..mesh.mesh import ClosedMesh
from ..view.camera import Camera
from ..view.exr import depth_along_view, require_openexr, write_exr
from ..view.film import film_size, require_clear_film
from ..view.frame import Frame
from ..view.frame_parts import MASKS
from ..view.frame_parts import disparity_scale as disparity_scale
from ..view.frame_parts import mask_shares as mask_shares
from ..view.frame_parts import picture as picture
from ..view.opacity import rgba_picture
from ..view.pictures import write_png
from . import inputs


def colours(frame: Frame, camera: Camera, cages: Sequence[ClosedMesh], transparent: bool) -> np.ndarray:
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
        raise ValueError("--format is for folders of pictures: the ending of a film says what it is")
    require_format(args.format or "")
    transparent = inputs.is_transparent(args)
    if transparent:
        require_clear_film(output)
    return transparent


def require_format(path: str | os.PathLike) -> None:
    """Raises ValueError for an OpenEXR file where its library is not installed, before any long work."""
    if os.fspath(path).lower().endswith("exr"):
        require_openexr()


def picture_task(
    path: str | os.PathLike, image: np.ndarray, frame: Frame, camera: Camera
) -> tuple[Callable[[], None], int]:
    """What writes a picture of a frame, .png, or .exr with its depth, in any thread, and the bytes that it holds."""
    # It needs neither the frame any more, nor what that has on a device.
    depth = depth_along_view(frame, camera) if os.fspath(path).lower().endswith(".exr") else None
    return functools.partial(write_picture, path, image, depth), image.nbytes + (0 if depth is None else depth.nbytes)


def write_picture(path: str | os.PathLike, image: np.ndarray, depth: np.ndarray | None) -> None:
    """Write a picture, .exr where it comes with its depth along the view, else .png."""
    if depth is None:
        write_png(path, image)
    else:
        write_exr(path, image, depth)


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
