"""Arguments of `warpcage edits`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "edits"
HELP = "write several edits of one scene to a file, or say what such a file holds"
EXAMPLE = """\
  warpcage edits -o house.edits.json --edit wing.obj:wing_up.obj --edit tower.obj:tower_aside.obj:keep \\
      --edit chimney.obj:remove
  warpcage edits house.edits.json
  warpcage edits house.edits.json --edit door.obj:bend:30:z:x -o more.edits.json
  warpcage render house.npz --edits house.edits.json -o house.png --overlay
  warpcage animate house.npz --edits house.edits.json -o house.mp4

An edit is a cage and what becomes of what is in it: CAGE:POSED moves it to where the posed cage is, CAGE:POSED:keep
leaves a copy where it was, CAGE:remove takes it away. CAGE:POSED:falloff=WIDTH holds the walls of the cage that cut
through matter and fades to rest in a band of that width inside them, so that the part does not tear off (held=still:
the walls that the pose leaves in place; held=3,4: these faces). crumbs=SIZE takes pieces smaller than that along, which
the cage cuts off. POSED is a cage file, a keyframe of a pose file (poses.json:NAME) or a preset (bend:40:x:z). Edits
act in their order, each on what the ones before it left. A Windows drive (C:\\cage.obj:C:\\posed.obj) is no separator.

The file is JSON, with paths relative to its own folder. Sessions of the editor (.session.json) are read too. Pictures
of what edits do are in docs/edits.md.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", help="edits file, or session of the editor (.session.json)")
    parser.add_argument(
        "--edit",
        action="append",
        metavar="CAGE:POSED[:keep]",
        help="an edit; give it again for the next. CAGE:remove takes away what is in the cage",
    )
    parser.add_argument("-o", "--output", metavar="FILE", help="edits file to write (.json)")
    options.add_cage_up(parser)
