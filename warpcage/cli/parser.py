"""The parser of all commands. It is made of words alone: no command is loaded for it."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from .arguments import (
    animate,
    bake,
    cage,
    capture,
    check,
    edit,
    edits,
    evaluate,
    fit,
    info,
    kernels,
    mesh,
    pose,
    render,
    run,
    select,
    sweep,
)
from .options import package_version

#: The commands in the order of their help.
COMMANDS = (
    capture,
    fit,
    select,
    mesh,
    cage,
    check,
    edit,
    pose,
    edits,
    render,
    animate,
    sweep,
    run,
    bake,
    evaluate,
    info,
    kernels,
)
EXAMPLE = """\
example, from pictures to a bent object:
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage cage lego.npz -o cage.obj
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands. `command` of what it reads is the name of the chosen one, or None."""
    parser = _Parser(
        prog="warpcage",
        description="Fit a radiance field to pictures, put a cage around it, pose the cage, render the deformed scene.",
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="command", parser_class=_Parser)
    for module in COMMANDS:
        command = commands.add_parser(
            module.NAME,
            help=module.HELP,
            description=module.HELP[0].upper() + module.HELP[1:] + ".",
            epilog="example:\n" + module.EXAMPLE,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        command.add_argument("--verbose", action="store_true", help="also say what is loaded and tried")
    return parser


class _Parser(argparse.ArgumentParser):
    """Reports wrong arguments in one line, as every other bad input is reported."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see {self.prog} --help)")


class _Version(argparse.Action):
    """Prints the version, which is looked up only then."""

    def __init__(self, option_strings: list[str], dest: str, **options: Any):
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(self, parser, namespace, values, option_string=None):
        print(f"warpcage {package_version()}")
        parser.exit()
