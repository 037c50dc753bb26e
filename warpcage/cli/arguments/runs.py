"""Arguments of `warpcage sweep` and `run`."""

from __future__ import annotations

import argparse

from ...core.names import COORDINATES, DENSITIES, FIELD_COORDINATES, TRANSPARENT
from . import options
from .options import command

SWEEP_EXAMPLE = """\
  warpcage sweep lego.npz --cage cage.obj --poses random:100 --cameras orbit:8 -o sweep.jsonl
  warpcage sweep lego.npz --cage cage.obj --poses random:5000 --cameras random:4 --size 800 \\
      --records webdataset --image jpg -o augmented.jsonl
  warpcage sweep lego.npz --cage cage.obj --poses rest poses.json twist:60 --cameras data/lego:test \\
      --coordinates mean_value harmonic green -o compared.jsonl
  warpcage run sweep.jsonl -o dataset --workers 2
"""

#: What stands behind pictures where --background is not given: of PNG files, and of JPEG files, which have no opacity.
USUAL_BACKGROUNDS = {"png": TRANSPARENT, "jpg": "white"}

#: The word of --background for that of the field.
OWN = "own"

#: Modes of random poses, as `cage.pose_modes` has them, which needs NumPy.
MODES = ("bend", "twist", "stretch", "taper", "wave", "bump")


@command("sweep", "write a job file of many poses of a field from many cameras, for data sets", SWEEP_EXAMPLE)
def add_sweep_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_output(parser, "JOBS", "job file to write (.jsonl); poses and cameras go beside it")
    _add_poses(parser)
    _add_cameras(parser)
    group = parser.add_argument_group("pictures")
    group.add_argument(
        "--coordinates",
        nargs="+",
        choices=COORDINATES,
        default=[FIELD_COORDINATES],
        metavar="KIND",
        help=f"kinds of coordinates, each of which makes all pictures: {', '.join(COORDINATES)} "
        f"(default: {FIELD_COORDINATES})",
    )
    group.add_argument(
        "--resolution",
        type=options.lattice_resolution,
        default=options.BY_SIZE,
        metavar="N",
        help='lattice cells along the longest side of the cage, or "precise" (default: by the size of the picture)',
    )
    group.add_argument("--density", choices=DENSITIES, default="opacity", help="as for render (default: %(default)s)")
    options.add_map(group)
    options.add_antialias(group)
    options.add_background(
        group,
        f"{TRANSPARENT}; of JPEG files white",
        f"; {TRANSPARENT}: opacity in the picture; {OWN}: what the field has behind it",
    )
    group.add_argument(
        "--supersampling", help="rays along each side of a pixel (default: that of the field)", **options.COUNT
    )
    _add_records(parser)
    options.add_scale_and_device(parser)
    options.add_quiet(parser)


