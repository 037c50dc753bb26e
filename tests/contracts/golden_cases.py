"""How each golden file is read and written again.

Version 0.1.0 made them, and noted what it read of them; what is of other programs or of older versions was written by
hand. They stay as they are. Files of a format that is new since are added by whoever adds the format, by the version
that does: put them into tests/data/golden and CASES, and note what is read of them by

    python tests/contracts/golden_cases.py NAME...
"""

import contextlib
import dataclasses
import gzip
import hashlib
import io
import json
import os
import pathlib
import sys
import tempfile
import warnings
import zipfile

import numpy as np

import warpcage
from warpcage import Cage, Camera, CameraFile, NodeSelection, PoseFile, SplatField, VoxelField
from warpcage.cage.pose_file import gltf_poses
from warpcage.fitting import load_progress, save_progress
from warpcage.studio.cli import main
from warpcage.studio.editor import read_session as session_document
from warpcage.studio.editor import write_session as write_document
from warpcage.studio.films.video import read_film_frame, write_film_frame
from warpcage.studio.jobs.job_file import JobFile, write_jobs
from warpcage.view import read_exr as exr_parts
from warpcage.view.camera_path import RefinedCameras

DATA = pathlib.Path(__file__).parent.parent / "data"
GOLDEN = DATA / "golden"

#: Those of the golden files that are no text.
BINARY = GOLDEN / "binary.zip"

#: What version 0.1.0 read of them: words.json, and values.npy of all arrays one after another.
READ = DATA / "golden_read.zip"


def exact(array):
    """An array in a word that says its type, shape and bits."""
    array = np.ascontiguousarray(array)
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    return f"{little.dtype.str} {array.shape} {hashlib.sha256(little.tobytes()).hexdigest()[:12]}"


def summary(array):
    """Shape, statistics and some values of an array."""
    flat = np.asarray(array, np.float64).ravel()
    places = np.linspace(0, flat.size - 1, 24).astype(int)
    return np.concatenate([array.shape, [flat.mean(), flat.std()], flat[places]])


def npz_arrays(path):
    """The arrays of an .npz in their order."""
    with np.load(path) as held:
        return {name: held[name] for name in held.files}


# -- fields and selections


def read_field(path):
    """All that a field holds, as a plain file has it: what is written of it is exact."""
    field = load_field(path)
    again = path.with_name(f"plain-{path.stem}.npz")
    field.save(again)
    found = {name: exact(array) for name, array in npz_arrays(again).items()}
    again.unlink()
    box = field.bounds if field.straightening is None else np.concatenate([field.bounds, field.straightening[:3, :3]])
    return found | {"box": box, "scaled": load_field(path, scene_scale=0.5).bounds}


