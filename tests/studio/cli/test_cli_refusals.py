"""What commands refuse: in one line, with status 2, and nothing is written; test_specs has wrong values of options."""

import json
import re
import shlex

import imageio.v3 as iio
import numpy as np
import pytest
from runs import run, write_files
from splat_scenes import splats_in_box

from warpcage import Cage, CameraFile, PoseFile, VoxelField, turntable
from warpcage.studio.editor import new_document, write_session

#: A deformation, and the end of a picture.
POSED, OUT = "--cage @cage.obj --posed @posed.obj", "-o @new.png"
RENDER, FILM, SWEEP = f"render @ball.npz {OUT}", "animate @ball.npz -o @new.mp4", "sweep @ball.npz -o @new.jsonl"
VIEWS, WORKERS = "render @ball.npz -o @new", f"animate @ball.npz {POSED} --frames 6 --workers 1"
PLACED, JOBS = f"{RENDER} --add @ball.npz", f"animate @ball.npz {POSED} --frames 5 --jobs @new.jsonl"
SPLATS, BAKED = f"render @scene.ply {OUT}", "bake @scene.ply -o @a.ply --cage @around.obj"
SESSION = f"{FILM} --session @ball.session.json --size 8"
DECIDED, PLACE = "--session cannot be combined with --", "@ball.npz:@text.txt"
CLEAR = "animate @ball.npz --transparent -o @new"
MESH, SELECT, CLEAN = "mesh @ball.npz -o @new", "select @ball.npz -o @new.npz", "clean @scene.ply -o @new.ply"

