"""Arguments of `warpcage info`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "info"
HELP = "describe a field, a cage, poses, edits, cameras or a scene; without a file: versions and devices"
EXAMPLE = """\
  warpcage info
  warpcage info lego.npz
  warpcage info cage.obj
  warpcage info data/lego --split test --sheet lego.png
"""

#: Most pictures on a contact sheet, and their longest side there.
SHEET_PICTURES, SHEET_SIDE = 100, 160


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "field",
        metavar="file",
        nargs="?",
        help=f"field (.npz), splats (.ply .splat .spz), cage ({' '.join(options.CAGE_ENDINGS)}), poses, edits or "
        "cameras (.json) or scene folder",
    )
    parser.add_argument("--split", default="train", help="split of a scene (default: %(default)s)")
    options.add_scene_format(parser)
    parser.add_argument(
        "--sheet",
        metavar="PICTURE",
        help=f"write a contact sheet of a scene's pictures, at most {SHEET_PICTURES} of them (.png)",
    )
    options.add_scene_scale(parser)
    options.add_device(parser)
