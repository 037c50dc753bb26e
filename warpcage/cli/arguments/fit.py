"""Arguments of `warpcage fit`."""

from __future__ import annotations

import argparse

from ...core.names import QUALITIES
from .. import options

NAME = "fit"
HELP = "fit a radiance field to the pictures of a scene"
EXAMPLE = """\
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage fit data/lego -o lego.npz --device cuda:0 --resolution 384 --background black
  warpcage fit data/lego -o lego.npz --quality high --checkpoint progress.npz --max-memory 6GB
  warpcage fit data/dtu/scan24 -o house.npz --split-masks
  warpcage fit my_phone_pictures -o fox.npz --refine-cameras
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", required=True, metavar="FIELD", help="field file to write (.npz)")
    options.add_scene(parser, split="train")
    options.add_background(
        parser,
        "white, behind pictures with opacity",
        "; or what is behind the object during the fit: random (random colours, for pictures with opacity), outer "
        "(voxels before and behind the object's box, to infinity), layers (of pictures behind it), constant, or auto: "
        "random for pictures with opacity, outer for whole ones (default: auto)",
    )
    parser.add_argument(
        "--straighten",
        action="store_true",
        help="turn the scene so that what is up for its cameras is +z; the field keeps the turn, by which cameras of "
        "the scene are turned too",
    )
    parser.add_argument(
        "--quality", choices=QUALITIES, default="standard", help="detail, at the cost of time (default: %(default)s)"
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
        "for density and 15 for colours with masks or surroundings)",
    )
    parser.add_argument(
        "--bounds",
        type=options.finite_float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="box around the object, world units (default: found from the pictures)",
    )
    parser.add_argument(
        "--refine-cameras",
        action="store_true",
        help="refine poses, focal lengths and the exposure of each picture with the field, for cameras that are not "
        "exact; the refined ones are written beside it (.cameras.json)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the order of the pixels (default: %(default)s)")
    options.add_device(parser)
    options.add_quiet(parser)
