"""Benchmarks of warpcage.

    python benchmarks SUITE [COMMAND] [options]

A suite of several commands lists them where none is given. README.md says what each measures.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import pathlib
import sys

from common import HERE, UsageError

#: Folders of suites, each a module that has commands.
FOLDERS = ("library", "programs", "pages")


def main(arguments: list[str]) -> int | None:
    """Run a command; its exit status."""
    paths = (path for folder in FOLDERS for path in sorted((HERE / folder).glob("*.py")))
    suites = {path.stem.replace("_", "-"): path for path in paths if "\n@command(" in path.read_text(encoding="utf-8")}
    if not arguments or arguments[0] not in suites:
        lines = [f"  {name:16} {first_line(path)}" for name, path in suites.items()]
        return listed(arguments, [__doc__.strip(), "", *lines])
    path = suites[arguments[0]]
    module = importlib.import_module(f"{path.parent.name}.{path.stem}")
    found = {
        name.replace("_", "-"): function
        for name, function in vars(module).items()
        if hasattr(function, "options") and function.__module__ == module.__name__
    }
    named = list(found) != ["main"]
    if named and (len(arguments) < 2 or arguments[1] not in found):
        lines = [f"  {name:16} {function.__doc__.splitlines()[0]}" for name, function in found.items()]
        return listed(arguments[1:], [f"python benchmarks {arguments[0]} COMMAND [options]", "", *lines])
    function = found[arguments[1] if named else "main"]
    parser = argparse.ArgumentParser(
        prog=" ".join(["python benchmarks", *arguments[: 1 + named]]),
        description=inspect.getdoc(function),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for names, more in function.options:
        parser.add_argument(*names, **more)
    try:
        return function(parser.parse_args(arguments[1 + named :]))
    except UsageError as error:
        parser.error(str(error))


def listed(arguments: list[str], lines: list[str]) -> int:
    """Say what there is; 2 where something else was asked for."""
    print("\n".join(lines))
    return 0 if not arguments or arguments[0] in ("-h", "--help") else 2


def first_line(path: pathlib.Path) -> str:
    """What a module's docstring begins with, without importing it."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").splitlines()[0]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
