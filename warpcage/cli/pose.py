"""`warpcage pose`: bend, twist, scale or move a cage."""

from __future__ import annotations

import argparse
from typing import Any

from ..cage.cage import Cage
from . import inputs, options, pose_keys


def run(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (*options.CAGE_ENDINGS, ".json"), "cage file")
    if output.suffix.lower() == ".json":
        pose_keys.run(args, output)
        return
    given = [name for name in pose_keys.OPTIONS if getattr(args, name)]
    if given:
        raise ValueError(f"--{given[0]} is for keys of a pose file: give one with -o (.json)")
    if not args.steps:
        raise ValueError("no step given: --bend, --twist, --taper, --stretch, --scale, --rotate or --translate")
    inputs.quiet_warp()

    cage = Cage.load(args.cage, up=args.cage_up)
    cage.require_usable(f"cage {args.cage!r}")
    stepped(cage, args).save(output, up=args.cage_up)
    print(f"wrote {output}: {steps_text(args)}")


def stepped(cage: Cage, args: argparse.Namespace) -> Cage:
    """A cage after the steps of the command, usable."""
    for name, value in args.steps or ():
        cage = getattr(cage, name)(*_arguments(name, value), **_options(name, args))
    cage.require_usable("the posed cage")
    return cage


def steps_text(args: argparse.Namespace) -> str:
    """The steps of the command in words."""
    steps = args.steps or ()
    return ", ".join(f"{name} {value if isinstance(value, float) else tuple(value)}" for name, value in steps)


def _arguments(name: str, value: Any) -> tuple:
    """Positional arguments of the step's method of Cage."""
    if name != "scale":
        return (value,)
    if len(value) not in (1, 3):
        raise ValueError(f"--scale takes one factor or three, got {len(value)}")
    return (value[0] if len(value) == 1 else tuple(value),)


def _options(name: str, args: argparse.Namespace) -> dict:
    """Keyword arguments of the step's method of Cage."""
    if name == "translate":
        return {}
    chosen = {"centre": args.centre}
    if name != "scale":
        chosen["axis"] = args.axis
    if name == "bend":
        chosen["towards"] = args.towards or ("z" if args.axis == "x" else "x")
    if name in ("bend", "twist", "taper", "stretch"):
        chosen["limits"] = tuple(args.limits)
    return chosen
