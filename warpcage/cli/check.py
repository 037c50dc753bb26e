"""`warpcage check`: examine a cage and a pose of it."""

from __future__ import annotations

import argparse
import json

from ..cage.cage import Cage
from ..cage.presets import is_preset
from ..cage.up_axis import load_standing
from . import inputs, options
from .cage import read_mesh
from .keyframes import pose_file, read_pose
from .standing import ending, posed_up, say_standing


def run(args: argparse.Namespace) -> int:
    inputs.require_field_scale(args)
    output = None if args.repair is None else options.check_output(args.repair, options.CAGE_ENDINGS, "cage file")
    inputs.quiet_warp()

    thing = _enclosed(args)
    reference = next(iter(thing.values()), None)
    cage, standing = load_standing(Cage, args.cage, up=args.cage_up, reference=reference, anywhere=True)
    if standing.turned:  # the table says what else there is
        say_standing(args.cage, standing, "--cage-up")
    pose = None if args.posed is None else _pose(args, cage, standing.up)
    notes = ()
    if output is not None:
        cage, notes = cage.repair()
        cage.save(output)
    report = cage.check(**thing, pose=pose)
    if args.json:
        print(json.dumps(report.as_dict() | {"file": args.cage, "repaired": list(notes)}, indent=1))
    else:
        for note in notes or (() if output is None else ("nothing to repair",)):
            print(f"repair: {note}")
        print(report)
    return 0 if report.usable and not report.standing else 1


def _pose(args: argparse.Namespace, cage: Cage, expected: str) -> Cage:
    """The pose of --posed; expected: the axis that points up in the cage's file."""
    if is_preset(args.posed) or pose_file(args.posed):
        return read_pose(cage, args.posed, usable=False)
    likely = expected if ending(args.posed) == ending(args.cage) else None
    pose, standing = load_standing(Cage, args.posed, up=posed_up(args), reference=cage, expected=likely)
    say_standing(args.posed, standing, "--posed-up")
    return pose


def _enclosed(args: argparse.Namespace) -> dict:
    """The object of --object, as Cage.check takes it."""
    if args.field is None:
        return {}
    if inputs.is_field(args.field):
        return {"field": inputs.read_field(args)}
    return {"mesh": read_mesh(args.field)}
