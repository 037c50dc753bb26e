"""`warpcage edit`: the editor in the browser."""

from __future__ import annotations

import argparse
import os
import pathlib
import sys
import webbrowser

from ..cage.cage import Cage
from ..core.files import require_file
from ..editor.demo import demo_files
from ..editor.edit import edit
from ..editor.session_file import session_path
from ..field.voxel_field import VoxelField
from . import inputs


def run(args: argparse.Namespace) -> None:
    if (args.field is None) == (not args.demo):
        raise ValueError("edit needs a field file, or --demo")
    device = inputs.chosen_device(args)
    if args.demo:
        if args.cage:
            raise ValueError("--demo brings its own cage: leave --cage out")
        args.field, demo_cage = map(str, demo_files(device))
    require_file(args.field, "field file")
    kept = pathlib.Path(args.session) if args.session else session_path(args.field)
    cages = [Cage.load(path, up=args.cage_up) for path in args.cage or ()]
    for path, cage in zip(args.cage or (), cages, strict=True):
        cage.require_usable(f"cage {path!r}")
    if kept.exists():
        if args.new:
            print(f"the session that was there is now {set_aside(kept)}")
        elif cages:
            raise ValueError(
                f"{str(kept)!r} holds a session of this field: leave --cage out to go on with it, or give --new"
            )
    if args.demo and not kept.exists():
        cages = [Cage.load(demo_cage)]
    field = VoxelField.load(args.field, scene_scale=args.scene_scale, device=device)
    options = {"host": args.host, "port": args.port, "allowed_hosts": args.allow_host}
    with edit(field, cages or None, session=kept, field_path=args.field, **options) as editor:
        print(f"edit {args.field} at {editor.url}\n(Ctrl+C ends; the session is kept in {kept})", flush=True)
        if not args.no_browser and not _opened(editor.url):
            print("no browser could be opened here: open the address above", file=sys.stderr)
        editor.wait()


def set_aside(path: pathlib.Path) -> pathlib.Path:
    """Give a session's file the first free name of NAME.1.session.json, NAME.2.session.json, ... and return it."""
    stem, _, ending = path.name.partition(".")
    number = 1
    while (other := path.with_name(f"{stem}.{number}.{ending}")).exists():
        number += 1
    os.rename(path, other)
    return other


def _opened(url: str) -> bool:
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
