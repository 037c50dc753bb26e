"""Files made to be misread: what they would cost is known before it is paid, and nothing else is taken for them."""

import base64
import dataclasses
import gzip
import io
import json
import struct
import subprocess
import sys
import textwrap
import zipfile

import numpy as np
import pytest
from hostile import (
    FIT,
    cut,
    fitted_scene,
    instead,
    members,
    put,
    require_refused,
    rows,
    small_field,
    swap,
    tree,
    whole,
    write_glb,
)
from refusals import peak_of, refused

from warpcage import FieldOptimizer, SplatField, VoxelField
from warpcage.core import (
    UNKNOWN,
    MemoryShortage,
    free_host_bytes,
    limit_threads,
    listed,
    npz_names,
    read_limited,
    read_npz,
)
from warpcage.field import io as field_files
from warpcage.fitting import NAMES, load_progress, scene_digest
from warpcage.mesh import polygons, read_mesh
from warpcage.mesh.io import gltf
from warpcage.studio.cli.cages import read_mesh as read_object

# The budget


def test_free_memory_is_the_least_of_system_groups_and_limits(tmp_path):
    system = {"proc/meminfo": "MemTotal: 64000 kB\nMemAvailable: 32000 kB\n", "proc/self/statm": "1 1 1 1 0 1 0\n"}
    assert free_host_bytes(put(tmp_path / "plain", system)) == 32000 * 1024
    second = system | {
        "proc/self/cgroup": "0::/job/step\n",
        "sys/fs/cgroup/job/step/memory.max": "max\n",
        "sys/fs/cgroup/job/step/memory.current": "900\n",
        "sys/fs/cgroup/job/memory.max": "5000\n",  # around the group of the process, and less
        "sys/fs/cgroup/job/memory.current": "4000\n",
        "sys/fs/cgroup/job/memory.stat": "anon 3000\ninactive_file 600\nactive_file 100\n",
    }
    assert free_host_bytes(put(tmp_path / "second", second)) == 5000 - 4000 + 700
    first = system | {
        "proc/self/cgroup": "5:cpu:/\n4:memory:/docker/abc\n",  # in a container its own group is the mount
        "sys/fs/cgroup/memory/memory.limit_in_bytes": "7000\n",
        "sys/fs/cgroup/memory/memory.usage_in_bytes": "6500\n",
        "sys/fs/cgroup/memory/memory.stat": "cache 1\ntotal_inactive_file 30\ntotal_active_file 3\n",
    }
    assert free_host_bytes(put(tmp_path / "first", first)) == 500 + 33
    first["sys/fs/cgroup/memory/memory.limit_in_bytes"] = "9223372036854771712\n"  # what version 1 has for none
    assert free_host_bytes(put(tmp_path / "none", first)) == 32000 * 1024
    first["sys/fs/cgroup/memory/memory.limit_in_bytes"] = "6000\n"  # lowered below what is in use
    assert free_host_bytes(put(tmp_path / "over", first)) == 0
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


def test_arrays_that_nobody_asked_for_are_not_read(tmp_path, monkeypatch):
    path = tmp_path / "field.npz"
    path.write_bytes(whole("field")["field.npz"])
    density = VoxelField.load(path, device="cpu").grid.density.numpy()
    extra = io.BytesIO()
    np.save(extra, np.zeros(1 << 25, np.uint8))
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("extra.npy", extra.getvalue())
        archive.writestr("broken.npy", b"this is no array")
    assert "extra" in npz_names(path, "field file")
    _, contents = peak_of(lambda: field_files.load_field(path), 1 << 22)  # less than an eighth of the extra array
    np.testing.assert_array_equal(contents.density, density)
    monkeypatch.setattr("warpcage.core.npz.free_host_bytes", lambda: 1 << 21)
    VoxelField.load(path, device="cpu")  # what is not read needs no memory


def test_fields_take_no_more_memory_than_is_counted(tmp_path):
    field = small_field(side=32)
    for kind in ("warpcage", "compact", "svox2"):
        path = tmp_path / f"{kind}.npz"
        field.save(path, format=kind)
        size = sum(array.nbytes for array in read_npz(path, "field file").values())
        peak, _ = peak_of(lambda path=path: field_files.load_field(path))
        assert 1.5 * size < peak < field_files.ROOM * size, (kind, peak / size)


