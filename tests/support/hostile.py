"""Hostile input: what whole files of each format are, ways to damage them, and what may come of reading them."""

import dataclasses
import functools
import gzip
import io
import json
import pathlib
import resource
import shutil
import struct
import tempfile
import zipfile

import dataset_writers as datasets
import numpy as np
import phone_writers as phone
import program_writers as program
import pytest
import scene_writers as plain
from PIL import Image
from refusals import refused
from runs import DEFAULTS
from scenes import blob_scene
from splat_scenes import require_usd, some_splats, zstd

import warpcage
from warpcage.field import LayeredBackground, OuterField
from warpcage.fitting import load_progress, save_progress
from warpcage.studio.jobs import JobFile, write_jobs
from warpcage.view import read_image

#: Bytes that reading a damaged file of some kilobytes may take: of the process, and of Python and NumPy.
MEMORY, LITTLE = 600 << 20, 1 << 24

# Formats


@dataclasses.dataclass(frozen=True)
class Format:
    """Files that write(folder) makes. One of them is read by its path, or the folder is, if it has no name.
    check: Whether what a damaged one gives all the same is whole."""

    write: object
    read: object
    check: object
    name: str = ""


def one_file(name, save, read, check=lambda read: True):
    return Format(lambda folder: save(folder / name), read, check, name)


bricks = functools.cache(plain.brick_pictures)


def scene(write, **options):
    def check(scene):
        return np.isfinite(scene.images).all()

    return Format(lambda folder: write(folder, bricks(3), **options), warpcage.load_scene, check)


def write_output(folder, pictures):
    """An output folder of 3D Gaussian Splatting with the scene of its pictures in it."""
    plain.write_colmap(folder / "truck", pictures, binary=False)
    splats = warpcage.SplatField.from_contents(some_splats(4, 0), device="cpu")
    datasets.write_output(folder, splats, pictures.cameras, pictures.names, "/no/truck", iterations=(7,))


LENS, BENT, MOVED = {"k1": -0.02, "p1": 0.001}, (-0.02, 0, 0, 0), {"applied_transform": np.eye(4)[:3].tolist()}


def with_matrices(folder, pictures):
    """A camera matrix a frame, and masks of the pictures' names, of which nothing is said."""
    plain.write_transforms(folder, pictures, shared=False, masks=True)

    def into_matrices(content):
        for frame in content["frames"]:
            fx, fy, cx, cy = (frame.pop(word) for word in ("fl_x", "fl_y", "cx", "cy"))
            frame["K"] = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
            del frame["mask_path"]

    plain.change_json(folder / "transforms.json", into_matrices)


def models_and_copies(folder, pictures):
    """A model of pictures that are there in images_2/ alone, beside one of no pictures, and masks of theirs."""
    plain.write_colmap(folder, pictures, binary=True, masks=True)
    plain.write_colmap(folder / "dense", pictures.pick([0, 1]), binary=False, where="sparse")
    for kind in ("images", "masks"):
        for file in (folder / kind).iterdir():
            image = Image.open(file)
            plain.write_image(folder / f"{kind}_2" / file.name, np.asarray(image)[::2, ::2])
            file.unlink()
        (folder / kind).rmdir()
    shutil.rmtree(folder / "dense/images")


SCENES = {
    "blender": scene(plain.write_blender),
    "nsvf": scene(plain.write_nsvf, splits="000"),
    "dtu": scene(plain.write_dtu),
    "transforms": scene(plain.write_transforms, masks=True),
    "transforms lens": scene(plain.write_transforms, shared=False, masks=True, distortion=LENS, **MOVED),
    "transforms matrix": scene(with_matrices),
    "colmap copies": scene(models_and_copies),
    "colmap text": scene(plain.write_colmap, binary=False, points=np.eye(3)[[0, 1, 2] * 4]),
    "colmap binary": scene(plain.write_colmap, binary=True, model="OPENCV", distortion=BENT, points=np.eye(3)),
    "colmap fisheye": scene(plain.write_colmap, binary=True, model="OPENCV_FISHEYE", distortion=(0.02, -0.002, 0, 0)),
    "polycam": scene(phone.write_polycam),
    "record3d": scene(phone.write_record3d, each=True),
    "arkitscenes": scene(phone.write_arkitscenes),
    "stray": scene(phone.write_stray),
    "llff": scene(program.write_llff),
    "realityscan": scene(program.write_realityscan, lens=(-0.02, 0, 0, 0, 0.001, 0)),
    "bundler": scene(program.write_bundler, distortion=(-0.02, 0.001)),
    "opensfm": scene(program.write_opensfm, **LENS),
    "metashape": scene(program.write_metashape, lens=LENS),
    "scannet": scene(datasets.write_scannet),
    "replica": scene(datasets.write_replica),
    "nerfies": scene(datasets.write_nerfies, lens=(-0.02, 0, 0, 0.001, 0), held=()),
    "blendedmvs": scene(datasets.write_blendedmvs, images="images"),
    "nerfpp": scene(datasets.write_nerfpp, splits={"train": range(3)}),
    "3dgs": scene(write_output),
}


