"""`warpcage fit`: fit a field to pictures."""

from __future__ import annotations

import argparse

from ..fitting.optimizer import fit
from ..fitting.options import QUALITIES
from ..scene.load import load_scene
from ..view.backgrounds import FIT_BACKGROUNDS
from . import inputs, options

NAME = "fit"
HELP = "fit a radiance field to the pictures of a scene"
EXAMPLE = """\
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage fit data/lego -o lego.npz --device cuda:0 --resolution 384 --background black
  warpcage fit data/lego -o lego.npz --quality high --checkpoint progress.npz --max-memory 6GB
  warpcage fit data/dtu/scan24 -o house.npz --split-masks
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", required=True, metavar="FIELD", help="field file to write (.npz)")
    options.add_scene(parser, split="train")
    options.add_background(
        parser,
        "white",
        "; or what is behind the object during the fit: random (random colours, for pictures with opacity), layers "
        "(layers around the field), constant, or auto (default)",
    )
    parser.add_argument(
        "--quality",
        choices=tuple(QUALITIES),
        default="standard",
        help="detail, at the cost of time (default: %(default)s)",
    )
    parser.add_argument(
        "--checkpoint", metavar="FILE", help="save the progress to this file (.npz), and continue from it if it exists"
    )
    parser.add_argument(
        "--checkpoint-seconds",
        type=options.positive_float,
        default=60.0,
        metavar="N",
        help="time between two checkpoints (default: %(default)s)",
    )
    parser.add_argument(
        "--resolution",
        type=options.positive_int,
        metavar="N",
        help="voxels along the longest side (default: follows the size of a pixel at the object)",
    )
    parser.add_argument(
        "--max-memory",
        type=options.memory,
        metavar="SIZE",
        help="device memory that the fit may take, pictures included, such as 4GB or 800MiB. If it is short, pictures "
        "are kept at 8 bits per channel, and voxels stay larger (default: most of what is free)",
    )
    parser.add_argument(
        "--epochs",
        type=options.positive_float,
        metavar="N",
        help="passes over the pixels that see the object (default: depends on --quality)",
    )
    parser.add_argument(
        "--variation",
        type=options.positive_float,
        metavar="FACTOR",
        help="factor on the total variation: higher is smoother (default: chosen from the pictures, at least 30 "
        "with masks or layers)",
    )
    parser.add_argument(
        "--bounds",
        type=options.finite_float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box around the object, world units (default: found from the pictures)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the order of the pixels (default: %(default)s)")
    options.add_device(parser)
    options.add_quiet(parser)


def run(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (".npz",), "field file")
    checkpoint = None if args.checkpoint is None else options.check_output(args.checkpoint, (".npz",), "checkpoint")
    options.require_folder(args.scene)
    device = inputs.chosen_device(args)

    is_kind = args.background in FIT_BACKGROUNDS
    kind = args.background if is_kind else "auto"
    colour = "white" if is_kind or args.background is None else args.background
    scene = load_scene(
        args.scene, split=args.split, downscale=args.downscale, format=args.format, background=colour, masks=args.masks
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
    behind = "" if field.background_model is None else f", {field.background_model.layer_count} background layers"
    print(
        f"wrote {output}: {field.voxel_count} voxels in a grid of {size}{behind}, {output.stat().st_size / 1e6:.1f} MB"
    )
