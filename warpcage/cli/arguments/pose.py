"""Arguments of `warpcage pose`."""

from __future__ import annotations

import argparse
from typing import Any

from .. import options

NAME = "pose"
HELP = "bend, twist, taper, stretch, scale, rotate or move a cage"
EXAMPLE = """\
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage pose cage.obj -o posed.obj --twist 30 --taper 0.6 --axis z --limits 0.3 1

Steps are applied in the order given. --axis, --towards, --limits and --centre apply to all steps of one call: run the
command again on the posed cage for another axis. A direction with a minus needs the equals sign: --towards=-x.
"""


class _Step(argparse.Action):
    """Collects steps in the order of the command line."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        assert option_string is not None
        namespace.steps = [*(namespace.steps or []), (option_string.lstrip("-"), values)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
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
        help="bend what lies along --axis into an arc in the direction of --towards",
    )
    add(
        "--twist",
        dest="steps",
        action=_Step,
        type=number,
        metavar="DEGREES",
        help="turn about --axis, from nothing at the start to DEGREES at the end",
    )
    add(
        "--taper",
        dest="steps",
        action=_Step,
        type=options.positive_float,
        metavar="FACTOR",
        help="scale across --axis, by 1 at the start to FACTOR at the end",
    )
    add(
        "--stretch",
        dest="steps",
        action=_Step,
        type=options.positive_float,
        metavar="FACTOR",
        help="scale along --axis",
    )
    add(
        "--scale",
        dest="steps",
        action=_Step,
        type=options.positive_float,
        nargs="+",
        metavar="FACTOR",
        help="scale by one factor, or by one per axis",
    )
    add("--rotate", dest="steps", action=_Step, type=number, metavar="DEGREES", help="turn about --axis")
    add(
        "--translate",
        dest="steps",
        action=_Step,
        type=number,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="move, world units",
    )
    where = parser.add_argument_group("where")
    where.add_argument("--axis", choices="xyz", default="z", help="axis of the steps (default: %(default)s)")
    where.add_argument(
        "--towards",
        choices=("x", "y", "z", "-x", "-y", "-z"),
        default=None,
        help="direction of a bend (default: x, or z if --axis is x)",
    )
    where.add_argument(
        "--limits",
        type=number,
        nargs=2,
        metavar=("FROM", "TO"),
        default=(0.0, 1.0),
        help="part of the extent along --axis that is bent, twisted, tapered or stretched, between 0 and 1 "
        "(default: 0 1)",
    )
    where.add_argument(
        "--centre",
        type=number,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="point that stays fixed, world units (default: middle of the bounding box)",
    )
    parser.set_defaults(steps=None)
