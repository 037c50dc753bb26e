"""Makes the golden files of tests/data. No test runs it: they were made by version 0.1.0, commit 3338dff, and stay.

    cd CLEAN_TREE_OF_3338dff && PYTHONPATH=$PWD:$PWD/tests python PATH/OF/THIS/make_golden.py

What is of other programs or of older versions is written by hand here, as readers document it. Files of a format that
is new after version 0.1.0 are added by whoever adds the format, by the version that does.
"""

import gzip
import json
import pathlib
import shutil
import struct
import sys
import tempfile
import zipfile

import golden_cases
import golden_names
import numpy as np
import scene_writers
from field_arrays import field_arrays, svox2_arrays
from golden_cases import CASES, DATA, GOLDEN, SAID, WRITTEN

import warpcage
from warpcage import Cage, Camera, CameraFile, CameraKey, NodeSelection, PoseFile, SplatField, VoxelField

BASE = pathlib.Path(warpcage.__file__).parent.parent
TEXTS = (".json", ".jsonl", ".md", ".obj", ".off", ".gltf")
CAGE = Cage.box([-0.85, -1.5, -0.75], [1.35, 0.5, 1.0])
POSED = CAGE.bend(40, axis="x", towards="z")


def rounded(vertices):
    return np.round(vertices * 1024) / 1024


def make_fields(folder):
    for number in (1, 2, 3, 4):
        np.savez(folder / "hand.npz", **field_arrays(number, side=4))
        field = VoxelField.load(folder / "hand.npz", device="cpu")
        field.save(folder / f"field_v{number}.npz")
        field.save(folder / f"compact_v{number}.npz", format="compact")
        if number == 1:
            field.save(folder / "svox2.npz", format="svox2")
    (folder / "hand.npz").unlink()
    np.savez_compressed(folder / "field_v1_bare.npz", **field_arrays(1, side=4, bare=True))
    np.savez_compressed(folder / "compact_by_hand.npz", **field_arrays(1, side=4, compact=True))
    for name, options in {
        "scalars": {"scalars": True, "basis": 1},
        "degree_1": {"basis": 4},
        "layered": {"layered": True, "basis": 1},
    }.items():
        np.savez_compressed(folder / f"svox2_{name}.npz", **svox2_arrays(**options))


def make_selections(folder):
    field = VoxelField.load(folder / "field_v1.npz", device="cpu")
    mask = field.node_densities() > 2.0
    from rooms import named

    plane = named("Plane", "field")([0.0, 0.0, 1.0], -0.5)
    NodeSelection(field, mask).save(folder / "chosen.npz")
    NodeSelection(field, mask & (np.arange(4) > 1), ("the ground was left out",), plane).save(folder / "chosen.json")


def make_splats(folder):
    random, count = np.random.default_rng(2), 12

    def splats(degree):
        return SplatField(
            random.uniform(-1, 1, (count, 3)).astype(np.float32),
            random.uniform(-5, -2, (count, 3)),
            random.normal(size=(count, 4)),
            random.normal(size=count),
            0.3 * random.normal(size=(count, (degree + 1) ** 2, 3)),
            device="cpu",
        )

    splats(2).save(folder / "splats.ply")
    splats(0).save(folder / "splats_0.ply")
    for ending in (".compressed.ply", ".splat", ".spz"):
        SplatField.load(folder / "splats.ply", device="cpu").save(folder / f"splats{ending}")
    names = ["rot_3", "rot_0", "rot_1", "rot_2", "label", "z", "x", "y", "f_dc_2", "f_dc_0", "f_dc_1", "opacity"]
    names += [f"f_rest_{number}" for number in reversed(range(9))] + ["scale_0", "scale_2", "scale_1", "beta"]
    kinds = {"label": ">i2", "scale_0": ">f8", "x": ">f8"}
    table = np.zeros(4, [(name, kinds.get(name, ">f4")) for name in names])
    for name in names:
        table[name] = random.integers(0, 9, 4) if name == "label" else random.normal(size=4)
    words = {">i2": "short", ">f4": "float", ">f8": "double"}
    lines = ["ply", "format binary_big_endian 1.0", "comment of mine", "element camera 2", "property uchar id"]
    lines += ["element vertex 4", *(f"property {words[kinds.get(name, '>f4')]} {name}" for name in names)]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    after = b"\x03" + np.arange(3, dtype=">i4").tobytes()
    (folder / "foreign.ply").write_bytes("\n".join(lines).encode() + b"\x07\x09" + table.tobytes() + after)
    header = struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 0, 0)
    body = b"".join(value.to_bytes(3, "little", signed=True) for value in (4096, -8192, 0))
    body += bytes([128, 255, 128, 0, 160, 144, 128, 128, 128, 255])
    (folder / "splats_v2.spz").write_bytes(gzip.compress(header + body, mtime=0))


