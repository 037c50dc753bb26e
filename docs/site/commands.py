"""Writes docs/cli.md from what the command line says of itself: `python docs/site/commands.py`."""

from __future__ import annotations

import pathlib

from warpcage.studio.cli.program import COMMANDS, ORDER

PAGE = pathlib.Path(__file__).resolve().parents[1] / "cli.md"

HEAD = """# Commands

Every command has `--help`; `--help all` says all options. Commands that compute take `--device cpu` or `--device
cuda:0`; without it they use CUDA where there is one. `WARPCAGE_THREADS` limits the CPU threads. The first run on a
machine compiles the kernels that it uses and keeps them in `~/.cache/warp` (`WARP_CACHE_PATH`);
[measurements](measurements.md) says how long that takes. Bad input ends with one line and status 2, and leaves
nothing half-written; `check` and `doctor` end with 1 where they found a fault, an interrupted command with 130. After
`pip install -e ".[completion]"` and `eval "$(register-python-argcomplete warpcage)"` a shell completes options and
names.

| command | what it does |
| --- | --- |
"""


def page() -> str:
    """The page: a table of all commands, then the examples of each."""
    rows = "".join(f"| [`{name}`](#{name}) | {COMMANDS[name].help} |\n" for name in ORDER)
    parts = (f"\n## {name}\n\n```\n{COMMANDS[name].example.rstrip()}\n```\n" for name in ORDER)
    return HEAD + rows + "".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
