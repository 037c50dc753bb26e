"""Arguments of `warpcage render`."""

from __future__ import annotations

import argparse

from .. import deformation_options, options

NAME = "render"
HELP = "render one view of a field, as it is or deformed by a cage"
EXAMPLE = """\
  warpcage render lego.npz -o lego.png
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --size 800
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --overlay \\
      --disparity bent_disparity.png --masks bent_masks.png --camera data/lego:test:3
  warpcage render lego.npz --cage cage.obj --posed twist:60 -o twisted.png
  warpcage render lego.npz --cage cage.obj -o caged.png --overlay
  warpcage render lego.npz --edit arm.obj:arm_up.obj:keep --edit cab.obj:remove -o parts.png
  warpcage render lego.npz -o lego.exr --background transparent
  warpcage render lego.npz --cage cage.obj --posed bend:20 bend:40 bend:60 -o bends/
  warpcage render lego.npz -o views/ --cameras interpolate --scene data/lego:test --frames 60
"""

#: Pictures of --cameras interpolate from each camera to the next where --frames is not given.
STEPS = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="PICTURE",
        help="picture to write (.png, .exr), or folder: a picture of each pose",
    )
    _add_many(parser)
    parser.add_argument("--disparity", metavar="PICTURE", help="also write the disparity in colour (.png)")
    parser.add_argument("--depth", metavar="PICTURE", help="also write the depth in grey, near is white (.png)")
    parser.add_argument("--alpha", metavar="PICTURE", help="also write the opacity (.png)")
    parser.add_argument(
        "--masks",
        metavar="PICTURE",
        help="also write what is turned inside out (red), what was uncovered (blue) and where the posed cage has "
        "nothing to show (yellow) (.png), and warn of how much there is of each",
    )
    parser.add_argument("--overlay", action="store_true", help="draw the cage into the picture")
    options.add_clear_background(parser)
    options.add_fill(parser)
    options.add_antialias(parser)
    deformation_options.add_deformation(parser, several=True)
    options.add_view(parser)
    options.add_scene_scale(parser)
    options.add_device(parser)


def _add_many(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("many pictures")
    group.add_argument(
        "--cameras",
        choices=("interpolate", "given"),
        help="given: one picture from each camera of --scene; interpolate: pictures along a smooth path through "
        "them. The output is then a folder or a film (.mp4, .gif, .mov, .webm)",
    )
    group.add_argument(
        "--scene",
        metavar="FILE|SCENE[:SPLIT]",
        help="camera file, or scene of the cameras, e.g. data/lego:test (default split: train)",
    )
    group.add_argument(
        "--frames",
        type=options.positive_int,
        metavar="N",
        help=f"pictures of --cameras interpolate (default: {STEPS} from each camera to the next)",
    )
