"""`warpcage mesh`: a field's surface."""

from __future__ import annotations

from ..core.files import atomic_path
from . import inputs, options

NAME = "mesh"
HELP = "extract the surface of a field as a triangle mesh"
EXAMPLE = """\
  warpcage mesh lego.npz -o lego.obj
  warpcage mesh lego.npz -o lego.ply --threshold 20 --components all
"""
ENDINGS = (".obj", ".ply", ".off", ".stl", ".glb")

#: (x, y, z) to (x, z, -y): glTF has y up, in meshes as in cages; the other formats take the numbers as they are.
TO_Y_UP = ((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1))


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument(
        "-o", "--output", required=True, metavar="MESH", help="mesh to write (.obj .ply .off .stl .glb; glTF with y up)"
    )
    parser.add_argument(
        "--threshold",
        type=options.positive_float,
        metavar="SIGMA",
        help="density at the surface, per world unit (default: chosen from the field)",
    )
    parser.add_argument(
        "--components",
        choices=("largest", "all"),
        default="largest",
        help="keep the largest connected part or all (default: %(default)s)",
    )
    options.add_scene_scale(parser)
    options.add_device(parser)


def run(args):
    output = options.check_output(args.output, ENDINGS, "mesh file")
    field = inputs.read_field(args)

    mesh = field.extract_mesh(threshold=args.threshold, components=args.components)
    low, high = mesh.bounds
    if output.suffix.lower() == ".glb":
        mesh.apply_transform(TO_Y_UP)
    with atomic_path(output) as temporary:
        mesh.export(temporary, file_type=output.suffix[1:].lower())
    print(
        f"wrote {output}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, from "
        f"{low.round(3).tolist()} to {high.round(3).tolist()}"
    )