@functools.cache
def small_field(kind="field", side=6):
    density = np.zeros((side,) * 3)
    density[2:-2, 2:-2, 2:-2] = 3.0
    sh = np.random.default_rng(0).normal(size=(side, side, side, 9, 3))
    field = warpcage.VoxelField.from_dense(density, sh, [[0, 0, 0], [1, 1, 1]], device="cpu")
    if kind == "layers":
        seen = np.full((3, 26, 4), 0.5)
        seen[1, 20:] = 0.1, 0.2, 0.3, 0.4  # as what nothing shows
        field.background_model = LayeredBackground((0.5,) * 3, 0.5, 2, seen, unseen=(0.1, 0.2, 0.3, 0.4))
    if kind == "outer":
        links = np.arange(8**3, dtype=np.int32).reshape(8, 8, 8)
        field.background_model = OuterField((0.5,) * 3, (0.5,) * 3, links, np.full((8**3, 4), 0.5))
    return field


def is_field(read):
    place, around = read.bounds.mean(axis=0, keepdims=True), read.background_model
    values = [read.node_densities(), read.bounds, read.sample(place, [[0.0, 0.0, 1.0]])[1]]
    values += [] if around is None else [around.sample(np.zeros((1, 3)), [[0.0, 0.0, 1.0]])]
    return all(np.isfinite(each).all() for each in values)


def field_format(kind, format="warpcage"):
    load = functools.partial(warpcage.VoxelField.load, device="cpu")
    return one_file("field.npz", lambda path: small_field(kind).save(path, format=format), load, is_field)


FIT = {"resolution": 16, "epochs": 60, "levels": 2, "batch_rays": 64, "device": "cpu"}


@functools.cache
def fitted_scene():
    """A scene with alphas and bounds, for fits of which there are checkpoints."""
    return dataclasses.replace(blob_scene(count=4, size=16), bounds=np.array([[-1.0] * 3, [1.0] * 3]))


@functools.cache
def running_fit():
    optimizer = warpcage.FieldOptimizer(fitted_scene(), **FIT)
    for _ in range(3):
        optimizer.step()
    return optimizer


def save_checkpoint(path):
    save_progress(running_fit(), path)


def read_checkpoint(path):
    load_progress(running_fit(), path)


FIELDS = {
    "field": field_format("field"),
    "compact": field_format("field", "compact"),
    "svox2": field_format("field", "svox2"),
    "layers": field_format("layers"),
    "outer": field_format("outer"),
    "checkpoint": one_file("c.npz", save_checkpoint, read_checkpoint),
}


def save_splats(path, **options):
    warpcage.SplatField.from_contents(some_splats(4, 1), device="cpu").save(path, **options)


def save_spz_4(path):
    zstd()  # or the test is skipped
    save_splats(path, version=4)


def save_usd(path):
    require_usd()  # or the test is skipped
    save_splats(path)


def is_splats(field):
    return np.isfinite(field.bounds).all() and field.splat_count == len(field.covariances)


def spz_4(streams=None, sizes=None, table=32, count=4, degree=0):
    sizes = sizes or [9 * count, count, 3 * count, 3 * count, 4 * count]
    streams = streams or [zstd()(bytes(size)) for size in sizes]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(streams), table)
    return b"".join([head, *(struct.pack("<QQ", len(s), n) for s, n in zip(streams, sizes, strict=True)), *streams])


def ksplat(*, sections=1, count=2, level=1, most=2, size=2, buckets=1, full=1, partial=0, degree=0):
    data = bytearray(4096 + 1024)
    struct.pack_into("<BB2xIIIIH", data, 0, 0, 1, sections, 1, 2, 2, level)
    struct.pack_into("<IIIIfH2xIIIIH", data, 4096, count, most, size, buckets, 5.0, 12, 0, 0, full, partial, degree)
    splat = struct.pack("<3H3e4e4B", 100, 200, 300, 0.1, 0.2, 0.3, 1, 0, 0, 0, 9, 99, 199, 255)
    return bytes(data) + bytes(12) + splat * 2


def splat_format(name, save=save_splats):
    return one_file(name, save, functools.partial(warpcage.SplatField.load, device="cpu"), is_splats)


