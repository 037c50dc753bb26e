"""`warpcage edits`: write several edits to a file, or list those of one."""

from __future__ import annotations

import argparse
import dataclasses

from . import options
from .deformation import Deformation, PosedEdit, is_session, numbered_edits, session_edits
from .edit_words import EditWords, parse_edit, read_edits_file, write_edits_file


def run(args: argparse.Namespace) -> None:
    if args.file is None and not args.edit:
        raise ValueError("give an edits file to read, or --edit for each edit to write")
    if args.edit and args.output is None:
        raise ValueError("--edit needs -o, the edits file to write")
    output = None if args.output is None else options.check_output(args.output, (".json",), "edits file")
    if args.file is not None and is_session(args.file):
        if output is not None:
            raise ValueError(f"{args.file} is a session of the editor, which --edits takes as it is: it needs no -o")
        deformation, names = session_edits(args.file)
        _list(args.file, deformation, names)
        return
    words = [] if args.file is None else read_edits_file(args.file)
    words += [parse_edit(text) for text in args.edit or ()]
    deformation = numbered_edits(words, args, "smooth")
    if output is not None:
        write_edits_file(output, [_with_up(edit, args.cage_up) for edit in words])
    _list(f"wrote {output}" if output is not None else str(args.file), deformation, [str(edit) for edit in words])


def _with_up(edit: EditWords, up: str | None) -> EditWords:
    """An edit that says which axis points up in its cages, where it was said for all."""
    return edit if edit.up is not None else dataclasses.replace(edit, up=up)


def _list(what: str, deformation: Deformation, names: list[str]) -> None:
    """Print a line for each edit."""
    count = len(names)
    print(f"{what}: {count} edit{'s'[: count > 1]}{', in this order' if count > 1 else ''}")
    for number, (name, part) in enumerate(zip(names, deformation.parts, strict=True), 1):
        print(f"  {number}. {name} ({_size(part)})")


def _size(part: PosedEdit) -> str:
    """How large the cage of an edit is, and how many poses it has."""
    poses = 0 if part.keyframes is None else len(part.keyframes.cages) - 1
    return f"{len(part.edit.cage.vertices)} vertices" + (f", {poses} poses" if poses > 1 else "")
