"""Broken field files: one clear line, nothing unpickled, nothing allocated on a claim. What is saved is whole or not
there."""

import io
import pathlib
import pickle
import signal
import subprocess
import sys
import textwrap
import zipfile

import numpy as np
import pytest
from hostile import cut, instead, members, require_refused, rows, small_field, whole
from refusals import refused

from warpcage import VoxelField
from warpcage.core import read_npz

# Archives and field files


class Trap:
    """Unpickling this leaves a file behind."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return pathlib.Path.touch, (self.path,)


def test_pickled_objects_are_never_opened(tmp_path):
    path, sprung = tmp_path / "field.npz", tmp_path / "sprung"
    contents, trap = dict(np.load(io.BytesIO(whole("field")["field.npz"]))), np.array([Trap(sprung)], object)
    np.savez(path, **contents, weights=trap)
    said = "array 'weights' holds pickled objects, which are never opened"
    refused(lambda: VoxelField.load(path), str(path), said)
    np.savez(path, **contents, extra=trap)  # which nothing asks for
    VoxelField.load(path)
    path.write_bytes(pickle.dumps(Trap(sprung)))
    refused(lambda: VoxelField.load(path), str(path), "is not an .npz field file")
    assert not sprung.exists()
    pickle.loads(path.read_bytes())  # the trap would have worked
    assert sprung.exists()


def npz(header, body=b"", version=(1, 0), claimed=None, name="density"):
    """An .npz of one member: a header of .npy as it stands, then the body. claimed: the size in the archive's list."""
    header = header.encode()
    member = (
        b"\x93NUMPY" + bytes(version) + len(header).to_bytes(2 if version == (1, 0) else 4, "little") + header + body
    )
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.npy", member)
    data = stream.getvalue()
    if claimed is not None:
        data = data.replace(len(member).to_bytes(4, "little"), claimed.to_bytes(4, "little"))
    return instead(data)


def header(descr, shape):
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"


NO_NUMBERS, NO_FIELD = "neither numbers nor text", "is not an .npz field file"