SPLATS = {
    "spz": splat_format("whole.spz"),
    "spz 4": splat_format("whole.spz", save_spz_4),
    "sog": splat_format("whole.sog"),
    "splats glb": splat_format("whole.glb"),
    "ksplat": splat_format("whole.ksplat", lambda path: path.write_bytes(ksplat())),
    "splats ply": splat_format("whole.ply"),
    "compressed ply": splat_format("whole.compressed.ply"),
    "splat": splat_format("whole.splat"),
    **{f"splats {kind}": splat_format(f"whole.{kind}", save_usd) for kind in ("usda", "usdc", "usdz")},
}


def is_picture(read):
    return read.ndim == 3 and read.shape[-1] in (1, 2, 3, 4) and 0 <= read.min() <= read.max() <= 1


def save_picture(path):
    color = np.random.default_rng(0).integers(0, 65536, (12, 17, 3), dtype=np.uint16)
    if path.name == "16.png":
        plain.write_deep_png(path, color)
    else:
        mode = {"palette": "P", "grey": "L"}.get(path.stem, "RGB")
        Image.fromarray((color >> 8).astype(np.uint8)).convert(mode).save(path)


PICTURES = {
    name: one_file(name, save_picture, read_image, is_picture)
    for name in ("8.png", "16.png", "palette.png", "8.jpg", "grey.jpg", "8.webp", "8.bmp", "8.tiff", "8.avif")
}


def is_cage(cage):
    return np.isfinite(cage.vertices).all() and cage.faces.max(initial=-1) < len(cage.vertices)


def save_cage(path):
    cage = warpcage.Cage.box((0, 0, 0), (1, 2, 3), segments=2)
    if path.name == "poses.json":
        return warpcage.PoseFile(cage, {"bent": cage.bend(20)}).save(path)
    if path.name != "text.ply":
        return cage.save(path)
    points, faces = cage.vertices.tolist(), [[3, *face] for face in cage.faces.tolist()]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {axis}" for axis in "xyz")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_text("\n".join([*lines, *(" ".join(map(str, row)) for row in points + faces)]) + "\n")


CAGES = {
    name: one_file(name, save_cage, warpcage.Cage.load, is_cage)
    for name in ("cage.obj", "cage.off", "cage.ply", "text.ply", "cage.glb", "cage.gltf")
}


def save_cameras(path):
    view = warpcage.Camera.look_at((0, -4, 0), (0, 0, 0), width=4, height=3)
    warpcage.CameraFile([warpcage.CameraKey(view, name=f"at {time}", time=time) for time in (0, 1)], fps=24).save(path)


def save_path(path):
    eye = {"position": [1.0, 2.0, 3.0], "target": [0.0, 0.0, 0.0], "fov": 50}
    frame = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50, "aspect": 1.5}
    values = {"position": [1, 2, 3, 2, 2, 2], "target": [0] * 6, "fov": [50, 60]}
    track = {"name": "fly", "frameRate": 30, "loopMode": "none", "keyframes": {"times": [0, 9], "values": values}}
    contents = {
        "cameras": datasets.camera_rows(bricks(3).cameras, ["a", "b", "c"]),
        "camera_path": {"camera_path": [frame] * 2, "render_width": 6, "render_height": 4, "seconds": 2, "fps": 1},
        "settings": {"version": 2, "cameras": [{"initial": eye}], "animTracks": [track]},
        "document": {
            "camera": {"fov": 50},
            "poseSets": [{"poses": [eye | {"frame": 9}]}],
            "timeline": {"frameRate": 30},
        },
    }
    path.write_text(json.dumps(contents[path.stem]))


def save_jobs(path):
    write_jobs(path, [{"id": f"shot/{k}", "posed": f"poses.npy#{k}"} for k in (0, 1)], defaults=DEFAULTS)


def read_jobs(path):
    with JobFile(path) as file:
        file.check()
        return list(file)


def save_selection(path):
    warpcage.select_nodes(small_field()).save(path)


def read_selection(path):
    return warpcage.NodeSelection.load(path, small_field())


#: Files of poses, views, chosen matter and work.
OTHERS = {
    "poses.json": one_file("poses.json", save_cage, warpcage.PoseFile.load, lambda file: is_cage(file.rest)),
    "cameras.json": one_file("cameras.json", save_cameras, warpcage.CameraFile.load),
    "3dgs cameras": one_file("cameras.json", save_path, warpcage.CameraFile.load),
    **{
        name: one_file(f"{name}.json", save_path, warpcage.CameraFile.load)
        for name in ("camera_path", "settings", "document")
    },
    "jobs.jsonl": one_file("jobs.jsonl", save_jobs, read_jobs),
    "chosen.npz": one_file("chosen.npz", save_selection, read_selection),
    "chosen.json": one_file("chosen.json", save_selection, read_selection),
}

FORMATS = SCENES | FIELDS | SPLATS | PICTURES | CAGES | OTHERS


