"""The command line: `warpcage fit | mesh | cage | check | pose | render | animate | ...`."""
# Commands stand in groups of two modules of one name. `arguments/GROUP.py` lists its commands (name, help, example,
# arguments) with the standard library alone, so that help comes at once. `GROUP.py` holds run_NAME(args), loaded when
# chosen, which returns the exit status where it is not 0. Wrong arguments are refused before any long work.

from __future__ import annotations

import importlib
import sys


def main(argv: list[str] | None = None) -> int:
    """Run one command; `argv` None takes sys.argv. Returns the exit status:
    0 done, 1 examined and unusable, 2 failed, 130 interrupted, 143 terminated, 129 where the terminal was closed."""
    try:  # around the import too: an interrupt at the start gives no traceback either
        return importlib.import_module(".program", __package__).run(argv)
    except KeyboardInterrupt:
        print("warpcage: interrupted", file=sys.stderr)
        return 130