# Checkpoints


@pytest.fixture
def checkpoint(tmp_path):
    (tmp_path / "c.npz").write_bytes(whole("checkpoint")["c.npz"])
    return tmp_path / "c.npz"


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
    scene = fitted_scene()
    other = dataclasses.replace(scene, **CHANGES[change](scene))
    assert scene_digest(other) != scene_digest(scene)
    refused(lambda: load_progress(FieldOptimizer(other, **FIT), checkpoint), "is the checkpoint of another fit")


def test_digests_are_the_same_for_any_threads_and_layout(two_threads):
    scene = fitted_scene()
    digest = scene_digest(scene)
    strided = np.repeat(scene.alphas[..., None], 2, axis=-1)[..., 0]
    with limit_threads(1):
        assert scene_digest(dataclasses.replace(scene, alphas=strided)) == digest
    swapped = dataclasses.replace(scene, images=scene.images[::-1])
    assert scene_digest(swapped) != digest


def test_a_checkpoint_holds_only_arrays_that_are_read(checkpoint):
    assert set(npz_names(checkpoint, "checkpoint")) <= NAMES


PLY = "ply\nformat ascii 1.0\nelement face"
WRONG = {
    "checkpoint": [
        ("", members({"version": np.array(2)}), "another version (2,  | remove it"),
        ("", members({"version": np.zeros((3, 2))}), "another version ([[0. 0.] [0. 0.] [ | remove it"),
    ],
    "cage.obj": [("", lambda data: b"v 0 0 nan\n" + data, "cage.obj:1: finite numbers expected")],
    "text.ply": [
        ("", swap("property float x", "property float w"), "PLY vertices need properties x, y, z"),
        ("", instead(f"{PLY} 0\nproperty list uchar int vertex_indices\nend_header\n"), "no vertices in it"),
        ("", swap("end_header", ""), "the PLY header has no end_header"),
        ("", swap("format ascii 1.0\n", ""), "the PLY header names no format"),
        ("", swap("vertex_indices", "corners"), "PLY faces need a list property vertex_indices"),
        ("", lambda data: data[: data.rstrip().rfind(b"\n")], "PLY elements 'face' announced"),
    ],
    "cage.ply": [("", cut(0.3), "the PLY file ends within its")],
    "poses.json": [
        ("", tree(lambda file, key=key, value=value: file.update({key: value})), "")
        for key in ("format", "version", "cage", "keyframes")
        for value in (None, 7.5, "x", [1], {"a": []})
    ],
}


@pytest.mark.parametrize("name, file, damage, words", rows(WRONG))
def test_other_versions_and_kinds_of_values_are_refused(tmp_path, name, file, damage, words):
    require_refused(name, tmp_path, {file: damage(whole(name)[file])}, words)


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


def require_cut(path, points):
    """A polygon is cut into triangles that all turn as it does, and have its area."""
    write_polygon(path, points)
    triangles = read_mesh(path)[2]
    a, b, c = (points[triangles[:, k]] for k in range(3))
    doubled = np.cross(b - a, c - a)[:, 2]
    x, y = points[:, :2].T
    whole = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
    assert len(triangles) == len(points) - 2 and (doubled * np.sign(whole) > -1e-9).all()
    assert doubled.sum() == pytest.approx(whole)
    return doubled


def test_polygons_of_many_corners_take_a_few_looks_at_each(tmp_path, monkeypatch):
    looks, count = [], 800
    measured = polygons.EarCutter.quality
    monkeypatch.setattr(polygons.EarCutter, "quality", lambda self, corner: looks.append(1) or measured(self, corner))
    assert (require_cut(tmp_path / "star.obj", star(count)) > 0).all()
    assert count <= len(looks) < 6 * count  # cutting anew at each ear would take 320,000


def test_blocked_ears_are_cut_when_nothing_is_in_their_way(tmp_path):
    """A comb: every tooth is in the way of the ears around it until it is gone."""
    teeth = 60
    y = np.tile([0.0, 50.0], teeth)
    y[0] = y[-1] = -1.0
    points = np.stack([np.repeat(np.arange(teeth), 2), -y, np.zeros(2 * teeth)], axis=1)
    require_cut(tmp_path / "comb.obj", points[::-1])


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


