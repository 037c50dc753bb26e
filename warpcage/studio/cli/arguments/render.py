"""Arguments of `warpcage render` and `animate`."""

from __future__ import annotations

from ....core.names import MOVE_HELP
from ...spec.film import TIME, FilmSpec
from .options import FOLLOWING, PICTURES, SCALE_AND_DEVICE, VIEW, command, deformation, flags_of, objects

#: Pictures of --cameras interpolate from each camera to the next where --frames is not given.
STEPS = 8

command(
    "render",
    "render",
    "render one view of a field, as it is or deformed by a cage",
    """\
  warpcage render lego.npz -o lego.png
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --size 800
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png --overlay \\
      --disparity bent_disparity.png --masks bent_masks.png --camera data/lego:test:3
  warpcage render lego.npz --cage cage.obj --posed twist:60 -o twisted.png
  warpcage render lego.npz --cage cage.obj -o caged.png --overlay
  warpcage render lego.npz --edit arm.obj:arm_up.obj:keep --edit cab.obj:remove -o parts.png
  warpcage render lego.npz --add mic.npz:beside.json -o both.png --save-stage both.stage.json
  warpcage render lego.npz -o lego.exr --background transparent
  warpcage render lego.npz --cage cage.obj --posed bend:20 bend:40 bend:60 -o bends/
  warpcage render lego.npz -o views/ --cameras interpolate --scene data/lego:test --frames 60
""",
    f"""
field
-o PICTURE  picture to write (.png, .exr), or a folder for a picture of each pose
many pictures:
--cameras  given: a picture from each camera of --scene; interpolate: pictures along a smooth path through them. The
    output is then a folder or a film (.mp4, .gif, .mov, .webm)
--scene FILE|SCENE[:SPLIT]  camera file, or scene of the cameras, e.g. data/lego:test (default split: train)
--frames N  pictures of --cameras interpolate (default: {STEPS} from each camera to the next)
options:
--disparity PICTURE  also write the disparity (inverse depth) in colour (.png)
--depth PICTURE  also write the depth in grey, near is white (.png)
--alpha PICTURE  also write the opacity (.png)
--masks PICTURE  also write what is turned inside out (red), background that was uncovered (blue) and places where the
    posed cage shows nothing (yellow) (.png), and print how much there is of each
{PICTURES}
""",
    deformation("POSED...", ". Several, or all keyframes of a pose file, make a picture each, in a folder"),
    objects("--save-stage FILE  also write a scene file of all objects (.stage.json)"),
    VIEW,
    SCALE_AND_DEVICE,
    cameras=("interpolate", "given"),
)

command(
    "animate",
    "animate",
    "render a film: from rest through the poses and back, or by the times of their keys",
    """\
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
  warpcage animate lego.npz --cage cage.obj --posed bend:45:y:z -o bend.gif --frames 24 --turn 0 --size 240
  warpcage animate lego.npz --cage cage.obj --posed one.obj two.obj rest -o walk.mp4 --motion once
  warpcage animate lego.npz --cage cage.obj --posed poses.json -o dance.mp4 --loop ping-pong
  warpcage animate lego.npz --cage cage.obj --posed walk.glb -o walk.mp4
  warpcage animate lego.npz --cage cage.obj --posed "walk_####.obj" -o walk.mp4 --fps 25
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o frames/ --frames 240 --cameras data/lego:test
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mov --background transparent
  warpcage animate lego.npz --edits lego.edits.json -o parts.mp4
  warpcage animate lego.npz --add mic.npz:around.json -o both.mp4
  warpcage animate lego.npz --session lego.session.json -o film.mp4 --size 800 600
  warpcage animate lego.npz --cage cage.obj --posed posed.obj --frames 240 --jobs film.jsonl
  warpcage run film.jsonl -o frames

An output without a file extension is a folder of pictures, PNG or EXR (--format). These, .mov (ProRes 4444) and .webm
(VP9) have an alpha channel, premultiplied in EXR files only. If the command is interrupted, run it again: it renders
only the frames that a folder lacks.

The film goes from rest through the poses of --posed in order. Each vertex moves straight or smoothly from pose to
pose. If all poses are the same preset, its amount changes instead, so that a bend stays an arc.

Keys at times make a film of their own length and rate, without the rest pose before them: a pose file with times
(`warpcage pose -o poses.json --key NAME --at SECONDS`), an animated glTF file, or one cage file a frame: a folder, a
pattern, or all of their names. --motion goes from rest through their poses instead.

--session makes the film of a session of the editor: its keys, its camera and its settings. A folder is new or empty
then, and appears when all of its pictures are there.
""",
    f"""
field
one of these:
-o FILM  film (.mp4, .gif, .mov, .webm) or folder of pictures
--jobs FILE  render nothing, but write a job file (.jsonl) of the frames: warpcage run renders them, on several GPUs or
    machines
options:
--workers N  processes that render, one a GPU, or with a share of the CPU cores each where there is none (default: this
    one)
{flags_of(FilmSpec, TIME)}
a session of the editor:
--session FILE  session file (.session.json): its object, edits, keys, camera and settings make the film
camera path:
--turn
--full-turn  all the way around, also where no picture was taken: --turn 360
--cameras MOVE|FILE|SCENE[:SPLIT]  move the camera instead by {MOVE_HELP};
    or move through the cameras of a file (.json, .glb, .gltf; at their times where they have some), or of a scene's
    pictures, e.g. data/lego:test (default split: train)
--shutter
options:
--show
{PICTURES}
""",
    deformation("POSED...", FOLLOWING),
    objects(),
    VIEW,
    SCALE_AND_DEVICE,
    "--quiet",
    output={},
    full_turn={"dest": "turn", "action": "store_const", "const": 360.0},
)
