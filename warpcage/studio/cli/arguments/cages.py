"""Arguments of `warpcage cage`, `check`, `pose`, `edits` and `edit`."""

from __future__ import annotations

import argparse
from typing import Any

from ....cage.axes import AXIS_NAMES, is_axis
from ....core.names import EASINGS, LOOPS
from .options import (
    CAGE_UP,
    CAGE_UP_FOUND,
    CAGES,
    MESHES,
    SCALE_AND_DEVICE,
    command,
    finite_float,
    positive_float,
    seconds,
)

command(
    "cage",
    "cages",
    "put a cage around a field or a mesh",
    """\
  warpcage cage lego.npz -o cage.obj --vertices 100
  warpcage cage room.npz -o chair.glb --seed 0.2 0 -0.5 --floaters 0.01
  warpcage cage room.npz -o cup.obj --selection cup.npz      (see warpcage select)
  warpcage cage dtu.npz -o object.obj --masks data/dtu_scan24 --method voxel
  warpcage cage lego.npz -o finer.obj --faces quads --focus poses.json
  warpcage cage lego.obj -o box.obj --box --segments 2 2 3
  warpcage cage house.npz -o wing.obj --snap box.obj --reach 0.1
  warpcage cage lego.obj -o tube.obj --cylinder --axis z --sides 12 --rings 4
""",
    f"""
field  field (.npz), splats or mesh ({MESHES})
-o CAGE  cage to write ({CAGES})
{CAGE_UP}
--object NAME  of a mesh file of several objects, the one to put the cage around (default: all)
--vertices N  approximate number of vertices of a cage wrapped around the object, 30 to 200 (default: 100)
--margin LENGTH  distance between object and cage, world units (default: 0.03 of the object's size for a box or a
    cylinder, otherwise chosen from the object)
--method  shell: an offset surface, decimated and pulled close; voxel: more even faces, like the paper's; auto: the
    tighter of the two (default: auto)
--symmetry  make the cage symmetric across the middle of this axis; auto: of the axis across which the object nearly is,
    if any
--detail  even: vertices lie evenly; parts: limbs get tubes of their own, gaps and holes stay open as far as the count
    allows (shell only) (default: even)
--focus FILE  shorter edges at the nodes of a selection (.npz), or where the poses of another cage around the object
    bend it (a pose file, .json, or other poses as of `warpcage pose --posed`); shell only
--finer FACTOR  by which edges are shorter there, 1 to 8 (default: 2)
--faces  triangles, or quads where they hold (default: triangles)
part of a larger field (several of these narrow it down one after another):
--selection
--in-box
--masks
--seed X Y Z  what is connected to this point, world units
--parts
--floaters
one of:
--box  a box along the axes
--cylinder  a cylinder along --axis
--snap CAGE  this cage around a part of a field, with each flat side moved by up to --reach to where it cuts through
    least of the object
options:
--reach LENGTH  how far --snap may move a side, world units
--segments N...  segments along each axis of the box: one number, or one per axis (default: 1)
--axis  axis of the cylinder (default: z)
--sides N  sides of the cylinder (default: 12)
--rings N  segments of the cylinder along its axis (default: 4)
--quiet  print no progress, even with --verbose
""",
    SCALE_AND_DEVICE,
    field={"metavar": "object"},
    method=("auto", "shell", "voxel"),
    symmetry=(*"xyz", "auto"),
    detail=("even", "parts"),
    finer=positive_float,
    faces=("triangles", "quads"),
    reach=positive_float,
    axis=tuple("xyz"),
)

command(
    "check",
    "cages",
    "examine a cage, what it encloses and what a pose does to it; exit status 1 if it cannot be used",
    """\
  warpcage check cage.obj
  warpcage check cage.obj --object lego.npz --posed posed.obj
  warpcage check broken.obj --repair mended.obj
  warpcage check cage.obj --json > report.json
""",
    f"""
cage  cage to examine ({CAGES})
--object OBJECT  field (.npz), splats or mesh that should be inside
--posed POSED  a pose of the cage, a file or a preset, to examine for inverted volume, stretch and folds
--repair FIXED  repair what can be repaired safely, print what was done, write the cage to this file and examine it
--json  print the report as JSON instead of a table
{CAGE_UP_FOUND}
--posed-up
""",
    SCALE_AND_DEVICE,
    object={"dest": "field"},
)


class _Step(argparse.Action):
    """Collects steps in the order of the command line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        assert option_string is not None
        namespace.steps = [*(namespace.steps or []), (option_string.lstrip("-"), values)]


def axis_word(text: str) -> str:
    """A name for a direction, as an argument. Raises argparse.ArgumentTypeError for others."""
    if not is_axis(text):
        raise argparse.ArgumentTypeError(f"must be {AXIS_NAMES}, got {text!r}")
    return text


command(
    "pose",
    "cages",
    "bend, twist, taper, stretch, scale, rotate or move a cage",
    """\
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage pose cage.obj -o posed.obj --twist 30 --taper 0.6 --axis z --limits 0.3 1
  warpcage pose cage.obj -o poses.json --key start --at 0
  warpcage pose cage.obj -o poses.json --key bow --at 1.5 --easing hold --bend 40 --axis x
  warpcage pose cage.obj -o poses.json --key up --at 2 --posed from_blender.obj --loop ping-pong
  warpcage pose cage.obj -o poses.json --key "from above" --at 2 --camera above.json
  warpcage pose cage.obj -o poses.json --posed walk.glb
  warpcage pose cage.obj -o walk.usdc --posed poses.json

Steps are applied in the order given. --axis, --towards, --limits and --centre apply to all steps of one call: run the
command again on the posed cage for another axis. A pose file (.json) gets a key for each call, and keeps those that it
has; `warpcage animate --posed poses.json` makes the film. A direction with a minus needs the equals sign: --towards=-x.
""",
    f"""
