"""`warpcage edit`: the editor in the browser."""

from __future__ import annotations

import argparse
import contextlib
import os
import pathlib
import sys
import warnings
import webbrowser
from collections.abc import Iterator

from ..cage.cage import Cage
from ..core.files import require_file
from ..editor.demo import demo_files
from ..editor.edit import edit, require_libraries
from ..editor.session import free_session_path, session_path
from ..errors import InputError
from ..field.selection import NodeSelection
from ..splats.io import splat_path
from ..splats.splat_field import load_field
from . import shared
from .pose_words import read_rest


def run_edit(args: argparse.Namespace) -> None:
    # each pose would say so anew, with other numbers; the page shows what the cage does
    warnings.filterwarnings("ignore", message="a cage has gaps narrower")
    if (args.field is None) == (not args.demo):
        raise InputError("edit needs a field file, or --demo")
    try:
        require_libraries()
    except ImportError as error:  # not for want of warpcage's own
        raise InputError(str(error)) from None
    device = shared.chosen_device(args)
    if args.demo:
        if args.cage or args.selection:
            raise InputError("--demo brings its own cage: leave --cage and --selection out")
        args.field, demo_cage = map(str, demo_files(device))
    args.field = str(splat_path(args.field))
    require_file(args.field, "field file")
    kept = pathlib.Path(args.session) if args.session else session_path(args.field)
    if kept.exists() and (args.cage or args.selection) and not args.new:
        option = "--cage" if args.cage else "--selection"
        raise InputError(
            f"{str(kept)!r} holds a session of this field: leave {option} out to go on with it, or give --new"
        )
    field = load_field(args.field, scene_scale=args.scene_scale, device=device)
    cages = [read_rest(path, args.cage_up, field, part=True, name=args.cage_object)[0] for path in args.cage or ()]
    if args.selection:
        cages.append(Cage.from_field(NodeSelection.load(args.selection, field)))
    if args.demo and (args.new or not kept.exists()):
        cages = [Cage.load(demo_cage)]
    options = {
        "field_path": args.field,
        "scene_scale": args.scene_scale,
        "host": args.host,
        "port": args.port,
        "allowed_hosts": args.allow_host,
    }
    with set_aside(kept) if args.new and kept.exists() else contextlib.nullcontext():
        editor = edit(field, cages or None, session=kept, **options)
    with editor:
        print(f"edit {args.field} at {editor.url}\n(Ctrl+C ends; the session is kept in {kept})", flush=True)
        if not args.no_browser and not _opened(editor.url):
            print("no browser could be opened here: open the address above", file=sys.stderr)
        editor.wait()


@contextlib.contextmanager
def set_aside(path: pathlib.Path) -> Iterator[None]:
    """Give a session's file the first free name of NAME.1.session.json, NAME.2.session.json, ...
    Where the block ends with an error, it gets its own name back."""
    other = free_session_path(path)
    os.rename(path, other)
    try:
        yield
    except BaseException:
        if not os.path.lexists(path):
            os.rename(other, path)
        raise
    print(f"the session that was there is now {other}")


def _opened(url: str) -> bool:
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
