"""Arguments of `warpcage sweep` and `run`."""

from __future__ import annotations

from ....core.names import COORDINATES, FIELD_COORDINATES, TRANSPARENT
from ...spec.film import FilmSpec
from ...spec.shot import COLORS, DEFORMATION, PICTURE
from .options import CAGE_UP_FOUND, CAGES, FOV, SCALE_AND_DEVICE, command, flags_of, positive_float, whole_number

#: What stands behind pictures where --background is not given: of PNG files, and of JPEG files, which have no opacity.
DEFAULT_BACKGROUNDS = {"png": TRANSPARENT, "jpg": "white"}

#: The value of --background for that of the field.
OWN = "own"

#: Modes of random poses, as `cage.pose_modes` has them, which needs NumPy.
MODES = ("bend", "twist", "stretch", "taper", "wave", "bump")

command(
    "sweep",
    "runs",
    "write a job file of many poses of a field from many cameras, for data sets",
    """\
  warpcage sweep lego.npz --cage cage.obj --poses random:100 --cameras orbit:8 -o sweep.jsonl
  warpcage sweep lego.npz --cage cage.obj --poses random:5000 --cameras random:4 --size 800 \\
      --image jpg -o augmented.jsonl
  warpcage sweep lego.npz --cage cage.obj --poses rest poses.json twist:60 --cameras data/lego:test \\
      --coordinates mean_value harmonic green -o compared.jsonl
  warpcage run sweep.jsonl -o dataset --workers 2
""",
    f"""
field
-o JOBS  job file to write (.jsonl), with poses and cameras beside it
poses:
--cage REST  cage around the undeformed object ({CAGES})
--poses POSES...  random:N for each seed; posed cage files, pose files (all keyframes of poses.json, or
    poses.json:NAME), animated glTF files, numbered files (walk_####.obj); arrays of vertices (.npy, (poses, vertices,
    3)); rest; and presets such as bend:40:x:z (default: random:100)
--seeds SEED...  random seeds of poses; the first is also that of cameras (default: 0)
--stretch LEAST LARGEST  limits of random poses: lengths in the pose over lengths at rest, everywhere (default: 0.5 2)
--reach LEAST MOST  strength of random poses, as shares of the most that --stretch allows (default: 0.3 1)
--modes MODE...  what random poses are made of: {", ".join(MODES)} (default: all)
--write-poses  make the random poses now and write them beside the job file, about 30 ms each; orbit and random cameras
    then frame every pose whole (default: each worker makes the poses that it renders)
--falloff
{CAGE_UP_FOUND}
--posed-up
cameras:
--cameras CAMERAS  orbit:N[:ELEVATION]: a circle around all poses; random:N: N random positions above the horizon, new
    ones for each pose; a camera file (.json, .glb); a transforms.json; or a scene, SCENE[:SPLIT] (default: orbit:8)
--views N  render each pose from N of the cameras, chosen at random (default: from all)
--fov DEGREES  horizontal field of view of orbit and random (default: {FOV})
--size PIXELS...  width, width and height, or aspect ratio such as 16:9, as for render (default: 400, or the size of the
    cameras' pictures)
pictures:
--coordinates KIND...  kinds of cage coordinates; all pictures are rendered with each: {", ".join(COORDINATES)}
    (default: {FIELD_COORDINATES})
{flags_of(FilmSpec, DEFORMATION, "coordinates")}
{flags_of(FilmSpec, PICTURE, "background", "fill", "overlay", "show", "format")}
--background COLOUR  {COLORS} (default: {TRANSPARENT}; of JPEG files white); {TRANSPARENT}: opacity in the picture;
    {OWN}: what the field has behind it
records (docs/sweeps.md):
--records  folder: files, with transforms.json for each pose and for all; webdataset: tar shards (deprecated, see
    docs/sweeps.md) (default: %(default)s)
--image  file format of pictures (default: %(default)s)
--items-per-shard N  pictures in a shard (default: 1000)
--no-depth  write no depth
--no-alpha  write no opacity
""",
    SCALE_AND_DEVICE,
    "--quiet",
    cage={"required": True},
    poses=["random:100"],
    seeds={"type": whole_number, "default": [0]},
    stretch={"type": positive_float, "default": (0.5, 2.0)},
    reach={"type": positive_float, "default": (0.3, 1.0)},
    modes={"choices": MODES, "default": list(MODES)},
    cameras="orbit:8",
    views={},
    coordinates={"choices": COORDINATES, "default": [FIELD_COORDINATES]},
    records={"choices": ("folder", "webdataset"), "default": "folder"},
    image={"choices": ("png", "jpg"), "default": "png"},
    items_per_shard=1000,
    no_depth={"dest": "depth", "action": "store_false"},
    no_alpha={"dest": "alpha", "action": "store_false"},
)

command(
    "run",
    "runs",
    "run a job file: render frames, fit fields and evaluate them, on several GPUs or machines",
    """\
  warpcage run jobs.jsonl -o frames
  warpcage run jobs.jsonl -o frames --dry-run
  warpcage run jobs.jsonl -o frames --workers 2
  warpcage run jobs.jsonl -o /shared/frames --cluster 10.0.0.1:6379
  warpcage run jobs.jsonl -o /shared/frames --part 3/16
""",
    """
jobs  job file (.jsonl), as docs/batch.md describes it
-o DIR  output folder; its manifest.jsonl records how each item ended. Outputs whose inputs did not change are kept
--workers N  processes that work, one a GPU, or with a share of the CPU cores each where there is none (default: 1; on a
    cluster all of its GPUs)
--cluster ADDRESS  work on a cluster, which needs Ray, at an address such as 10.0.0.1:6379, or "auto" for the one that
    this machine belongs to; all its machines see the files under the same paths
--part K/N  run only the K-th of N equal parts of the job, such as 3/16, beside other runs; a run without it joins their
    manifests (docs/farms.md)
--retries N  how often to retry an item, on another worker where possible, after its worker crashed or after an error
    that is not one of its input (default: %(default)s)
--item-timeout SECONDS  stop an item that takes longer, loading included, and retry it as after a crash. A single worker
    is then a process of its own (default: no limit)
--dry-run  only say what would be made, what exists already, and how long it would take, measured on one item of each
    kind whose output is thrown away
--device
--quiet
""",
    retries={"type": whole_number, "default": 2},
    item_timeout=positive_float,
)
