"""`warpcage render -o FOLDER`: a picture of each pose, of one field and from one camera."""

from __future__ import annotations

import argparse
import pathlib

from ..core.names import counted
from ..core.overlap import Beside
from . import inputs, options, outputs, view
from .deformation import read_deformation

#: Options for one picture of one pose.
SINGLE = ("disparity", "depth", "alpha", "masks")


def run(args: argparse.Namespace) -> None:
    """Render them all. The field is read once, and its lattice is made once."""
    folder = _checked_folder(args.output)
    given = [name for name in SINGLE if getattr(args, name) is not None]
    if given:
        raise ValueError(f"--{given[0]} is for one picture: give the name of a picture with -o")
    inputs.require_deformation(args, f"the folder {args.output!r}")
    transparent, kind = outputs.checked_opacity(args, folder), args.format or "png"
    view.check_saved(args)
    field = inputs.read_field(args)
    inputs.require_fillable(args, field)
    deformation = read_deformation(args, field, "linear")
    assert deformation is not None
    camera = view.chosen_camera(args, inputs.visible_points(field, deformation, args.frame))
    inputs.set_lattice(args, camera)
    deformer = inputs.make_deformer(field, deformation, args)
    count = max(1, deformation.pose_count - 1)
    digits = max(4, len(str(count)))
    with Beside() as beside:
        for number in range(1, count + 1):
            cages = deformation.at(float(min(number, deformation.pose_count - 1)))
            try:
                deformer.pose(cages)
            except ValueError as error:
                raise ValueError(f"pose {number} of {count}: {error}") from error
            frame = inputs.render_view(deformer, camera, args)
            drawn = inputs.drawn_cages(deformer, deformation) if args.overlay else ()
            picture = outputs.colours(frame, camera, drawn, transparent)
            path = folder / f"pose_{number:0{digits}d}.{kind}"
            beside.run(*outputs.picture_task(path, picture, frame, camera))
    view.save_cameras(args, [camera])
    print(f"wrote {folder}: {counted(count, 'picture')} of {camera.width}x{camera.height}")


def _checked_folder(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"{text!r} exists already: pictures of several poses go into a new or an empty folder")
    options.check_parent(path)
    return path
