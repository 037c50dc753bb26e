"""The command line: `warpcage fit | mesh | cage | check | pose | render | animate | ...`, one module a command.

A command module holds NAME, HELP (one line), EXAMPLE (shown by --help), add_arguments(parser) and run(args). Nothing
heavy is imported before a command runs, so that --help and wrong arguments answer at once.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings

from . import animate, bake, cage, check, evaluate, fit, info, mesh, pose, render
from .options import package_version

COMMANDS = (fit, mesh, cage, check, pose, render, animate, bake, evaluate, info)
EXAMPLE = """\
example, from pictures to a bent object:
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage cage lego.npz -o cage.obj
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
"""


def main(argv: list[str] | None = None) -> int:
    """Run one command; the exit status: 0 done, 1 examined and unusable, 2 bad input (one line on stderr says what),
    130 interrupted."""
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
    except BrokenPipeError:  # whoever read our output has had enough; keep the interpreter's last flush quiet too
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, OSError) as error:
        print(f"warpcage: error: {_one_line(error)}", file=sys.stderr)
        return 2
    return status or 0


def build_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="warpcage",
        description="Fit a radiance field to pictures, put a cage around it, pose the cage, render the deformed scene.",
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, help="print the version and leave")
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
    """Wrong arguments end in the same one line as every other bad input."""

    def error(self, message: str):
        raise ValueError(f"{message} (see {self.prog} --help)")


class _Version(argparse.Action):
    def __init__(self, option_strings, dest, **options):
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(self, parser, namespace, values, option_string=None):
        print(f"warpcage {package_version()}")
        parser.exit()


def _show_warning(message, category, filename, lineno, file=None, line=None):
    """A warning as one line too, without the place in the source."""
    print(f"warpcage: warning: {_one_line(message)}", file=sys.stderr)


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        name = f" {str(error.filename)!r}" if error.filename else ""
        return f"{error.strerror[0].lower()}{error.strerror[1:]}{name}"
    return " ".join(str(error).split()) or type(error).__name__
