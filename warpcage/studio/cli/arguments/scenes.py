"""Arguments of `warpcage capture`, `fit`, `fit-pose` and `evaluate`."""

from __future__ import annotations

from ...spec.scene import FIT, SPLAT_FIT, FitSpec
from ...spec.shot import COLORS
from .options import (
    CAGE_UP_FOUND,
    CAGES,
    FRAME,
    FRAME_VALUE,
    SCALE_AND_DEVICE,
    SCENE,
    SPLATS,
    command,
    flags_of,
    length,
    positive_float,
    whole_number,
)

command(
    "capture",
    "scenes",
    "make a scene of a video or a folder of pictures: find the cameras, undistort the pictures",
    """\
  warpcage capture walk.mp4 -o scene
  warpcage capture pictures -o scene --feature-size 1600
  warpcage capture pictures -o scene --pictures names.txt
  warpcage capture pictures -o scene --masks masks
  warpcage capture turning.mp4 -o scene --turntable
  warpcage fit scene -o object.npz
""",
    """
source  video, or folder of pictures (.jpg .png .webp .bmp .tif)
-o SCENE  folder to write, new or empty: a scene for fit
--pictures FILE  text file that names the pictures of the folder to use, one a line
--masks FOLDER  masks of the pictures, white where they are used: NAME.png or NAME.jpg.png for picture NAME.jpg,
    frame_00012.png for frame 12 of a video; or one picture for all (default: `masks` in the folder of pictures or
    beside it, and the opacity of the pictures)
--no-masks  use whole pictures
--turntable  for an object that turns in front of a fixed camera: ignore what stays still in the picture
--frames N  most frames to take of a video: sharp ones, spread over its camera path (default: %(default)s)
--feature-size PIXELS  longer side of pictures while features are detected; larger is more exact and slower (default:
    %(default)s)
--seed  random seed (default: %(default)s)
--quiet
""",
    source={"metavar": "VIDEO|FOLDER"},
    masks={"metavar": "FOLDER|PICTURE", "default": True},
    frames=120,
    feature_size=800,
    seed={"type": int, "default": 0},
)

command(
    "fit",
    "scenes",
    "fit a radiance field to the pictures of a scene",
    """\
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage fit data/lego -o lego.npz --device cuda:0 --resolution 384 --background black
  warpcage fit data/lego -o lego.npz --quality high --checkpoint progress.npz --max-memory 6GB
  warpcage fit data/dtu/scan24 -o house.npz --split-masks
  warpcage fit my_phone_pictures -o fox.npz --refine-cameras
  warpcage fit my_phone_pictures -o fox.ply                  splats, which show whole places best
""",
    f"-o FIELD  field file to write: of voxels (.npz) or of splats ({SPLATS})",
    SCENE,
    f"""
--as  what to fit: voxels (best for objects, above all with masks or opacity) or splats (best for whole places)
    (default: by the ending of --output)
--background COLOUR  {COLORS} (default: white, behind pictures with opacity); or what the fit takes as background:
    random (random colours, for pictures with opacity), outer (voxels before and behind the object's box, to infinity),
    layers (of pictures behind it), constant, or auto: random for pictures with opacity, outer for whole ones (default:
    auto)
--straighten
--quality
--checkpoint FILE  save the progress to this file (.npz), and continue from it if it exists
--checkpoint-seconds N  time between two checkpoints (default: %(default)s)
--preview PICTURE  write this picture (.png) again every 20 seconds: a picture of the scene beside the field so far; at
    first, for voxels, the cameras, points and box of the object
FitSpec.resolution
{flags_of(FitSpec, FIT, "quality", "seed")}
FitSpec.epochs
FitSpec.variation
{flags_of(FitSpec, SPLAT_FIT)}
--bounds X0 Y0 Z0 X1 Y1 Z1  box around the object, world units (default: found from the pictures)
one of:
--refine-cameras  refine poses, focal lengths and the exposure of each picture with the field, for cameras that are not
    exact; the refined ones are written beside it (.cameras.json)
--check-cameras  find out during the fit whether cameras are off, and refine them only then; one line says which
options:
--seed
--device
--quiet
""",
    checkpoint_seconds={"type": positive_float, "default": 60.0},
)

command(
    "evaluate",
    "scenes",
    "compare renders of a field with a scene's pictures (PSNR, SSIM)",
    """\
  warpcage evaluate lego.npz data/lego
  warpcage evaluate lego.npz data/lego --split test --downscale 2 --json psnr.json --worst worst.png
  warpcage evaluate output/truck         an output folder of 3D Gaussian Splatting, and the pictures that it names
""",
    "field",
    SCENE,
    f"""
--background COLOUR  {COLORS} (default: the field's own)
--json FILE  also write the figures to this file (.json)
--worst FILE  write the worst view (.png): picture, render, and their difference
{FRAME} (default: one beside the field or
    the scene, where that makes it show the pictures)
one of:
--given-cameras  use the cameras as they are given. By default, where the field has refined cameras, each camera is
    moved as the refined ones near it were, without a look at its picture, and the mean of the given cameras is printed
    too
--tune-cameras  first move and turn the camera of each view to match the field best, as is usual for fields with refined
    cameras: the figures then rate the field, not the cameras
""",
    SCALE_AND_DEVICE,
    "--quiet",
    split="test",
    scene={"nargs": "?"},
    frame=FRAME_VALUE,
)

command(
    "fit-pose",
    "scenes",
    "find the pose of a cage in which a field looks like pictures of the object",
    """\
  warpcage fit-pose toy.npz --cage cage.obj --pictures bent -o pose.obj
  warpcage fit-pose toy.npz --cage cage.obj --pictures bent -o pose.obj --parameters handles --max-pixels 200
  warpcage fit-pose toy.npz --cage cage.obj --pictures photographs -o pose.obj --exposure
  warpcage render toy.npz --cage cage.obj --posed pose.obj --camera bent:0 -o found.png
""",
    f"""
field
--cage REST  cage around the object ({CAGES})
--pictures SCENE  folder with pictures of the posed object and their cameras, in the field's world: with opacity, with
    masks, or whole, before one colour or what is around the field (formats as for warpcage fit)
-o POSE  posed cage to write ({CAGES})
--split
--downscale
--background COLOUR  {COLORS}: behind the object (default: white with opacity or masks, else what is around the field)
--start POSED  pose to begin with, a cage file or a preset such as bend:40:x:z (default: the cage at rest)
--parameters  what may move in the end; handles are the smoothest shapes of the cage (default: %(default)s)
--regularize WEIGHT  weight of the prior that neighbours move rigidly (default: %(default)s)
--restarts N  turns of the start that are tried first; 0 begins with the start itself (default: %(default)s)
--max-pixels N  pixels along the longer side of the largest pictures that are compared (default: %(default)s)
--exposure  find an exposure and a white balance for each picture, for photographs
{CAGE_UP_FOUND}
--posed-up
--coordinates
--seed
--quiet
""",
    SCALE_AND_DEVICE,
    cage={"required": True},
    pictures={"required": True},
    parameters={"choices": ("rigid", "affine", "handles", "vertices"), "default": "vertices"},
    regularize={"type": length, "default": 0.05},
    restarts={"type": whole_number, "default": 32},
    max_pixels=400,
    seed={"type": whole_number, "default": 0},
)
