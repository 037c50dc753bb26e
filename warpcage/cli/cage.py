"""`warpcage cage`: a cage around a field or a mesh."""

from __future__ import annotations

import pathlib

from ..cage.cage import Cage
from ..core.files import require_file
from ..field.selection import select_nodes
from ..field.surface import extract_mesh
from ..scene.load import load_scene
from . import inputs, options
from .mesh import TO_Y_UP

NAME = "cage"
HELP = "put a cage around a field or a mesh"
EXAMPLE = """\
  warpcage cage lego.npz -o cage.obj --vertices 100
  warpcage cage room.npz -o chair.glb --seed 0.2 0 -0.5 --floaters 0.01
  warpcage cage dtu.npz -o object.obj --masks data/dtu_scan24 --method voxel
  warpcage cage lego.obj -o box.obj --box --segments 2 2 3
  warpcage cage lego.obj -o tube.obj --cylinder --axis z --sides 12 --rings 4
"""
MESH_ENDINGS = (".obj", ".ply", ".off", ".stl", ".glb")


def add_arguments(parser):
    parser.add_argument("field", metavar="object", help="field (.npz) or mesh (.obj .ply .off .stl .glb)")
    parser.add_argument(
        "-o", "--output", required=True, metavar="CAGE", help=f"cage to write ({' '.join(options.CAGE_ENDINGS)})"
    )
    options.add_cage_up(parser)
    parser.add_argument(
        "--vertices",
        type=options.positive_int,
        metavar="N",
        help="about this many vertices, 30 to 200, wrapped around the object (default: 100)",
    )
    parser.add_argument(
        "--margin",
        type=options.positive_float,
        metavar="LENGTH",
        help="room between object and cage, world units (default: 0.03 of the object's size for a "
        "box or a cylinder, chosen from the object otherwise)",
    )
    parser.add_argument(
        "--method",
        choices=("auto", "shell", "voxel"),
        help="shell: offset, decimated, drawn close; voxel: of more even faces, as the paper's; auto: "
        "the tighter of both (default: auto)",
    )
    parser.add_argument("--symmetry", choices="xyz", help="mirror-symmetric across the middle of this axis (voxel)")
    _add_selection(parser)
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument("--box", action="store_true", help="a box along the axes")
    shape.add_argument("--cylinder", action="store_true", help="a cylinder along --axis")
    parser.add_argument(
        "--segments",
        type=options.positive_int,
        nargs="+",
        metavar="N",
        help="pieces along each axis of the box, one number or three (default: 1)",
    )
    parser.add_argument("--axis", choices="xyz", help="axis of the cylinder (default: z)")
    parser.add_argument("--sides", type=options.positive_int, metavar="N", help="sides of the cylinder (default: 12)")
    parser.add_argument(
        "--rings", type=options.positive_int, metavar="N", help="pieces of the cylinder along its axis (default: 4)"
    )
    parser.add_argument("--quiet", action="store_true", help="do not tell what is tried")
    options.add_scene_scale(parser)
    options.add_device(parser)


def _add_selection(parser):
    group = parser.add_argument_group("object of a larger field (each leaves away from what is left)")
    group.add_argument(
        "--in-box",
        type=options.finite_float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="what lies between two corners, world units",
    )
    group.add_argument("--masks", metavar="SCENE", help="what the opacity of every training picture of a scene shows")
    group.add_argument(
        "--seed", type=options.finite_float, nargs=3, metavar=("X", "Y", "Z"), help="what connects to a point"
    )
    group.add_argument("--parts", type=options.positive_int, metavar="N", help="the N largest connected parts")
    group.add_argument(
        "--floaters",
        type=options.positive_float,
        metavar="SHARE",
        help="leave out connected parts of fewer voxels than this share of the largest, e.g. 0.01",
    )


