"""Files made to be misread: what they would cost is known before it is paid, and nothing else is taken for them."""

import dataclasses
import io
import json
import os
import subprocess
import sys
import textwrap
import tracemalloc
import zipfile

import numpy as np
import pytest
from test_optimize import blob_scene

from warpcage.core.checks import listed
from warpcage.core.files import npz_names, read_limited, read_npz
from warpcage.core.memory import UNKNOWN, free_host_bytes
from warpcage.field.files import files as field_files
from warpcage.field.voxel_field import VoxelField
from warpcage.fitting.checkpoint import load_progress, save_progress, scene_digest
from warpcage.fitting.optimizer import FieldOptimizer


def refused(action, *words, error=ValueError):
    """The action is refused in one line that holds all the words."""
    with pytest.raises(error) as caught:
        action()
    message = str(caught.value)
    assert type(caught.value) is error and "\n" not in message
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
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 30_000)
    assert len(read_limited(path, "file", room=30)) == 1000
    refused(lambda: read_limited(path, "file", room=31), "some.txt: its 1000 bytes need 0.00 GiB of memory")


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
    from warpcage.core.threads import limit_threads

    scene, _ = checkpoint
    digest = scene_digest(scene)
    strided = np.repeat(scene.alphas[..., None], 2, axis=-1)[..., 0]
    with limit_threads(1):
        assert scene_digest(dataclasses.replace(scene, alphas=strided)) == digest
    swapped = dataclasses.replace(scene, images=scene.images[::-1])
    assert scene_digest(swapped) != digest


def test_checkpoints_of_earlier_versions_are_named_so(checkpoint, tmp_path):
    scene, path = checkpoint
    contents = dict(np.load(path)) | {"version": np.array(2)}
    np.savez(tmp_path / "old.npz", **contents)
    optimizer = FieldOptimizer(scene, device="cpu", **FIT)
    refused(lambda: load_progress(optimizer, tmp_path / "old.npz"), "old.npz", "another version (2, ", "remove it")


def test_checkpoints_hold_no_arrays_that_are_not_read(checkpoint):
    from warpcage.fitting.checkpoint import NAMES

    assert set(npz_names(checkpoint[1], "checkpoint")) <= NAMES


# Messages


def test_lists_in_messages_are_cut(tmp_path):
    assert listed([]) == "none" and listed("abc") == "a, b, c"
    assert listed(range(12), 3) == "0, 1, 2 and 9 more"
    assert len(listed(["x" * 10_000] * 10_000)) < 600
    np.savez(tmp_path / "many.npz", **{f"array_{k:04d}": np.zeros(1) for k in range(500)})
    refused(lambda: VoxelField.load(tmp_path / "many.npz"), "it holds array_0000, array_0001, ", " and 492 more")