def load_field(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of svox2 files that hold more than is read
        return VoxelField.load(path, device="cpu", **options)


def write_field(format):
    return lambda path, target: load_field(path).save(target, format=format)


def saved_again(kind, **options):
    """What writes a file as the object of a class that it holds."""
    return lambda path, target: kind.load(path).save(target, **options)


def selected_field(path):
    return load_field(path.with_name("field_v1.npz"))


def read_selection(path):
    chosen = NodeSelection.load(path, selected_field(path))
    floor = chosen.floor
    plane = {} if floor is None else {"normal": np.asarray(floor.normal), "offset": np.asarray(floor.offset)}
    return {"mask": exact(np.asarray(chosen.mask)), "notes": json.dumps(chosen.notes), **plane}


def write_selection(path, target):
    NodeSelection.load(path, selected_field(path)).save(target)


# -- splats

#: Parts of splats by the names that the stored values have.
SPLAT_PARTS = {"centres": "centers", **{name: name for name in ("log_scales", "quaternions", "logits", "harmonics")}}


def read_splats(path):
    contents = SplatField.load(path, device="cpu").contents
    return {stored: getattr(contents, name) for stored, name in SPLAT_PARTS.items()}


def write_splats(source):
    """Each format is written from the same splats: those of a .ply, which holds all bits."""
    return lambda path, target: SplatField.load(path.with_name(source), device="cpu").save(target)


# -- cages, poses and cameras


def read_cage(path):
    cage = Cage.load(path, up="y" if "_y" in path.stem else None)
    return {"vertices": cage.vertices, "faces": exact(cage.faces.astype(np.int32))}


def write_cage(up):
    return lambda path, target: Cage.load(path.with_name("cage.obj")).save(target, up=up)


def read_poses(path):
    file = PoseFile.load(path)
    parts = {"times": file.times, "easings": file.easings, "fps": file.fps, "loop": file.loop, "names": file.names}
    found = {"rest": file.rest.vertices, "faces": exact(file.rest.faces.astype(np.int32))}
    found |= {f"pose {name}": file[name].vertices for name in file.names}
    found |= {f"camera {index}": key.camera.camera_to_world for index, key in enumerate(file.cameras)}
    if file.timed:
        found["at time"] = file.at_time(0.4 * file.length).vertices
    return found | {"film": json.dumps(parts)}


def read_motion(path):
    """The motion in a glTF file."""
    rest = Cage.load(path)
    file = gltf_poses(path, rest)
    found = {f"pose {name}": file[name].vertices for name in file.names}
    return found | {"rest": rest.vertices, "times": np.array([file.times.get(name, -1.0) for name in file.names])}


def camera_numbers(camera):
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
    return np.concatenate([numbers, np.asarray(camera.camera_to_world).ravel()])


def read_cameras(path):
    file = CameraFile.load(path)
    words = [[key.name, key.time, key.easing] for key in file]
    targets = [key.target for key in file if key.target is not None]
    found = {"cameras": np.array([camera_numbers(key.camera) for key in file])}
    found |= {"targets": np.array(targets)} if targets else {}
    return found | {"words": json.dumps([words, file.fps, file.loop])}


def read_refined(path):
    """A camera file with exposures: it is read as cameras."""
    entries = json.loads(path.read_text(encoding="utf-8"))["cameras"]
    return read_cameras(path) | {"exposures": json.dumps([entry["exposure"] for entry in entries])}


def write_refined(path, target):
    entries, keys = json.loads(path.read_text(encoding="utf-8"))["cameras"], CameraFile.load(path)
    exposures = [np.array([entry["exposure"][name] for entry in entries]) for name in ("gain", "offset")]
    RefinedCameras([key.name for key in keys], [key.camera for key in keys], *exposures).save(target)


# -- jobs, sessions, reports


def read_jobs(path):
    """Items with all that they take from the header, and which of them share what is loaded and posed."""
    with JobFile(path) as job:
        job.check()
        items = list(job)
        orders = [item.order for item in items]
        alike = [orders.index(order) for order in orders]
        parts = {"items": [item.to_json() for item in items], "header": job.header, "alike": alike}
        return {name: json.dumps(part) for name, part in parts.items()}


def write_job_lines(path, target):
    """The lines of a file, checked and written again: those of version 2 have poses that are drawn."""
    with JobFile(path) as job:
        header = job.header
        lines = [json.loads(job.data(index)) for index in range(len(job))]
    parts = {name: header.get(name) for name in ("defaults", "records", "extra")}
    write_jobs(target, lines, **parts)


def read_session(path):
    """The document of a session, as JSON of our own."""
    document = session_document(path, load_field(path.with_name("field_v1.npz")))
    return {"document": json.dumps(document.to_json("field_v1"))}


def write_session(path, target):
    field = load_field(path.with_name("field_v1.npz"))
    write_document(target, session_document(path, field), field, "field_v1.npz")


#: A report of a capture, of the numbers in capture.json.
REPORT = warpcage.CaptureReport(
    folder=pathlib.Path("scene"),
    source="walk.mp4",
    pictures=["frame_0001.jpg", "frame_0002.jpg", "frame_0003.jpg"],
    registered=[True, False, True],
    sharpness=[0.75, 0.25, 0.5],
    errors=[0.5, None, 0.625],
    points=1234,
    error=0.5625,
    size=(640, 480),
    around=75.0,
    elevation=(10.0, 35.5),
    sphere=0.25,
    upper=0.5,
    advice=["Go once more around the object."],
    facts={"frames": 3},
)


def read_text(path):
    return {"text": path.read_text(encoding="utf-8")}


# -- pictures of films


def read_frame(path):
    return {"pixels": exact(read_film_frame(path))}


def write_frame(path, target):
    write_film_frame(target, read_film_frame(path))


def read_exr(path):
    return {name: array.astype(np.float32) for name, array in exr_parts(path).items()}


# -- checkpoints of fits

FIT = {"resolution": 8, "batch_rays": 64, "least_steps": 12, "epochs": 0.1, "levels": 2, "directional": 0.5}


def checkpoint_optimizer(path):
    """A fit of the scene beside a checkpoint."""
    with np.load(path.with_name("checkpoint_scene.npz")) as held:
        cameras = [Camera(10.0, 10.0, 4.0, 4.0, 8, 8, pose) for pose in held["poses"]]
        images, alphas = held["images"] / np.float32(255), held["alphas"] / np.float32(255)
    scene = warpcage.Scene(images, alphas, cameras, bounds=np.array([[-1.0, -1, -1], [1, 1, 1]]))
    return warpcage.FieldOptimizer(scene, device="cpu", seed=4, **FIT)


def read_checkpoint(path):
    """Where a fit is that goes on with a checkpoint."""
    optimizer = checkpoint_optimizer(path)
    load_progress(optimizer, path)
    state = {"steps": optimizer.step_count, "level": optimizer.level, "left": optimizer.total_steps}
    state |= {"shape": list(map(int, optimizer.field.resolution)), "rows": optimizer.field.voxel_count}
    return {"state": json.dumps(state), "density": exact(optimizer.field.grid.density.numpy())}


def write_checkpoint(path, target):
    optimizer = checkpoint_optimizer(path)
    load_progress(optimizer, path)
    save_progress(optimizer, target)


# -- scenes


def read_scene(path):
    """All splits of a scene in one of the formats."""
    found = {}
    for split in ("train", "test"):
        scene = warpcage.load_scene(path, split=split)
        found[f"{split} images"] = summary(scene.images)
        found[f"{split} cameras"] = np.array([camera_numbers(camera) for camera in scene.cameras])
        if scene.alphas is not None:
            found[f"{split} alphas"] = summary(scene.alphas)
        found[f"{split} names"] = json.dumps(list(scene.names))
        placed = {name: getattr(scene, name) for name in ("bounds", "to_source")}
        found |= {f"{split} {name}": array for name, array in placed.items() if array is not None}
    return found


@dataclasses.dataclass(frozen=True)
class Case:
    """How a golden file is read, and what writes it again, or None where warpcage does not write that format."""

    read: object
    write: object = None


CASES = {
    **{f"field_v{number}.npz": Case(read_field, write_field("warpcage")) for number in (1, 2, 3, 4)},
    "field_v1_bare.npz": Case(read_field),
    **{f"compact_v{number}.npz": Case(read_field, write_field("compact")) for number in (1, 2, 3, 4)},
    "compact_by_hand.npz": Case(read_field),
    "svox2.npz": Case(read_field, write_field("svox2")),
    **{f"svox2_{kind}.npz": Case(read_field) for kind in ("scalars", "degree_1", "layered")},
    "chosen.npz": Case(read_selection, write_selection),
    "chosen.json": Case(read_selection, write_selection),
    "splats.ply": Case(read_splats, write_splats("splats.ply")),
    "splats_0.ply": Case(read_splats, write_splats("splats_0.ply")),
    "foreign.ply": Case(read_splats, write_splats("foreign.ply")),
    **{
        f"splats{ending}": Case(read_splats, write_splats("splats.ply"))
        for ending in (".compressed.ply", ".splat", ".spz")
    },
    "splats_v2.spz": Case(read_splats),
    **{f"cage{ending}": Case(read_cage, write_cage(None)) for ending in (".obj", ".ply", ".off", ".glb", ".gltf")},
    **{f"cage_y{ending}": Case(read_cage, write_cage("y")) for ending in (".obj", ".ply")},
    "poses.json": Case(read_poses, saved_again(PoseFile)),
    "film.json": Case(read_poses, saved_again(PoseFile)),
    "moved_object.glb": Case(read_motion),
    "cameras.json": Case(read_cameras, saved_again(CameraFile)),
    "one_camera.json": Case(read_cameras, saved_again(CameraFile)),
    "moving_camera.glb": Case(read_cameras),
    "still_cameras.glb": Case(read_cameras),
    "refined.cameras.json": Case(read_refined, write_refined),
    "jobs_v1.jsonl": Case(read_jobs, write_job_lines),
    "jobs_v2.jsonl": Case(read_jobs, write_job_lines),
    "records.jsonl": Case(read_jobs, write_job_lines),
    "shards.jsonl": Case(read_jobs, write_job_lines),
    "session.session.json": Case(read_session, write_session),
    "session_early.session.json": Case(read_session),
    "capture.json": Case(read_text, lambda path, target: target.write_text(REPORT.to_json(), encoding="utf-8")),
    "capture.md": Case(read_text, lambda path, target: target.write_text(REPORT.to_markdown(), encoding="utf-8")),
    "frame.npz": Case(read_frame, write_frame),
    "picture.exr": Case(read_exr),
    "checkpoint.npz": Case(read_checkpoint, write_checkpoint),
    **{
        f"scenes/{name}": Case(read_scene)
        for name in ("blender", "transforms", "colmap_text", "colmap", "dtu", "nsvf", "polycam", "record3d")
    },
}

#: Files that `warpcage info` describes: but for glTF files that hold cameras alone.
DESCRIBED = [
    name
    for name in CASES
    if name.endswith((".ply", ".splat", ".spz", ".obj", ".off", ".glb", ".gltf"))
    or name.startswith(("field", "compact", "svox2", "scenes/", "poses", "film", "one_camera", "cameras", "refined"))
    if not name.endswith(("camera.glb", "cameras.glb"))
]

#: What the command line says of files, and what it writes: words by name. @ is the folder that it writes to.
SAID = {
    **{f"info {name}": f"info {name}" for name in DESCRIBED},
    "info edits": "info several.edits.json",
    "edits": "edits several.edits.json",
    "edits of a session": "edits session.session.json",
}
WRITTEN = {
    "several.edits.json": (
        "edits --edit cage.obj:posed.obj:keep --edit cage.obj:remove:fragments=0.1 --edit "
        "cage.obj:bend:40:x:z:falloff=0.25:held=1,2 --edit "
        "cage.obj:poses.json:bent:held=still:falloff=0.5 --cage-up z -o @/several.edits.json"
    ),
    "again.edits.json": ("edits several.edits.json --edit cage_y.obj:twist:60 -o @/again.edits.json"),
    "session_film.jsonl": (
        "animate field_v1.npz --session session.session.json --jobs @/session_film.jsonl --size 8 --quiet"
    ),
    "film.jsonl": (
        "animate field_v1.npz --edits several.edits.json --frames 3 --camera one_camera.json --turn 90 "
        "--background black --jobs @/film.jsonl --quiet"
    ),
    "keys_film.jsonl": (
        "animate field_v1.npz --cage cage.obj --posed film.json --size 8 6 --jobs @/keys_film.jsonl --quiet"
    ),
    "sweep.jsonl": (
        "sweep field_v1.npz --cage cage.obj --poses random:2 posed.obj poses.json twist:60 --seeds 3 "
        "--cameras cameras.json --coordinates green --size 8 6 --device cpu --quiet -o @/sweep.jsonl"
    ),
}

#: A film's frames, one folder of which is there.
FILM_WORDS = (
    "animate field_v1.npz --cage cage.obj --posed posed.obj --frames 3 --camera one_camera.json "
    "--turn 0 --coordinates mean_value --resolution 8 --background black --device cpu --quiet"
)


@contextlib.contextmanager
def in_folder(folder):
    """Be in a folder, as paths of commands are relative."""
    before = pathlib.Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def said(folder, words, out=None):
    """What a command says in a folder."""
    text = io.StringIO()
    with in_folder(folder), contextlib.redirect_stdout(text), contextlib.redirect_stderr(io.StringIO()) as errors:
        status = main([word.replace("@", str(out)) for word in words.split()])
    assert status == 0, errors.getvalue()
    return text.getvalue()


def laid_out(folder):
    """The golden files in a folder of their own, archives unpacked."""
    for path in sorted(GOLDEN.iterdir()):
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as archive:
                archive.extractall(folder if path == BINARY else folder / path.stem)
        else:
            (folder / path.name).write_bytes(path.read_bytes())
    return folder


def payload(path):
    """What a file holds, where compressors and stamps of time may differ: arrays, or bytes."""
    if path.suffix == ".npz":
        return [(name, exact(array)) for name, array in npz_arrays(path).items()]
    return gzip.decompress(path.read_bytes()) if path.suffix == ".spz" else path.read_bytes()


def expected():
    """What version 0.1.0 read, by file and part: words, and arrays."""
    with zipfile.ZipFile(READ) as archive:
        held = json.loads(archive.read("words.json"))
        values = np.frombuffer(archive.read("values.f8"), "<f8")
    found, place = {file: dict(parts) for file, parts in held["words"].items()}, 0
    for file, part, shape in held["arrays"]:
        size = int(np.prod(shape))
        found.setdefault(file, {})[part] = values[place : place + size].reshape(shape)
        place += size
    return found


def note(names):
    """Add what is read of new files to what was read of the others."""
    with zipfile.ZipFile(READ) as archive:
        held, values = json.loads(archive.read("words.json")), [np.frombuffer(archive.read("values.f8"), "<f8")]
    for name in names:
        for part, value in CASES[name].read(laid_out(pathlib.Path(tempfile.mkdtemp())) / name).items():
            if isinstance(value, str):
                held["words"].setdefault(name, {})[part] = value
            else:
                held["arrays"].append([name, part, list(np.shape(value))])
                values.append(np.asarray(value, np.float64).ravel())
    with zipfile.ZipFile(READ, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr("words.json", json.dumps(held, indent=0, ensure_ascii=False))
        archive.writestr("values.f8", np.concatenate(values).astype("<f8").tobytes())


if __name__ == "__main__":
    note(sys.argv[1:])
