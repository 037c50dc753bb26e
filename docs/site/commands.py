"""Writes docs/cli.md, docs/job_keys.md and a table of docs/python.md: `python docs/site/commands.py`."""

from __future__ import annotations

import json
import pathlib
import re
from dataclasses import MISSING
from typing import Any

from warpcage.core.checks import format_lines
from warpcage.core.spec import defaults_of, options_of, plain
from warpcage.edits.spec import EditSpec
from warpcage.field.render import RenderOptions
from warpcage.mesh.io.formats import FORMATS
from warpcage.splats.io.formats import BUILT_IN
from warpcage.studio.cli.program import COMMANDS, ORDER
from warpcage.studio.jobs.items import EvaluateItem, FitItem, FrameItem, Item

DOCS = pathlib.Path(__file__).resolve().parents[1]
PAGE, KEYS_PAGE, PYTHON_PAGE = DOCS / "cli.md", DOCS / "job_keys.md", DOCS / "python.md"

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

FORMATS_HEAD = """
## Formats of files

`warpcage info` lists them too, with those of other packages. Voxels are `.npz`; `mesh` writes and `cage` reads `.stl`
too. [Splats](splats.md#files) and [meshes](blender.md) say more.

| files of | format |
| --- | --- |
"""


def page() -> str:
    """The page: a table of all commands, then the examples of each, and the formats of files."""
    rows = "".join(f"| [`{name}`](#{name}) | {COMMANDS[name].help} |\n" for name in ORDER)
    parts = (f"\n## {name}\n\n```\n{COMMANDS[name].example.rstrip()}\n```\n" for name in ORDER)
    return HEAD + rows + "".join(parts) + _formats()


def _formats() -> str:
    """The files of meshes and splats, as `warpcage info` lists them."""
    lines = {"Cages and meshes": FORMATS, "Splats": BUILT_IN}
    rows = (f"| {what} | {line} |\n" for what, formats in lines.items() for line in format_lines(formats))
    return FORMATS_HEAD + "".join(rows)


KEYS_HEAD = """# Keys of job files

All keys of the lines of [job files](batch.md), and of "defaults" in their headers. The flags of `warpcage render` and
`animate` of the same names mean the same; `--cage-up` is `up` here, `--cage-object` is `object`. Lengths are world
units.
"""


def keys_page() -> str:
    """The page: a table of keys for each kind of item, and for edits."""
    specs = {"Frames": FrameItem, "Edits": EditSpec, "Fits": FitItem, "Evaluations": EvaluateItem}
    return KEYS_HEAD + "".join(f"\n## {title}\n\n{_keys(spec)}" for title, spec in specs.items())


def _keys(spec: type) -> str:
    """The table of a spec's keys."""
    rows, names = [], list(options_of(spec))
    if isinstance(spec, type) and issubclass(spec, Item):
        rows = [f"| `kind` | `{spec.kind}` | {'`frame`' if spec is FrameItem else 'needed'} |\n"]
        names = [name for name in spec.known() if name in options_of(spec)]
        if spec is FrameItem:
            short = ", ".join(f"`{name}`" for name in spec.short)
            rows.append(f"| {short} | one edit, its keys beside those of the frame, in place of `edits` | |\n")
    for name in names:
        option, default = options_of(spec)[name], defaults_of(spec)[name]
        choices = [choice for choice in option.values.choices if choice not in option.help]
        help = option.help + (": " + ", ".join(f"`{choice}`" for choice in choices) if choices else "")
        help = help.replace("0.2,0.3,0.4", "[0.2, 0.3, 0.4]")  # as a flag has it
        help += f" (version {option.since})" if option.since > 1 else ""
        rows.append(f"| `{name}` | {help} | {option.default_help or _default(default)} |\n")
    return "| key | meaning | if it is left out |\n| --- | --- | --- |\n" + "".join(rows)


def _default(default: Any) -> str:
    """A default as JSON has it."""
    return "needed" if default is MISSING else "" if default in (None, {}) else f"`{json.dumps(plain(default))}`"


def options_table() -> str:
    """The table of what `render` takes."""
    rows = (f"| `{name}` | {each.help} |\n" for name, each in options_of(RenderOptions).items() if name != "fill")
    return "| option | what it does |\n| --- | --- |\n" + "".join(rows)


def with_options(text: str) -> str:
    """docs/python.md with that table in the place of the one that it has."""
    return re.sub(r"\| option \| what it does \|\n(\|.*\n)+", lambda _: options_table(), text)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    PYTHON_PAGE.write_text(with_options(PYTHON_PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    KEYS_PAGE.write_text(keys_page(), encoding="utf-8")
