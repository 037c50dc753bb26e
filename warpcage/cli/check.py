"""`warpcage check`: whether a cage, and a pose of it, can be trusted."""

from __future__ import annotations

import json
import pathlib

from ..cage.cage import Cage
from . import inputs, options
from .cage import read_mesh
from .keyframes import is_preset, pose_file, read_pose

NAME = "check"
HELP = "examine a cage, what it encloses and what a pose does; exit status 1 if it cannot be used"
EXAMPLE = """\
  warpcage check cage.obj
  warpcage check cage.obj --object lego.npz --posed posed.obj
  warpcage check broken.obj --repair mended.obj
  warpcage check cage.obj --json > report.json
"""


def add_arguments(parser):
    parser.add_argument("cage", help=f"cage to examine ({' '.join(options.CAGE_ENDINGS)})")
    parser.add_argument("--object", dest="field", metavar="OBJECT", help="field (.npz) or mesh that ought to be inside")
    parser.add_argument(
        "--posed", metavar="POSED", help="a pose of the cage, a file or a preset: inverted volume, stretch, folds"
    )
    parser.add_argument(
        "--repair",
        metavar="MENDED",
        help="mend what can be mended safely, say what was done, write the cage here and examine it",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON instead of a table")
    options.add_cage_up(parser)
    options.add_scene_scale(parser)
    options.add_device(parser)


def run(args):
    inputs.require_field_scale(args)
    output = None if args.repair is None else options.check_output(args.repair, options.CAGE_ENDINGS, "cage file")
    inputs.quiet_warp()

    cage = Cage.load(args.cage, up=args.cage_up)
    pose = None
    if args.posed is not None:
        named = is_preset(args.posed) or pose_file(args.posed)
        pose = read_pose(cage, args.posed, usable=False) if named else Cage.load(args.posed, up=args.cage_up)
    notes = ()
    if output is not None:
        cage, notes = cage.repair()
        cage.save(output)
    report = cage.check(**_enclosed(args), pose=pose)
    if args.json:
        print(json.dumps(report.as_dict() | {"file": args.cage, "repaired": list(notes)}, indent=1))
    else:
        for note in notes or (() if output is None else ("nothing to repair",)):
            print(f"repair: {note}")
        print(report)
    return 0 if report.usable else 1


def _enclosed(args) -> dict:
    if args.field is None:
        return {}
    if pathlib.Path(args.field).suffix.lower() == ".npz":
        return {"field": inputs.read_field(args)}

    return {"mesh": read_mesh(args.field)}
