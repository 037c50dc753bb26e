"""`warpcage evaluate`: a field against pictures that it has not seen."""

import json

from . import options

NAME = "evaluate"
HELP = "compare renders of a field with a scene's pictures (PSNR)"
EXAMPLE = """\
  warpcage evaluate lego.npz data/lego
  warpcage evaluate lego.npz data/lego --split test --downscale 2 --json psnr.json
"""


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument("scene", help="folder with pictures and cameras")
    parser.add_argument("--split", default="test", help="which pictures (default: %(default)s)")
    parser.add_argument("--format", metavar="NAME", help="scene format (default: found out)")
    parser.add_argument("--downscale", type=options.positive_int, default=1, metavar="N",
                        help="shrink the pictures by averaging N x N pixels (default: %(default)s)")
    options.add_background(parser, "the field's own")
    parser.add_argument("--json", metavar="FILE", help="write the figures too")
    options.add_device(parser)
    options.add_quiet(parser)


def run(args):
    report = None if args.json is None else options.check_output(args.json, (".json",), "report")
    options.require_folder(args.scene)
    field = options.read_field(args)
    from ..evaluation import evaluate, mean_psnr
    from ..files import atomic_path
    from ..scene import load_scene

    background = field.background if args.background is None else args.background
    scene = load_scene(args.scene, split=args.split, downscale=args.downscale, format=args.format,
                       background=background)
    rows = evaluate(field, scene, progress=not args.quiet)
    mean = mean_psnr(rows)
    width = max(len("view"), *(len(row["view"]) for row in rows))
    print(f"{'view':{width}}  PSNR dB")
    for row in rows:
        print(f"{row['view']:{width}}  {row['psnr']:7.2f}")
    print(f"{'mean':{width}}  {mean:7.2f}")
    if report is not None:
        content = {"field": args.field, "scene": args.scene, "split": args.split, "downscale": args.downscale,
                   "mean_psnr": mean, "views": rows}
        with atomic_path(report) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