ARRAYS = [
    ({"version": np.array(99)}, "format version 99 | upgrade"),
    ({"version": np.array("new")}, "version must hold numbers"),
    ({"version": None}, "lacks version"),
    ({"sh": None}, "lacks sh"),
    ({"resolution": np.array([6, 6])}, "resolution must hold numbers of shape (3,)"),
    ({"resolution": np.array([100000] * 3)}, "resolution | (100000, 100000, 100000)"),
    ({"resolution": np.array([-6, -6, 6])}, "resolution | (-6, -6, 6)"),
    ({"occupancy": np.zeros(3, np.uint8)}, "occupancy must hold numbers of shape (27,)"),
    ({"density": np.full(64, np.nan, np.float32)}, "density holds values that are not finite"),
    ({"density": np.zeros(3, np.float32)}, "density must hold numbers of shape (64,), got float32 (3,)"),
    ({"bounds": np.array([[0, 0, 0], [1, 1, 0.0]])}, "bounds | lower below upper"),
    ({"bounds": np.array([[0, 0, 0], [1, 1, np.inf]])}, "bounds"),
    ({"background": np.array([2, 0, 0.0])}, "background"),
    ({"weights": np.full(64, np.nan)}, "weights holds values that are not finite"),
    ({"format": np.array("warpcage fit")}, "is the checkpoint of a fit, not yet a field"),
    ({"format": None}, "neither a warpcage nor a Plenoxels field: it holds background"),
]
HEADERS = [
    ("'<f8'", "(1000000, 1000000)", "'density' claims 8000000000000 bytes (1000000, 1000000), the file has 80"),
    ("'<f8'", "(10**15,)", NO_FIELD),  # a formula, which is none of a header's business
    ("'<f8'", "(1000000000000000,)", "claims 8000000000000000 bytes"),
    ("'<f8'", "(1000000000000, 0)", "claims 0 bytes"),
    ("'<U0'", "(1000000000000,)", NO_NUMBERS),  # NumPy makes it one letter each: 4 TB
    ("'|V0'", "(1000000000000,)", NO_NUMBERS),
    ("[('a', '<f8')]", "(2,)", NO_NUMBERS),
    ("('<f8', (1000000,))", "(2,)", NO_NUMBERS),
    ("'|O'", "(10,)", "pickled objects"),
]
BEHIND = {
    "layers": [
        ({"layers_rgba": np.zeros((3, 4), np.uint8)}, "layers_rgba"),
        ({"layers_seen": np.zeros(3, np.uint8)}, "layers_seen"),
        ({"layers_side": np.array(10**6)}, "cells along an edge"),
        ({"layers_count": np.array(1)}, "cells along an edge"),
        ({"layers_half": np.array(np.nan)}, "half side"),
        ({"layers_center": np.array([0, np.inf, 0])}, "center"),
        ({"layers_unseen": None}, "layers_unseen"),
        ({"layers_count": None}, "layers_count"),
    ],
    "outer": [
        ({"outer_rgba": np.zeros((3, 4), np.uint8)}, "outer_rgba"),
        ({"outer_rgba": None}, "outer_rgba"),
        ({"outer_occupancy": np.zeros(3, np.uint8)}, "outer_occupancy"),
        ({"outer_side": np.array(10**6)}, "voxels along a side"),
        ({"outer_half": np.array([1.0, -1.0, 1.0])}, "half sides"),
        ({"outer_center": np.array([0, np.inf, 0])}, "center"),
        ({"outer_sky": None}, "outer_sky"),
    ],
}
FIELDS = {
    **{name: [("", members(arrays), message) for arrays, message in group] for name, group in BEHIND.items()},
    "field": [
        ("", cut(0.0), f"{NO_FIELD}: | an empty file"),
        *(("", cut(share), f"{NO_FIELD}: | cut off or damaged") for share in (0.1, 0.5, 0.9, 0.999)),
        *(("", members(arrays), message) for arrays, message in ARRAYS),
        *(("", npz(header(descr, shape), bytes(80)), message) for descr, shape, message in HEADERS),
        ("", npz(header("'<f8'", "(536870812,)"), bytes(80), claimed=2**32 - 900),
         "'density.npy' claims 4294966396 bytes out of"),
        ("", npz(" " * (1 << 24), version=(2, 0)), "a header of 16777216 bytes"),
        ("", npz(header("'<f8'", "(10,)"), bytes(80), version=(9, 0)), "unknown .npy version"),
    ]
}  # fmt: skip


@pytest.mark.parametrize("name, file, damage, message", rows(FIELDS))
def test_wrong_field_files(tmp_path, name, file, damage, message):
    require_refused(name, tmp_path, {file: damage(whole(name)[file])}, message)


