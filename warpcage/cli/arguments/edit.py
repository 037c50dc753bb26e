"""Arguments of `warpcage edit`."""

from __future__ import annotations

import argparse

from . import options
from .options import Command

EDIT_HELP = "pose cages by hand in the browser and see the scene follow"

EDIT_EXAMPLE = """\
  warpcage edit --demo
  warpcage edit lego.npz --cage cage.obj
  warpcage edit lego.npz --port 8700 --no-browser     (then, at home: ssh -L 8700:127.0.0.1:8700 HOST)

What is edited is kept beside the field, as NAME.session.json, and the next call goes on with it.
"""


def add_edit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("field", nargs="?", help="field file (.npz)")
    parser.add_argument("--demo", action="store_true", help="edit a brick excavator, which is fitted once and kept")
    parser.add_argument(
        "--cage",
        action="append",
        metavar="CAGE",
        help=f"cage at rest ({' '.join(options.CAGE_ENDINGS)}); repeat it for several edits "
        "(default: the session's, or none; the page can make one)",
    )
    options.add_cage_up(parser, found=True)
    options.add_selection(parser, "also an edit with a cage around what is chosen")
    parser.add_argument("--session", metavar="FILE", help="the session's file (default: beside the field)")
    parser.add_argument(
        "--new", action="store_true", help="begin anew; a session that is there is kept under another name"
    )
    serving = parser.add_argument_group("serving")
    serving.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: this machine only)"
    )
    serving.add_argument("--port", type=port_number, default=0, help="port to listen on (default: a free one)")
    serving.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="host name under which the page may be opened too, such as that of a proxy",
    )
    serving.add_argument("--no-browser", action="store_true", help="print the address and open no browser")
    options.add_scene_scale(parser)
    options.add_device(parser)


def port_number(text: str) -> int:
    """A port, 0 for a free one."""
    if not (text.isascii() and text.isdigit()) or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no port: 0 to 65535")
    return int(text)


COMMANDS = (Command("edit", EDIT_HELP, EDIT_EXAMPLE, add_edit_arguments, "edit"),)
