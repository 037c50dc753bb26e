"""`warpcage render`: pictures of a field, as it is or deformed."""

from __future__ import annotations

import argparse

from ..view.pictures import write_png
from . import flight, inputs, options, outputs, view

NAME = "render"
HELP = "render one view of a field, as it is or deformed by a cage"
EXAMPLE = """\
  warpcage render lego.npz -o lego.png
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --size 800
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --overlay \\
      --disparity bent_disparity.png --masks bent_masks.png --camera data/lego:test:3
  warpcage render lego.npz --cage cage.obj --posed twist:60 -o twisted.png
  warpcage render lego.npz -o views/ --cameras interpolate --scene data/lego:test --frames 60
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    parser.add_argument("-o", "--output", required=True, metavar="PICTURE", help="picture to write (.png)")
    flight.add_arguments(parser)
    parser.add_argument("--disparity", metavar="PICTURE", help="also write the disparity in colour (.png)")
    parser.add_argument("--depth", metavar="PICTURE", help="also write the depth in grey, near is white (.png)")
    parser.add_argument("--alpha", metavar="PICTURE", help="also write the opacity (.png)")
    parser.add_argument(
        "--masks",
        metavar="PICTURE",
        help="also write where the map folds over (red), what it uncovers (blue) and what it sends out of the "
        "rest cage (yellow) (.png), and warn of how much there is of each",
    )
    parser.add_argument("--overlay", action="store_true", help="draw the cage into the picture")
    options.add_background(parser, "the field's own")
    options.add_deformation(parser)
    options.add_view(parser)
    options.add_scene_scale(parser)
    options.add_device(parser)


def run(args: argparse.Namespace) -> None:
    if args.overlay:
        inputs.require_deformation(args, "--overlay")
    if args.cameras is not None:
        return flight.run(args)
    if args.scene is not None or args.frames is not None:
        raise ValueError("--scene and --frames belong to --cameras")
    output = options.check_output(args.output, (".png",), "picture")
    extra = {
        kind: options.check_output(getattr(args, kind), (".png",), "picture")
        for kind in ("disparity", "depth", "alpha", "masks")
        if getattr(args, kind) is not None
    }
    if args.masks is not None:
        inputs.require_deformation(args, "--masks")
    cages = inputs.read_cages(args)
    field = inputs.read_field(args)

    camera = view.chosen_camera(args, inputs.visible_points(field, *(cages or ())))
    frame = inputs.posed_renderer(field, cages, args).render(camera, **inputs.background_option(args))
    write_png(output, outputs.picture(frame, "rgb", camera, cages[1] if cages and args.overlay else None))
    for kind, path in extra.items():
        write_png(path, outputs.picture(frame, kind))
    names = " and ".join(map(str, [output, *extra.values()]))
    print(f"wrote {names}: {frame.width}x{frame.height}, {100 * float(frame.alpha.mean()):.1f} % covered")
    if args.masks is not None:
        outputs.warn_of_masks(outputs.mask_shares(frame))
