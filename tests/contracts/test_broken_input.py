"""Broken scenes: one clear line that names file and field, and nothing allocated on a claim."""

import json

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

from warpcage import Error, load_scene

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
    assert isinstance(caught.value, error) and isinstance(caught.value, Error) and "\n" not in message
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
    elif (folder / "transforms.json").is_file() or (folder / "sparse").is_dir():  # lists name pictures thrown away
        with pytest.warns(UserWarning, match=f"1 of them are not there .* {picture.name}"):
            load_scene(folder)
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
    """NeRF-synthetic scenes have an angle of view for all sizes: a smaller picture is one of fewer pixels there."""
    picture = a_picture(folder)
    write_image(picture, np.zeros((10, 12, 3), np.uint8))
    if (folder / "transforms_train.json").is_file():
        camera = load_scene(folder).cameras[1]
        assert (camera.width, camera.height) == (12, 10) and load_scene(folder).has_sizes
        return
    refuse(folder, f"{picture.name} | 12x10 | 24x20")


@EVERY
def test_picture_that_claims_a_huge_size(folder):
    from scene_writers import png_bytes

    picture = a_picture(folder)
    picture.write_bytes(png_bytes(50000, 50000, 8, 2, bytes(100)))
    refuse(folder, f"{picture.name} | cannot be read")


@EVERY
def test_no_such_split(folder):
    refuse(folder, "'evaluation' | splits: ", FileNotFoundError, split="evaluation")


@EVERY
def test_more_pictures_than_memory(folder, monkeypatch):
    monkeypatch.setattr("warpcage.scene.pictures.flight_bytes", lambda *view: 1000)
    monkeypatch.setattr("warpcage.scene.pictures.free_host_bytes", lambda: 14000)
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
        (lambda c: c.update(camera_model="FISHEYE_OF_OURS"), "camera_model 'FISHEYE_OF_OURS' is not read"),
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
        ({"world_mat_9": np.array([{}], object)}, "array 'world_mat_9' holds pickled objects, which are never opened"),
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
        ("cameras.txt", "2 PINHOLE", "2 LENS", "cameras.txt | 'LENS' is not read"),
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
