"""Arguments of `warpcage cage`, `check`, `pose`, `edits` and `edit`."""

from __future__ import annotations

import argparse
from typing import Any

from ...cage.axes import AXIS_WORDS, is_axis
from ...core.names import EASINGS, LOOPS
from . import options
from .options import command

CAGE_EXAMPLE = """\
  warpcage cage lego.npz -o cage.obj --vertices 100
  warpcage cage room.npz -o chair.glb --seed 0.2 0 -0.5 --floaters 0.01
  warpcage cage room.npz -o cup.obj --selection cup.npz      (see warpcage select)
  warpcage cage dtu.npz -o object.obj --masks data/dtu_scan24 --method voxel
  warpcage cage lego.obj -o box.obj --box --segments 2 2 3
  warpcage cage house.npz -o wing.obj --snap box.obj --reach 0.1
  warpcage cage lego.obj -o tube.obj --cylinder --axis z --sides 12 --rings 4
"""


@command("cage", "put a cage around a field or a mesh", CAGE_EXAMPLE)
def add_cage_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "field", metavar="object", help=f"field (.npz), splats or mesh ({' '.join(options.MESH_ENDINGS)})"
    )
    options.add_output(parser, "CAGE", f"cage to write ({' '.join(options.CAGE_ENDINGS)})")
    options.add_cage_up(parser)
    parser.add_argument(
        "--object", metavar="NAME", help="the object of a mesh file of several to put the cage around (default: all)"
    )
    parser.add_argument(
        "--vertices",
        help="approximate number of vertices of a cage wrapped around the object, 30 to 200 (default: 100)",
        **options.COUNT,
    )
    parser.add_argument(
        "--margin",
        help="distance between object and cage, world units (default: 0.03 of the object's size for a box or a "
        "cylinder, otherwise chosen from the object)",
        **options.LENGTH,
    )
    parser.add_argument(
        "--method",
        choices=("auto", "shell", "voxel"),
        help="shell: an offset surface, decimated and pulled close; voxel: more even faces, like the paper's; "
        "auto: the tighter of the two (default: auto)",
    )
    parser.add_argument("--symmetry", choices="xyz", help="mirror the cage across the middle of this axis (voxel only)")
    _add_selection(parser)
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument("--box", action="store_true", help="a box along the axes")
    shape.add_argument("--cylinder", action="store_true", help="a cylinder along --axis")
    shape.add_argument(
        "--snap",
        metavar="CAGE",
        help="this cage around a part of a field, each of its flat walls moved by up to --reach to where it cuts least "
        "matter",
    )
    parser.add_argument("--reach", type=options.positive_float, metavar="LENGTH", help="of --snap, world units")
    parser.add_argument(
        "--segments",
        type=options.positive_int,
        nargs="+",
        metavar="N",
        help="segments along each axis of the box: one number, or one per axis (default: 1)",
    )
    parser.add_argument("--axis", choices="xyz", help="axis of the cylinder (default: z)")
    parser.add_argument("--sides", help="sides of the cylinder (default: 12)", **options.COUNT)
    parser.add_argument("--rings", help="segments of the cylinder along its axis (default: 4)", **options.COUNT)
    parser.add_argument("--quiet", action="store_true", help="do not print what is tried, even with --verbose")
    options.add_scale_and_device(parser)


def _add_selection(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "part of a larger field (if several are given, each selects from what the ones before leave)"
    )
    options.add_selection(group)
    options.add_in_box(group)
    group.add_argument("--masks", metavar="SCENE", help="what is opaque in every training picture of a scene")
    group.add_argument("--seed", help="what is connected to this point, world units", **options.POINT)
    options.add_parts(group)


CHECK_EXAMPLE = """\
  warpcage check cage.obj
  warpcage check cage.obj --object lego.npz --posed posed.obj
  warpcage check broken.obj --repair mended.obj
  warpcage check cage.obj --json > report.json
"""


