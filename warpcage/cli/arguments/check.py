"""Arguments of `warpcage check`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "check"
HELP = "examine a cage, what it encloses and what a pose does to it; exit status 1 if it is of no use"
EXAMPLE = """\
  warpcage check cage.obj
  warpcage check cage.obj --object lego.npz --posed posed.obj
  warpcage check broken.obj --repair mended.obj
  warpcage check cage.obj --json > report.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cage", help=f"cage to examine ({' '.join(options.CAGE_ENDINGS)})")
    parser.add_argument(
        "--object", dest="field", metavar="OBJECT", help="field (.npz), splats or mesh that should be inside"
    )
    parser.add_argument(
        "--posed",
        metavar="POSED",
        help="a pose of the cage, a file or a preset, to examine for inverted volume, stretch and folds",
    )
    parser.add_argument(
        "--repair",
        metavar="MENDED",
        help="repair what can be repaired safely, print what was done, write the cage to this file and examine it",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON instead of a table")
    options.add_cage_up(parser, found=True, posed=True)
    options.add_scene_scale(parser)
    options.add_device(parser)
