"""Files made to be misread: what they would cost is known before it is paid, and nothing else is taken for them."""

import base64
import dataclasses
import io
import json
import struct
import subprocess
import sys
import textwrap
import tracemalloc
import zipfile

import numpy as np
import pytest
from scenes import blob_scene

from warpcage import Error, FieldOptimizer, VoxelField
from warpcage.cli.cages import read_mesh as read_object
from warpcage.core import UNKNOWN, MemoryShortage, free_host_bytes, listed, npz_names, read_limited, read_npz
from warpcage.field import io as field_files
from warpcage.fitting import load_progress, save_progress, scene_digest
from warpcage.mesh import polygons, read_mesh
from warpcage.mesh.io import gltf


def refused(action, *words, error=ValueError):
    """The action is refused in one line that holds all the words."""
    with pytest.raises(error) as caught:
        action()
    message = str(caught.value)
    assert isinstance(caught.value, error) and isinstance(caught.value, Error) and "\n" not in message
    for word in words:
        assert word in message, message


def peak_of(action):
    """Most bytes that Python and NumPy held during an action, beyond those held before it, and what it returned."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        result = action()
        return tracemalloc.get_traced_memory()[1] - before, result
    finally:
        tracemalloc.stop()


# The budget


def tree(root, files):
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return str(root)


def test_free_memory_is_the_least_of_system_groups_and_limits(tmp_path):
    system = {"proc/meminfo": "MemTotal: 64000 kB\nMemAvailable: 32000 kB\n", "proc/self/statm": "1 1 1 1 0 1 0\n"}
    assert free_host_bytes(tree(tmp_path / "plain", system)) == 32000 * 1024
    second = system | {
        "proc/self/cgroup": "0::/job/step\n",
        "sys/fs/cgroup/job/step/memory.max": "max\n",
        "sys/fs/cgroup/job/step/memory.current": "900\n",
        "sys/fs/cgroup/job/memory.max": "5000\n",  # around the group of the process, and less
        "sys/fs/cgroup/job/memory.current": "4000\n",
        "sys/fs/cgroup/job/memory.stat": "anon 3000\ninactive_file 600\nactive_file 100\n",
    }
    assert free_host_bytes(tree(tmp_path / "second", second)) == 5000 - 4000 + 700
    first = system | {
        "proc/self/cgroup": "5:cpu:/\n4:memory:/docker/abc\n",  # in a container its own group is the mount
        "sys/fs/cgroup/memory/memory.limit_in_bytes": "7000\n",
        "sys/fs/cgroup/memory/memory.usage_in_bytes": "6500\n",
        "sys/fs/cgroup/memory/memory.stat": "cache 1\ntotal_inactive_file 30\ntotal_active_file 3\n",
    }
    assert free_host_bytes(tree(tmp_path / "first", first)) == 500 + 33
    first["sys/fs/cgroup/memory/memory.limit_in_bytes"] = "9223372036854771712\n"  # what version 1 has for none
    assert free_host_bytes(tree(tmp_path / "none", first)) == 32000 * 1024
    first["sys/fs/cgroup/memory/memory.limit_in_bytes"] = "6000\n"  # lowered below what is in use
    assert free_host_bytes(tree(tmp_path / "over", first)) == 0
    assert 0 < free_host_bytes() < UNKNOWN


@pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux counts them")
def test_free_memory_knows_the_limits_of_the_process():
    script = """
        import resource
        from warpcage.core.memory import free_host_bytes
        used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, resource.RLIM_INFINITY))
        free = free_host_bytes()
        bytearray(free // 2)
        try:
            bytearray(free + 2**24)
        except MemoryError:
            print(free)
    """
    run = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    assert 0 < int(run.stdout) <= 2**28


def test_files_are_only_read_where_there_is_room(tmp_path, monkeypatch):
    path = tmp_path / "some.txt"
    path.write_bytes(bytes(1000))
    monkeypatch.setattr("warpcage.core.memory.LITTLE", 0)
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 30_000)
    assert len(read_limited(path, "file", room=30)) == 1000
    words = "some.txt: its 1000 bytes need 0.00 GiB of memory"
    refused(lambda: read_limited(path, "file", room=31), words, error=MemoryShortage)


# Archives


def small_field(folder):
    density = np.zeros((6, 6, 6))
    density[1:5, 1:5, 1:5] = 3.0
    sh = np.random.default_rng(0).normal(size=(6, 6, 6, 9, 3))
    path = folder / "field.npz"
    VoxelField.from_dense(density, sh, [[0, 0, 0], [1, 1, 1]]).save(path)
    return path


def add_member(path, name, data):
    """Another member in an archive."""
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w") as member:
        for first in range(0, len(data), 1 << 20):
            member.write(data[first : first + (1 << 20)])


def test_arrays_that_nobody_asked_for_are_not_read(tmp_path, monkeypatch):
    path = small_field(tmp_path)
    whole = VoxelField.load(path, device="cpu")
    extra = io.BytesIO()
    np.save(extra, np.zeros(1 << 25, np.uint8))
    add_member(path, "extra.npy", extra.getvalue())
    add_member(path, "broken.npy", b"this is no array")
    assert "extra" in npz_names(path, "field file")
    peak, contents = peak_of(lambda: field_files.load_field(path))
    assert peak < 1 << 22  # less than an eighth of the extra array
    np.testing.assert_array_equal(contents.density, whole.grid.density.numpy())
    monkeypatch.setattr("warpcage.core.files.free_host_bytes", lambda: 1 << 21)
    VoxelField.load(path, device="cpu")  # what is not read needs no memory


def test_fields_take_no_more_memory_than_is_counted(tmp_path):
    side = 48
    sh = np.random.default_rng(0).normal(size=(side, side, side, 9, 3)).astype(np.float32)
    field = VoxelField.from_dense(np.ones((side,) * 3), sh, [[0, 0, 0], [1, 1, 1]], device="cpu")
    del sh
    for kind in ("warpcage", "compact", "svox2"):
        path = tmp_path / f"{kind}.npz"
        field.save(path, format=kind)
        size = sum(array.nbytes for array in read_npz(path, "field file").values())
        peak, _ = peak_of(lambda path=path: field_files.load_field(path))
        assert 1.5 * size < peak < field_files.ROOM * size, (kind, peak / size)


def npy_bytes(header_text, version=(1, 0)):
    """A member of an archive with a header as it stands."""
    length_bytes = 2 if version == (1, 0) else 4
    text = header_text.encode()
    return b"\x93NUMPY" + bytes(version) + len(text).to_bytes(length_bytes, "little") + text


@pytest.mark.parametrize(
    "descr, shape, words",
    [
        ("'<f8'", "(10**15,)", "an .npz file"),  # a formula, which is none of a header's business
        ("'<f8'", "(1000000000000000,)", "claims 8000000000000000 bytes"),
        ("'<f8'", "(1000000000000, 0)", "claims 0 bytes"),
        ("'<U0'", "(1000000000000,)", "neither numbers nor text"),  # NumPy makes it one letter each: 4 TB
        ("'|V0'", "(1000000000000,)", "neither numbers nor text"),
        ("[('a', '<f8')]", "(2,)", "neither numbers nor text"),
        ("('<f8', (1000000,))", "(2,)", "neither numbers nor text"),
    ],
)
def test_hostile_headers_are_refused_before_anything_is_allocated(tmp_path, descr, shape, words):
    path = tmp_path / "file.npz"
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", npy_bytes(header) + bytes(8))
    peak, _ = peak_of(lambda: refused(lambda: read_npz(path, "file"), "file.npz is not an .npz file", words))
    assert peak < 1 << 20


def test_long_headers_are_refused_before_they_are_read(tmp_path):
    path = tmp_path / "file.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", npy_bytes(" " * (1 << 24), version=(2, 0)))
    peak, _ = peak_of(lambda: refused(lambda: read_npz(path, "file"), "a header of 16777216 bytes"))
    assert peak < 1 << 20


def test_archives_that_claim_more_than_the_file_has(tmp_path):
    path = tmp_path / "file.npz"
    np.savez_compressed(path, a=np.zeros(1000, np.uint8))
    data = bytearray(path.read_bytes())
    entry = data.index(b"PK\x01\x02")
    data[entry + 20 : entry + 28] = (1 << 30).to_bytes(4, "little") * 2  # both sizes in the central directory
    path.write_bytes(data)
    refused(lambda: read_npz(path, "file"), "its arrays claim 1073741824 packed bytes")


# Checkpoints


FIT = {"resolution": 16, "levels": 1, "batch_rays": 256}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A scene with alphas, surroundings and bounds, and the checkpoint of its fit."""
    scene = blob_scene(count=4, size=16)
    scene = dataclasses.replace(scene, bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    optimizer = FieldOptimizer(scene, device="cpu", **FIT)
    path = tmp_path_factory.mktemp("checkpoint") / "c.npz"
    save_progress(optimizer, path)
    load_progress(FieldOptimizer(scene, device="cpu", **FIT), path)
    return scene, path


def one_pixel(images):
    images = images.copy()
    images[2, 3, 5, 1] = 0.5 * images[2, 3, 5, 1] + 0.1  # neither its row nor its column is a seventh
    return images


def moved(cameras):
    pose = cameras[1].camera_to_world.copy()
    pose[0, 3] += 1e-9
    return [cameras[0], dataclasses.replace(cameras[1], camera_to_world=pose), *cameras[2:]]


CHANGES = {
    "pixel": lambda scene: {"images": one_pixel(scene.images)},
    "alphas": lambda scene: {"alphas": 0.5 * scene.alphas},
    "background": lambda scene: {"background": np.zeros(3, np.float32)},
    "camera": lambda scene: {"cameras": moved(scene.cameras)},
    "bounds": lambda scene: {"bounds": 1.5 * scene.bounds},
    "surroundings": lambda scene: {"surroundings": 0.1 * scene.images},
    "captured": lambda scene: {"captured": True},
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_checkpoint_sees_every_change_of_the_scene(checkpoint, change):
    scene, path = checkpoint
    other = dataclasses.replace(scene, **CHANGES[change](scene))
    assert scene_digest(other) != scene_digest(scene)
    optimizer = FieldOptimizer(other, device="cpu", **FIT)
    refused(lambda: load_progress(optimizer, path), "is the checkpoint of another fit")


def test_digests_are_the_same_for_any_threads_and_layout(checkpoint, two_threads):
    from warpcage.core import limit_threads

    scene, _ = checkpoint
    digest = scene_digest(scene)
    strided = np.repeat(scene.alphas[..., None], 2, axis=-1)[..., 0]
    with limit_threads(1):
        assert scene_digest(dataclasses.replace(scene, alphas=strided)) == digest
    swapped = dataclasses.replace(scene, images=scene.images[::-1])
    assert scene_digest(swapped) != digest


@pytest.mark.parametrize("version, named", [(2, "(2, "), (np.zeros((3, 2)), "([[0. 0.] [0. 0.] [")])
def test_checkpoints_of_earlier_versions_are_named_so(checkpoint, tmp_path, version, named):
    scene, path = checkpoint
    contents = dict(np.load(path)) | {"version": np.array(version)}
    np.savez(tmp_path / "old.npz", **contents)
    optimizer = FieldOptimizer(scene, device="cpu", **FIT)
    refused(lambda: load_progress(optimizer, tmp_path / "old.npz"), "old.npz", f"another version {named}", "remove it")


def test_checkpoints_hold_no_arrays_that_are_not_read(checkpoint):
    from warpcage.fitting import NAMES

    assert set(npz_names(checkpoint[1], "checkpoint")) <= NAMES


# Messages


def test_lists_in_messages_are_cut(tmp_path):
    assert listed([]) == "none" and listed("abc") == "a, b, c"
    assert listed(range(12), 3) == "0, 1, 2 and 9 more"
    assert len(listed(["x" * 10_000] * 10_000)) < 600
    np.savez(tmp_path / "many.npz", **{f"array_{k:04d}": np.zeros(1) for k in range(500)})
    refused(lambda: VoxelField.load(tmp_path / "many.npz"), "it holds array_0000, array_0001, ", " and 492 more")


# Meshes


def star(count, seed=0):
    """A flat polygon around the origin with a corner at each of many radii, (n, 3)."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(count) / count
    radius = rng.uniform(0.2, 1.0, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)


def write_polygon(path, points):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    path.write_text("\n".join([*lines, "f " + " ".join(str(k + 1) for k in range(len(points)))]) + "\n")


def doubled_areas(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)[:, 2]


def test_polygons_of_many_corners_take_a_few_looks_at_each(tmp_path, monkeypatch):
    looks = []
    measured = polygons.EarCutter.quality
    monkeypatch.setattr(polygons.EarCutter, "quality", lambda self, corner: looks.append(1) or measured(self, corner))
    count = 800
    points = star(count)
    write_polygon(tmp_path / "star.obj", points)
    _, _, triangles = read_mesh(tmp_path / "star.obj")
    areas = doubled_areas(points, triangles)
    x, y = points[:, :2].T
    assert len(triangles) == count - 2 and (areas > 0).all()
    assert areas.sum() == pytest.approx((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    assert count <= len(looks) < 6 * count  # cutting anew at each ear would take 320,000


def test_blocked_ears_are_cut_when_nothing_is_in_their_way(tmp_path):
    # a comb: every tooth is in the way of the ears around it until it is gone
    teeth = 60
    x = np.repeat(np.arange(teeth), 2).astype(float)
    y = np.tile([0.0, 50.0], teeth)
    y[0] = y[-1] = -1.0
    points = np.stack([x, -y, np.zeros(2 * teeth)], axis=1)[::-1]
    write_polygon(tmp_path / "comb.obj", points)
    _, _, triangles = read_mesh(tmp_path / "comb.obj")
    areas = doubled_areas(points, triangles)
    u, v = points[:, :2].T
    assert (areas * np.sign(areas.sum()) > -1e-9).all()
    assert areas.sum() == pytest.approx((u * np.roll(v, -1) - v * np.roll(u, -1)).sum())


def test_more_corners_than_are_cut_are_refused_and_convex_ones_are_not(tmp_path):
    write_polygon(tmp_path / "star.obj", star(polygons.MAX_CORNERS + 1))
    refused(lambda: read_mesh(tmp_path / "star.obj"), "star.obj:4098: a face of 4097 corners", "at most 4096")
    angle = 2 * np.pi * np.arange(6000) / 6000
    write_polygon(tmp_path / "disc.obj", np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    assert len(read_mesh(tmp_path / "disc.obj")[2]) == 5998


def instances(folder, nodes, *, triangles=400, primitives=1):
    """A .gltf whose nodes share one mesh of some triangles over a hundred vertices."""
    rng = np.random.default_rng(0)
    data = rng.random((100, 3)).astype("<f4").tobytes() + rng.integers(0, 100, (triangles, 3)).astype("<u4").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * primitives}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 100},
            {"bufferView": 0, "byteOffset": 1200, "componentType": 5125, "type": "SCALAR", "count": 3 * triangles},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data), "uri": "data:x;base64," + base64.b64encode(data).decode()}],
    }
    path = folder / "many.gltf"
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize("nodes, primitives", [(3000, 1), (1, 3000), (20, 150)])
def test_instances_are_counted_before_they_are_made(tmp_path, nodes, primitives):
    path = instances(tmp_path, nodes, triangles=4000, primitives=primitives)
    peak, _ = peak_of(
        lambda: refused(lambda: read_mesh(path), "many.gltf", "come to 12000000 triangles", "at most 10000000")
    )
    assert peak < 1 << 26 and path.stat().st_size < 2_000_000


def test_instances_of_an_object_to_be_caged_are_counted_too(tmp_path):
    """`warpcage cage` reads meshes by trimesh, which makes each instance."""
    content = instances(tmp_path, 3000, triangles=4000).read_bytes()
    content += b" " * (-len(content) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(content), len(content), 0x4E4F534A)
    (tmp_path / "many.glb").write_bytes(head + content)
    path = str(tmp_path / "many.glb")
    peak, _ = peak_of(
        lambda: refused(lambda: read_object(path), "many.glb", "come to 12000000 triangles", "at most 10000000")
    )
    assert peak < 1 << 26


def test_instances_need_memory_that_is_there(tmp_path, monkeypatch):
    path = instances(tmp_path, 1000)
    peak, (_, vertices, triangles) = peak_of(lambda: read_mesh(path))
    assert vertices.shape == (100_000, 3) and triangles.shape == (400_000, 3)
    need = gltf.VERTEX_BYTES * len(vertices) + gltf.TRIANGLE_BYTES * len(triangles)
    assert need / 8 < peak < need
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: need - 1)
    refused(lambda: read_mesh(path), "1000 nodes with meshes come to 400000 triangles", "0.07 GiB of memory")


def test_a_buffer_that_many_entries_name_is_read_once(tmp_path):
    path = instances(tmp_path, 1)
    document = json.loads(path.read_text())
    data = base64.b64decode(document["buffers"][0]["uri"].split(",")[1])
    (tmp_path / "data.bin").write_bytes(data + bytes(1 << 20))
    document["buffers"] = [{"byteLength": len(data), "uri": "data.bin"}] * 100
    path.write_text(json.dumps(document))
    peak, _ = peak_of(lambda: read_mesh(path))
    assert peak < 10 << 20
    (tmp_path / "folder").mkdir()
    (tmp_path / "data.bin").rename(tmp_path / "folder" / "data.bin")
    path = path.rename(tmp_path / "folder" / "many.gltf")
    (tmp_path / "outside.bin").write_bytes(data)
    (tmp_path / "folder" / "data.bin").unlink()
    (tmp_path / "folder" / "data.bin").symlink_to(tmp_path / "outside.bin")
    refused(lambda: read_mesh(path), "its buffer 'data.bin' leads out of the folder")


def test_lists_of_a_ply_are_counted_before_they_are_read(tmp_path, monkeypatch):
    header = "ply\nformat binary_little_endian 1.0\nelement {}\nproperty list {} int vertex_indices\nend_header\n"
    path = tmp_path / "c.ply"
    path.write_bytes(header.format("face 1000000", "uchar").encode() + bytes(1_000_000))
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 28)
    words = "c.ply: its 1000000 elements 'face' need 0."
    peak, _ = peak_of(lambda: refused(lambda: read_mesh(path), words, error=MemoryShortage))
    assert peak < 1 << 22
    path.write_bytes(header.format("face 100000000000", "uchar").encode() + bytes(1000))
    refused(lambda: read_mesh(path), "ends within its 100000000000 elements 'face'")
    path.write_bytes(header.format("face 2", "char").encode() + b"\xff" * 100)
    refused(lambda: read_mesh(path), "ends within element 0 of 2 'face'")


def test_long_lines_are_cut_in_messages(tmp_path):
    path = tmp_path / "c.obj"
    path.write_text("v 0 0 " + "x" * 100_000 + "\n")
    with pytest.raises(ValueError) as error:
        read_mesh(path)
    assert len(str(error.value)) < 400 and "c.obj:1" in str(error.value)
