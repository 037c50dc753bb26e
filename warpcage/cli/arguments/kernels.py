"""Arguments of `warpcage kernels`."""

from __future__ import annotations

import argparse

NAME = "kernels"
HELP = "list the kernel files, or copy one with all that it needs into a program of your own"
EXAMPLE = """\
  warpcage kernels list
  warpcage kernels copy mean_value my_kernels

The copy needs Warp and nothing of warpcage: from my_kernels.coordinates.mean_value import mean_value_position
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", metavar="action", required=True)
    actions.add_parser("list", help="print the name and the topic of every kernel file")
    copy = actions.add_parser("copy", help="copy one kernel file and the files that it needs")
    copy.add_argument("name", help="kernel file, such as mean_value or coordinates/mean_value")
    copy.add_argument("destination", metavar="DEST", help="folder of the copy; Python imports it by this name")
