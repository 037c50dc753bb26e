"""`warpcage render --cameras`: pictures from all cameras of a scene, or from cameras between them."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Iterable, Iterator

import numpy as np

from ..core.names import counted
from ..core.overlap import Beside
from ..view.camera import Camera
from ..view.camera_path import path_cameras
from ..view.film import FILM_ENDINGS, write_film
from ..view.frame import Frame
from ..view.motion import cameras_along
from . import inputs, options, outputs, view
from .arguments.render import STEPS
from .deformation import read_deformation

#: Frames per second of films.
VIDEO_RATE, GIF_RATE = 24, 15

#: Options that are for a single picture.
SINGLE = ("disparity", "depth", "alpha", "masks", "camera", "view", "frame", "eye", "target")


def run(args: argparse.Namespace) -> None:
    """Render them all."""
    output = _checked_output(args.output)
    transparent = outputs.checked_opacity(args, output)
    if args.scene is None:
        raise ValueError("--cameras needs --scene, the scene of the cameras")
    if any(getattr(args, name) is not None for name in SINGLE):
        name = next(name for name in SINGLE if getattr(args, name) is not None)
        raise ValueError(f"--cameras cannot be combined with --{name}, which is for one picture")
    view.check_saved(args)
    if args.cameras == "given" and args.frames is not None:
        raise ValueError("--frames belongs to --cameras interpolate")
    field = inputs.read_field(args)
    inputs.require_fillable(args, field)
    cameras = chosen_cameras(args)
    deformation = read_deformation(args, field)
    inputs.set_lattice(args, cameras[0])
    renderer = inputs.posed_renderer(field, deformation, args)
    drawn = inputs.drawn_cages(renderer, deformation) if args.overlay else ()

    def pictures() -> Iterator[tuple[np.ndarray, Frame, Camera]]:
        for camera in cameras:
            frame = inputs.render_view(renderer, camera, args)
            yield outputs.colours(frame, camera, drawn, transparent), frame, camera

    view.save_cameras(args, cameras)
    _write(output, pictures(), args.format or "png")
    size = outputs.size_text(cameras[0].width, cameras[0].height, output)
    print(f"wrote {output}: {counted(len(cameras), 'picture')} of {size}")


def chosen_cameras(args: argparse.Namespace) -> list[Camera]:
    """One camera per picture."""
    if view.camera_file(args.scene):
        keys = view.camera_keys(args, args.scene)
        if args.cameras == "interpolate":
            return path_cameras(keys, args.frames or max(1, STEPS * (len(keys) - 1) + 1))
        return [key.camera for key in keys]
    cameras = view.sized_cameras(args, args.scene)
    if args.cameras == "given":
        return cameras
    return cameras_along(cameras, args.frames or max(1, STEPS * (len(cameras) - 1) + 1))


def _checked_output(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.suffix:
        return options.check_output(text, FILM_ENDINGS, "film (a folder of pictures has no ending)")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"{text!r} exists already: --cameras writes a new or an empty folder, or a film")
    options.check_parent(path)
    return path


def _write(output: pathlib.Path, pictures: Iterable[tuple[np.ndarray, Frame, Camera]], kind: str) -> None:
    if output.suffix:
        rate = GIF_RATE if output.suffix.lower() == ".gif" else VIDEO_RATE
        write_film(output, (outputs.finished(image) for image, _, _ in pictures), rate)
        return
    with Beside() as beside:
        for index, (image, frame, camera) in enumerate(pictures):
            beside.run(*outputs.picture_task(output / f"view_{index:04d}.{kind}", image, frame, camera))
