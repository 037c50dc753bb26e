"""`warpcage pose`: move the vertices of a cage."""

from __future__ import annotations

import argparse

from ..cage.cage import Cage
from . import inputs, options

NAME = "pose"
HELP = "bend, twist, taper, stretch, scale, rotate or move a cage"
EXAMPLE = """\
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage pose cage.obj -o posed.obj --twist 30 --taper 0.6 --axis z --limits 0.3 1

Steps are taken in the order given. --axis, --towards, --limits and --centre hold for all steps of one call; call it
again on the posed cage for another axis. A direction with a minus needs the equals sign: --towards=-x.
"""


class _Step(argparse.Action):
    """Collects steps in the order of the command line."""

    def __call__(self, parser, namespace, values, option_string=None):
        namespace.steps = [*(namespace.steps or []), (option_string.lstrip("-"), values)]


def add_arguments(parser):
    number = options.finite_float
    parser.add_argument("cage", help=f"cage to pose ({' '.join(options.CAGE_ENDINGS)})")
    parser.add_argument(
        "-o", "--output", required=True, metavar="POSED", help=f"cage to write ({' '.join(options.CAGE_ENDINGS)})"
    )
    options.add_cage_up(parser)
    steps = parser.add_argument_group("steps")
    add = steps.add_argument
    add(
        "--bend",
        dest="steps",
        action=_Step,
        type=number,
        metavar="DEGREES",
        help="along --axis into an arc towards --towards",
    )
    add(
        "--twist",
        dest="steps",
        action=_Step,
        type=number,
        metavar="DEGREES",
        help="about --axis, more and more along it",
    )
    add(
        "--taper",
        dest="steps",
        action=_Step,
        type=options.positive_float,
        metavar="FACTOR",
        help="scale across --axis by 1 at its beginning to FACTOR at its end",
    )
    add("--stretch", dest="steps", action=_Step, type=options.positive_float, metavar="FACTOR", help="along --axis")
    add(
        "--scale",
        dest="steps",
        action=_Step,
        type=options.positive_float,
        nargs="+",
        metavar="FACTOR",
        help="one factor, or one for each of x, y, z",
    )
    add("--rotate", dest="steps", action=_Step, type=number, metavar="DEGREES", help="about --axis")
    add("--translate", dest="steps", action=_Step, type=number, nargs=3, metavar=("X", "Y", "Z"), help="world units")
    where = parser.add_argument_group("where")
    where.add_argument("--axis", choices="xyz", default="z", help="(default: %(default)s)")
    where.add_argument(
        "--towards",
        choices=("x", "y", "z", "-x", "-y", "-z"),
        default=None,
        help="where a bend leads (default: x, or z where --axis is x)",
    )
    where.add_argument(
        "--limits",
        type=number,
        nargs=2,
        metavar=("FROM", "TO"),
        default=(0.0, 1.0),
        help="part of the extent along --axis that is bent, twisted, tapered, stretched (default: 0 1)",
    )
    where.add_argument(
        "--centre",
        type=number,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="fixed point of steps that have one (default: middle of the bounding box)",
    )
    parser.set_defaults(steps=None)


def run(args):
    output = options.check_output(args.output, options.CAGE_ENDINGS, "cage file")
    if not args.steps:
        raise ValueError("no step given: --bend, --twist, --taper, --stretch, --scale, --rotate or --translate")
    inputs.quiet_warp()

    cage = Cage.load(args.cage, up=args.cage_up)
    cage.require_usable(f"cage {args.cage!r}")
    for name, value in args.steps:
        cage = getattr(cage, name)(*_arguments(name, value), **_options(name, args))
    cage.require_usable("the posed cage")
    cage.save(output, up=args.cage_up)
    steps = ", ".join(f"{name} {value if isinstance(value, float) else tuple(value)}" for name, value in args.steps)
    print(f"wrote {output}: {steps}")


def _arguments(name, value):
    if name != "scale":
        return (value,)
    if len(value) not in (1, 3):
        raise ValueError(f"--scale takes one factor or three, got {len(value)}")
    return (value[0] if len(value) == 1 else tuple(value),)


def _options(name, args) -> dict:
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
