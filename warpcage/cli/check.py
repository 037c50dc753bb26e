"""`warpcage check`: examine a cage and a pose of it."""

from __future__ import annotations

import argparse
import json
import pathlib

from ..cage.cage import Cage
from . import inputs, options
from .cage import read_mesh
from .keyframes import is_preset, pose_file, read_pose


def run(args: argparse.Namespace) -> int:
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


def _enclosed(args: argparse.Namespace) -> dict:
    """The object of --object, as Cage.check takes it."""
    if args.field is None:
        return {}
    if pathlib.Path(args.field).suffix.lower() == ".npz":
        return {"field": inputs.read_field(args)}
    return {"mesh": read_mesh(args.field)}
