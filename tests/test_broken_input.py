"""Broken data: one clear line that names file and field, nothing unpickled, nothing allocated on a claim; and what is
saved is whole or not there."""

import io
import json
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
from scene_writers import (
    brick_pictures,
    write_blender,
    write_colmap,
    write_dtu,
    write_image,
    write_nsvf,
    write_transforms,
)

from warpcage import VoxelField, load_scene
from warpcage.core.files import read_npz

WRITERS = {
    "blender": write_blender,
    "nsvf": lambda folder, pictures: write_nsvf(folder, pictures, "000"),
    "dtu": write_dtu,
    "transforms": lambda folder, pictures: write_transforms(folder, pictures, masks=True),
    "colmap": lambda folder, pictures: write_colmap(folder, pictures, binary=False),
}


@pytest.fixture(scope="module")
def pictures():
    return brick_pictures(3)


@pytest.fixture
def folder(tmp_path, pictures, request):
    WRITERS[request.param](tmp_path, pictures)
    load_scene(tmp_path, format=request.param)
    return tmp_path


def refuse(folder, words, error=ValueError, **options):
    """load_scene refuses the folder in one line that holds all the words."""
    with pytest.raises(error) as caught:
        load_scene(folder, **options)
    message = str(caught.value)
    assert type(caught.value) is error and "\n" not in message
    for word in words.split(" | "):
        assert word in message, message


def a_picture(folder):
    """A picture of the training split."""
    return sorted(path for path in folder.rglob("*.png") if path.parent.name not in ("mask", "masks"))[1]


def edit_json(folder, change):
    path = next(folder.glob("transforms*.json"))
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


# Pictures, in every format

EVERY = pytest.mark.parametrize("folder", WRITERS, indirect=True)


@EVERY
def test_missing_picture(folder):
    picture = a_picture(folder)
    picture.unlink()
    if (folder / "image").is_dir():  # DTU pairs by order: it is the number that tells
        refuse(folder, "2 images and 3 masks")
    elif (folder / "rgb").is_dir():  # NSVF lists the folder itself
        assert len(load_scene(folder)) == 2
    else:
        refuse(folder, f"{picture.name} | is not there", FileNotFoundError)


@EVERY
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.9])
def test_truncated_picture(folder, share):
    picture = a_picture(folder)
    content = picture.read_bytes()
    picture.write_bytes(content[: int(share * len(content))])
    refuse(folder, f"{picture.name} | cannot be read")


@EVERY
def test_picture_of_another_size(folder):
    picture = a_picture(folder)
    write_image(picture, np.zeros((10, 12, 3), np.uint8))
    refuse(folder, f"{picture.name} | 12x10 | 24x20")


@EVERY
def test_picture_that_claims_a_huge_size(folder):
    from test_images import png_bytes

    picture = a_picture(folder)
    picture.write_bytes(png_bytes(50000, 50000, 8, 2, bytes(100)))
    refuse(folder, f"{picture.name} | cannot be read")


@EVERY
def test_no_such_split(folder):
    refuse(folder, "'evaluation' | splits: ", FileNotFoundError, split="evaluation")


@EVERY
def test_more_pictures_than_memory(folder, monkeypatch):
    monkeypatch.setattr("warpcage.scene.formats.views.free_host_bytes", lambda: 20000)
    refuse(folder, "pictures of 24x20 need | give downscale=2 or more")
    assert load_scene(folder, downscale=2).images.shape[1:] == (10, 12, 3)


# Cameras


@pytest.mark.parametrize("folder", ["blender", "transforms"], indirect=True)
@pytest.mark.parametrize(
    "change, words",
    [
        (
            lambda c: c["frames"][0]["transform_matrix"][1].__setitem__(2, float("nan")),
            "frame 0: transform_matrix[1][2] | finite",
        ),
        (lambda c: c["frames"][0].update(transform_matrix=np.zeros((4, 4)).tolist()), "frame 0 | rotation"),
        (lambda c: c["frames"][0].update(transform_matrix=(2 * np.eye(4)).tolist()), "frame 0 | rotation"),
        (lambda c: c["frames"][0].update(transform_matrix=[[1, 2], [3, 4]]), "frame 0: transform_matrix | 4x4"),
        (lambda c: c["frames"][0].pop("transform_matrix"), "frame 0: transform_matrix | None"),
        (lambda c: c["frames"][0].pop("file_path"), "frame 0: file_path"),
        (lambda c: c["frames"][0].update(file_path=7), "frame 0: file_path | 7"),
        (lambda c: c["frames"].append(c["frames"][0]), "frame 3 | listed twice | frame 0"),
        (lambda c: c.update(frames=[]), "no frames"),
        (lambda c: c.update(frames=[1]), "frame 0 must be a JSON object"),
        (lambda c: c["frames"][0].update(file_path="../../outside.png"), "file_path | out of the data folder"),
        (lambda c: c["frames"][0].update(file_path="/etc/passwd"), "file_path | out of the data folder"),
        (lambda c: c["frames"][0].update(file_path="images\\..\\..\\outside"), "file_path | out of the data folder"),
    ],
)
def test_wrong_json(folder, change, words):
    edit_json(folder, change)
    refuse(folder, f"transforms | .json | {words}", split="all" if (folder / "transforms.json").exists() else "train")


