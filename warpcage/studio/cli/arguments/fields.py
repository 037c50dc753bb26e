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
    MOTION_ENDINGS,
    SCALE_AND_DEVICE,
    SELECTION_ENDINGS,
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
    "choose an object of a scene, without what it stands on, by a click or a region",
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
-o SELECTION  selection to write ({" ".join(SELECTION_ENDINGS)}); cage, mesh, bake and edit take it by --selection
--preview PICTURE  also write a view with what is chosen tinted green (.png)
click (kept is what hangs together with it; repeat it for more):
--point X Y Z  a place on the object, world units
--pixel COLUMN ROW  a pixel of the view that shows the object, from 0 at the top left
region (if several are given, each selects from what the ones before leave):
--in-box
--sphere X Y Z RADIUS  what is in a sphere, world units
--in-cage CAGE  what is in a cage ({CAGES})
{CAGE_UP_FOUND}
--masks
--depth NEAR FAR  what the cameras of --views show at these distances from them, world units
--views FILE|SCENE[:SPLIT]  camera file, or scene of the cameras, of --depth
what the object stands on, which is left out:
--plane  ground: a level plane, such as a floor or a table; wall: an upright one; any: either, whatever is up; none: it
    stands on nothing (default: %(default)s)
--plane-at X Y Z  a point on the plane, where several could be it (default: the one that fits)
--clearance LENGTH  distance above the plane from which on matter is the object's, world units (default: by how even the
    plane is, a voxel or two)
of what is left:
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
    "remove what hangs loose in a field, and what no view shows",
    """\
  warpcage clean place.ply -o clean.ply --preview gone.png
  warpcage clean place.ply -o clean.ply --views data/room --largest-scale 0.5
  warpcage clean room.npz -o clean.npz --floaters 0.01
  warpcage clean lego.npz -o clean.npz --parts 1 --views data/lego --least-views 3
""",
    """
field
-o FIELD  field to write (.npz, of splats as they come)
--preview PICTURE  also write a view with what went tinted red (.png)
what hangs loose (splats fainter than 1/255 go too):
--floaters SHARE  connected parts with fewer voxels than this share of the largest, and more than three voxels away from
    what is kept; 0 for none (default: %(default)s)
--parts N  all but the N largest connected parts (default: none)
--largest-scale LENGTH  splats only: those with a standard deviation above this, world units (default: none)
what no view shows:
--views FILE|SCENE[:SPLIT]  camera file, or scene of the cameras, that must show what is kept
--least-views N  so many of them must show it (default: 1)
--least-weight WEIGHT  rendering weight from which a view shows something: of a splat summed over the pixels of a
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
--frames N  so many, evenly, from rest to the last pose ({" ".join(MOTION_ENDINGS)}; default: those of a film whose keys
    have times, at its rate, else the last pose alone)
--threshold SIGMA  density at the surface, per world unit (default: chosen from the field)
--components  which connected parts to keep (default: %(default)s)
--colors  write the colours of the surface at its vertices, as they are seen from straight ahead (glTF, USD, .ply,
    .obj; default: for glTF and USD)
--faces N  simplify the surface to about so many, which films and textures are made of sooner (default: all)
--texture PIXELS  write the colours as a picture of so many pixels a side, finer than those of vertices and in their
    place (.glb, .gltf; take --faces 20000 or so with it)
--as-captured  in the coordinates of the scene's files, for a field that was straightened (warpcage fit --straighten)
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
    "make a new field of a deformed one, that needs no cage: voxels are resampled, splats moved",
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
-o FIELD  field to write (.npz, of splats as they come; .nvdb, .vdb: a volume for other programs, deformed or not)
--voxels N  voxels along the longest side of the deformed scene (default: voxels as large as the field's)
--format  file format; svox2 is a Plenoxels checkpoint (default: warpcage)
--frames N  splats only: so many files from rest to the pose, -o walk_####.ply with the # for the number
--overwrite  of --frames: also remove the files of a longer sequence of that name (default: a warning names them)
--selection FILE  only what is chosen, cut out of its scene, by warpcage select (.npz, .json)
{FRAME}
""",
    deformation(resolution="128"),
    SCALE_AND_DEVICE,
    format=("warpcage", "svox2"),
    frame=FRAME_VALUE,
)
