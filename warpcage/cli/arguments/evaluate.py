"""Arguments of `warpcage evaluate`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "evaluate"
HELP = "compare renders of a field with a scene's pictures (PSNR, SSIM)"
EXAMPLE = """\
  warpcage evaluate lego.npz data/lego
  warpcage evaluate lego.npz data/lego --split test --downscale 2 --json psnr.json --worst worst.png
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_scene(parser, split="test")
    options.add_background(parser, "the field's own")
    parser.add_argument("--json", metavar="FILE", help="also write the figures to this file (.json)")
    parser.add_argument(
        "--worst", metavar="FILE", help="write the worst view (.png): picture, render, and their difference"
    )
    parser.add_argument(
        "--tune-cameras",
        action="store_true",
        help="turn and shift the camera of each view first so that it matches the field best, as is usual for fields "
        "of refined cameras: the figures then say how good the field is, not where the views are",
    )
    options.add_scene_scale(parser)
    options.add_device(parser)
    options.add_quiet(parser)