REFUSED = {
    "": None,
    "dance": "dance",
    "info --wrong": "--wrong",
    # fields and cages
    "fit @scene": "--output",
    "fit @nowhere -o @new.npz": "nowhere",
    "fit @empty -o @new.npz": "known format",
    "fit @scene -o @new.npz --split validation": "validation",
    "fit @scene -o @new.ckpt": "must end in .npz",
    "fit @scene -o @new.npz --device cuda:99": "cuda:99",
    "fit @scene -o @new.npz --max-memory '4 apples'": "4 apples",
    "fit @scene -o @new.npz --max-memory 20kB": "max_memory",
    "fit @scene -o @text.txt/new.npz": "not a folder",
    "fit @scene -o @x.ply --epochs 2": "--epochs is not for fits of splats",
    "fit @scene -o @x.npz --steps 5": "--steps is not for fits of voxels",
    "fit @scene -o @x.npz --as splats": "x.npz' must end in .",
    "fit @scene -o @x.ply --background layers": "is for voxels",
    "mesh @nowhere.npz -o @new.obj": "nowhere.npz",
    "mesh @broken.npz -o @new.obj": "broken.npz",
    "mesh @ball.npz -o @new.txt": "must end in",
    "mesh @ball.npz -o @new.obj --threshold 1e9": "threshold",
    "mesh @scene.ply -o @mesh.obj": "mesh is for fields of voxels",
    "mesh @ball.npz -o @new.stl --colors": ".stl has no colours",
    f"{MESH}.usdc --texture 64": "--texture is for glTF",
    f"{MESH}.ply --texture 64": "--texture is for glTF",
    f"{MESH}.glb --texture 64 --colors": "--texture is for glTF",
    f"{MESH}.obj --selection @ball.npz": "not a selection file",
    f"{MESH}.ply --cage @cage.obj --posed twist:20 --frames 5": "motion",
    f"{MESH}.glb --frames 5": "--frames needs a deformation",
    f"{MESH}.obj --cage @cage.obj --posed twist:20 twist:40": "one pose",
    f"{MESH}.glb --edit @cage.obj:remove": "bake",
    f"{MESH}.glb --edit @cage.obj:@posed.obj:keep": "bake",
    "cage @nowhere.obj -o @new.obj": "nowhere.obj",
    "cage @text.txt -o @new.obj": "text.txt",
    "cage @cage.obj -o @new.obj --box --sides 5": "--sides belongs to --cylinder",
    "cage @cage.obj -o @new.obj --box --cylinder": "not allowed with",
    "cage @ball.npz -o @new.obj --method best": "--method",
    "cage @ball.npz -o @new.obj --box --symmetry x": "--symmetry is for",
    "cage @cage.obj -o @new.obj --parts 1": "--parts is for fields",
    "cage @ball.npz -o @new.obj --seed 0.9 0.9 0.9": "near the seed point",
    "cage @ball.npz -o @new.obj --masks @nowhere": "nowhere",
    "cage @scene.ply -o @a.ply --vertices 2": "--vertices must be a whole number from 8 to 2000",
    "cage @scene.ply -o @a.ply --in-box 7 7 7 8 8 8": "visible cells are outside",
    "cage @header.ply -o @a.ply": "cannot be read as a mesh, it is cut off or damaged",
    "cage @cage.obj -o @new.obj --selection @none.npz": "is for fields",
    "cage @ball.npz -o @new.obj --selection @none.npz": "none.npz",
    "check @scene.ply": "scene.ply holds splats, without faces, no mesh and no cage",
    "check @scene.compressed.ply": "holds splats",
    "check @scene": "must end in .obj",
    "pose @scene -o @new.obj --bend 3": "must end in .obj",
    "pose @cage.obj -o @new.obj": "no step",
    "pose @broken.obj -o @new.obj --bend 3": "broken.obj:1",
    "pose @open.obj -o @new.obj --bend 3": "open.obj",
    "pose @cage.obj -o @new.obj --bend 3 --axis x --towards x": "axes",
    "pose @cage.obj -o @new.obj --scale 0": "positive",
    "pose @cage.obj -o @new.obj --bend nan": "finite",
    "pose @cage.obj -o @new.obj --key a --bend 3": "--key is for keys of a pose file",
    "pose @cage.obj -o @new.json": "needs --key NAME",
    "evaluate @ball.npz @nowhere": "nowhere",
    "info @nowhere.npz": "nowhere.npz",
    "info @text.txt": "text.txt",
    "info @cut.splat": "32 bytes a splat",
    "info @scene.ply --scene-scale 2": "--scene-scale is for fields",
    "info @scene --scene-scale 0.5": "--scene-scale is for fields (.npz), got ",
    "check @cage.obj --scene-scale 0.5": "--scene-scale is for fields (.npz), got ",
    "cage @cage.obj -o @new.obj --scene-scale 0.5": "--scene-scale is for fields (.npz), got ",
    "info --sheet @new.png": "--sheet shows the pictures of a scene folder",
    "info @ball.npz --sheet @new.png": "--sheet shows the pictures of a scene folder",
    "info --box @new.png": "--box shows where the object",
    "info @ball.npz --box @new.png": "--box shows where the object",
    # selections
    SELECT: "needs a click",
    "select @ball.npz -o @new.txt --point 0 0 0": "must end in .npz or .json",
    f"{SELECT} --point 0 0 9": "is on nothing",
    f"{SELECT} --depth 1 2": "go together",
    f"{SELECT} --point 0 0 0 --plane none --clearance 1": "a plane",
    f"{SELECT} --pixel 0 0": "is on nothing",
    f"{SELECT} --pixel -1 0": "at least 0",
    "select @scene.ply -o @new.npz --up 0 0 1 --point -1 -1 1": "is on nothing",
    "bake @ball.npz -o @new.npz --selection @none.npz --voxels 9": "--voxels is for",
    "bake @scene.ply -o @new.ply --selection @none.npz": "none.npz",
    "clean @scene.ply -o @new.npz": "must end in .ply or ",
    "clean @none.ply -o @new.ply": "none.ply",
    f"{CLEAN} --largest-scale 1e-6": "nothing would be left",
    f"{CLEAN} --floaters 2": "floaters must be a share",
    f"{CLEAN} --least-views 2": "belong to --views",
    f"{CLEAN} --preview @new.jpg": "must end in .png",
    "clean @ball.npz -o @new.npz --largest-scale 1": "--largest-scale is for files of splats",
    "clean @ball.npz -o @new.ply": "must end in .npz",
    # deformations
    f"{RENDER} --cage @cage.obj": "--cage and --posed go together",
    f"{RENDER} --posed @top.obj": "--posed needs --cage",
    f"{RENDER} --cage @open.obj --posed @open.obj": "open.obj",
    f"{RENDER} --cage @inward.obj --posed @inward.obj": "inward.obj",
    f"{RENDER} --cage @cage.obj --posed @other.obj": "vertices",
    f"{FILM} --cage @cage.obj --posed bend:wide": "not a preset",
    f"{RENDER} {POSED} --resolution precise": "closed form",
    f"{RENDER} {POSED} --fill": "the background of this field is one colour",
    f"{RENDER} --fill": "--fill needs a deformation",
    f"{RENDER} --overlay": "--overlay needs a deformation: --cage and --posed (or --cage alone, at rest)",
    f"{RENDER} --cage @cage.obj --posed rest rest": "2 poses make as many pictures: give a folder",
    "render @ball.npz -o @scene --cage @cage.obj --posed rest rest": "exists already",
    f"{VIEWS} --cage @cage.obj --posed rest rest --masks @m.png": "--masks is for one picture",
    f"{RENDER} --edit @gone.obj:rest": "gone.obj",
    f"{RENDER} --edit @top.obj:rest --edit @left.obj:@posed.obj": "edit 2 of 2: cage",
    f"{RENDER} --edit @left.obj:@left.json": "holds 2 keyframes: name one",
    f"{RENDER} --edit @open.obj:rest": "edit 1 of 1: cage",
    f"{RENDER} --edit @top.obj:rest:held=3": "edit 1 of 1: held names the sides that an edit fades towards",
    f"{RENDER} --cage @top.obj --posed rest --edit @top.obj:rest": "--cage and --edit do not go together",
    f"{RENDER} --edits @left.json": "its format is 'warpcage poses'",
    f"{RENDER} --edits @text.txt": "not an edits file",
    f"{RENDER} --edits @gone.json": "gone.json",
    "bake @ball.npz -o @new.npz": "--cage and --posed",
    f"bake @ball.npz -o @new.obj {POSED}": "must end in .npz",
    f"bake @ball.npz -o @new.npz {POSED} --voxels 1": "resolution must be",
    # splats
    f"{SPLATS} --masks @m.png --cage @around.obj": "--masks is for fields of vox",
    f"{SPLATS} --scene-scale 2": "--scene-scale is for fields",
    f"{RENDER} --frame @frame.json": "only splats are moved out of nerfstudio's coordinates",
    f"{RENDER} --frame sideways": "takes rest, posed or a .json file, got 'sideways'",
    f"{RENDER} --antialias": "--antialias is for files of splats",
    f"{RENDER} --map forward": "--map forward is for files of splats",
    "bake @scene.ply -o @a.npz --cage @around.obj --posed twist:9": "a.npz' must end in .",
    f"{BAKED} --voxels 9": "--voxels and --format",
    "bake @scene.ply -o @a.ply": "needs a deformation",
    f"{BAKED} --frames 3": "numbered files of splats",
    "bake @scene.ply -o @a_##.ply --frames 1 --cage @around.obj --posed twist:9": "the pose at rest alone",
    "bake @scene.ply -o @a_##.ply --cage @around.obj --posed twist:9": "give --frames, how many",
    f"{BAKED} --posed twist:9 --overwrite": "--overwrite is for numbered files: give --frames",
    f"{BAKED} --posed twist:9 --falloff 0.1": "or say which sides are held: still (",
    # views
    "render @cage.obj -o @a.png": "cage.obj is not a field: fields are .npz (voxels) or ",
    "render @empty -o @a.png": "empty' is a folder",
    "render @ball.npz -o @new.jpg": "must end in .png",
    f"{RENDER} --masks @m.png": "--masks",
    f"{RENDER} --camera @scene:99": "0 to 5",
    f"{RENDER} --camera @scene": "SCENE:INDEX",
    f"{RENDER} --size 0": "at least 1",
    f"{RENDER} --size 40 20 10": "a width and a height",
    f"{RENDER} --size 16:0": "two numbers such as 16:9",
    f"{RENDER} --size widen": "or a shape",
    f"{RENDER} --size 99999": "99999x99999 is too large, a picture has at most 2,147,483,647 pixels",
    f"{RENDER} --camera @two.json": "two.json: it holds 2 cameras: name one of 0, 1",
    f"{RENDER} --camera @two.json:9": "it holds no camera '9', only 0, 1",
    f"{RENDER} --camera @ball.npz": "must be a camera file (.json, .glb, .gltf), SCENE:INDEX",
    f"{RENDER} --camera @none.json": "none.json' is not there",
    f"{RENDER} --camera @two.json:0 --view top": "cannot be combined",
    f"{RENDER} --camera @two.json:0 --frame posed": "cannot be combined",
    f"{RENDER} --eye 0 0 3 --view top": "cannot be combined",
    f"{RENDER} --save-camera camera.txt": "must end in .json",
    f"{VIEWS} --cameras given --scene @two.json --view top": "cannot be combined with --view",
    f"{VIEWS} --cameras interpolate": "--cameras needs --scene",
    f"{VIEWS} --cameras interpolate --scene @scene --camera @scene:0": "combined with --camera",
    f"{VIEWS} --cameras interpolate --scene @scene --depth new.png": "combined with --depth",
    f"{VIEWS} --cameras given --scene @scene --frames 3": "--frames belongs",
    f"{RENDER} --cameras given --scene @scene": "must end in .mp4 or .gif",
    "render @ball.npz -o @scene --cameras given --scene @scene": "exists",
    f"{VIEWS} --cameras given --scene @nowhere": "nowhere",
    f"{VIEWS} --cameras given --scene @scene:validation": "validation",
    f"{RENDER} --scene @scene": "belong to --cameras",
    # several objects
    f"{RENDER} --add {PLACE}": "text.txt: not a place file",
    f"{RENDER} --add @none.npz": "none.npz' is not there",
    f"{PLACED}:a:b:c": "must be FIELD, FIELD:PLACE.json or",
    f"{RENDER} --save-stage x.json": "that ends in .stage.json",
    f"render @none.stage.json {OUT}": "none.stage.json' is not there",
    f"render @none.stage.json {OUT} {POSED}": "have cages of their own",
    f"{FILM} --add @ball.npz --workers 2": "--workers and --jobs render one field",
    f"bake @none.stage.json -o @new.npz {POSED}": "--cage does not go with a scene file",
    # films
    "animate @ball.npz -o @new.avi": ".mp4, .gif",
    f"{FILM} --fps 1e30": "must be from 0.01 to 1000",
    "animate @ball.npz -o @new.gif --fps 60": "must be from 0.01 to 50",
    f"{FILM} --show masks": "--show masks",
    f"{FILM} --turn 9 --cameras @scene": "combine",
    f"{FILM} --cameras @nowhere": "nowhere",
    f"{FILM} --transparent": "a film that ends in .mp4 has no opacity: give .mov",
    "animate @ball.npz -o @new.gif --background transparent": "a film that ends in .gif has no opacity",
    f"{CLEAR}.mov --background black": "give one of them",
    f"{CLEAR} --show depth": "--show depth has no opacity",
    "animate @ball.npz -o @new.mov --format exr": "--format is for folders",
    "animate @ball.npz -o @new --format exr --show alpha": "leave out --show",
    f"{FILM} --jobs @new.jsonl": "not allowed with",
    "animate @ball.npz --jobs @a.mp4": "must end in .jsonl or .json",
    f"{JOBS} --show depth --overlay": "draw cages into colours alone: leave out --overlay, or --show depth",
    f"{JOBS} --loop once": "--loop is for keys at times",
    f"{WORKERS} -o @a.mov --show depth": "--workers makes .mov films of colours alone",
    f"{WORKERS} -o @a.mp4 --show alpha --overlay": "draw cages into colours alone",
    f"{WORKERS} --jobs @a.jsonl": "--workers does not go with --jobs: give it to warpcage run",
    f"{WORKERS} -o @a.avi": "must end in",
    f"{FILM} --session @nothing.json": "nothing.json' is not there",
    f"{FILM} --session @text.txt": "text.txt: not a session file",
    "animate @other.npz -o @new.mp4 --session @ball.session.json": "it belongs to another field, ball.npz, with other",
    f"{SESSION} {POSED}": f"{DECIDED}cage",
    f"{SESSION} --frames 48": f"{DECIDED}frames: the session decides that",
    f"{SESSION} --coordinates harmonic": f"{DECIDED}coordinates",
    f"{SESSION} --resolution precise": f"{DECIDED}resolution",
    f"{SESSION} --turn 0": f"{DECIDED}turn",
    f"{SESSION} --eye 1 2 3": f"{DECIDED}eye",
    f"{SESSION} --show rgb": f"{DECIDED}show",
    f"{SESSION} --background white": f"{DECIDED}background",
    f"{FILM} --cage @cage.obj --posed @timed.json --frames 9": "--frames is not for keys at times",
    # sweeps
    f"{SWEEP} --cage @open.obj": "is open",
    f"{SWEEP} --cage @cage.obj --poses random": "--poses 'random' must be random:N",
    f"{SWEEP} --cage @cage.obj --poses random:0": "--poses 'random:0' must be random:N",
    f"{SWEEP} --cage @cage.obj --poses @ball.npz": "cage",
    f"{SWEEP} --cage @cage.obj --poses @other.npy": "must hold (poses, 26, 3) vertices",
    f"{SWEEP} --cage @cage.obj --cameras orbit:8:95": "must be orbit:N or orbit:N:ELEVATION",
    f"{SWEEP} --cage @cage.obj --cameras nowhere": "scene folder 'nowhere' is not there",
    f"{SWEEP} --cage @cage.obj --cameras nowhere.json": "camera file 'nowhere.json' is not there",
    f"{SWEEP} --cage @cage.obj --cameras random:4 --views 2": "--views chooses among cameras that all poses share",
    f"{SWEEP} --cage @cage.obj --cameras orbit:2 --views 3": "views must be a whole number from 1 to 2",
    f"{SWEEP} --cage @cage.obj --seeds 1 1": "--seeds names one twice",
    f"{SWEEP} --cage @cage.obj --stretch 1.5 2": "stretch must hold 1 between",
    f"{SWEEP} --cage @cage.obj --resolution precise": "harmonic coordinates have no closed form",
    f"{SWEEP} --cage @cage.obj --image jpg --background transparent": "a JPEG has no opacity",
    # runs
    "run @no.jsonl -o @out": "is not there",
    "run @twice.jsonl -o @out": "lines 2 and 3: two items have the id 'a'",
    "run @slip.jsonl -o @out": "line 2",
    "run @once.jsonl -o @text.txt": "is a file",
    # files of another kind than they should be
    "info @picture.png": "looks like a picture",
    "check @picture.png": "looks like a picture",
    "check @cage.obj --object @picture.png": "looks like a picture",
    f"{RENDER} --cage @cage.obj --posed @picture.png": "looks like a picture",
    f"{RENDER} --edits @picture.png": "looks like a picture",
    f"{RENDER} --camera @picture.png": "looks like a picture",
    f"{RENDER} --add @ball.npz:@picture.png": "looks like a picture",
    f"{RENDER} --frame @picture.stage.json": "looks like a picture",
    f"render @picture.stage.json {OUT}": "looks like a picture",
    f"{FILM} --session @picture.png": "looks like a picture",
    f"{FILM} --cameras @picture.stage.json": "looks like a picture",
    "fit @picture.png -o @new.npz": "looks like a picture",
    "pose @picture.png -o @new.obj --bend 3": "looks like a picture",
    "run @picture.png -o @new": "looks like a picture",
    "mesh @ball.npz --selection @picture.png -o @new.obj": "looks like a picture",
    # the editor
    "edit --no-browser": "field file, or --demo",
    "edit @other.npz --demo --no-browser": "field file, or --demo",
    "edit --demo --cage @cage.obj --no-browser": "brings its own cage",
    "edit --demo --selection @none.npz --no-browser": "brings its own",
    "edit @nothing.npz --no-browser": "is not there",
    "edit @broken.npz --no-browser": "is not an .npz",
    "edit @other.npz --cage @nothing.obj --no-browser": "nothing.obj",
    "edit @other.npz --cage @open.obj --no-browser": "open.obj",
    "edit @other.npz --session @broken.session.json --no-browser": "--new sets that file aside and begins anew",
    "edit @other.npz --host no.such.host.invalid --no-browser": "",
    "edit @other.npz --host 192.0.2.1 --no-browser": "assign requested address",
    **{
        f"edit @other.npz --no-browser --port={port}": "must be 0 to 65535"
        for port in ("-1", "65536", "x", "1.5", "''", "²")
    },
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("refusals"))
    CameraFile(turntable((0, 0, 0), 3.0, 10, 2, width=40, height=40)).save(folder / "two.json")
    Cage.box((-0.7, -0.7, 0.0), (0.7, 0.7, 0.7)).save(folder / "top.obj")
    left = Cage.box((-0.7, -0.7, -0.7), (-0.2, 0.7, 0.7))
    left.save(folder / "left.obj")
    PoseFile(left, {"near": left.translate([-0.1, 0, 0]), "far": left.translate([-0.2, 0, 0])}).save(
        folder / "left.json"
    )
    np.save(folder / "other.npy", np.zeros((2, 5, 3)))
    Cage.box((-9, -9, -9), (9, 9, 9)).save(folder / "around.obj")
    timed = PoseFile(rest := Cage.load(folder / "cage.obj"), {"a": rest, "b": rest.scale(0.9)})
    timed.times = {"a": 0.0, "b": 1.0}
    timed.save(folder / "timed.json")
    (folder / "frame.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 1}))
    for name in ("picture.png", "picture.stage.json"):
        iio.imwrite(folder / name, np.zeros((4, 4, 3), np.uint8), extension=".png")
    header, item = (
        '{"format": "warpcage jobs", "version": 1}',
        '{"id": "a", "field": "ball.npz", "camera": "two.json#0"}',
    )
    for name, lines in {"once": [item], "twice": [item, item], "slip": ['{"id": "a", "fields": 3}']}.items():
        (folder / f"{name}.jsonl").write_text("\n".join([header, *lines]))
    splats = splats_in_box("cpu", count=40, scales=(-3.5, -2.8), degree=1)
    for name in ("scene.ply", "scene.compressed.ply"):
        splats.save(folder / name)
    (folder / "header.ply").write_bytes((folder / "scene.ply").read_bytes()[:60])
    (folder / "cut.splat").write_bytes(bytes(33))
    field = VoxelField.load(folder / "ball.npz", device="cpu")
    write_session(folder / "ball.session.json", new_document(field, [], 16, "ball"), field, "ball.npz")
    (folder / "broken.session.json").write_text("{}")
    values = np.full((4, 4, 4), 9.0), np.zeros((4, 4, 4, 9, 3)), [[3, 0, 0], [4, 1, 1]]
    VoxelField.from_dense(*values, device="cpu").save(folder / "other.npz")
    return folder


#: What long work reports meanwhile, where a machine is slow.
PROGRESS = re.compile(r"^\w+: \d+/\d+, about ")


@pytest.mark.parametrize("line", REFUSED, ids=lambda line: line or "no command")
def test_what_is_refused_takes_one_line_and_leaves_nothing(files, line, capsys):
    before = sorted(files.rglob("*"))
    assert run(files, *shlex.split(line)) == 2
    said, error = capsys.readouterr()
    if REFUSED[line] is not None:  # without a command, help comes with it
        *warned, last = error.splitlines()
        assert last.startswith("warpcage: error: ") and REFUSED[line] in last and said == "", (said, error)
        assert all("do not belong together" in each or PROGRESS.search(each) for each in warned), error
    assert sorted(files.rglob("*")) == before