def _add_poses(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("poses")
    group.add_argument(
        "--cage",
        required=True,
        metavar="REST",
        help=f"cage around the undeformed object ({' '.join(options.CAGE_ENDINGS)})",
    )
    group.add_argument(
        "--poses",
        nargs="+",
        default=["random:100"],
        metavar="POSES",
        help="random:N for each seed; posed cage files, pose files (all keyframes of poses.json, or poses.json:NAME), "
        "animated glTF files, numbered files (walk_####.obj); arrays of vertices (.npy, (poses, vertices, 3)); rest; "
        "and presets such as bend:40:x:z (default: random:100)",
    )
    group.add_argument(
        "--seeds",
        nargs="+",
        type=options.whole_number,
        default=[0],
        metavar="SEED",
        help="seeds of random poses; the first is that of random cameras too (default: 0)",
    )
    group.add_argument(
        "--stretch",
        nargs=2,
        type=options.positive_float,
        default=(0.5, 2.0),
        metavar=("LEAST", "LARGEST"),
        help="bounds of random poses: lengths in the pose over lengths at rest, everywhere (default: 0.5 2)",
    )
    group.add_argument(
        "--reach",
        nargs=2,
        type=options.positive_float,
        default=(0.3, 1.0),
        metavar=("LEAST", "MOST"),
        help="how far random poses go, as shares of the farthest that the bounds allow (default: 0.3 1)",
    )
    group.add_argument(
        "--modes",
        nargs="+",
        choices=MODES,
        default=list(MODES),
        metavar="MODE",
        help=f"what random poses are made of: {', '.join(MODES)} (default: all)",
    )
    group.add_argument(
        "--write-poses",
        action="store_true",
        help="draw random poses now and write them beside the job file, which takes some 30 ms of a core each; then "
        "cameras that are made see every pose whole (default: workers draw them, each what it makes)",
    )
    group.add_argument(
        "--falloff",
        help="for a cage around a part: hold the walls that cut through matter, and let poses fade to rest in a band "
        "of this width inside them, world units (default: no wall is held)",
        **options.positive("WIDTH"),
    )
    options.add_cage_up(group, found=True, posed=True)


def _add_cameras(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("cameras")
    group.add_argument(
        "--cameras",
        default="orbit:8",
        metavar="CAMERAS",
        help="orbit:N[:ELEVATION]: a circle around all poses; random:N: N places above the horizon, others for each "
        "pose; a camera file (.json, .glb); a transforms.json; or a scene, SCENE[:SPLIT] (default: orbit:8)",
    )
    group.add_argument(
        "--views", help="see each pose from N of the cameras, chosen at random (default: from all)", **options.COUNT
    )
    group.add_argument(
        "--fov",
        type=options.field_of_view,
        default=40.0,
        metavar="DEGREES",
        help="horizontal field of view of orbit and random (default: %(default)s)",
    )
    group.add_argument(
        "--size",
        help="width, or width and height, or a shape such as 16:9, as for render (default: 400, or the size of the "
        "cameras' pictures)",
        **options.PIXELS,
    )


def _add_records(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("records (docs/sweeps.md)")
    group.add_argument(
        "--records",
        choices=("folder", "webdataset"),
        default="folder",
        help="folder: files, with transforms.json for each pose and for all; webdataset: tar shards (default: "
        "%(default)s)",
    )
    group.add_argument("--image", choices=("png", "jpg"), default="png", help="pictures (default: %(default)s)")
    group.add_argument("--items-per-shard", default=1000, help="pictures of a shard (default: 1000)", **options.COUNT)
    group.add_argument("--no-depth", dest="depth", action="store_false", help="leave depth out")
    group.add_argument("--no-alpha", dest="alpha", action="store_false", help="leave opacity out")


RUN_EXAMPLE = """\
  warpcage run jobs.jsonl -o frames
  warpcage run jobs.jsonl -o frames --dry-run
  warpcage run jobs.jsonl -o frames --workers 2
  warpcage run jobs.jsonl -o /shared/frames --cluster 10.0.0.1:6379
  warpcage run jobs.jsonl -o /shared/frames --part 3/16
"""


@command(
    "run",
    "make all that a job file describes: frames, fits and evaluations, over several GPUs or machines",
    RUN_EXAMPLE,
)
def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("jobs", help="job file (.jsonl), as docs/batch.md describes it")
    options.add_output(
        parser,
        "DIR",
        "folder of what is made, and of manifest.jsonl, which says what became of each item. What is there "
        "already and whose inputs did not change is kept",
    )
    parser.add_argument(
        "--workers",
        help="processes that work, one a GPU, or with a part of the cores each where there is none (default: 1; on a "
        "cluster all of its GPUs)",
        **options.COUNT,
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help='work on a cluster, which needs Ray, at an address such as 10.0.0.1:6379, or "auto" for the one that this '
        "machine belongs to; all its machines see the files under the same paths",
    )
    parser.add_argument(
        "--part",
        metavar="K/N",
        help="make the K-th of N equal ranges of the items, such as 3/16, beside runs of others; a run without it "
        "joins their manifests (docs/farms.md)",
    )
    parser.add_argument(
        "--retries",
        type=options.whole_number,
        default=2,
        metavar="N",
        help="how often an item is tried again, elsewhere where possible, after the death of its worker or an error "
        "that is not one of its input (default: %(default)s)",
    )
    parser.add_argument(
        "--item-timeout",
        help="end the worker of an item that takes longer, loading included, and try the item again like one of a "
        "worker that died. One worker is a process of its own then (default: no limit)",
        **options.positive("SECONDS"),
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="say what would be made, what is there already, and how long it would take, from an item of each kind "
        "that is made once and thrown away",
    )
    options.add_device(parser)
    options.add_quiet(parser)
