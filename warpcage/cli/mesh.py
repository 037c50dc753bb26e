"""`warpcage mesh`: a field's surface."""

from . import options

NAME = "mesh"
HELP = "extract the surface of a field as a triangle mesh"
EXAMPLE = """\
  warpcage mesh lego.npz -o lego.obj
  warpcage mesh lego.npz -o lego.ply --threshold 20 --components all
"""

ENDINGS = (".obj", ".ply", ".off", ".stl", ".glb")


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument("-o", "--output", required=True, metavar="MESH",
                        help="mesh to write (.obj .ply .off .stl .glb)")
    parser.add_argument("--threshold", type=options.positive_float, metavar="SIGMA",
                        help="density at the surface, per world unit (default: chosen from the field)")
    parser.add_argument("--components", choices=("largest", "all"), default="largest",
                        help="keep the largest connected part or all (default: %(default)s)")
    options.add_device(parser)


def run(args):
    output = options.check_output(args.output, ENDINGS, "mesh file")
    field = options.read_field(args)
    from ..files import atomic_path

    mesh = field.extract_mesh(threshold=args.threshold, components=args.components)
    with atomic_path(output) as temporary:
        mesh.export(temporary, file_type=output.suffix[1:].lower())
    low, high = mesh.bounds
    print(f"wrote {output}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, from "
          f"{low.round(3).tolist()} to {high.round(3).tolist()}")
