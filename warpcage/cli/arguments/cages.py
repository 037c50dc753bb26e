"""Arguments of `warpcage cage` and `check`."""

from __future__ import annotations

import argparse

from . import options
from .options import Command

CAGE_HELP = "put a cage around a field or a mesh"

CAGE_EXAMPLE = """\
  warpcage cage lego.npz -o cage.obj --vertices 100
  warpcage cage room.npz -o chair.glb --seed 0.2 0 -0.5 --floaters 0.01
  warpcage cage room.npz -o cup.obj --selection cup.npz      (see warpcage select)
  warpcage cage dtu.npz -o object.obj --masks data/dtu_scan24 --method voxel
  warpcage cage lego.obj -o box.obj --box --segments 2 2 3
  warpcage cage house.npz -o wing.obj --snap box.obj --reach 0.1
  warpcage cage lego.obj -o tube.obj --cylinder --axis z --sides 12 --rings 4
"""


def add_cage_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "field", metavar="object", help=f"field (.npz), splats or mesh ({' '.join(options.MESH_ENDINGS)})"
    )
    parser.add_argument(
        "-o", "--output", required=True, metavar="CAGE", help=f"cage to write ({' '.join(options.CAGE_ENDINGS)})"
    )
    options.add_cage_up(parser)
    parser.add_argument(
        "--object", metavar="NAME", help="the object of a mesh file of several to put the cage around (default: all)"
    )
    parser.add_argument(
        "--vertices",
        type=options.positive_int,
        metavar="N",
        help="approximate number of vertices of a cage wrapped around the object, 30 to 200 (default: 100)",
    )
    parser.add_argument(
        "--margin",
        type=options.length,
        metavar="LENGTH",
        help="distance between object and cage, world units (default: 0.03 of the object's size for a box or a "
        "cylinder, otherwise chosen from the object)",
    )
    parser.add_argument(
        "--method",
        choices=("auto", "shell", "voxel"),
        help="shell: an offset surface, decimated and pulled close; voxel: more even faces, like the paper's; "
        "auto: the tighter of the two (default: auto)",
    )
    parser.add_argument("--symmetry", choices="xyz", help="mirror the cage across the middle of this axis (voxel only)")
    _add_selection(parser)
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument("--box", action="store_true", help="a box along the axes")
    shape.add_argument("--cylinder", action="store_true", help="a cylinder along --axis")
    shape.add_argument(
        "--snap",
        metavar="CAGE",
        help="this cage around a part of a field, each of its flat walls moved by up to --reach to where it cuts least "
        "matter",
    )
    parser.add_argument("--reach", type=options.positive_float, metavar="LENGTH", help="of --snap, world units")
    parser.add_argument(
        "--segments",
        type=options.positive_int,
        nargs="+",
        metavar="N",
        help="segments along each axis of the box: one number, or one per axis (default: 1)",
    )
    parser.add_argument("--axis", choices="xyz", help="axis of the cylinder (default: z)")
    parser.add_argument("--sides", type=options.positive_int, metavar="N", help="sides of the cylinder (default: 12)")
    parser.add_argument(
        "--rings", type=options.positive_int, metavar="N", help="segments of the cylinder along its axis (default: 4)"
    )
    parser.add_argument("--quiet", action="store_true", help="do not print what is tried, even with --verbose")
    options.add_scene_scale(parser)
    options.add_device(parser)


def _add_selection(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "part of a larger field (if several are given, each selects from what the ones before leave)"
    )
    options.add_selection(group)
    options.add_in_box(group)
    group.add_argument("--masks", metavar="SCENE", help="what is opaque in every training picture of a scene")
    group.add_argument(
        "--seed",
        type=options.finite_float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="what is connected to this point, world units",
    )
    options.add_parts(group)


CHECK_HELP = "examine a cage, what it encloses and what a pose does to it; exit status 1 if it is of no use"

CHECK_EXAMPLE = """\
  warpcage check cage.obj
  warpcage check cage.obj --object lego.npz --posed posed.obj
  warpcage check broken.obj --repair mended.obj
  warpcage check cage.obj --json > report.json
"""


def add_check_arguments(parser: argparse.ArgumentParser) -> None:
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


COMMANDS = (
    Command("cage", CAGE_HELP, CAGE_EXAMPLE, add_cage_arguments, "cages"),
    Command("check", CHECK_HELP, CHECK_EXAMPLE, add_check_arguments, "cages"),
)
