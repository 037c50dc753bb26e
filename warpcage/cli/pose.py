"""`warpcage pose`: bend, twist, scale or move a cage."""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

from ..cage.axes import axis_of, default_towards, with_up
from ..cage.cage import Cage
from ..core.files import require_file
from ..splats.splat_field import load_field
from . import inputs, options, pose_keys
from .standing import ending, read_rest


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
    if output.exists() and pathlib.Path(args.cage).exists() and output.samefile(args.cage):
        raise ValueError(
            f"-o {output} is the cage at rest itself, which is needed beside a posed one: name another file"
        )
    inputs.quiet_warp()

    cage, found = read_cage(args)
    stepped(cage, args).save(output, up=args.cage_up or found.get(ending(str(output))))
    print(f"wrote {output}: {steps_text(args)}")


def read_cage(args: argparse.Namespace) -> tuple[Cage, dict[str, str]]:
    """The cage of the command, and the axis that points up in files of its ending.
    With --object the axis is found by that field, and `args.up` becomes the field's unless --up is given too."""
    field = None if args.object is None else load_field(require_file(args.object, "field file"))
    if field is not None and args.up is None:
        args.up = tuple(field.up)
    args.straightening = None if field is None else field.straightening  # for cameras of its scene
    return read_rest(args.cage, args.cage_up, field, part=True)


def stepped(cage: Cage, args: argparse.Namespace) -> Cage:
    """A cage after the steps of the command, usable."""
    for name, value in args.steps or ():
        cage = getattr(cage, name)(*_arguments(name, value), **_options(name, cage, args))
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


def _options(name: str, cage: Cage, args: argparse.Namespace) -> dict:
    """Keyword arguments of the step's method of Cage."""
    if name == "translate":
        return {}
    chosen = {"centre": args.centre}
    if name != "scale":
        chosen["axis"] = axis_of(with_up(args.axis, args.up))
    if name == "bend":
        chosen["towards"] = default_towards(cage, chosen["axis"])
        if args.towards is not None:
            chosen["towards"] = axis_of(with_up(args.towards, args.up))
    if name in ("bend", "twist", "taper", "stretch"):
        chosen["limits"] = tuple(args.limits)
    return chosen