@functools.cache
def whole(name):
    """The whole files of a format, bytes by their names."""
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        FORMATS[name].write(folder)
        FORMATS[name].read(folder / FORMATS[name].name)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def put(folder, files):
    """Write files, bytes or text, or remove those that are None."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            path.unlink(missing_ok=True)
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder


# What may come of reading them


def read_or_refuse(name, folder, changes, **options):
    """What is read of a format some of whose files are others is whole. Or it is refused: in one line that names a file
    or the folder. The files are put back."""
    of, files = FORMATS[name], whole(name)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    put(folder, changes)
    try:
        assert of.check(of.read(folder / of.name, **options))
    except (ValueError, FileNotFoundError) as error:
        message = str(error)
        assert isinstance(error, warpcage.Error) and message and "\n" not in message, repr(error)
        assert any(pathlib.Path(file).name in message for file in files) or str(folder) in message, message
    finally:
        put(folder, {file: files[file] for file in changes})
    if not of.name.endswith((".usdc", ".usdz")):  # OpenUSD takes what the tables of a damaged file ask for
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY >> 10


def require_refused(name, folder, changes, words="", error=None, **options):
    """A format some of whose files are others, or None, is refused for little memory, with all the words."""
    of, missing = FORMATS[name], None in changes.values()
    path = put(folder, whole(name) | changes) / of.name
    error = error or (FileNotFoundError if missing else ValueError)
    most = LITTLE + 4 * sum(len(content or b"") for content in changes.values())
    refused(lambda: of.read(path, **options), of.name, *words.split(" | "), error=error, most=most)


def rows(table):
    """Hand-made damages as parameters: a table of (file, damage, words) by formats, with "" for the one file."""
    return [
        pytest.param(name, file or FORMATS[name].name, damage, words, id=f"{name}-{number}-{words[:40]}")
        for name, group in table.items()
        for number, (file, damage, words) in enumerate(group)
    ]


# Damages by hand: functions of bytes


def cut(share):
    """A share of the bytes, or all but some of the last."""
    return lambda data: data[: int(share * len(data)) if share >= 0 else share]


def swap(old, new):
    def apply(data):
        assert old.encode() in data
        return data.replace(old.encode(), new.encode())

    return apply


def instead(content):
    return lambda data: content if isinstance(content, bytes) else content.encode()


def gone(data):
    return None


def packed(format, place, value):
    """A number written over bytes."""
    size = struct.calcsize(format)
    return lambda data: data[:place] + struct.pack(format, value) + data[place + size :]


def tree(change, ending=".json"):
    """What is inside a file, changed by a function: see OPENED."""

    def apply(data):
        content = OPENED[ending][0](data)
        change(content)
        return OPENED[ending][1](content)

    return apply


def members(changes, ending=".npz"):
    """Arrays of an .npz, or files of an archive: those that are None are left out."""

    def change(content):
        content |= changes
        for name in [name for name, value in changes.items() if value is None]:
            del content[name]

    return tree(change, ending)


# What is inside files: trees of dicts, lists, numbers, texts, arrays and bytes


def write_json(content):
    return json.dumps(content).encode()


def read_arrays(data):
    """With a text of JSON in an array as a tree."""
    arrays = dict(np.load(io.BytesIO(data)))
    texts = {name: str(array) for name, array in arrays.items() if array.dtype.kind == "U"}
    return arrays | {name: json.loads(text) for name, text in texts.items() if text.startswith("{")}


def write_arrays(content):
    stream, numbers = io.BytesIO(), np.ndarray | np.generic
    texts = {name: json.dumps(value) for name, value in content.items() if not isinstance(value, numbers)}
    np.savez(stream, **content | texts)
    return stream.getvalue()


def read_archive(data):
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return files | {"meta.json": json.loads(files["meta.json"])}


def write_archive(content):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in content.items():
            archive.writestr(name, value if isinstance(value, bytes) else json.dumps(value))
    return stream.getvalue()


def read_lines(data):
    return {f"line {number}": json.loads(line) for number, line in enumerate(data.splitlines())}


def write_lines(content):
    return b"\n".join(map(write_json, content.values()))


def read_glb(data):
    size = struct.unpack_from("<I", data, 12)[0]
    return {"document": json.loads(data[20 : 20 + size]), "rest": data[20 + size :]}


def write_glb(content):
    text = write_json(content.get("document"))
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + content.get("rest", b"")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


OPENED = {
    ".json": (json.loads, write_json),
    ".gltf": (json.loads, write_json),
    ".jsonl": (read_lines, write_lines),
    ".npz": (read_arrays, write_arrays),
    ".sog": (read_archive, write_archive),
    ".glb": (read_glb, write_glb),
    ".gzip": (lambda data: {"inside": gzip.decompress(data)}, lambda tree: gzip.compress(tree.get("inside", b""))),
}
