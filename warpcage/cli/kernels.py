"""`warpcage kernels`: the kernel files, and copies of them for other programs."""

from __future__ import annotations

import argparse
import pathlib

from ..core.kernel_files import copy_kernel, find_kernel, kernel_names, kernel_summary
from . import options


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
