"""Arguments of `warpcage render` and `animate`."""

from __future__ import annotations

import argparse
from fractions import Fraction
from typing import Any

from ...core.names import LOOPS
from . import options
from .options import command

RENDER_EXAMPLE = """\
  warpcage render lego.npz -o lego.png
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --size 800
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --overlay \\
      --disparity bent_disparity.png --masks bent_masks.png --camera data/lego:test:3
  warpcage render lego.npz --cage cage.obj --posed twist:60 -o twisted.png
  warpcage render lego.npz --cage cage.obj -o caged.png --overlay
  warpcage render lego.npz --edit arm.obj:arm_up.obj:keep --edit cab.obj:remove -o parts.png
  warpcage render lego.npz --add mic.npz:beside.json -o both.png --save-stage both.stage.json
  warpcage render lego.npz -o lego.exr --background transparent
  warpcage render lego.npz --cage cage.obj --posed bend:20 bend:40 bend:60 -o bends/
  warpcage render lego.npz -o views/ --cameras interpolate --scene data/lego:test --frames 60
"""

#: Pictures of --cameras interpolate from each camera to the next where --frames is not given.
STEPS = 8


@command("render", "render one view of a field, as it is or deformed by a cage", RENDER_EXAMPLE)
def add_render_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_output(parser, "PICTURE", "picture to write (.png, .exr), or folder: a picture of each pose")
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
    options.add_deformation(parser, several=True)
    options.add_things(parser, saved=True)
    options.add_view(parser)
    options.add_scale_and_device(parser)


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
        help=f"pictures of --cameras interpolate (default: {STEPS} from each camera to the next)",
        **options.COUNT,
    )


ANIMATE_EXAMPLE = """\
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
  warpcage animate lego.npz --cage cage.obj --posed bend:45:y:z -o bend.gif --frames 24 --turn 0 --size 240
  warpcage animate lego.npz --cage cage.obj --posed one.obj two.obj rest -o walk.mp4 --motion once
  warpcage animate lego.npz --cage cage.obj --posed poses.json -o dance.mp4 --loop ping-pong
  warpcage animate lego.npz --cage cage.obj --posed walk.glb -o walk.mp4
  warpcage animate lego.npz --cage cage.obj --posed "walk_####.obj" -o walk.mp4 --fps 25
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o frames/ --frames 240 --cameras data/lego:test
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mov --background transparent
  warpcage animate lego.npz --edits lego.edits.json -o parts.mp4
  warpcage animate lego.npz --add mic.npz:around.json -o both.mp4
  warpcage animate lego.npz --session lego.session.json -o film.mp4 --size 800 600
  warpcage animate lego.npz --cage cage.obj --posed posed.obj --frames 240 --jobs film.jsonl
  warpcage run film.jsonl -o frames

An output without an ending is a folder of pictures, PNG or EXR (--format). Opacity is kept by those, .mov (ProRes 4444)
and .webm (VP9); colours are straight, but in EXR files multiplied by opacity. If the command is interrupted, run it
again: it renders only what is missing of a folder.

The film goes from rest through the poses of --posed in order. Each vertex moves straight or smoothly from pose to
pose. If all poses are the same preset, its amount changes instead, so that a bend stays an arc.

Keys at times make a film of their own length and rate, without the rest pose before them: a pose file with times
(`warpcage pose -o poses.json --key NAME --at SECONDS`), an animated glTF file, or one cage file a frame: a folder, a
pattern, or all of their names. --motion goes from rest through their poses instead.

--session makes the film of a session of the editor: its keys, its camera and its settings. A folder is new or empty
then, and appears when all of its pictures are there.
"""

#: What a session decides by itself, of the options that have a default.
OF_SESSIONS = ("frames", "fps", "motion", "interpolation", "show", "coordinates", "resolution", "density", "fov")


class Default:
    """The default of an option that a session decides, as nobody gave it; value: what it is without a session."""

    def __init__(self, value: Any):
        self.value = value

    def __str__(self) -> str:
        return str(self.value)


@command(
    "animate",
    "render a film from rest through the poses and back, with the camera turning around the object",
    ANIMATE_EXAMPLE,
)
def add_animate_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("-o", "--output", metavar="FILM", help="film (.mp4, .gif, .mov, .webm) or folder of pictures")
    goal.add_argument(
        "--jobs",
        metavar="FILE",
        help="render nothing, but write a job file (.jsonl) of the frames: warpcage run makes them, over GPUs and "
        "machines",
    )
    parser.add_argument(
        "--workers",
        help="processes that render, one a GPU, or with a part of the cores each where there is none (default: this "
        "one)",
        **options.COUNT,
    )
    parser.add_argument("--frames", default=48, help="number (default: %(default)s)", **options.COUNT)
    parser.add_argument(
        "--fps",
        type=options.positive_fraction,
        default=Fraction(24),
        metavar="RATE",
        help="frames per second, such as 24, 12.5 or 30000/1001 (default: %(default)s)",
    )
    parser.add_argument(
        "--motion",
        choices=("swing", "once", "hold"),
        default="swing",
        help="swing: to the last pose and back; once: to the last pose; hold: posed throughout (default: %(default)s)",
    )
    parser.add_argument(
        "--loop",
        choices=LOOPS,
        help="what a film of keys at times does at its end: once; loop: begin again; ping-pong: go back to its "
        "beginning (default: what the pose file says, or once)",
    )
    parser.add_argument(
        "--interpolation",
        choices=("smooth", "linear"),
        default="smooth",
        help="linear: straight from pose to pose at constant speed; smooth: without jolts at the poses and slow at "
        "both ends (default: %(default)s)",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        default=None,
        help="replace the frames of another film that are in the folder",
    )
    session = parser.add_argument_group("a session of the editor")
    session.add_argument("--session", metavar="FILE", help="session file (.session.json), instead of all that it holds")
    path = parser.add_argument_group("camera path")
    path.add_argument(
        "--turn",
        type=options.finite_float,
        default=None,
        metavar="DEGREES",
        help="how far the camera turns around the target; 0 keeps it still (default: 360)",
    )
    path.add_argument(
        "--cameras",
        metavar="FILE|SCENE[:SPLIT]",
        help="move through the cameras of a file instead (.json, .glb, .gltf; at their times where they have some), or "
        "of a scene's pictures, e.g. data/lego:test (default split: train)",
    )
    parser.add_argument(
        "--show",
        choices=options.PICTURE_KINDS,
        default="rgb",
        help="rgb; alpha; depth (near is white) or disparity, on one scale for the whole film; masks: what is turned "
        "inside out, what was uncovered and where a posed cage has nothing to show, with a warning of how much "
        "(default: %(default)s)",
    )
    parser.add_argument("--overlay", action="store_true", help="draw the cage into the pictures")
    options.add_clear_background(parser)
    options.add_fill(parser)
    options.add_antialias(parser)
    options.add_deformation(parser, keyframes=True)
    options.add_things(parser)
    options.add_view(parser)
    options.add_scale_and_device(parser)
    options.add_quiet(parser)
    parser.set_defaults(**{name: Default(parser.get_default(name)) for name in OF_SESSIONS})