cage  cage to pose ({CAGES})
-o POSED  cage to write ({CAGES}; glTF and USD hold all frames of a --posed file), or pose file to add a key to (.json)
{CAGE_UP}
keys of a pose file (-o poses.json):
--key NAME  name of the key; one of that name is replaced
--at SECONDS  time of the key in the film
--easing  easing from this key to the next (default: smooth, or as it was)
--posed POSED  start from this pose instead of the cage at rest: a cage file, a key of a pose file, or a preset. Without
    --key: all keys of an animated glTF file, its shape keys, or numbered files (walk_####.obj)
--camera FILE[:NAME]|SCENE:[SPLIT:]INDEX  camera of the film at this key: from a camera file (render --save-camera
    writes one) or of a scene's picture; without steps and --posed the key is of the camera only
--remove  take the key out of the file
--fps RATE  frames per second of the film
--loop  what the film does at its end
steps:
--bend DEGREES  bend what lies along --axis into an arc in the direction of --towards
--twist DEGREES  rotate about --axis, from 0 at the start to DEGREES at the end
--taper FACTOR  scale across --axis, by 1 at the start to FACTOR at the end
--stretch FACTOR  scale along --axis
--scale FACTOR...  scale by one factor, or by one per axis
--rotate DEGREES  rotate about --axis
--translate X Y Z  move, world units
where:
--axis AXIS  axis of the steps: {AXIS_NAMES}. up is that of --up or --object; long, middle and short are those of the
    cage itself (default: %(default)s)
--towards AXIS  direction of a bend, given like --axis; only its part across --axis counts (default: x, or z if --axis
    is x)
--up X Y Z  direction that is up in the scene
--object FIELD  field of the cage (.npz), from which up, and the up axis of the cage file, are taken
--limits FROM TO  part of the extent along --axis that is bent, twisted, tapered or stretched, between 0 and 1 (default:
    0 1)
--centre X Y Z  point that stays fixed, world units (default: middle of the bounding box)
""",
    at=seconds,
    easing=EASINGS,
    loop=LOOPS,
    axis={"type": axis_word, "default": "z"},
    towards=axis_word,
    limits={"type": finite_float, "default": (0.0, 1.0)},
    centre={"dest": "center"},
    **dict.fromkeys(
        ("bend", "twist", "taper", "stretch", "scale", "rotate", "translate"), {"dest": "steps", "action": _Step}
    ),
)

command(
    "edits",
    "cages",
    "write several edits of one scene to a file, or describe such a file",
    """\
  warpcage edits -o house.edits.json --edit wing.obj:wing_up.obj --edit tower.obj:tower_aside.obj:keep \\
      --edit chimney.obj:remove
  warpcage edits house.edits.json
  warpcage edits house.edits.json --edit door.obj:bend:30:z:x -o more.edits.json
  warpcage render house.npz --edits house.edits.json -o house.png --overlay
  warpcage animate house.npz --edits house.edits.json -o house.mp4

An edit is a cage and what becomes of what is in it: CAGE:POSED moves it to where the posed cage is, CAGE:POSED:keep
leaves a copy where it was, CAGE:remove takes it away. CAGE:POSED:falloff=WIDTH holds the sides of the cage that cut
through the object and fades out in a band of that width inside them, so that the part does not tear off (held=still:
the sides that the pose leaves in place; held=3,4: these faces). fragments=SIZE takes loose pieces along that the cage
cuts off, up to that size. POSED is a cage file, a keyframe of a pose file (poses.json:NAME) or a preset (bend:40:x:z).
Edits act in order, each on the result of those before it. Windows paths may have a drive (C:\\cage.obj:C:\\posed.obj).

The file is JSON, with paths relative to its own folder. Sessions of the editor (.session.json) are read too. Pictures
of what edits do are in docs/edits.md.
""",
    """
file  edits file, or session of the editor (.session.json)
--edit CAGE:POSED[:keep]  an edit; repeat it for the next. CAGE:remove deletes what is in the cage
-o FILE  edits file to write (.json)
""",
    CAGE_UP,
    file={"nargs": "?"},
    output={},
)


def port_number(text: str) -> int:
    """A port, 0 for a free one."""
    if not (text.isascii() and text.isdigit()) or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"a port must be 0 to 65535, got {text!r}")
    return int(text)


command(
    "edit",
    "cages",
    "pose cages interactively in the browser and see the scene follow",
    """\
  warpcage edit --demo
  warpcage edit lego.npz --cage cage.obj
  warpcage edit scene.ply
  warpcage edit both.stage.json                       (several objects, as render --save-stage writes them)
  warpcage edit lego.npz --port 8700 --no-browser     (then, at home: ssh -L 8700:127.0.0.1:8700 HOST)

Edits are saved beside the field, as NAME.session.json, and the next call continues with them.
""",
    f"""
field
--demo  edit a brick excavator, which is fitted once and kept
--cage CAGE  cage at rest ({CAGES}); repeat it for several edits (default: those of the session, or none; the editor can
    make them)
{CAGE_UP_FOUND}
--selection FILE  also add an edit with a cage around the object of a selection file (warpcage select writes one: .npz,
    .json)
--session FILE  session file (default: beside the field)
--new  start a new session; an existing one is kept under another name
serving:
--host ADDRESS  address to listen on (default: this machine only)
--port  port to listen on (default: a free one)
--allow-host NAME  another host name that the page may be opened under, such as that of a proxy
--no-browser  only print the address, open no browser
""",
    SCALE_AND_DEVICE,
    field={"nargs": "?"},
    cage={"action": "append"},
    host="127.0.0.1",
    port={"type": port_number, "default": 0},
    allow_host={"action": "append", "default": []},
)
