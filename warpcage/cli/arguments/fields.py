"""Arguments of `warpcage select`, `clean`, `mesh` and `bake`."""

from __future__ import annotations

import argparse

from ...core.names import PLANES
from . import options
from .options import command

SELECT_EXAMPLE = """\
  warpcage select room.npz -o cup.npz --point 0.2 0.1 0.4 --preview cup.png
  warpcage select fox.npz -o fox_chosen.npz --camera data/fox:12 --pixel 486 518 --plane wall --preview fox.png
  warpcage select room.npz -o table.npz --sphere 0 0 0.3 0.8 --floaters 0.05
  warpcage select room.npz -o near.json --depth 0.5 1.2 --views data/room
  warpcage select place.ply -o cup.npz --point 0.2 0.1 0.4 --preview cup.png
  warpcage cage room.npz --selection cup.npz -o cup.obj
"""


@command("select", "choose an object of a scene, without what it stands on, by a click or a region", SELECT_EXAMPLE)
def add_select_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_output(
        parser,
        "SELECTION",
        f"selection to write ({' '.join(options.SELECTION_ENDINGS)}); cage, mesh, bake and edit take it by --selection",
    )
    parser.add_argument(
        "--preview", metavar="PICTURE", help="also write a view with what is chosen tinted green (.png)"
    )
    numbers = {"type": options.finite_float, "metavar": ("X", "Y", "Z"), "nargs": 3}
    click = parser.add_argument_group("click (kept is what hangs together with it; repeat it for more)")
    click.add_argument("--point", action="append", help="a place on the object, world units", **numbers)
    click.add_argument(
        "--pixel",
        action="append",
        nargs=2,
        type=options.whole_number,
        metavar=("COLUMN", "ROW"),
        help="a pixel of the view that shows the object, from 0 at the top left",
    )
    _add_region(parser)
    stand = parser.add_argument_group("what the object stands on, which is left out")
    stand.add_argument(
        "--plane",
        choices=(*PLANES, "none"),
        default="ground",
        help="ground: a level plane, such as a floor or a table; wall: an upright one; any: either, whatever is up; "
        "none: it stands on nothing (default: %(default)s)",
    )
    stand.add_argument(
        "--plane-at", help="a point on the plane, where several could be it (default: the one that fits)", **numbers
    )
    stand.add_argument(
        "--clearance",
        help="distance above the plane from which on matter is the object's, world units (default: by how even the "
        "plane is, a voxel or two)",
        **options.LENGTH,
    )
    options.add_parts(parser.add_argument_group("of what is left"))
    options.add_view(parser)
    options.add_scale_and_device(parser)


