"""`warpcage bake`: a deformed scene as a field of its own."""

from __future__ import annotations

from ..deform.bake import bake
from . import inputs, options

NAME = "bake"
HELP = "resample a deformed field into a new one, which needs no cage and renders faster"
EXAMPLE = """\
  warpcage bake lego.npz --cage cage.obj --posed posed.obj -o bent.npz
  warpcage bake lego.npz --cage cage.obj --posed twist:60 -o twisted.npz --format svox2 --voxels 512
"""


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument("-o", "--output", required=True, metavar="FIELD", help="field to write (.npz)")
    parser.add_argument(
        "--voxels",
        type=options.positive_int,
        metavar="N",
        help="voxels along the longest side of the deformed scene (default: as large as the field's)",
    )
    parser.add_argument(
        "--format",
        choices=("warpcage", "svox2"),
        default="warpcage",
        help="warpcage, or svox2: a Plenoxels checkpoint (default: %(default)s)",
    )
    options.add_deformation(parser)
    options.add_scene_scale(parser)
    options.add_device(parser)


def run(args):
    output = options.check_output(args.output, (".npz",), "field file")
    if args.cage is None:
        raise ValueError("bake needs a deformation: --cage and --posed")
    rest, posed = inputs.read_cages(args)
    field = inputs.read_field(args)

    baked = bake(inputs.make_deformer(field, rest, args).pose(posed), resolution=args.voxels)
    baked.save(output, format=args.format)
    size = "x".join(map(str, baked.resolution))
    print(f"wrote {output}: {baked.voxel_count} voxels of {size}, {output.stat().st_size / 1e6:.1f} MB")