def make_cages(folder):
    for ending in (".obj", ".ply", ".off", ".glb", ".gltf"):
        CAGE.save(folder / f"cage{ending}")
    for ending in (".obj", ".ply"):
        CAGE.save(folder / f"cage_y{ending}", up="y")
    CAGE.with_vertices(rounded(POSED.vertices)).save(folder / "posed.obj")


def look(eye, time=None, name="", easing="smooth", target=None):
    camera = Camera.look_at(eye, (0.25, -0.5, 0.125), width=8, height=6)
    pose = camera.camera_to_world.copy()
    return CameraKey(Camera(9.5, 9.25, 4.0, 3.25, 8, 6, pose), time, name, easing, target)


def make_poses_and_cameras(folder):
    poses = PoseFile(CAGE, {"rest": CAGE, "bent": rounded(POSED.vertices)})
    poses.times = {"bent": 1.0}
    poses.save(folder / "poses.json")
    film = PoseFile(CAGE, {"a": CAGE, "b": rounded(CAGE.twist(30).vertices), "c": CAGE})
    film.times, film.easings = {"a": 0.0, "b": 0.25, "c": 0.5}, {"a": "linear", "b": "hold"}
    film.fps, film.loop = 8.0, "loop"
    film.cameras = [look((4.0, 1, 1), 0.0, "front"), look((0, 4.0, 2), 0.5, easing="linear")]
    film.save(folder / "film.json")
    keys = [
        look((4.0, 1, 1), 0.0, "front", target=(0.0, 0.5, 0.0)),
        look((0.5, 4.0, 1), 1.5, "side", "hold"),
        look((-4.0, 1, 1), 2.0, "back"),
    ]
    CameraFile(keys, fps=12.5, loop="ping-pong").save(folder / "cameras.json")
    look((3.5, 1.5, 1)).camera.save(folder / "one_camera.json")
    fixtures = BASE / "tests" / "fixtures"
    shutil.copy(fixtures / "blender_cameras" / "moving.glb", folder / "moving_camera.glb")
    shutil.copy(fixtures / "blender_cameras" / "still.glb", folder / "still_cameras.glb")
    shutil.copy(fixtures / "blender_motion" / "moved_object.glb", folder / "moved_object.glb")
    from rooms import named

    gains, offsets = np.array([[1.0, 1.125, 0.875], [0.5, 1, 1]]), np.array([[0.0, 0.0625, 0], [0.125, 0, -0.25]])
    refined = named("RefinedCameras", "view")(["r_0", "r_1"], [key.camera for key in keys[:2]], gains, offsets)
    refined.save(folder / "refined.cameras.json")


FRAME = {
    "field": "field_v1.npz",
    "cage": "cage.obj",
    "camera": "one_camera.json",
    "coordinates": "mean_value",
    "resolution": 8,
}
EYE = {"eye": [4, 1, 1], "target": [0.25, -0.5, 0.125], "width": 8, "height": 6}