@command(
    "check",
    "examine a cage, what it encloses and what a pose does to it; exit status 1 if it is of no use",
    CHECK_EXAMPLE,
)
def add_check_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cage", help=f"cage to examine ({' '.join(options.CAGE_ENDINGS)})")
    parser.add_argument(
        "--object", dest="field", metavar="OBJECT", help="field (.npz), splats or mesh that should be inside"
    )
    parser.add_argument(
        "--posed",
        metavar="POSED",
        help="a pose of the cage, a file or a preset, to examine for inverted volume, stretch and folds",
    )
    parser.add_argument(
        "--repair",
        metavar="MENDED",
        help="repair what can be repaired safely, print what was done, write the cage to this file and examine it",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON instead of a table")
    options.add_cage_up(parser, found=True, posed=True)
    options.add_scale_and_device(parser)


POSE_EXAMPLE = """\
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage pose cage.obj -o posed.obj --twist 30 --taper 0.6 --axis z --limits 0.3 1
  warpcage pose cage.obj -o poses.json --key start --at 0
  warpcage pose cage.obj -o poses.json --key bow --at 1.5 --easing hold --bend 40 --axis x
  warpcage pose cage.obj -o poses.json --key up --at 2 --posed from_blender.obj --loop ping-pong
  warpcage pose cage.obj -o poses.json --key "from above" --at 2 --camera above.json
  warpcage pose cage.obj -o poses.json --posed walk.glb

Steps are applied in the order given. --axis, --towards, --limits and --centre apply to all steps of one call: run the
command again on the posed cage for another axis. A pose file (.json) gets a key for each call, and keeps those that it
has; `warpcage animate --posed poses.json` makes the film. A direction with a minus needs the equals sign: --towards=-x.
"""


class _Step(argparse.Action):
    """Collects steps in the order of the command line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        assert option_string is not None
        namespace.steps = [*(namespace.steps or []), (option_string.lstrip("-"), values)]


@command("pose", "bend, twist, taper, stretch, scale, rotate or move a cage", POSE_EXAMPLE)
def add_pose_arguments(parser: argparse.ArgumentParser) -> None:
    number = options.finite_float
    parser.add_argument("cage", help=f"cage to pose ({' '.join(options.CAGE_ENDINGS)})")
    options.add_output(
        parser, "POSED", f"cage to write ({' '.join(options.CAGE_ENDINGS)}), or pose file that gets a key (.json)"
    )
    options.add_cage_up(parser)
    _add_keys(parser)
    steps, degrees = parser.add_argument_group("steps"), {"type": number, "metavar": "DEGREES"}
    factor = {"type": options.positive_float, "metavar": "FACTOR"}
    for name, help, kind in (
        ("bend", "bend what lies along --axis into an arc in the direction of --towards", degrees),
        ("twist", "turn about --axis, from nothing at the start to DEGREES at the end", degrees),
        ("taper", "scale across --axis, by 1 at the start to FACTOR at the end", factor),
        ("stretch", "scale along --axis", factor),
        ("scale", "scale by one factor, or by one per axis", factor | {"nargs": "+"}),
        ("rotate", "turn about --axis", degrees),
        ("translate", "move, world units", options.POINT),
    ):
        steps.add_argument(f"--{name}", dest="steps", action=_Step, help=help, **kind)
    where = parser.add_argument_group("where")
    where.add_argument(
        "--axis",
        type=axis_word,
        default="z",
        metavar="AXIS",
        help=f"axis of the steps: {AXIS_WORDS}. up is that of --up or --object; long, middle and short are those of "
        "the cage itself (default: %(default)s)",
    )
    where.add_argument(
        "--towards",
        type=axis_word,
        default=None,
        metavar="AXIS",
        help="direction of a bend, in the same words; what is across --axis counts (default: x, or z if --axis is x)",
    )
    where.add_argument("--up", help="what is up in the scene", **options.POINT)
    where.add_argument(
        "--object",
        metavar="FIELD",
        help="field of the cage (.npz): says what is up, and which axis points up in the file",
    )
    where.add_argument(
        "--limits",
        type=number,
        nargs=2,
        metavar=("FROM", "TO"),
        default=(0.0, 1.0),
        help="part of the extent along --axis that is bent, twisted, tapered or stretched, between 0 and 1 "
        "(default: 0 1)",
    )
    where.add_argument(
        "--centre",
        dest="center",
        help="point that stays fixed, world units (default: middle of the bounding box)",
        **options.POINT,
    )
    parser.set_defaults(steps=None)


def _add_keys(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("keys of a pose file (-o poses.json)")
    group.add_argument("--key", metavar="NAME", help="name of the key; one of that name is replaced")
    group.add_argument("--at", type=options.seconds, metavar="SECONDS", help="when the film reaches it")
    group.add_argument(
        "--easing", choices=EASINGS, help="how the way from it to the next key goes (default: smooth, or as it was)"
    )
    group.add_argument(
        "--posed",
        metavar="POSED",
        help="begin with this pose instead of the cage at rest: a cage file, a key of a pose file, or a preset. "
        "Without --key: all keys of an animated glTF file, of its shapes, or of numbered files (walk_####.obj)",
    )
    group.add_argument(
        "--camera",
        metavar="FILE[:NAME]|SCENE:[SPLIT:]INDEX",
        help="the camera of the film at this key: of a camera file (render --save-camera writes one) or of a scene's "
        "picture; without steps and --posed it is a key of the camera alone",
    )
    group.add_argument("--remove", action="store_true", help="take the key out of the file")
    group.add_argument("--fps", type=options.positive_fraction, metavar="RATE", help="frames per second of the film")
    group.add_argument("--loop", choices=LOOPS, help="what the film does at its end")


EDITS_EXAMPLE = """\
  warpcage edits -o house.edits.json --edit wing.obj:wing_up.obj --edit tower.obj:tower_aside.obj:keep \\
      --edit chimney.obj:remove
  warpcage edits house.edits.json
  warpcage edits house.edits.json --edit door.obj:bend:30:z:x -o more.edits.json
  warpcage render house.npz --edits house.edits.json -o house.png --overlay
  warpcage animate house.npz --edits house.edits.json -o house.mp4

An edit is a cage and what becomes of what is in it: CAGE:POSED moves it to where the posed cage is, CAGE:POSED:keep
leaves a copy where it was, CAGE:remove takes it away. CAGE:POSED:falloff=WIDTH holds the walls of the cage that cut
through matter and fades to rest in a band of that width inside them, so that the part does not tear off (held=still:
the walls that the pose leaves in place; held=3,4: these faces). fragments=SIZE takes pieces smaller than that along,
which the cage cuts off. POSED is a cage file, a keyframe of a pose file (poses.json:NAME) or a preset (bend:40:x:z).
Edits act in their order, each on what the ones before it left. A Windows drive (C:\\cage.obj:C:\\posed.obj) is no
separator.

The file is JSON, with paths relative to its own folder. Sessions of the editor (.session.json) are read too. Pictures
of what edits do are in docs/edits.md.
"""


@command("edits", "write several edits of one scene to a file, or say what such a file holds", EDITS_EXAMPLE)
def add_edits_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", help="edits file, or session of the editor (.session.json)")
    parser.add_argument(
        "--edit",
        action="append",
        metavar="CAGE:POSED[:keep]",
        help="an edit; give it again for the next. CAGE:remove takes away what is in the cage",
    )
    parser.add_argument("-o", "--output", metavar="FILE", help="edits file to write (.json)")
    options.add_cage_up(parser)


def axis_word(text: str) -> str:
    """A word for a direction, as an argument. Raises argparse.ArgumentTypeError for others."""
    if not is_axis(text):
        raise argparse.ArgumentTypeError(f"must be {AXIS_WORDS}, got {text!r}")
    return text


EDIT_EXAMPLE = """\
  warpcage edit --demo
  warpcage edit lego.npz --cage cage.obj
  warpcage edit scene.ply
  warpcage edit lego.npz --port 8700 --no-browser     (then, at home: ssh -L 8700:127.0.0.1:8700 HOST)

What is edited is kept beside the field, as NAME.session.json, and the next call goes on with it.
"""


@command("edit", "pose cages by hand in the browser and see the scene follow", EDIT_EXAMPLE)
def add_edit_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_field(parser, nargs="?")
    parser.add_argument("--demo", action="store_true", help="edit a brick excavator, which is fitted once and kept")
    parser.add_argument(
        "--cage",
        action="append",
        metavar="CAGE",
        help=f"cage at rest ({' '.join(options.CAGE_ENDINGS)}); repeat it for several edits "
        "(default: the session's, or none; the page can make one)",
    )
    options.add_cage_up(parser, found=True)
    options.add_selection(parser, "also an edit with a cage around what is chosen")
    parser.add_argument("--session", metavar="FILE", help="the session's file (default: beside the field)")
    parser.add_argument(
        "--new", action="store_true", help="begin anew; a session that is there is kept under another name"
    )
    serving = parser.add_argument_group("serving")
    serving.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: this machine only)"
    )
    serving.add_argument("--port", type=port_number, default=0, help="port to listen on (default: a free one)")
    serving.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="host name under which the page may be opened too, such as that of a proxy",
    )
    serving.add_argument("--no-browser", action="store_true", help="print the address and open no browser")
    options.add_scale_and_device(parser)


def port_number(text: str) -> int:
    """A port, 0 for a free one."""
    if not (text.isascii() and text.isdigit()) or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no port: 0 to 65535")
    return int(text)
