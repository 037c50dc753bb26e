"""Arguments of `warpcage capture`, `fit` and `evaluate`."""

from __future__ import annotations

import argparse

from ...core.names import QUALITIES
from . import options
from .options import command

CAPTURE_EXAMPLE = """\
  warpcage capture walk.mp4 -o scene
  warpcage capture pictures -o scene --feature-size 1600
  warpcage capture pictures -o scene --pictures names.txt
  warpcage fit scene -o object.npz
"""


@command(
    "capture",
    "make a scene of a video or a folder of pictures: find the cameras, undistort the pictures",
    CAPTURE_EXAMPLE,
)
def add_capture_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", metavar="VIDEO|FOLDER", help="video, or folder of pictures (.jpg .png .webp .bmp .tif)"
    )
    options.add_output(parser, "SCENE", "folder to write, new or empty: a scene for fit")
    parser.add_argument(
        "--pictures", metavar="FILE", help="text file that names the pictures of the folder to use, one a line"
    )
    parser.add_argument(
        "--frames",
        default=120,
        help="most frames of a video that are taken: the sharp ones, spread along its way (default: %(default)s)",
        **options.COUNT,
    )
    parser.add_argument(
        "--feature-size",
        type=options.positive_int,
        default=800,
        metavar="PIXELS",
        help="longer side at which features are looked for; more is more exact and takes longer (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of what is drawn by lot (default: %(default)s)")
    options.add_quiet(parser)


FIT_EXAMPLE = """\
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage fit data/lego -o lego.npz --device cuda:0 --resolution 384 --background black
  warpcage fit data/lego -o lego.npz --quality high --checkpoint progress.npz --max-memory 6GB
  warpcage fit data/dtu/scan24 -o house.npz --split-masks
  warpcage fit my_phone_pictures -o fox.npz --refine-cameras
  warpcage fit my_phone_pictures -o fox.ply                  splats, which show whole places best
"""


@command("fit", "fit a radiance field to the pictures of a scene", FIT_EXAMPLE)
def add_fit_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_output(
        parser, "FIELD", f"field file to write: of voxels (.npz) or of splats ({' '.join(options.SPLAT_ENDINGS)})"
    )
    options.add_scene(parser, split="train")
    parser.add_argument(
        "--as",
        dest="representation",
        choices=("voxels", "splats"),
        help="what to make: voxels show objects best, above all with masks or opacity, splats whole places (default: "
        "by the ending of --output)",
    )
    options.add_background(
        parser,
        "white, behind pictures with opacity",
        "; or what is behind the object during the fit: random (random colours, for pictures with opacity), outer "
        "(voxels before and behind the object's box, to infinity), layers (of pictures behind it), constant, or auto: "
        "random for pictures with opacity, outer for whole ones (default: auto)",
    )
    parser.add_argument(
        "--straighten",
        action="store_true",
        help="turn the scene so that what is up for its cameras is +z; the field keeps the turn, by which cameras of "
        "the scene are turned too",
    )
    parser.add_argument(
        "--quality",
        choices=QUALITIES,
        default="standard",
        help="detail, at the cost of time: fast takes about half as long; high 3 to 9 times as long, with up to twice "
        "the memory, for about 1 dB where cameras are exact and views many, and for little elsewhere (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--checkpoint", metavar="FILE", help="save the progress to this file (.npz), and continue from it if it exists"
    )
    parser.add_argument(
        "--checkpoint-seconds",
        default=60.0,
        help="time between two checkpoints (default: %(default)s)",
        **options.positive("N"),
    )
    parser.add_argument(
        "--preview",
        metavar="PICTURE",
        help="write this picture (.png) anew every 20 seconds: a picture of the scene beside the field so far; before "
        "the first, of voxels, the cameras, points and the box of the object",
    )
    parser.add_argument(
        "--resolution",
        help="voxels along the longest side (default: follows the size of a pixel at the object)",
        **options.COUNT,
    )
    parser.add_argument(
        "--max-memory",
        metavar="SIZE",
        help="device memory that the fit may take, pictures included, such as 4GB or 800MiB. If it is short, pictures "
        "are kept at 8 bits per channel, and voxels stay larger (default: most of what is free)",
    )
    parser.add_argument(
        "--epochs",
        help="passes over the pixels that see the object (default: depends on --quality)",
        **options.positive("N"),
    )
    parser.add_argument("--steps", help="splats: pictures that are drawn", **options.COUNT)
    parser.add_argument("--most-splats", help="splats: how many at the end", **options.COUNT)
    parser.add_argument(
        "--variation",
        help="factor on the total variation: higher is smoother (default: chosen from the pictures, at least 30 "
        "for density and 15 for colours with masks or surroundings)",
        **options.positive("FACTOR"),
    )
    parser.add_argument(
        "--bounds", help="box around the object, world units (default: found from the pictures)", **options.BOX
    )
    cameras = parser.add_mutually_exclusive_group()
    cameras.add_argument(
        "--refine-cameras",
        action="store_true",
        help="refine poses, focal lengths and the exposure of each picture with the field, for cameras that are not "
        "exact; the refined ones are written beside it (.cameras.json)",
    )
    cameras.add_argument(
        "--check-cameras",
        action="store_true",
        help="find out while fitting whether cameras are off, and refine them so where they are; one line says which",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the order of the pixels (default: %(default)s)")
    options.add_device(parser)
    options.add_quiet(parser)


EVALUATE_EXAMPLE = """\
  warpcage evaluate lego.npz data/lego
  warpcage evaluate lego.npz data/lego --split test --downscale 2 --json psnr.json --worst worst.png
"""


@command("evaluate", "compare renders of a field with a scene's pictures (PSNR, SSIM)", EVALUATE_EXAMPLE)
def add_evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_scene(parser, split="test")
    options.add_background(parser, "the field's own")
    parser.add_argument("--json", metavar="FILE", help="also write the figures to this file (.json)")
    parser.add_argument(
        "--worst", metavar="FILE", help="write the worst view (.png): picture, render, and their difference"
    )
    cameras = parser.add_mutually_exclusive_group()
    cameras.add_argument(
        "--given-cameras",
        action="store_true",
        help="keep the cameras of the views as they are given. Otherwise those of fields of refined cameras go along "
        "with the refined ones near them, no view being looked at, and the mean of the given ones is told too",
    )
    cameras.add_argument(
        "--tune-cameras",
        action="store_true",
        help="turn and shift the camera of each view first so that it matches the field best, as is usual for fields "
        "of refined cameras: the figures then say how good the field is, not where the views are",
    )
    options.add_scale_and_device(parser)
    options.add_quiet(parser)
