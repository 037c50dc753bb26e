"""Broken archives and field files: one clear line, nothing unpickled, nothing allocated on a claim. What is saved is
whole or not there."""

import io
import os
import pathlib
import pickle
import signal
import subprocess
import sys
import textwrap
import zipfile

import numpy as np
import pytest

from warpcage import VoxelField
from warpcage.core import read_npz

# Archives and field files


class Trap:
    """Unpickling this leaves a file behind."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return pathlib.Path.touch, (self.path,)


def small_field():
    density = np.zeros((6, 6, 6))
    density[2:4, 2:4, 2:4] = 3.0
    return VoxelField.from_dense(density, np.zeros((6, 6, 6, 9, 3)), [[0, 0, 0], [1, 1, 1]])


def refuse_field(path, words):
    with pytest.raises(ValueError) as caught:
        VoxelField.load(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in (str(path), *words.split(" | ")):
        assert word in message, message


def test_pickled_objects_are_never_opened(tmp_path):
    path, sprung = tmp_path / "field.npz", tmp_path / "sprung"
    small_field().save(path)
    contents = dict(np.load(path))
    np.savez(path, **contents, weights=np.array([Trap(sprung)], object))
    refuse_field(path, "array 'weights' holds pickled objects, which are never opened")
    np.savez(path, **contents, extra=np.array([Trap(sprung)], object))  # which nothing asks for
    VoxelField.load(path)
    assert not sprung.exists()
    path.write_bytes(pickle.dumps(Trap(sprung)))
    refuse_field(path, "is not an .npz field file")
    assert not sprung.exists()
    pickle.loads(path.read_bytes())  # the trap would have worked
    assert sprung.exists()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_field_file_cut_off(tmp_path, share):
    path = tmp_path / "field.npz"
    small_field().save(path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refuse_field(path, f"is not an .npz field file: | {'cut off or damaged' if share else 'something else'}")


@pytest.mark.parametrize(
    "changes, words",
    [
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
        ({"format": "warpcage fit"}, "is the checkpoint of a fit, not yet a field"),
        ({"format": None}, "neither a warpcage nor a Plenoxels field: it holds background"),
    ],
)
def test_wrong_field_files(tmp_path, changes, words):
    path = tmp_path / "field.npz"
    small_field().save(path)
    contents = {name: array for name, array in {**np.load(path), **changes}.items() if array is not None}
    np.savez(path, **contents)
    refuse_field(path, words)


def write_npz(path, name, header, body, claimed=None):
    """An .npz with one member: an .npy header, then the body; `claimed` overwrites the size in the directory."""
    member = io.BytesIO()
    np.lib.format.write_array_header_1_0(member, header)
    member.write(body)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.npy", member.getvalue())
    if claimed is not None:
        data = path.read_bytes()
        size = len(member.getvalue()).to_bytes(4, "little")
        path.write_bytes(data.replace(size, claimed.to_bytes(4, "little")))


def test_sizes_that_are_only_claimed(tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
    write_npz(path, "density", header, bytes(80))  # the array's header claims 8 TB
    refuse_field(path, "'density' claims 8000000000000 bytes (1000000, 1000000), the file has 80")
    header["shape"] = (2**29 - 100,)
    write_npz(path, "density", header, bytes(80), claimed=2**32 - 900)  # and so does the archive
    refuse_field(path, "'density.npy' claims 4294966396 bytes out of")
    write_npz(path, "density", {**header, "shape": (10**7,)}, bytes(8 * 10**7))  # a real one: 80 kB hold 80 MB
    assert path.stat().st_size < 200_000
    monkeypatch.setattr("warpcage.core.files.free_host_bytes", lambda: 10**7)
    refuse_field(path, "its arrays claim 0.1 GiB | 0.0 GiB are free")
    write_npz(path, "density", {**header, "descr": "|O"}, bytes(80))
    refuse_field(path, "pickled objects")


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
    from warpcage.view.film import write_gif, write_video
    from warpcage.view.pictures import write_png
    folder, how = pathlib.Path(sys.argv[1]), sys.argv[2]
    rng = np.random.default_rng(0)
    density = np.ones((24, 24, 24))
    field = VoxelField.from_dense(density, rng.random((24, 24, 24, 9, 3)), [[0, 0, 0], [1, 1, 1]])
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
    if how == "full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        for name, save in saves.items():
            try:
                save(folder / name)
            except (OSError, ValueError) as error:
                print(name, "refused")
    elif how == "killed at the end":
        os.replace = kill
        saves["field.npz"](folder / "field.npz")
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # the kernel ends the process in the middle of its write
        saves["field.npz"](folder / "field.npz")
"""


def save_in_child(folder, how):
    environment = {**os.environ, "WARP_CACHE_PATH": os.environ.get("WARP_CACHE_PATH", "")}
    if not environment["WARP_CACHE_PATH"]:
        del environment["WARP_CACHE_PATH"]
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(SAVES), str(folder), how],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_a_full_disk_leaves_the_previous_file(tmp_path):
    names = ["field.npz", "svox2.npz", "cage.obj", "cage.ply", "image.png", "film.gif", "film.mp4"]
    for name in names:
        (tmp_path / name).write_bytes(b"previous")
    child = save_in_child(tmp_path, "full")
    assert child.returncode == 0, child.stderr
    refused = [line.split()[0] for line in child.stdout.splitlines() if line.endswith("refused")]
    assert refused == names
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)  # no leftovers
    assert all((tmp_path / name).read_bytes() == b"previous" for name in names)


@pytest.mark.parametrize("how, ended", [("killed at the end", signal.SIGKILL), ("killed in between", signal.SIGXFSZ)])
def test_a_killed_process_leaves_the_previous_file(tmp_path, how, ended):
    path = tmp_path / "field.npz"
    field = small_field()
    field.save(path)
    before = path.read_bytes()
    child = save_in_child(tmp_path, how)
    assert child.returncode == -ended, child.stderr
    assert path.read_bytes() == before
    assert VoxelField.load(path).voxel_count == field.voxel_count
    assert len(list(tmp_path.iterdir())) == 2  # what the dead process had written lies beside it, under another name


def test_a_folder_that_takes_no_files_is_named_with_the_file(tmp_path, monkeypatch):
    def refuse(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(PermissionError) as error:
        small_field().save(tmp_path / "field.npz")
    assert error.value.filename == str(tmp_path / "field.npz")