def make_jobs(folder):
    np.save(folder / "rows.npy", np.stack([CAGE.vertices, rounded(POSED.vertices)]))
    items = [
        {"id": "rest", "posed": "rest"},
        {
            "id": "bent",
            "posed": "posed.obj",
            "outputs": {"rgb": "{id}.png", "depth": "depth/{id}.npy", "alpha": "{id}_alpha.png"},
        },
        {"id": "shot/frame_0001", "posed": "rows.npy#1", "camera": "cameras.json#1", "coordinates": "green"},
        {
            "id": "twice",
            "edits": [
                {"cage": "cage.obj", "posed": "twist:60", "keep": True},
                {"cage": "cage.obj", "posed": "translate:0:0:1", "falloff": 0.25, "held": [1, 2]},
            ],
            "camera": EYE,
        },
        {
            "id": "gone",
            "edits": [{"cage": "cage.obj", "remove": True, "crumbs": 0.1, "up": "z"}],
            "background": [0, 0.5, 1],
        },
        {
            "id": "plain",
            "cage": None,
            "posed": None,
            "background": "transparent",
            "supersampling": 2,
            "extra": {"note": "kept with the record"},
        },
        {
            "id": "key",
            "posed": "poses.json#bent",
            "size": [6, 4],
            "density": "paper",
            "overlay": True,
            "scene_scale": 1.0,
        },
        {
            "id": "fits",
            "kind": "fit",
            "scene": "scenes/blender",
            "options": {"resolution": 8, "epochs": 0.05, "least_steps": 4, "levels": 1},
            "output": "fits/scene.npz",
        },
        {"id": "psnr", "kind": "evaluate", "scene": "scenes/blender", "output": "psnr.json"},
    ]
    write_jobs(folder / "jobs_v1.jsonl", items, defaults=FRAME, extra={"made": "by hand"})
    drawn = [
        {"id": "drawn", "posed": {"random": {"seed": 3, "number": 12}}},
        {
            "id": "more",
            "posed": {"random": {"number": 1, "stretch": [0.75, 1.5], "reach": [1, 1], "modes": ["wave", "bend"]}},
        },
        {"id": "usual"},
    ]
    write_jobs(folder / "jobs_v2.jsonl", drawn, defaults=FRAME | {"posed": "posed.obj"})
    frames = [
        {
            "id": f"pose_{pose}/camera_{camera}",
            "posed": f"rows.npy#{pose}",
            "camera": f"cameras.json#{camera}",
            "extra": {"pose": pose},
        }
        for pose in (0, 1)
        for camera in (0, 1)
    ]
    write_jobs(folder / "records.jsonl", frames, defaults=FRAME, records={"kind": "folder", "image": "png"})
    write_jobs(
        folder / "shards.jsonl",
        frames,
        defaults=FRAME,
        records={"kind": "webdataset", "items_per_shard": 3, "image": "jpg", "alpha": False},
    )


def write_jobs(path, items, **options):
    from warpcage.batch.job_file import write_jobs

    write_jobs(path, items, **options)


def make_sessions(folder):
    rest, posed = CAGE.vertices.tolist(), rounded(POSED.vertices).tolist()
    edit = {
        "id": 1,
        "name": "Move 1",
        "kind": "move",
        "visible": True,
        "faces": CAGE.faces.tolist(),
        "rest": rest,
        "posed": posed,
        "falloff": 0.25,
        "held": "still",
        "crumbs": 0.125,
    }
    other = edit | {
        "id": 4,
        "name": "größer",
        "kind": "remove",
        "visible": False,
        "posed": rest,
        "falloff": 0.0,
        "held": "cut",
        "crumbs": 0.0,
    }
    copy = edit | {"id": 6, "name": "a copy", "kind": "copy", "falloff": 0.0, "held": "cut", "crumbs": 0.0}
    view = {"eye": [4.0, 1.0, 1.0], "target": [0.25, -0.5, 0.125], "up": [0.0, 0.0, 1.0], "fov": 40.0}
    keys = [
        {"id": 2, "time": 0.0, "name": "start", "easing": "linear", "poses": {"1": rest, "6": rest}, "view": view},
        {"id": 3, "time": 0.5, "name": "end", "easing": "smooth", "poses": {"1": posed, "6": posed}, "view": None},
        {"id": 5, "time": 0.75, "name": "look", "easing": "hold", "poses": None, "view": view | {"fov": 30.0}},
    ]
    settings = {
        "coordinates": "mean_value",
        "resolution": 32,
        "density": "paper",
        "background": [0.0, 0.5, 1.0],
        "supersampling": 2,
        "show": "disparity",
        "mode": "rest",
        "fill": True,
    }
    document = {
        "edits": [edit, other, copy],
        "selection": {"edit": 1, "mode": "face", "vertices": [0, 2, 3]},
        "settings": settings,
        "view": view,
        "timeline": {"keys": keys, "length": 1.0, "fps": 4.0, "loop": "ping-pong"},
        "time": 0.25,
        "next_id": 9,
    }
    field = {"name": "field_v1.npz", "bounds": VoxelField.load(folder / "field_v1.npz", device="cpu").bounds.tolist()}

    def write(name, document):
        content = {"format": "warpcage session", "version": 1, "field": field, "document": document}
        (folder / name).write_text(json.dumps(content) + "\n", encoding="utf-8")

    write("session.session.json", document)
    early = [
        {name: value for name, value in each.items() if name not in ("falloff", "held", "crumbs")}
        for each in (edit, other)
    ]
    write(
        "session_early.session.json",
        document
        | {
            "edits": early,
            "settings": {"coordinates": "green", "background": "#336699"},
            "timeline": {"keys": keys[2:], "length": 2, "fps": 24, "loop": "once"},
            "view": view | {"up": [0, 0, 2]},
            "time": 0,
        },
    )


