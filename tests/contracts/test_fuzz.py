"""Damaged files of every kind that is read: only ValueError and FileNotFoundError come out, in one line, and memory
stays bounded. WARPCAGE_FUZZ_EXAMPLES=2000 tries more files of each kind, other ones each time."""

import json
import os
import resource
import shutil

import numpy as np
import pytest

pytest.importorskip("hypothesis")

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from phone_writers import write_arkitscenes, write_polycam, write_record3d, write_stray
from program_writers import write_bundler, write_llff, write_metashape, write_opensfm, write_realityscan
from scene_writers import brick_pictures, write_blender, write_colmap, write_dtu, write_nsvf, write_transforms

from warpcage import Cage, FieldOptimizer, PoseFile, VoxelField, load_scene
from warpcage.field import LayeredBackground, OuterField
from warpcage.fitting import load_progress, save_progress
from warpcage.view import read_image

EXAMPLES = os.environ.get("WARPCAGE_FUZZ_EXAMPLES")
COUNT = int(EXAMPLES or 120)

fuzz = settings(
    max_examples=COUNT,
    derandomize=EXAMPLES is None,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)

#: Megabytes that reading one damaged file of a few kilobytes may take.
MEMORY = 600

WORDS = [
    b"nan", b"-inf", b"1e400", b"-1", b"0", b"99999999999999999999", b"1" * 5000, b"4294967295", b"x", b"\x00", b"null",
    b"true", b'"text"', b"[]", b"{}", b"[" * 3000, b"../../x", b"/etc/passwd", b"\xff\xfe", b"\n", b"#",
]  # fmt: skip


@st.composite
def damages(draw):
    """A function bytes -> bytes."""
    kind = draw(st.sampled_from(["cut", "flip", "insert", "remove", "word", "repeat", "swap"]))
    place, size = draw(st.floats(0, 1)), draw(st.integers(1, 40))
    content = draw(st.one_of(st.sampled_from(WORDS), st.binary(max_size=16)))

    def apply(data: bytes) -> bytes:
        at = int(place * len(data))
        if kind == "cut":
            return data[:at]
        if kind == "flip":
            return data[:at] + bytes(byte ^ (size * 7 & 255) for byte in data[at : at + 1]) + data[at + 1 :]
        if kind == "insert":
            return data[:at] + content + data[at:]
        if kind == "remove":
            return data[:at] + data[at + size :]
        if kind == "repeat":
            return data[:at] + data[at : at + size] * 3 + data[at + size :]
        if kind == "swap":
            return data[:at] + data[at + size : at + 2 * size] + data[at : at + size] + data[at + 2 * size :]
        words = data.replace(b",", b" , ").split(b" ")  # a whole word of a text file
        words[min(int(place * len(words)), len(words) - 1)] = content
        return b" ".join(words)

    return apply


def damaged(data, applied):
    for damage in applied:
        data = damage(data)
    return data


