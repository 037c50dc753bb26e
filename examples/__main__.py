"""`python -m warpcage.examples` lists the examples, `python -m warpcage.examples render_lego --quick` runs one."""

from __future__ import annotations

import ast
import os
import pathlib
import subprocess
import sys

from warpcage.core.names import meant

FOLDER = pathlib.Path(__file__).resolve().parent


def examples() -> dict[str, pathlib.Path]:
    """The files of the examples by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.py")) if not path.stem.startswith("__")}


def main(words: list[str]) -> int:
    """Run the example that the first word names with the others; without words list all. Returns the exit status."""
    there = examples()
    if not words or words[0] in ("-h", "--help"):
        print("usage: python -m warpcage.examples NAME [--help | words of the example]\n")
        width = max(map(len, there))
        for name, path in there.items():
            about = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            print(f"{name:{width}}  {about.splitlines()[0]}")
        return 0
    name = words[0].removesuffix(".py")
    if name not in there:
        more = meant(name, there) or ": `python -m warpcage.examples` lists them"
        print(f"warpcage: error: there is no example {name!r}{more}", file=sys.stderr)
        return 2
    # a process of its own, as one of them wants to begin without warpcage; it imports the package that this one is of
    paths = [os.path.dirname(sys.modules["warpcage"].__path__[0]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run([sys.executable, str(there[name]), *words[1:]], env=environment).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
