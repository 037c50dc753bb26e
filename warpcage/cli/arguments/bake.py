"""Arguments of `warpcage bake`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "bake"
HELP = "resample a deformed field into a new field that needs no cage and renders faster"
EXAMPLE = """\
  warpcage bake lego.npz --cage cage.obj --posed posed.obj -o bent.npz
  warpcage bake lego.npz --cage cage.obj --posed twist:60 -o twisted.npz --format svox2 --voxels 512
  warpcage bake lego.npz --edits lego.edits.json -o parts.npz
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    parser.add_argument("-o", "--output", required=True, metavar="FIELD", help="field to write (.npz)")
    parser.add_argument(
        "--voxels",
        type=options.positive_int,
        metavar="N",
        help="voxels along the longest side of the deformed scene (default: voxels as large as the field's)",
    )
    parser.add_argument(
        "--format",
        choices=("warpcage", "svox2"),
        default="warpcage",
        help="file format; svox2 is a Plenoxels checkpoint (default: %(default)s)",
    )
    options.add_deformation(parser, usual_resolution="128")
    options.add_scene_scale(parser)
    options.add_device(parser)
