"""Arguments of `warpcage info`, `demo`, `doctor` and `kernels`."""

from __future__ import annotations

import argparse

from . import options
from .options import command

INFO_EXAMPLE = """\
  warpcage info
  warpcage info lego.npz
  warpcage info cage.obj
  warpcage info data/lego --split test --sheet lego.png
  warpcage info place --box place.png                        where fit takes the object to be
"""

#: Most pictures on a contact sheet, and their longest side there.
SHEET_PICTURES, SHEET_SIDE = 100, 160


@command(
    "info",
    "describe a field, a cage, poses, edits, cameras, places, a stage or a scene; without a file: versions and devices",
    INFO_EXAMPLE,
)
def add_info_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "field",
        metavar="file",
        nargs="?",
        help=f"field (.npz), splats ({' '.join(options.SPLATS_READ)}), cage "
        f"({' '.join(options.CAGE_ENDINGS)}), poses, edits, cameras, places or stages (.json) or scene folder",
    )
    parser.add_argument("--split", default="train", help="split of a scene (default: %(default)s)")
    options.add_scene_format(parser)
    parser.add_argument(
        "--sheet",
        metavar="PICTURE",
        help=f"write a contact sheet of a scene's pictures, at most {SHEET_PICTURES} of them (.png)",
    )
    parser.add_argument(
        "--box", metavar="PICTURE", help="write a picture of a scene's cameras, points and object's box (.png)"
    )
    options.add_scale_and_device(parser)


KERNELS_EXAMPLE = """\
  warpcage kernels list
  warpcage kernels copy mean_value my_kernels
  warpcage kernels copy lattice my_maps
  warpcage kernels copy harmonics my_kernels --alone

The copy needs Warp and nothing of warpcage: from my_kernels.coordinates.mean_value import mean_value_position. It has
the modules that launch its kernels, in host/, the licence, and a README.md with a call that runs.
"""


@command(
    "kernels", "list the kernel files, or copy some with all that they need into a program of your own", KERNELS_EXAMPLE
)
def add_kernels_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", metavar="action", required=True)
    actions.add_parser("list", help="print the name and the topic of every kernel file")
    copy = actions.add_parser("copy", help="copy a kernel file, or all of a folder, with what they need")
    copy.add_argument(
        "name", help="kernel file, such as mean_value or coordinates/mean_value, or a folder of them, such as lattice"
    )
    copy.add_argument("destination", metavar="DEST", help="folder of the copy; Python imports it by this name")
    copy.add_argument(
        "--alone", action="store_true", help="without the modules that launch the kernels, for launches of your own"
    )


DEMO_EXAMPLE = """\
  warpcage demo
  warpcage demo -o out --device cuda:0

Makes an excavator of bricks with pictures of it, fits a field to them, puts a cage around it and bends it. The folder
has the pictures, the film, the mesh, the cages and the field then; the seconds of each stage are told.
"""


@command(
    "demo",
    "go the whole way, from pictures to a bent object, on a small scene that is made for it",
    DEMO_EXAMPLE,
    "doctor",
)
def add_demo_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-o", "--output", metavar="FOLDER", default="warpcage_demo", help="where results go (default: %(default)s)"
    )
    options.add_device(parser)


DOCTOR_EXAMPLE = """\
  warpcage doctor
  warpcage doctor --device cuda:0

Versions, devices, driver, memory, kernel cache, codecs, extras, and a test of some seconds. The exit status is 1 where
something keeps it from working.
"""


command(
    "doctor",
    "look whether warpcage works on this machine, and say what to do where it does not",
    DOCTOR_EXAMPLE,
    "doctor",
)(options.add_device)
