"""`warpcage render`: a picture of a field, deformed or not, or many of them."""

from __future__ import annotations

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


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument("-o", "--output", required=True, metavar="PICTURE", help="picture to write (.png)")
    flight.add_arguments(parser)
    parser.add_argument("--disparity", metavar="PICTURE", help="write the disparity in colour too (.png)")
    parser.add_argument("--depth", metavar="PICTURE", help="write the depth in grey too, near is white (.png)")
    parser.add_argument("--alpha", metavar="PICTURE", help="write the opacity too (.png)")
    parser.add_argument(
        "--masks",
        metavar="PICTURE",
        help="write where the map folds over (red), what it uncovers (blue) and what it sends out of "
        "the rest cage (yellow) too (.png), and warn of their shares",
    )
    parser.add_argument("--overlay", action="store_true", help="draw the cage into the picture")
    options.add_background(parser, "the field's own")
    options.add_deformation(parser)
    options.add_view(parser)
    options.add_scene_scale(parser)
    options.add_device(parser)


def run(args):
    if args.overlay and args.cage is None:
        raise ValueError("--overlay draws a cage: it needs --cage and --posed")
    if args.cameras is not None:
        return flight.run(args, background_option(args))
    if args.scene is not None or args.frames is not None:
        raise ValueError("--scene and --frames belong to --cameras")
    output = options.check_output(args.output, (".png",), "picture")
    extra = {
        kind: options.check_output(getattr(args, kind), (".png",), "picture")
        for kind in ("disparity", "depth", "alpha", "masks")
        if getattr(args, kind) is not None
    }
    if args.masks is not None and args.cage is None:
        raise ValueError("--masks needs a deformation: --cage and --posed")
    rest, posed = inputs.read_cages(args)
    field = inputs.read_field(args)

    camera = view.chosen_camera(args, inputs.visible_points(field, rest, posed))
    renderer = field if rest is None else inputs.make_deformer(field, rest, args)
    if posed is not None:
        renderer.pose(posed)
    frame = renderer.render(camera, **background_option(args))
    write_png(output, outputs.picture(frame, "rgb", camera, posed if args.overlay else None))
    for kind, path in extra.items():
        write_png(path, outputs.picture(frame, kind))
    names = " and ".join(map(str, [output, *extra.values()]))
    print(f"wrote {names}: {frame.width}x{frame.height}, {100 * float(frame.alpha.mean()):.1f} % covered")
    if args.masks is not None:
        outputs.warn_of_masks(outputs.mask_shares(frame))


def background_option(args) -> dict:
    return {} if args.background is None else {"background": args.background}
