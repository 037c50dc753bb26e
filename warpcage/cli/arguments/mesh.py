"""Arguments of `warpcage mesh`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "mesh"
HELP = "extract the surface of a field as a triangle mesh"
EXAMPLE = """\
  warpcage mesh lego.npz -o lego.obj
  warpcage mesh lego.npz -o lego.glb                    with colours, for Blender: docs/blender.md
  warpcage mesh lego.npz -o lego.ply --threshold 20 --components all
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="MESH",
        help=f"mesh to write ({' '.join(options.MESH_ENDINGS)}; glTF with y up)",
    )
    parser.add_argument(
        "--threshold",
        type=options.positive_float,
        metavar="SIGMA",
        help="density at the surface, per world unit (default: chosen from the field)",
    )
    parser.add_argument(
        "--components",
        choices=("largest", "all"),
        default="largest",
        help="which connected parts to keep (default: %(default)s)",
    )
    parser.add_argument(
        "--colors",
        action=argparse.BooleanOptionalAction,
        help="write the colours of the surface at its vertices, as they are seen from straight ahead (.glb, .ply, "
        ".obj; default: for .glb)",
    )
    parser.add_argument(
        "--as-captured",
        action="store_true",
        help="in the coordinates of the scene's files, for a field that was straightened (warpcage fit --straighten)",
    )
    options.add_selection(parser)
    options.add_scene_scale(parser)
    options.add_device(parser)