@pytest.mark.parametrize("folder", ["transforms"], indirect=True)
@pytest.mark.parametrize(
    "change, words",
    [
        (lambda c: c.update(fl_x="wide"), "fl_x | finite number | 'wide'"),
        (lambda c: c.update(fl_x=-3), "fl_x must be positive"),
        (lambda c: (c.pop("fl_x"), c.pop("fl_y")), "no fl_x and no camera_angle_x"),
        (lambda c: c.update(w=48), "48x20 | has 24x20"),
        (lambda c: c.pop("h"), ": h must be a finite number"),
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "camera_model 'OPENCV_FISHEYE' is not read"),
        (lambda c: c.update(is_fisheye=True), "is_fisheye is not read"),
        (lambda c: c.update(k4=0.1), "k4"),
        (lambda c: c.update(k1=1e9), "lens distortion k1=1e+09"),
        (lambda c: c.update(k1=10**400), "k1 must be a finite number"),
        (lambda c: c["frames"][1].update(mask_path="../mask.png"), "mask_path | out of the data folder"),
        (lambda c: c.update(applied_transform=np.zeros((3, 4)).tolist()), "applied_transform is singular"),
        (lambda c: c.update(ply_file_path="../points.ply"), "ply_file_path | out of the data folder"),
        (lambda c: c.update(applied_transform=5), "applied_transform must be a 4x4 matrix"),
        (lambda c: c.update(train_filenames=["images/other.png"]), "train_filenames names 'other.png'"),
        (lambda c: c.update(train_filenames=[]), "train_filenames must list"),
        (lambda c: c.update(train_filenames=["images/view_01.png"] * 2), "listed twice"),
    ],
)
def test_wrong_transforms(folder, change, words):
    edit_json(folder, change)
    refuse(folder, f"transforms.json | {words}")


@pytest.mark.parametrize("folder", ["transforms"], indirect=True)
def test_wrong_masks(folder):
    mask = folder / "masks" / "view_01.png"
    write_image(mask, np.zeros((4, 4), np.uint8))
    refuse(folder, "mask 'view_01.png' is 4x4")
    mask.unlink()
    refuse(folder, "masks/view_01.png | is not there", FileNotFoundError)
    assert load_scene(folder, masks=False).alphas is None


@pytest.mark.parametrize("folder", ["blender", "transforms"], indirect=True)
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_json_cut_off(folder, share):
    path = next(folder.glob("transforms*.json"))
    path.write_text(path.read_text()[: int(share * path.stat().st_size)])
    refuse(folder, f"{path.name} is no JSON file")


@pytest.mark.parametrize("folder", ["blender"], indirect=True)
@pytest.mark.parametrize(
    "content, words",
    [
        (b"\xff\xfe{", "no JSON file"),
        (b"[" * 100000, "no JSON file"),
        (b"[1]", "must hold a JSON object"),
        (b"{}", "no scene of a known format"),
    ],
)
def test_json_of_another_kind(folder, content, words):
    (folder / "transforms_train.json").write_bytes(content)
    refuse(folder, words)


@pytest.mark.parametrize("folder", ["nsvf"], indirect=True)
@pytest.mark.parametrize(
    "file, content, words",
    [
        ("pose/0_view_01.txt", None, "0_view_01.txt | is not there"),
        ("pose/0_view_01.txt", "1 0 0", "0_view_01.txt | 4x4 pose expected, got 3 numbers"),
        ("pose/0_view_01.txt", "nan " * 16, "0_view_01.txt | not finite"),
        ("pose/0_view_01.txt", "one " * 16, "0_view_01.txt | 'one'"),
        ("pose/0_view_01.txt", "0 " * 16, "0_view_01.txt | rotation"),
        ("intrinsics.txt", "", "intrinsics.txt | got 0 numbers"),
        ("intrinsics.txt", "-30 0 12 0 30 10 0 0 1", "focal lengths must be positive"),
        ("intrinsics.txt", "30 1 12 0 30 10 0 0 1", "intrinsics.txt | skew"),
        ("bbox.txt", "1 1 1 0 0 0", "bbox.txt | lower below upper"),
        ("bbox.txt", "1 1", "bbox.txt | got 2 numbers"),
    ],
)
def test_wrong_nsvf(folder, file, content, words):
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content)
    refuse(folder, words, ValueError if content is not None else FileNotFoundError)


