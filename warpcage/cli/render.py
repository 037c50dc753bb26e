"""`warpcage render`: pictures of a field, as it is or deformed."""

from __future__ import annotations

import argparse
import pathlib

from ..view.pictures import write_png
from . import flight, inputs, many_poses, options, outputs, view
from .deformation import read_deformation


def run(args: argparse.Namespace) -> None:
    if args.overlay:
        inputs.require_deformation(args, "--overlay")
    if args.cameras is not None:
        return flight.run(args)
    if args.scene is not None or args.frames is not None:
        raise ValueError("--scene and --frames belong to --cameras")
    if not pathlib.Path(args.output).suffix and inputs.is_deformed(args):
        return many_poses.run(args)
    if args.posed is not None and len(args.posed) > 1:
        raise ValueError(f"{len(args.posed)} poses make as many pictures: give a folder with -o, which has no ending")
    if args.format is not None:
        raise ValueError("--format is for folders of pictures: the ending of a single one says what it is")
    output = options.check_output(args.output, (".png", ".exr"), "picture")
    outputs.require_format(output)
    view.check_saved(args)
    transparent = inputs.is_transparent(args)
    extra = {
        kind: options.check_output(getattr(args, kind), (".png",), "picture")
        for kind in ("disparity", "depth", "alpha", "masks")
        if getattr(args, kind) is not None
    }
    if args.masks is not None:
        inputs.require_deformation(args, "--masks")
    field = inputs.read_field(args)
    if args.masks is not None:
        inputs.require_voxels(field, "--masks")
    inputs.require_fillable(args, field)
    deformation = read_deformation(args, field)

    camera = view.chosen_camera(args, inputs.visible_points(field, deformation, args.frame))
    view.warn_of_edges(args, camera, deformation)
    inputs.set_lattice(args, camera)
    renderer = inputs.posed_renderer(field, deformation, args)
    frame = inputs.render_view(renderer, camera, args)
    drawn = inputs.drawn_cages(renderer, deformation) if args.overlay else ()
    write, _ = outputs.picture_task(output, outputs.colours(frame, camera, drawn, transparent), frame, camera)
    write()
    for kind, path in extra.items():
        write_png(path, outputs.picture(frame, kind))
    view.save_cameras(args, [camera])
    names = " and ".join(map(str, [output, *extra.values()]))
    print(f"wrote {names}: {frame.width}x{frame.height}, {100 * float(frame.alpha.mean()):.1f} % covered")
    if args.masks is not None:
        outputs.warn_of_masks(outputs.mask_shares(frame))
