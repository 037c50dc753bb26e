"""Arguments of `warpcage select`, `clean`, `mesh` and `bake`."""

from __future__ import annotations

import argparse

from ....core.names import PLANES
from .options import (
    CAGE_UP_FOUND,
    CAGES,
    FOLLOWING,
    FRAME,
    FRAME_VALUE,
    MESHES,
    SCALE_AND_DEVICE,
    VIEW,
    cages,
    command,
    deformation,
    length,
    positive_float,
    positive_int,
    whole_number,
)

command(
    "select",
    "fields",
    "select an object of a scene by a click or a region, without the floor or wall it stands on",
    """\
  warpcage select room.npz -o cup.npz --point 0.2 0.1 0.4 --preview cup.png
  warpcage select fox.npz -o fox_chosen.npz --camera data/fox:12 --pixel 486 518 --plane wall --preview fox.png
  warpcage select room.npz -o table.npz --sphere 0 0 0.3 0.8 --floaters 0.05
  warpcage select room.npz -o near.json --depth 0.5 1.2 --views data/room
  warpcage select place.ply -o cup.npz --point 0.2 0.1 0.4 --preview cup.png
  warpcage cage room.npz --selection cup.npz -o cup.obj
""",
    f"""
field
-o SELECTION  selection to write (.npz, .json); cage, mesh, bake and edit take it by --selection
--preview PICTURE  also write a picture with the selection tinted green (.png)
click (selects what is connected to that place; repeat it for more):
--point X Y Z  a place on the object, world units
--pixel COLUMN ROW  a pixel of the view that shows the object, from 0 at the top left
region (several of these narrow it down one after another):
--in-box
--sphere X Y Z RADIUS  what is in a sphere, world units
--in-cage CAGE  what is in a cage ({CAGES})
{CAGE_UP_FOUND}
--masks
--depth NEAR FAR  what the cameras of --views see at these distances from them, world units
--views FILE|SCENE[:SPLIT]  camera file, or scene whose cameras --depth uses
floor or wall that the object stands on, which is left out:
--plane  ground: a level plane, such as a floor or a table; wall: an upright one; any: either, in any direction; none:
    leave nothing out (default: %(default)s)
--plane-at X Y Z  a point on the plane, where there are several (default: the one that fits)
--clearance LENGTH  height above the plane at which the object begins, world units (default: by how flat the plane is, a
    voxel or two)
parts of the selection:
--parts
--floaters
""",
    VIEW,
    SCALE_AND_DEVICE,
    point={"action": "append"},
    pixel={"action": "append", "type": whole_number},
    depth=length,
    plane={"choices": (*PLANES, "none"), "default": "ground"},
)

command(
    "clean",
    "fields",
    "remove loose parts (floaters) of a field, and what no camera sees",
    """\
  warpcage clean place.ply -o clean.ply --preview gone.png
  warpcage clean place.ply -o clean.ply --views data/room --largest-scale 0.5
  warpcage clean room.npz -o clean.npz --floaters 0.01
  warpcage clean lego.npz -o clean.npz --parts 1 --views data/lego --least-views 3
""",
    """
field
-o FIELD  field to write (.npz; splats: any of their formats)
--preview PICTURE  also write a picture with what was removed tinted red (.png)
loose parts (splats fainter than 1/255 are removed too):
--floaters SHARE  remove connected parts with fewer voxels than this share of the largest, and more than three voxels
    away from what is kept; 0 for none (default: %(default)s)
--parts N  remove all but the N largest connected parts (default: none)
--largest-scale LENGTH  splats only: remove those with a standard deviation above this, world units (default: none)
what no camera sees:
--views FILE|SCENE[:SPLIT]  camera file, or scene whose cameras must see what is kept
--least-views N  number of cameras that must see it (default: 1)
--least-weight WEIGHT  rendering weight from which a camera sees something: of a splat summed over the pixels of a
    picture of at most 800, of a voxel the largest of any pixel (default: 0.01)
""",
    VIEW,
    SCALE_AND_DEVICE,
    floaters={"type": length, "default": 0.002},
    largest_scale=positive_float,
)

command(
    "mesh",
    "fields",
    "extract the surface of a field as a triangle mesh",
    """\
  warpcage mesh lego.npz -o lego.obj
  warpcage mesh lego.npz -o lego.glb                    with colours, for Blender: docs/blender.md
  warpcage mesh lego.npz -o lego.ply --threshold 20 --components all
  warpcage mesh lego.npz -o lego.glb --faces 20000 --texture 2048
  warpcage mesh lego.npz --cage cage.obj --posed bend:40:x:z -o bent.glb
  warpcage mesh lego.npz --cage cage.obj --posed poses.json -o walk.usdc      the film, a time sample a frame
""",
    f"""
field
-o MESH  mesh to write ({MESHES}; glTF with y up)
--frames N  number of frames, evenly from rest to the last pose (glTF and USD; default: those of a film
    whose keys have times, at its rate, else the last pose only)
--threshold SIGMA  density at the surface, per world unit (default: chosen from the field)
--components  which connected parts to keep (default: %(default)s)
--colors  write vertex colours, as the surface is seen from the front (glTF, USD, .ply, .obj; default: for glTF and USD)
--faces N  simplify the surface to about this many faces, which makes films and textures quicker (default: all)
--texture PIXELS  write a texture of this many pixels a side, finer than vertex colours and instead of them (.glb,
    .gltf; use --faces 20000 or so with it)
--as-captured  in the coordinates of the scene's files, for a field of warpcage fit --straighten
--selection
""",
    cages("POSED...", FOLLOWING),
    SCALE_AND_DEVICE,
    texture=positive_int,
    components={"choices": ("largest", "all"), "default": "largest"},
    colors={"action": argparse.BooleanOptionalAction},
)

command(
    "bake",
    "fields",
    "write a deformed field as a new one that needs no cage: voxels are resampled, splats moved",
    """\
  warpcage bake lego.npz --cage cage.obj --posed posed.obj -o bent.npz
  warpcage bake lego.npz --cage cage.obj --posed twist:60 -o twisted.npz --format svox2 --voxels 512
  warpcage bake both.stage.json -o both.npz
  warpcage bake lego.npz --edits lego.edits.json -o parts.npz
  warpcage bake scene.ply --cage cage.obj --posed bend:40:x:z -o bent.ply
  warpcage bake scene.ply --cage cage.obj --posed bend:40:x:z -o bend_####.ply --frames 30
  warpcage bake room.npz --selection cup.npz -o cup_alone.npz
  warpcage bake place.ply --selection cup.npz -o cup.ply
  warpcage bake splat.ply --frame dataparser_transforms.json -o splat_in_dataset.ply      of nerfstudio
  warpcage bake lego.npz -o lego.nvdb                   for Houdini and others: docs/blender.md
""",
    f"""
field
-o FIELD  field to write (.npz; splats: any of their formats), or .nvdb, .vdb: a volume for other programs, deformed or
    not
--voxels N  voxels along the longest side of the deformed scene (default: voxels as large as the field's)
--format  file format; svox2 is a Plenoxels checkpoint (default: warpcage)
--frames N  splats only: number of files from rest to the pose; -o walk_####.ply has # for the digits of the number
--overwrite  with --frames: also remove files of a longer sequence of that name (default: a warning names them)
--selection FILE  only the object of a selection file, cut out of its scene (warpcage select writes one: .npz, .json)
{FRAME}
""",
    deformation(resolution="128"),
    SCALE_AND_DEVICE,
    format=("warpcage", "svox2"),
    frame=FRAME_VALUE,
)
