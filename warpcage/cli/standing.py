"""How cage files stand: which axis points up in them, and the lines that say so."""

from __future__ import annotations

import argparse
import pathlib
import sys

from ..cage.cage import Cage
from ..cage.up_axis import Standing, load_standing


def read_rest(path: str, up: str | None, thing: object = None, *, part: bool = False) -> tuple[Cage, dict[str, str]]:
    """A cage at rest around a field or mesh, usable, and the axis to expect in files of its ending.
    up: "y" or "z"; None finds it by what the cage holds of `thing`, without which it is that of the format."""
    rest, standing = load_standing(Cage, path, up=up, reference=thing)
    rest.require_usable(f"cage {path!r}")
    # A cage that may hold a part alone, as one of several, is told of only where another axis would hold far more.
    if standing.turned or standing.doubtful or standing.likelier or not part:
        say_standing(path, standing, "--cage-up")
    return rest, {ending(path): standing.up}


def posed_up(args: argparse.Namespace) -> str | None:
    """The axis that points up in posed cage files, None where it is to be found."""
    return getattr(args, "posed_up", None) or args.cage_up


def say_standing(name: str, standing: Standing, option: str) -> None:
    """Print a line on stderr on how a cage file stands, if there is anything to say."""
    if standing.turned:
        before = "z" if standing.up == "y" else "y"
        print(f"warpcage: cage {name!r} {standing.note} ({option} {before} keeps it as it was)", file=sys.stderr)
    elif standing.doubtful:
        print(f"warpcage: warning: cage {name!r} {standing.note} (see {option})", file=sys.stderr)
    elif standing.note:
        print(f"warpcage: cage {name!r} {standing.note}", file=sys.stderr)


def ending(text: str) -> str:
    """The ending of a file, lower case."""
    return pathlib.Path(text).suffix.lower()
