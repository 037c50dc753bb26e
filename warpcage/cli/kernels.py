"""`warpcage kernels`: the kernel files, and copies of them for other programs."""

from __future__ import annotations

import argparse
import pathlib

from ..core.kernel_files import copy_kernel, find_kernel, kernel_names, kernel_summary
from . import options

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


def run(args: argparse.Namespace) -> None:
    if args.action == "list":
        _print_list()
    else:
        _copy(args.name, pathlib.Path(args.destination))


def _print_list() -> None:
    names = kernel_names()
    width = max(map(len, names))
    for name in names:
        print(f"{name:{width}}  {kernel_summary(name)}")


def _copy(text: str, destination: pathlib.Path) -> None:
    name = find_kernel(text)
    options.check_parent(destination)
    paths = copy_kernel(name, destination)
    module = f"{destination.resolve().name}.{name}".replace("/", ".")
    print(f"{destination} holds {name} and all that it needs; use it as in: from {module} import ...")
    for path in paths:
        print(f"  {path}")