@pytest.mark.parametrize("folder", ["dtu"], indirect=True)
@pytest.mark.parametrize(
    "changes, words",
    [
        ({"world_mat_1": None}, "lacks world_mat_1"),
        ({"world_mat_1": np.full((4, 4), np.nan)}, "world_mat_1 must be a finite 4x4 matrix"),
        ({"world_mat_1": np.ones((4, 4))}, "world_mat_1 @ scale_mat_1 is singular"),
        ({"world_mat_1": np.ones((2, 2))}, "world_mat_1 must be a finite 4x4"),
        ({"scale_mat_1": np.zeros((4, 4))}, "is singular"),
        ({"scale_mat_1": np.array(["a"])}, "scale_mat_1 must be"),
        ({"scale_mat_1": np.eye(4) + np.eye(4, k=1) * [0, 0.5, 0, 0]}, "skew"),
        ({"extra": np.array([{}], object)}, "array 'extra' holds pickled objects, which are never opened"),
    ],
)
def test_wrong_dtu(folder, changes, words):
    path = folder / "cameras_sphere.npz"
    contents = {name: array for name, array in {**np.load(path), **changes}.items() if array is not None}
    np.savez(path, **contents)
    refuse(folder, f"cameras_sphere.npz | {words}")


@pytest.mark.parametrize("folder", ["colmap"], indirect=True)
@pytest.mark.parametrize(
    "file, old, new, words",
    [
        ("images.txt", "view_01.png", "../../outside.png", "images.txt | out of the data folder"),
        ("images.txt", "view_01.png", "view_02.png", "view_02.png | listed twice"),
        ("cameras.txt", "2 PINHOLE", "9 PINHOLE", "camera 2, which | cameras.txt lacks"),
        ("cameras.txt", "2 PINHOLE", "2 FOV", "cameras.txt | 'FOV' is not read"),
        ("cameras.txt", "2 PINHOLE", "2 OPENCV", "camera 2 needs 8 parameters"),
        ("cameras.txt", "2 PINHOLE", "two PINHOLE", "cameras.txt:3 | 'two'"),
        ("cameras.txt", "2 PINHOLE 24 20 31.0", "2 PINHOLE 24 20 nan", "cameras.txt:3 | not finite"),
        ("cameras.txt", "2 PINHOLE 24 20", "2 PINHOLE 48 40", "camera is for 48x40 pixels"),
        ("cameras.txt", "2 PINHOLE", "2", "cameras.txt:3"),
    ],
)
def test_wrong_colmap(folder, file, old, new, words):
    path = folder / "sparse" / "0" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    refuse(folder, words)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_binary_colmap_cut_off(tmp_path, pictures, name):
    write_colmap(tmp_path, pictures, binary=True, points=np.eye(3))
    path = tmp_path / "sparse" / "0" / name
    content = path.read_bytes()
    for size in (0, 5, 8, 40, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        refuse(tmp_path, name)
    path.write_bytes(b"\xff" * 8 + content[8:])  # a count beyond all bounds
    refuse(tmp_path, f"{name} | announces 18446744073709551615 records")


def test_an_empty_split(tmp_path, pictures):
    write_dtu(tmp_path / "dtu", pictures.pick([0]))
    refuse(tmp_path / "dtu", "split 'train' | is empty")
    assert len(load_scene(tmp_path / "dtu", split="test")) == 1
    (tmp_path / "nsvf" / "rgb").mkdir(parents=True)
    (tmp_path / "nsvf" / "pose").mkdir()
    (tmp_path / "nsvf" / "intrinsics.txt").write_text("30 12 10 0\n")
    refuse(tmp_path / "nsvf", "rgb | holds no pictures", FileNotFoundError)
    write_colmap(tmp_path / "colmap", pictures, binary=False)
    (tmp_path / "colmap" / "sparse" / "0" / "images.txt").write_text("# none\n")
    refuse(tmp_path / "colmap", "images.txt holds no images")


def test_a_format_that_is_not_there(tmp_path, pictures):
    write_blender(tmp_path, pictures)
    for name, words in {"nsvf": "intrinsics.txt", "dtu": "cameras_sphere.npz", "colmap": "no COLMAP model"}.items():
        refuse(tmp_path, words, FileNotFoundError, format=name)


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
    np.savez(path, **contents, extra=np.array([Trap(sprung)], object))
    refuse_field(path, "array 'extra' holds pickled objects, which are never opened")
    path.write_bytes(pickle.dumps(Trap(sprung)))
    refuse_field(path, "is no .npz field file")
    assert not sprung.exists()
    pickle.loads(path.read_bytes())  # the trap would have worked
    assert sprung.exists()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_field_file_cut_off(tmp_path, share):
    path = tmp_path / "field.npz"
    small_field().save(path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refuse_field(path, "is no .npz field file")


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
        ({"format": "warpcage fit"}, "is the checkpoint of a fit, no field yet"),
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
    refuse_field(path, "its arrays claim 0.1 GiB, 0.0 GiB are free")
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
    from warpcage.images import write_gif, write_png, write_video
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
    def refuse(**names):
        raise PermissionError(13, "Permission denied", str(tmp_path / ".field-abc.npz"))

    monkeypatch.setattr("tempfile.mkstemp", refuse)
    with pytest.raises(PermissionError) as error:
        small_field().save(tmp_path / "field.npz")
    assert error.value.filename == str(tmp_path / "field.npz")