TOO_MANY = ("come to 12000000 triangles", "at most 10000000")


@pytest.mark.parametrize("nodes, primitives", [(3000, 1), (1, 3000), (20, 150)])
def test_instances_are_counted_before_they_are_made(tmp_path, nodes, primitives):
    path = instances(tmp_path, nodes, triangles=4000, primitives=primitives)
    refused(lambda: read_mesh(path), "many.gltf", *TOO_MANY, most=1 << 26)
    assert path.stat().st_size < 2_000_000


def test_instances_of_an_object_to_be_caged_are_counted_too(tmp_path):
    """`warpcage cage` reads meshes by trimesh, which makes each instance."""
    document = json.loads(instances(tmp_path, 3000, triangles=4000).read_text())
    put(tmp_path, whole("cage.glb") | {"many.glb": write_glb({"document": document})})
    read_object(str(tmp_path / "cage.glb"))  # what is imported on the way
    refused(lambda: read_object(str(tmp_path / "many.glb")), "many.glb", *TOO_MANY, most=1 << 26)


def test_instances_need_memory_that_is_there(tmp_path, monkeypatch):
    path = instances(tmp_path, 1000)
    peak, (_, vertices, triangles) = peak_of(lambda: read_mesh(path))
    assert vertices.shape == (100_000, 3) and triangles.shape == (400_000, 3)
    need = gltf.VERTEX_BYTES * len(vertices) + gltf.TRIANGLE_BYTES * len(triangles)
    assert need / 8 < peak < need
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: need - 1)
    refused(lambda: read_mesh(path), "1000 nodes with meshes come to 400000 triangles", "0.07 GiB of memory")


def test_a_buffer_that_many_entries_name_is_read_once_and_is_no_link_out(tmp_path):
    (tmp_path / "folder").mkdir()
    path, buffer = instances(tmp_path / "folder", 1), tmp_path / "folder" / "data.bin"
    document = json.loads(path.read_text())
    data = base64.b64decode(document["buffers"][0]["uri"].split(",")[1])
    buffer.write_bytes(data + bytes(1 << 20))
    document["buffers"] = [{"byteLength": len(data), "uri": "data.bin"}] * 100
    path.write_text(json.dumps(document))
    peak_of(lambda: read_mesh(path), 10 << 20)
    buffer.symlink_to(buffer.rename(tmp_path / "outside.bin"))
    refused(lambda: read_mesh(path), "its buffer 'data.bin' leads out of the folder")


def test_lists_of_a_ply_are_counted_before_they_are_read(tmp_path, monkeypatch):
    header = "ply\nformat binary_little_endian 1.0\nelement {}\nproperty list {} int vertex_indices\nend_header\n"
    path = tmp_path / "c.ply"
    path.write_bytes(header.format("face 1000000", "uchar").encode() + bytes(1_000_000))
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 28)
    said = "c.ply: its 1000000 elements 'face' need 0."
    refused(lambda: read_mesh(path), said, error=MemoryShortage, most=1 << 22)
    path.write_bytes(header.format("face 100000000000", "uchar").encode() + bytes(1000))
    refused(lambda: read_mesh(path), "ends within its 100000000000 elements 'face'")
    path.write_bytes(header.format("face 2", "char").encode() + b"\xff" * 100)
    refused(lambda: read_mesh(path), "ends within element 0 of 2 'face'")


def test_splats_of_an_spz_file_are_counted_before_they_are_unpacked(tmp_path, monkeypatch):
    path, places = tmp_path / "a.spz", np.random.default_rng(0).bytes(2_000_000)
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 1_000_000, 0, 12, 0, 0)
    path.write_bytes(gzip.compress(header + places + bytes(18_000_000), 1))
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 28)
    said = "a.spz: its 1000000 splats of degree 0 need 0."
    refused(lambda: SplatField.load(path), said, error=MemoryShortage, most=1 << 24)


def test_long_lines_are_cut_in_messages(tmp_path):
    path = tmp_path / "c.obj"
    path.write_text("v 0 0 " + "x" * 100_000 + "\n")
    said = refused(lambda: read_mesh(path))
    assert len(said) < 400 and "c.obj:1" in said