def make_pictures(folder):
    from rooms import named

    random = np.random.default_rng(7)
    named("write_film_frame", "view")(folder / "frame.npz", random.random((4, 5, 4)))
    named("write_exr", "view")(folder / "picture.exr", random.random((4, 5, 4)), 10 * random.random((4, 5)))
    report = golden_cases.capture_report(None)
    (folder / "capture.json").write_text(report.to_json(), encoding="utf-8")
    (folder / "capture.md").write_text(report.to_markdown(), encoding="utf-8")


def make_checkpoint(folder):
    from rooms import named

    cameras = [
        Camera.look_at(eye, (0, 0, 0)).camera_to_world for eye in [(3.0, 0, 1), (0, 3.0, 1), (-3.0, 0, 1), (0, -3.0, 1)]
    ]
    y, x = np.mgrid[:8, :8]
    alphas = np.repeat(np.where((x - 3.5) ** 2 + (y - 3.5) ** 2 < 8, 255, 0)[None], 4, axis=0).astype(np.uint8)
    images = np.where(alphas[..., None] > 0, [[[200, 100, 50]]], 255).astype(np.uint8)
    np.savez_compressed(folder / "checkpoint_scene.npz", images=images, alphas=alphas, poses=np.array(cameras))
    path = folder / "checkpoint.npz"
    optimizer = golden_cases.checkpoint_optimizer(path)
    for _ in range(golden_cases.CHECKPOINT_STEPS):
        optimizer.step()
    named("save_progress", "fitting")(optimizer, path)
    np.savez_compressed(path, **golden_cases.npz_arrays(path))