def read_or_refuse(read):
    """Run `read`; it may only refuse, in one line, and without much memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        result = read()
    except (ValueError, FileNotFoundError) as error:
        assert "\n" not in str(error) and str(error)
        result = None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1024 * MEMORY
    return result


def try_damages(path, read, check):
    """Damage a file in many ways; what is read of it all the same is checked."""
    whole = path.read_bytes()

    @fuzz
    @given(st.lists(damages(), min_size=1, max_size=3))
    def try_damaged(applied):
        path.write_bytes(damaged(whole, applied))
        found = read_or_refuse(lambda: read(path))
        if found is not None:
            check(found)

    try_damaged()


FORMATS = {
    "blender": lambda folder, pictures: write_blender(folder, pictures),
    "nsvf": lambda folder, pictures: write_nsvf(folder, pictures, "000"),
    "dtu": lambda folder, pictures: write_dtu(folder, pictures),
    "transforms": lambda folder, pictures: write_transforms(folder, pictures, shared=False, masks=True,
                                                            distortion={"k1": -0.02, "p1": 0.001},
                                                            applied_transform=np.eye(4)[:3].tolist()),
    "colmap text": lambda folder, pictures: write_colmap(folder, pictures, binary=False,
                                                       points=np.eye(3)[[0, 1, 2] * 4]),
    "colmap binary": lambda folder, pictures: write_colmap(folder, pictures, binary=True, model="OPENCV",
                                                           distortion=(-0.02, 0, 0, 0)),
    "colmap fisheye": lambda folder, pictures: write_colmap(folder, pictures, binary=True, model="OPENCV_FISHEYE",
                                                            distortion=(0.02, -0.002, 0, 0)),
    "polycam": write_polycam,
    "record3d": lambda folder, pictures: write_record3d(folder, pictures, each=True),
    "arkitscenes": write_arkitscenes,
    "stray": write_stray,
    "llff": write_llff,
    "realityscan": lambda folder, pictures: write_realityscan(folder, pictures, lens=(-0.02, 0, 0, 0, 0.001, 0)),
    "bundler": lambda folder, pictures: write_bundler(folder, pictures, distortion=(-0.02, 0.001)),
    "opensfm": lambda folder, pictures: write_opensfm(folder, pictures, k1=-0.02, p1=0.001),
    "metashape": lambda folder, pictures: write_metashape(folder, pictures, lens={"k1": -0.02, "p1": 0.001}),
}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    pictures = brick_pictures(3)
    root = tmp_path_factory.mktemp("fuzz")
    for name, write in FORMATS.items():
        (root / name).mkdir()
        write(root / name, pictures.pick([0, 1, 2]))
    return root


@pytest.mark.parametrize("name", FORMATS)
def test_scene_folders(folders, name):
    folder = folders / name
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    # cameras more often than pictures
    files += 3 * [path for path in files if path.suffix != ".png"]
    contents = {path: path.read_bytes() for path in files}
    assert load_scene(folder).images.shape[0] >= 2

    @fuzz
    @given(st.sampled_from(files), st.lists(damages(), min_size=1, max_size=3), st.booleans())
    def try_damaged(path, applied, detect):
        path.write_bytes(damaged(contents[path], applied))
        try:
            scene = read_or_refuse(lambda: load_scene(folder, format=None if detect else name.split()[0]))
            if scene is not None:
                assert np.isfinite(scene.images).all()
        finally:
            path.write_bytes(contents[path])

    try_damaged()


JSON_VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(10**320), 10**320),
        st.floats(),
        st.text(max_size=8),
        st.sampled_from(
            "../x.png /etc/passwd images .. . images/view_00.png \0 train train/view_01 masks/view_01.png PINHOLE "
            "OPENCV_FISHEYE EQUIRECTANGULAR".split(" ")
            + ["a" * 5000]
        ),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=3)),
    max_leaves=8,
)


@pytest.mark.parametrize("name", ["blender", "transforms"])
def test_json_with_wrong_values(folders, name):
    folder = folders / name
    path = next(folder.glob("transforms*.json"))
    original = path.read_text()

    @fuzz
    @given(st.data())
    def try_damaged(data):
        content = json.loads(original)
        frame = data.draw(st.sampled_from([content, *content["frames"]]))
        key = data.draw(st.sampled_from([*frame, "k4", "mask_path", "train_filenames", "applied_transform", "w"]))
        value = data.draw(JSON_VALUES)
        inner = frame.get(key)
        while isinstance(inner, list) and inner and data.draw(st.booleans()):
            frame, key = inner, data.draw(st.integers(0, len(inner) - 1))
            inner = frame[key]
        frame[key] = value
        path.write_text(json.dumps(content))
        try:
            read_or_refuse(lambda: load_scene(folder))
        finally:
            path.write_text(original)

    try_damaged()


@pytest.mark.parametrize("name", ["cage.gltf", "poses.json", "reconstruction.json"])
def test_json_of_others_with_wrong_values(tmp_path, folders, name):
    path, cage = tmp_path / name, Cage.box((0, 0, 0), (1, 2, 3))
    if name == "reconstruction.json":
        shutil.copytree(folders / "opensfm", tmp_path, dirs_exist_ok=True)
        read = lambda path: load_scene(path.parent)  # noqa: E731
    else:
        PoseFile(cage, {"bent": cage.bend(20)}).save(path) if name == "poses.json" else cage.save(path)
        read = PoseFile.load if name == "poses.json" else Cage.load
    original = json.loads(path.read_text())

    @fuzz
    @given(st.data())
    def try_damaged(data):
        content = inner = json.loads(json.dumps(original))
        while isinstance(inner, dict | list) and inner and (inner is content or data.draw(st.booleans())):
            outer = inner
            key = data.draw(
                st.sampled_from(sorted(inner)) if isinstance(inner, dict) else st.integers(0, len(inner) - 1)
            )
            inner = outer[key]
        outer[key] = data.draw(JSON_VALUES | st.integers(-9, 10**10) | st.sampled_from(["../x.bin", "cage.gltf"]))
        path.write_text(json.dumps(content))
        read_or_refuse(lambda: read(path))

    try_damaged()


ARRAYS = st.sampled_from([
    np.zeros(0), np.zeros((0, 9, 3)), np.full((2, 3), np.nan), np.array("text"), np.array([1, 2, 3]),
    np.array([10**6, 10**6, 10**6]), np.array([-1, 2, 3]), np.float64(1e300), np.array(2**63, np.uint64), np.int8(1),
    np.zeros((3, 3, 3), np.int64), np.full((6, 6, 6), 2**40), np.array([True]), np.array([1j]),
    np.array([[1e300] * 3, [2e300] * 3]), np.array([[0, 0, 0], [1e-300, 1, 1]]),
    np.full((6, 6, 6), -7, np.int32), np.full(27, 255, np.uint8), np.array([1e38], np.float32),
    np.ones((4, 4)), np.zeros((2, 3), "M8[s]"), np.zeros(3, [("x", "f4"), ("y", "i4")]),
])  # fmt: skip


@pytest.mark.parametrize("format", ["warpcage", "svox2", "layers", "outer"])
def test_field_files(tmp_path_factory, format):
    density = np.zeros((6, 6, 6))
    density[2:4, 2:4, 2:4] = 3.0
    field = VoxelField.from_dense(density, np.zeros((6, 6, 6, 9, 3)), [[0, 0, 0], [1, 1, 1]])
    if format == "layers":
        field.background_model = LayeredBackground(
            (0.5, 0.5, 0.5), 0.5, 2, np.full((3, 26, 4), 0.5), unseen=(0.1, 0.2, 0.3, 0.4)
        )
    if format == "outer":
        links = np.arange(8**3, dtype=np.int32).reshape(8, 8, 8)
        field.background_model = OuterField((0.5,) * 3, (0.5,) * 3, links, np.full((8**3, 4), 0.5))
    path = tmp_path_factory.mktemp("field") / "field.npz"
    field.save(path, format="svox2" if format == "svox2" else "warpcage")
    whole = path.read_bytes()
    contents = dict(np.load(path))

    @fuzz
    @given(
        st.lists(damages(), max_size=2),
        st.dictionaries(st.sampled_from(sorted(contents)), st.none() | ARRAYS, max_size=2),
    )
    def try_damaged(applied, changes):
        changed = {name: array for name, array in {**contents, **changes}.items() if array is not None}
        np.savez(path, **changed)
        path.write_bytes(damaged(path.read_bytes() if changes else whole, applied))
        read = read_or_refuse(lambda: VoxelField.load(path))
        if read is not None:
            assert np.isfinite(read.node_densities()).all() and np.isfinite(read.bounds).all()
            _, sampled = read.sample(read.bounds.mean(axis=0, keepdims=True), [[0.0, 0.0, 1.0]])
            assert np.isfinite(sampled).all()
            if read.background_model is not None:
                assert np.isfinite(read.background_model.sample(np.zeros((1, 3)), [[0.0, 0.0, 1.0]])).all()

    try_damaged()


def test_fit_checkpoints(folders, tmp_path):
    scene = load_scene(folders / "blender")
    options = {"resolution": 16, "epochs": 60, "levels": 2, "batch_rays": 64}
    optimizer = FieldOptimizer(scene, **options)
    for _ in range(3):
        optimizer.step()
    path = tmp_path / "progress.npz"
    save_progress(optimizer, path)
    contents, whole = dict(np.load(path)), path.read_bytes()
    load_progress(FieldOptimizer(scene, **options), path)
    target = FieldOptimizer(scene, **options)

    @fuzz
    @given(
        st.lists(damages(), max_size=2),
        st.dictionaries(st.sampled_from(sorted(contents)), st.none() | ARRAYS, max_size=2),
        st.none() | JSON_VALUES,
        st.integers(0, 5),
    )
    def try_damaged(applied, changes, value, which):
        changed = {name: array for name, array in {**contents, **changes}.items() if array is not None}
        if value is not None and "state" not in changes:
            state = json.loads(str(contents["state"]))
            state[sorted(state)[which % len(state)]] = value
            changed["state"] = np.array(json.dumps(state))
        np.savez(path, **changed)
        path.write_bytes(damaged(path.read_bytes() if changes or value is not None else whole, applied))
        read_or_refuse(lambda: load_progress(target, path))

    try_damaged()


@pytest.mark.parametrize(
    "kind", ["8.png", "16.png", "palette.png", "colour.jpg", "grey.jpg", "any.webp", "any.bmp", "any.tiff", "any.avif"]
)
def test_pictures(tmp_path_factory, kind):
    from PIL import Image
    from scene_writers import write_deep_png

    path = tmp_path_factory.mktemp("pictures") / kind
    color = np.random.default_rng(0).integers(0, 65536, (12, 17, 3), dtype=np.uint16)
    picture = Image.fromarray((color >> 8).astype(np.uint8))
    if kind == "16.png":
        write_deep_png(path, color)
    else:
        {"palette.png": picture.convert("P"), "grey.jpg": picture.convert("L")}.get(kind, picture).save(path)
    assert read_image(path).shape[:2] == (12, 17)

    def check(read):
        assert read.ndim == 3 and read.shape[-1] in (1, 2, 3, 4) and 0 <= read.min() <= read.max() <= 1

    try_damages(path, read_image, check)


@pytest.mark.parametrize("ending", [".obj", ".off", ".ply", "text.ply", ".glb", ".gltf"])
def test_cage_files(tmp_path_factory, ending):
    cage = Cage.box((0, 0, 0), (1, 2, 3), segments=2)
    path = tmp_path_factory.mktemp("cage") / f"cage{ending}"
    if ending == "text.ply":
        lines = ["ply", "format ascii 1.0", f"element vertex {len(cage.vertices)}"]
        lines += [f"property float {axis}" for axis in "xyz"]
        lines += [f"element face {len(cage.faces)}", "property list uchar int vertex_indices", "end_header"]
        lines += [" ".join(map(str, point)) for point in cage.vertices.tolist()]
        lines += [" ".join(map(str, [3, *face])) for face in cage.faces.tolist()]
        path.write_text("\n".join(lines) + "\n")
    else:
        cage.save(path)
    assert len(Cage.load(path).faces) == len(cage.faces)

    def check(read):
        assert np.isfinite(read.vertices).all() and read.faces.max(initial=-1) < len(read.vertices)

    try_damages(path, Cage.load, check)