def run(args):
    output = options.check_output(args.output, options.CAGE_ENDINGS, "cage file")
    _check_combination(args)
    inputs.require_field_scale(args)
    inputs.quiet_warp()
    is_field = pathlib.Path(args.field).suffix.lower() == ".npz"
    thing = inputs.read_field(args) if is_field else read_mesh(args.field)

    if any(value is not None for value in _selection(args).values()):
        thing = _selected(thing, is_field, args)
    if args.box or args.cylinder:
        mesh = _surface(thing) if is_field else thing
        cage = _box_around(mesh, args) if args.box else _cylinder_around(mesh, args)
    else:
        make = Cage.from_field if is_field else Cage.from_mesh
        cage = make(
            thing,
            vertex_count=args.vertices or 100,
            margin=args.margin,
            method=args.method or "auto",
            symmetry=args.symmetry,
            progress=not args.quiet,
        )
    cage.require_usable("the cage")
    cage.save(output, up=args.cage_up)
    print(f"wrote {output}: {len(cage.vertices)} vertices, {len(cage.faces)} faces")


def _check_combination(args):
    needs = {
        "segments": ("box", args.box),
        "axis": ("cylinder", args.cylinder),
        "sides": ("cylinder", args.cylinder),
        "rings": ("cylinder", args.cylinder),
    }
    for name, (shape, chosen) in needs.items():
        if getattr(args, name) is not None and not chosen:
            raise ValueError(f"--{name} belongs to --{shape}")
    if args.vertices is not None and (args.box or args.cylinder):
        raise ValueError(
            "--vertices is for a cage wrapped around the object; a box takes --segments, a cylinder --sides and --rings"
        )
    for name in ("method", "symmetry"):
        if getattr(args, name) is not None and (args.box or args.cylinder):
            raise ValueError(f"--{name} is for a cage wrapped around the object")
    if args.segments is not None and len(args.segments) not in (1, 3):
        raise ValueError(f"--segments takes one number or three, got {len(args.segments)}")


def _selection(args) -> dict:
    return {"box": args.in_box, "masks": args.masks, "seed": args.seed, "parts": args.parts, "floaters": args.floaters}


def _selected(field, is_field: bool, args):
    """The chosen nodes of a field; what was left out goes to standard output."""
    chosen = {name: value for name, value in _selection(args).items() if value is not None}
    if not is_field:
        raise ValueError(f"--{'in-box' if 'box' in chosen else next(iter(chosen))} is for fields: cut a mesh yourself")
    if "box" in chosen:
        chosen["box"] = [args.in_box[:3], args.in_box[3:]]
    if "masks" in chosen:
        scene = load_scene(args.masks)
        if scene.alphas is None:
            raise ValueError(f"the pictures of scene {args.masks!r} have no opacity to take as masks")
        chosen |= {"masks": scene.alphas, "cameras": scene.cameras}
    selection = select_nodes(field, **chosen)
    for note in selection.notes:
        print(note)
    return selection


def _surface(field):
    return extract_mesh(field, components="all")


def read_mesh(path):
    """A trimesh.Trimesh with its vertices in the file's order, z up: what glTF holds is turned."""
    import numpy as np
    import trimesh

    path = require_file(path, "mesh file")
    if path.suffix.lower() not in MESH_ENDINGS:
        raise ValueError(f"mesh file {str(path)!r} must end in {' or '.join(MESH_ENDINGS)}, a field in .npz")
    try:
        mesh = trimesh.load(path, force="mesh", process=False, maintain_order=True)
    except Exception as error:
        raise ValueError(f"{path} cannot be read as a mesh: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{path} holds no triangles")
    return mesh.apply_transform(np.transpose(TO_Y_UP)) if path.suffix.lower() == ".glb" else mesh


def _margin(mesh, args) -> float:
    return 0.03 * float(mesh.extents.max()) if args.margin is None else args.margin


def _box_around(mesh, args):
    margin = _margin(mesh, args)
    segments = args.segments or [1]
    low, high = mesh.bounds
    return Cage.box(low - margin, high + margin, segments=segments[0] if len(segments) == 1 else tuple(segments))


def _cylinder_around(mesh, args):
    """About the middle of the bounding box, so wide that the flat sides clear every vertex."""
    import numpy as np

    margin, axis, sides = _margin(mesh, args), args.axis or "z", args.sides or 12
    if sides < 3:
        raise ValueError(f"a cylinder needs at least 3 sides, got {sides}")
    centre = mesh.bounds.mean(axis=0)
    along = "xyz".index(axis)
    reach = np.linalg.norm(np.delete(mesh.vertices - centre, along, axis=1), axis=1).max() + margin
    height = mesh.extents[along] + 2 * margin
    return Cage.cylinder(centre, reach / np.cos(np.pi / sides), height, axis=axis, sides=sides, rings=args.rings or 4)
