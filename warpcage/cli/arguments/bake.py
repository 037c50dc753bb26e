"""Arguments of `warpcage bake`."""

from __future__ import annotations

import argparse

from .. import deformation_options, options

NAME = "bake"
HELP = "make a new field of a deformed one, that needs no cage: voxels are resampled, splats moved"
EXAMPLE = """\
  warpcage bake lego.npz --cage cage.obj --posed posed.obj -o bent.npz
  warpcage bake lego.npz --cage cage.obj --posed twist:60 -o twisted.npz --format svox2 --voxels 512
  warpcage bake lego.npz --edits lego.edits.json -o parts.npz
  warpcage bake scene.ply --cage cage.obj --posed bend:40:x:z -o bent.ply
  warpcage bake scene.ply --cage cage.obj --posed bend:40:x:z -o bend_####.ply --frames 30
  warpcage bake room.npz --selection cup.npz -o cup_alone.npz
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    parser.add_argument(
        "-o", "--output", required=True, metavar="FIELD", help="field to write (.npz, of splats as they come)"
    )
    parser.add_argument(
        "--voxels",
        type=options.positive_int,
        metavar="N",
        help="voxels along the longest side of the deformed scene (default: voxels as large as the field's)",
    )
    parser.add_argument(
        "--format",
        choices=("warpcage", "svox2"),
        help="file format; svox2 is a Plenoxels checkpoint (default: warpcage)",
    )
    parser.add_argument(
        "--frames",
        type=options.positive_int,
        metavar="N",
        help="splats only: so many files from rest to the pose, -o walk_####.ply with the # for the number",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="of --frames: also remove the files of a longer sequence of that name (default: a warning names them)",
    )
    options.add_selection(parser, "only what is chosen, cut out of its scene,")
    deformation_options.add_deformation(parser, usual_resolution="128")
    options.add_scene_scale(parser)
    options.add_device(parser)
