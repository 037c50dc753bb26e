"""`warpcage render`: one picture of a field, deformed or not."""

from . import options

NAME = "render"
HELP = "render one view of a field, as it is or deformed by a cage"
EXAMPLE = """\
  warpcage render lego.npz -o lego.png
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --size 800
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --overlay \\
      --disparity bent_disparity.png --camera data/lego:test:3
"""


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument("-o", "--output", required=True, metavar="PICTURE", help="picture to write (.png)")
    parser.add_argument("--disparity", metavar="PICTURE", help="write the disparity in colour too (.png)")
    parser.add_argument("--overlay", action="store_true", help="draw the cage into the picture")
    options.add_background(parser, "the field's own")
    options.add_deformation(parser)
    options.add_view(parser)
    options.add_device(parser)


def run(args):
    output = options.check_output(args.output, (".png",), "picture")
    disparity = None if args.disparity is None else options.check_output(args.disparity, (".png",), "picture")
    if args.overlay and args.cage is None:
        raise ValueError("--overlay draws a cage: it needs --cage and --posed")
    rest, posed = options.read_cages(args)
    field = options.read_field(args)
    from ..images import colour_disparity, write_png

    camera = options.chosen_camera(args, options.visible_points(field, rest, posed))
    renderer = field if rest is None else options.make_deformer(field, rest, args)
    if posed is not None:
        renderer.pose(posed)
    frame = renderer.render(camera, **background_option(args))
    write_png(output, with_overlay(frame, camera, posed) if args.overlay else frame.rgb)
    if disparity is not None:
        write_png(disparity, colour_disparity(frame.disparity, alpha=frame.alpha))
    print(f"wrote {output}{'' if disparity is None else f' and {disparity}'}: {frame.width}x{frame.height}, "
          f"{100 * float(frame.alpha.mean()):.1f} % covered")


def background_option(args) -> dict:
    return {} if args.background is None else {"background": args.background}


def with_overlay(frame, camera, cage):
    """The frame's picture with the cage drawn over it, (h, w, 3)."""
    from ..overlay import draw_cage

    return draw_cage(frame.rgb, camera, cage)
