"""The command line: `warpcage fit | mesh | cage | check | pose | render | animate | ...`."""
# A command has two modules of its name. `arguments/NAME.py` holds NAME, HELP (one line), EXAMPLE (shown by --help) and
# add_arguments(parser); it needs the standard library alone, so that help comes at once. `NAME.py` holds run(args),
# which returns the exit status where it is not 0. It is loaded when the command is chosen. Wrong arguments are refused
# before any long work.

from __future__ import annotations

import importlib
import sys


def main(argv: list[str] | None = None) -> int:
    """Run one command; its words are those of sys.argv where `argv` is None. Returns the exit status:
    0 done, 1 examined and unusable, 2 failed, 130 interrupted, 143 terminated, 129 where the terminal was closed."""
    try:  # around the import too: whoever interrupts the start wants no traceback either
        return importlib.import_module(".program", __package__).run(argv)
    except KeyboardInterrupt:
        print("warpcage: interrupted", file=sys.stderr)
        return 130