def _add_region(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("region (if several are given, each selects from what the ones before leave)")
    options.add_in_box(group)
    group.add_argument(
        "--sphere",
        type=options.finite_float,
        nargs=4,
        metavar=("X", "Y", "Z", "RADIUS"),
        help="what is in a sphere, world units",
    )
    group.add_argument("--in-cage", metavar="CAGE", help=f"what is in a cage ({' '.join(options.CAGE_ENDINGS)})")
    options.add_cage_up(group, found=True)
    group.add_argument("--masks", metavar="SCENE", help="what is opaque in every training picture of a scene")
    group.add_argument(
        "--depth",
        type=options.length,
        nargs=2,
        metavar=("NEAR", "FAR"),
        help="what the cameras of --views show at these distances from them, world units",
    )
    group.add_argument("--views", metavar="FILE|SCENE[:SPLIT]", help="camera file, or scene of the cameras, of --depth")


CLEAN_EXAMPLE = """\
  warpcage clean place.ply -o clean.ply --preview gone.png
  warpcage clean place.ply -o clean.ply --views data/room --largest-scale 0.5
  warpcage clean room.npz -o clean.npz --floaters 0.01
  warpcage clean lego.npz -o clean.npz --parts 1 --views data/lego --least-views 3
"""


@command("clean", "remove what hangs loose in a field, and what no view shows", CLEAN_EXAMPLE)
def add_clean_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_output(parser, "FIELD", "field to write (.npz, of splats as they come)")
    parser.add_argument("--preview", metavar="PICTURE", help="also write a view with what went tinted red (.png)")
    loose = parser.add_argument_group("what hangs loose (splats fainter than 1/255 go too)")
    loose.add_argument(
        "--floaters",
        type=options.length,
        default=0.002,
        metavar="SHARE",
        help="connected parts with fewer voxels than this share of the largest, and more than three voxels away from "
        "what is kept; 0 for none (default: %(default)s)",
    )
    loose.add_argument("--parts", help="all but the N largest connected parts (default: none)", **options.COUNT)
    loose.add_argument(
        "--largest-scale",
        help="splats only: those with a standard deviation above this, world units (default: none)",
        **options.positive("LENGTH"),
    )
    shown = parser.add_argument_group("what no view shows")
    shown.add_argument(
        "--views",
        metavar="FILE|SCENE[:SPLIT]",
        help="camera file, or scene of the cameras, that must show what is kept",
    )
    shown.add_argument("--least-views", help="so many of them must show it (default: 1)", **options.COUNT)
    shown.add_argument(
        "--least-weight",
        help="rendering weight from which a view shows something: of a splat summed over the pixels of a picture of at "
        "most 800, of a voxel the largest of any pixel (default: 0.01)",
        **options.positive("WEIGHT"),
    )
    options.add_view(parser)
    options.add_scale_and_device(parser)


MESH_EXAMPLE = """\
  warpcage mesh lego.npz -o lego.obj
  warpcage mesh lego.npz -o lego.glb                    with colours, for Blender: docs/blender.md
  warpcage mesh lego.npz -o lego.ply --threshold 20 --components all
"""


@command("mesh", "extract the surface of a field as a triangle mesh", MESH_EXAMPLE)
def add_mesh_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_output(parser, "MESH", f"mesh to write ({' '.join(options.MESH_ENDINGS)}; glTF with y up)")
    parser.add_argument(
        "--threshold",
        help="density at the surface, per world unit (default: chosen from the field)",
        **options.positive("SIGMA"),
    )
    parser.add_argument(
        "--components",
        choices=("largest", "all"),
        default="largest",
        help="which connected parts to keep (default: %(default)s)",
    )
    parser.add_argument(
        "--colors",
        action=argparse.BooleanOptionalAction,
        help="write the colours of the surface at its vertices, as they are seen from straight ahead (.glb, .ply, "
        ".obj; default: for .glb)",
    )
    parser.add_argument(
        "--as-captured",
        action="store_true",
        help="in the coordinates of the scene's files, for a field that was straightened (warpcage fit --straighten)",
    )
    options.add_selection(parser)
    options.add_scale_and_device(parser)


BAKE_EXAMPLE = """\
  warpcage bake lego.npz --cage cage.obj --posed posed.obj -o bent.npz
  warpcage bake lego.npz --cage cage.obj --posed twist:60 -o twisted.npz --format svox2 --voxels 512
  warpcage bake both.stage.json -o both.npz
  warpcage bake lego.npz --edits lego.edits.json -o parts.npz
  warpcage bake scene.ply --cage cage.obj --posed bend:40:x:z -o bent.ply
  warpcage bake scene.ply --cage cage.obj --posed bend:40:x:z -o bend_####.ply --frames 30
  warpcage bake room.npz --selection cup.npz -o cup_alone.npz
  warpcage bake place.ply --selection cup.npz -o cup.ply
"""


@command(
    "bake", "make a new field of a deformed one, that needs no cage: voxels are resampled, splats moved", BAKE_EXAMPLE
)
def add_bake_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser)
    options.add_output(parser, "FIELD", "field to write (.npz, of splats as they come)")
    parser.add_argument(
        "--voxels",
        help="voxels along the longest side of the deformed scene (default: voxels as large as the field's)",
        **options.COUNT,
    )
    parser.add_argument(
        "--format",
        choices=("warpcage", "svox2"),
        help="file format; svox2 is a Plenoxels checkpoint (default: warpcage)",
    )
    parser.add_argument(
        "--frames",
        help="splats only: so many files from rest to the pose, -o walk_####.ply with the # for the number",
        **options.COUNT,
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="of --frames: also remove the files of a longer sequence of that name (default: a warning names them)",
    )
    options.add_selection(parser, "only what is chosen, cut out of its scene,")
    options.add_deformation(parser, usual_resolution="128")
    options.add_scale_and_device(parser)