def test_archives_that_hold_much_in_little(tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    path.write_bytes(npz(header("'<f8'", "(1000000,)"), bytes(8 * 10**6))(b""))  # 8 kB hold 8 MB
    assert path.stat().st_size < 20_000
    monkeypatch.setattr("warpcage.core.npz.free_host_bytes", lambda: 10**6)
    refused(lambda: VoxelField.load(path), "bomb.npz", "its arrays claim 0.0 GiB", "0.0 GiB are free")
    np.savez_compressed(path, a=np.zeros(1000, np.uint8))
    data = bytearray(path.read_bytes())
    entry = data.index(b"PK\x01\x02")
    data[entry + 20 : entry + 28] = (1 << 30).to_bytes(4, "little") * 2  # both sizes in the list of members
    path.write_bytes(data)
    refused(lambda: read_npz(path, "file"), "its arrays claim 1073741824 packed bytes")


def test_archives_come_back_whole(tmp_path):
    arrays = {
        "a": np.arange(24.0).reshape(2, 3, 4),
        "f": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "text": np.array("warpcage"),
        "empty": np.zeros((0, 3)),
        "one": np.float16(1.5),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "file.npz", **arrays)
        read = read_npz(tmp_path / "file.npz", "file")
        assert read.keys() == arrays.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(read[name], array)
            assert read[name].dtype == np.asarray(array).dtype
    with pytest.raises(FileNotFoundError, match="camera file.*none.npz"):
        read_npz(tmp_path / "none.npz", "camera file")


# Saving

SAVES = """
    import os, pathlib, resource, signal, sys
    import numpy as np
    from warpcage import Cage, VoxelField
    from warpcage.studio.films.video import write_gif, write_video
    from warpcage.view.pictures import write_png
    rng = np.random.default_rng(0)
    density = np.ones((24, 24, 24))
    bounds = [[0, 0, 0], [1, 1, 1]]
    field = VoxelField.from_dense(density, rng.random((24, 24, 24, 9, 3)), bounds, device="cpu")
    noise = [rng.random((96, 96, 3)) for _ in range(4)]
    saves = {
        "field.npz": field.save,
        "svox2.npz": lambda path: field.save(path, format="svox2"),
        "cage.obj": Cage.box((0, 0, 0), (1, 1, 1), segments=8).save,
        "cage.ply": Cage.box((0, 0, 0), (1, 1, 1), segments=12).save,
        "image.png": lambda path: write_png(path, noise[0]),
        "film.gif": lambda path: write_gif(path, noise),
        "film.mp4": lambda path: write_video(path, noise),
    }
    def kill(*_):
        os.kill(os.getpid(), signal.SIGKILL)
    def save_all(folder):
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        for name, save in saves.items():
            try:
                save(folder / name)
            except (OSError, ValueError) as error:
                print(name, "refused", flush=True)
    def killed_at_the_end(folder):
        os.replace = kill
        saves["field.npz"](folder / "field.npz")
    def killed_in_between(folder):
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # the kernel ends the process in the middle of its write
        saves["field.npz"](folder / "field.npz")
    for work in (save_all, killed_at_the_end, killed_in_between):
        process = os.fork()
        if not process:
            work(pathlib.Path(sys.argv[1]) / work.__name__)
            os._exit(0)
        print(work.__name__, os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""

NAMES = ["field.npz", "svox2.npz", "cage.obj", "cage.ply", "image.png", "film.gif", "film.mp4"]


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder for each way to end, in which files were that others should take the place of, and what was said."""
    root = tmp_path_factory.mktemp("saves")
    for way in ("save_all", "killed_at_the_end", "killed_in_between"):
        (root / way).mkdir()
        (root / way / "field.npz").write_bytes(whole("field")["field.npz"])
    for name in NAMES:
        (root / "save_all" / name).write_bytes(b"previous")
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(SAVES), str(root)]
    child = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert child.returncode == 0, child.stderr
    return root, [tuple(line.split()) for line in child.stdout.splitlines()]


def test_a_full_disk_leaves_the_previous_file(saved):
    root, said = saved
    assert said[: len(NAMES) + 1] == [*((name, "refused") for name in NAMES), ("save_all", "0")]
    assert sorted(path.name for path in (root / "save_all").iterdir()) == sorted(NAMES)  # no leftovers
    assert all((root / "save_all" / name).read_bytes() == b"previous" for name in NAMES)


@pytest.mark.parametrize(
    "moment, ended", [("killed_at_the_end", signal.SIGKILL), ("killed_in_between", signal.SIGXFSZ)]
)
def test_a_killed_process_leaves_the_previous_file(saved, moment, ended):
    root, said = saved
    assert (moment, str(-ended)) in said
    assert (root / moment / "field.npz").read_bytes() == whole("field")["field.npz"]
    assert (
        len(list((root / moment).iterdir())) == 2
    )  # what the dead process had written lies beside it, by another name


def test_a_folder_that_takes_no_files_is_named_with_the_file(tmp_path, monkeypatch):
    def refuse(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(PermissionError) as error:
        small_field().save(tmp_path / "field.npz")
    assert error.value.filename == str(tmp_path / "field.npz")
