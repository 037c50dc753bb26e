"""`warpcage fit`: pictures to a field."""

from __future__ import annotations

from ..fitting.optimizer import fit
from ..scene.load import load_scene
from . import inputs, options

NAME = "fit"
HELP = "fit a radiance field to the pictures of a scene"
EXAMPLE = """\
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage fit data/lego -o lego.npz --device cuda:0 --resolution 384 --background black
  warpcage fit data/lego -o lego.npz --quality high --checkpoint progress.npz --max-memory 6GB
  warpcage fit data/dtu/scan24 -o house.npz --split-masks
"""


def add_arguments(parser):
    parser.add_argument("scene", help="folder with pictures and cameras")
    parser.add_argument("-o", "--output", required=True, metavar="FIELD", help="field file to write (.npz)")
    parser.add_argument("--split", default="train", help="which pictures (default: %(default)s)")
    parser.add_argument("--format", metavar="NAME", help="scene format (default: found out)")
    options.add_masks(parser)
    parser.add_argument(
        "--downscale",
        type=options.positive_int,
        default=1,
        metavar="N",
        help="shrink the pictures by averaging N x N pixels (default: %(default)s)",
    )
    options.add_background(
        parser,
        "white",
        "; or what stands behind the pictures in the fit: random colours "
        "where they have opacity, layers around the field, constant, or auto (default)",
    )
    parser.add_argument(
        "--quality",
        choices=("fast", "standard", "high"),
        default="standard",
        help="time against detail (default: %(default)s)",
    )
    parser.add_argument(
        "--checkpoint",
        metavar="FILE",
        help="keep the progress in this file (.npz), and go on from it where it is there",
    )
    parser.add_argument(
        "--checkpoint-seconds",
        type=options.positive_float,
        default=60.0,
        metavar="N",
        help="how often (default: %(default)s)",
    )
    parser.add_argument(
        "--resolution",
        type=options.positive_int,
        metavar="N",
        help="voxels along the longest side (default: after the size of a pixel at the object)",
    )
    parser.add_argument(
        "--max-memory",
        type=options.memory,
        metavar="SIZE",
        help="device memory that the fit may take, pictures included, such as 4GB or 800MiB; where it "
        "is short, pictures are kept at 8 bits a channel and voxels stay larger (default: most of "
        "what is free)",
    )
    parser.add_argument("--epochs", type=options.positive_float, metavar="N", help="passes over the pixels that matter")
    parser.add_argument(
        "--variation",
        type=options.positive_float,
        metavar="FACTOR",
        help="on the total variation: more is smoother (default: 1; 30 with masks or layers)",
    )
    parser.add_argument(
        "--bounds",
        type=options.finite_float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box around the object, world units (default: found from the pictures)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the order of the pixels (default: %(default)s)")
    options.add_device(parser)
    options.add_quiet(parser)


def run(args):
    output = options.check_output(args.output, (".npz",), "field file")
    checkpoint = None if args.checkpoint is None else options.check_output(args.checkpoint, (".npz",), "checkpoint")
    options.require_folder(args.scene)
    device = inputs.chosen_device(args)

    kind = args.background if args.background in ("auto", "layers", "random", "constant") else "auto"
    colour = args.background if kind != args.background else None
    scene = load_scene(
        args.scene,
        split=args.split,
        downscale=args.downscale,
        format=args.format,
        background=colour or "white",
        masks=args.masks,
    )
    names = ("resolution", "epochs", "variation", "max_memory")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.bounds is not None:
        given["bounds"] = [args.bounds[:3], args.bounds[3:]]
    field = fit(
        scene,
        quality=args.quality,
        device=device,
        seed=args.seed,
        progress=not args.quiet,
        background=kind,
        checkpoint=checkpoint,
        checkpoint_seconds=args.checkpoint_seconds,
        **given,
    )
    field.save(output)
    size = "x".join(str(n) for n in field.resolution)
    behind = "" if field.background_model is None else f" before {field.background_model.layer_count} layers"
    print(f"wrote {output}: {field.voxel_count} voxels of {size}{behind}, {output.stat().st_size / 1e6:.1f} MB")
