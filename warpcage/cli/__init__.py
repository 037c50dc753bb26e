"""The command line: `warpcage fit | mesh | cage | check | pose | render | animate | ...`, one module per command.

A command module holds NAME, HELP (one line), EXAMPLE (shown by --help), add_arguments(parser) and run(args), which
returns the exit status where it is not 0. Wrong arguments are refused before any long work.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from typing import Any, NoReturn

from . import animate, bake, cage, check, evaluate, fit, info, kernels, mesh, pose, render
from .options import package_version

COMMANDS = (fit, mesh, cage, check, pose, render, animate, bake, evaluate, info, kernels)
EXAMPLE = """\
example, from pictures to a bent object:
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage cage lego.npz -o cage.obj
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
"""


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Words of the command line after the program's name. None takes them from sys.argv.

    Returns:
        The exit status: 0 done, 1 examined and unusable, 2 bad input (one line on stderr says what), 130 interrupted,
        141 where the reader of the output closed it.
    """
    try:
        arguments = build_parser().parse_args(argv)
        if arguments.command is None:
            build_parser().print_help()
            return 2
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            status = arguments.run(arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("warpcage: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output closed it: keep the interpreter's last flush quiet too
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, OSError) as error:
        print(f"warpcage: error: {_one_line(error)}", file=sys.stderr)
        return 2
    return status or 0


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
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
        command.set_defaults(run=module.run)
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


def _show_warning(message, category, filename, lineno, file=None, line=None):
    """Print a warning as one line, without the place in the source."""
    print(f"warpcage: warning: {_one_line(message)}", file=sys.stderr)


def _one_line(error: Exception | str) -> str:
    if isinstance(error, OSError) and error.strerror:
        name = f" {str(error.filename)!r}" if error.filename else ""
        return f"{error.strerror[0].lower()}{error.strerror[1:]}{name}"
    return " ".join(str(error).split()) or type(error).__name__