def make_scenes(folder):
    from scene_writers import OPENGL
    from scipy.spatial.transform import Rotation

    pictures = scene_writers.brick_pictures(3, width=6, height=5)
    centered = scene_writers.brick_pictures(3, width=6, height=5, centered=True)
    scene_writers.write_blender(folder / "blender", centered.pick(range(2)))
    scene_writers.write_blender(folder / "blender", centered.pick([2]), "test")
    scene_writers.write_transforms(folder / "transforms", pictures, shared=False, distortion={"k1": 0.1, "p1": 0.01})
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    scene_writers.write_colmap(
        folder / "colmap_text", pictures, binary=False, model="SIMPLE_RADIAL", distortion=(0.05,), points=points
    )
    scene_writers.write_colmap(folder / "colmap", pictures, binary=True, points=points, masks=True)
    scene_writers.write_dtu(folder / "dtu", pictures)
    scene_writers.write_nsvf(folder / "nsvf", centered, "002")
    turned = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    poses = []
    for number, (name, rgba, camera) in enumerate(zip(pictures.names, pictures.rgba, pictures.cameras, strict=True)):
        pose = turned @ camera.camera_to_world @ OPENGL
        content = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        content |= {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
        path = folder / "polycam" / "keyframes" / "cameras" / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
        scene_writers.write_image(folder / "polycam" / "keyframes" / "images" / f"{name}.png", rgba)
        scene_writers.write_image(folder / "record3d" / "rgbd" / f"{number}.png", rgba)
        poses.append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
    first = pictures.cameras[0]
    content = {
        "w": first.width,
        "h": first.height,
        "poses": poses,
        "K": [first.fx, 0, 0, 0, first.fy, 0, first.cx, first.cy, 1],
    }
    (folder / "record3d" / "metadata").write_text(json.dumps(content))


def zipped(folder, path, emptied=()):
    """Pack a folder; emptied: names of files of which only the size counts."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file() and not file.name.endswith(".lock"):
                data = bytes(file.stat().st_size) if file.name in emptied else file.read_bytes()
                archive.writestr(zipfile.ZipInfo(file.relative_to(folder).as_posix()), data, zipfile.ZIP_DEFLATED, 9)


def make_runs(folder, out):
    """Outputs of runs that the next run keeps."""
    for name in ("jobs_v1", "records", "shards"):
        report = warpcage.run_jobs(folder / f"{name}.jsonl", folder / f"run_{name}", device="cpu")
        assert not report.failed, report.failed
        zipped(folder / f"run_{name}", out / f"run_{name}.zip", ("scene.npz",))
    golden_cases.said(folder, f"{golden_cases.FILM_WORDS} -o film_frames")
    zipped(folder / "film_frames", out / "film_frames.zip")


def write_expected(folder):
    words, arrays = {}, {}
    for name, case in CASES.items():
        for part, value in case.read(folder / name).items():
            if isinstance(value, str):
                words.setdefault(name, {})[part] = value
            else:
                arrays[name, part] = np.asarray(value)
    words["said"] = {name: golden_cases.said(folder, argv) for name, argv in SAID.items()}
    golden_cases.write_expected(words, arrays)


def make_files():
    shutil.rmtree(GOLDEN, ignore_errors=True)
    GOLDEN.mkdir(parents=True)
    for make in (
        make_fields,
        make_selections,
        make_splats,
        make_cages,
        make_poses_and_cameras,
        make_jobs,
        make_sessions,
        make_pictures,
        make_checkpoint,
    ):
        make(GOLDEN)
    with tempfile.TemporaryDirectory() as temporary:
        scenes = pathlib.Path(temporary) / "scenes"
        make_scenes(scenes)
        zipped(scenes, GOLDEN / "scenes.zip")
        folder = pathlib.Path(temporary) / "files"
        folder.mkdir()
        golden_cases.laid_out(folder)
        for name in WRITTEN:
            golden_cases.said(folder, WRITTEN[name], folder)
            for path in folder.glob(f"{name.partition('.')[0]}.*"):
                shutil.copy(path, GOLDEN / path.name)
        make_runs(folder, GOLDEN)
        binary = pathlib.Path(temporary) / "binary"
        binary.mkdir()
        for path in list(GOLDEN.iterdir()):
            if path.suffix != ".zip" and not path.name.endswith(TEXTS):
                shutil.move(path, binary / path.name)
        zipped(binary, golden_cases.BINARY)
        write_expected(folder)


def compact(text):
    """Help without its indentation, which no test compares."""
    return "".join(f"{' '.join(line.split())}\n" for line in text.splitlines())


def make_names():
    (DATA / "help").mkdir(parents=True, exist_ok=True)
    for command in ["", *golden_names.commands()]:
        path = DATA / "help" / f"{command or golden_names.PROGRAM}.txt"
        path.write_text(compact(golden_names.help_text(command)), encoding="utf-8")
    names = golden_names.public_names().items()
    lines = [f"{json.dumps(name)}:{json.dumps(what, separators=(',', ':'))}" for name, what in names]
    (DATA / "public_names.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    assert warpcage.__version__ == "0.1.0" and pathlib.Path.cwd() == BASE, f"run it in a clean tree, not of {BASE}"
    make_names()
    make_files()
    print(sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()), "bytes", file=sys.stderr)
