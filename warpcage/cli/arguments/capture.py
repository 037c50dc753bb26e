"""Arguments of `warpcage capture`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "capture"
HELP = "make a scene of a video or a folder of pictures: find the cameras, undistort the pictures"
EXAMPLE = """\
  warpcage capture walk.mp4 -o scene
  warpcage capture pictures -o scene --feature-size 1600
  warpcage fit scene -o object.npz
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", metavar="VIDEO|FOLDER", help="video, or folder of pictures (.jpg .png .webp .bmp .tif)"
    )
    parser.add_argument(
        "-o", "--output", required=True, metavar="SCENE", help="folder to write, new or empty: a scene for fit"
    )
    parser.add_argument(
        "--frames",
        type=options.positive_int,
        default=120,
        metavar="N",
        help="most frames of a video that are taken: the sharp ones, spread along its way (default: %(default)s)",
    )
    parser.add_argument(
        "--feature-size",
        type=options.positive_int,
        default=800,
        metavar="PIXELS",
        help="longer side at which features are looked for; more is more exact and takes longer (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of what is drawn by lot (default: %(default)s)")
    options.add_quiet(parser)
