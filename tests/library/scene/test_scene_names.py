"""Names and numbers as other machines write them: encodings, byte order marks, decimal commas, paths of elsewhere."""

import codecs
import json
import os
import pathlib
import unicodedata
import warnings

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from scene_readers import load, require_equal
from scene_writers import brick_pictures, write_colmap, write_image, write_nsvf, write_transforms

import warpcage
from warpcage import load_scene
from warpcage.scene.formats.transforms import TransformsCameras


@pytest.fixture(scope="module")
def bricks():
    return brick_pictures(3)


WORDS = {"gbk": "\u6a21\u578b\u7167\u7247", "shift_jis": "\u5199\u771f\u8868\u30bd", "utf-8": "\u00e9t\u00e9"}


def renamed_model(folder, pictures, encoding, *, binary, disk):
    """A COLMAP model with names in an encoding; disk: how the files are called, by the name."""
    write_colmap(folder, pictures, binary=binary)
    listing = folder / "sparse" / "0" / f"images.{'bin' if binary else 'txt'}"
    data = listing.read_bytes()
    for name in pictures.names:
        other = f"{WORDS[encoding]} {name}.png"
        data = data.replace(f"{name}.png".encode(), other.encode(encoding))
        (folder / "images" / f"{name}.png").rename(disk(folder / "images", other))
    listing.write_bytes(data)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("encoding", WORDS)
def test_colmap_names_in_other_encodings(tmp_path, bricks, encoding, binary):
    renamed_model(tmp_path, bricks, encoding, binary=binary, disk=lambda folder, name: folder / name)
    scene = load(tmp_path, split="all")
    require_equal(scene, bricks)
    assert scene.names == [f"{WORDS[encoding]} {name}" for name in bricks.names]


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_names_whose_files_have_the_same_bytes(tmp_path, bricks, binary):
    def on_disk(folder, name):
        path = folder / os.fsdecode(name.encode("gbk"))
        try:
            path.touch()
        except OSError as error:
            pytest.skip(f"names must be UTF-8 here: {error}")
        return path

    renamed_model(tmp_path, bricks, "gbk", binary=binary, disk=on_disk)
    scene = load(tmp_path, split="all")
    require_equal(scene, bricks)
    assert all(name.isprintable() and name.encode() for name in scene.names)


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_accents_may_be_letters_of_their_own(tmp_path, bricks, form):
    other = {"NFC": "NFD", "NFD": "NFC"}[form]
    write_transforms(tmp_path, bricks)
    text = (tmp_path / "transforms.json").read_text()
    for name in bricks.names:
        on_disk = unicodedata.normalize(form, f"\u00e9t\u00e9 {name}.png")
        (tmp_path / "images" / f"{name}.png").rename(tmp_path / "images" / on_disk)
        text = text.replace(f"images/{name}.png", unicodedata.normalize(other, f"images/\u00e9t\u00e9 {name}.png"))
    (tmp_path / "transforms.json").write_text(text)
    require_equal(load(tmp_path, split="all"), bricks)


def text_files(folder):
    return [path for path in folder.rglob("*") if path.suffix in (".txt", ".json")]


def rewrite(folder, change):
    for path in text_files(folder):
        path.write_bytes(change(path.read_text()))


FORMATS = {
    "transforms": (lambda folder, pictures: write_transforms(folder, pictures), "all"),
    "colmap": (lambda folder, pictures: write_colmap(folder, pictures, binary=False, points=np.eye(3)), "all"),
    "nsvf": (lambda folder, pictures: write_nsvf(folder, pictures, "000"), "train"),
}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("mark", ["utf-8-sig", "utf-16"])
def test_marks_of_byte_order(tmp_path, bricks, name, mark):
    write, split = FORMATS[name]
    write(tmp_path, bricks)
    rewrite(tmp_path, lambda text: text.encode(mark))
    first = text_files(tmp_path)[0].read_bytes()
    assert first.startswith((codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    require_equal(load(tmp_path, split=split), bricks)


@pytest.mark.parametrize("name", ["colmap", "nsvf"])
def test_decimal_commas(tmp_path, bricks, name):
    write, split = FORMATS[name]
    write(tmp_path, bricks)
    rewrite(tmp_path, lambda text: text.replace(".png", "_png").replace(".", ",").replace("_png", ".png").encode())
    require_equal(load(tmp_path, split=split), bricks)
    mixed = next(path for path in text_files(tmp_path) if path.name in ("images.txt", "intrinsics.txt"))
    mixed.write_text(mixed.read_text().replace(",", ".", 1))
    refused(lambda: load(tmp_path, split=split), match=f"{mixed.name}.*decimal commas beside points")


ELSEWHERE = ["/home/somebody/capture/images/", "C:\\Users\\somebody\\capture\\images\\", "../capture/images/", "D:/x/"]
ELSEWHERE += ["file:///home/somebody/images/"]


@pytest.mark.parametrize("start", ELSEWHERE)
@pytest.mark.parametrize("name", ["transforms", "colmap"])
def test_paths_of_another_machine(tmp_path, bricks, name, start):
    """Files of such names in the folder are taken, and it is said once."""
    FORMATS[name][0](tmp_path, bricks)
    listing = tmp_path / {"transforms": "transforms.json", "colmap": "sparse/0/images.txt"}[name]
    text, plain = listing.read_text(), {"transforms": "images/view_", "colmap": "view_"}[name]
    written = json.dumps(start)[1:-1] if name == "transforms" else start
    listing.write_text(text.replace(plain, f"{written}view_"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        require_equal(load(tmp_path, split="all"), bricks)
    assert [MESSAGES["scene.moved"] in str(warning.message) for warning in caught] == [True]
    assert pathlib.Path(caught[0].filename).name == "scene_readers.py"  # where it was called
    listing.write_text(text.replace(plain, f"{written}other/sub/view_"))
    with pytest.warns(UserWarning, match=MESSAGES["scene.moved"]):
        require_equal(load(tmp_path, split="all"), bricks)


@pytest.mark.parametrize("start", [start for start in ELSEWHERE if not start.startswith("..")])
def test_paths_of_another_machine_may_be_missing(tmp_path, bricks, start):
    """As other names that are not there: left out, and counted."""
    write_transforms(tmp_path, bricks)
    listing = tmp_path / "transforms.json"
    listing.write_text(listing.read_text().replace("images/view_", f"{json.dumps(start)[1:-1]}view_"))
    (tmp_path / "images" / "view_01.png").unlink()
    with pytest.warns(UserWarning, match="left out, the first is view_01.png"):
        assert len(load(tmp_path, split="all").names) == len(bricks.names) - 1


@pytest.mark.parametrize("name", ["transforms", "colmap"])
def test_endings_in_other_letters(tmp_path, bricks, name):
    """IMG.JPG in place of IMG.jpg, as programs and file systems change them."""
    FORMATS[name][0](tmp_path, bricks)
    for picture in (tmp_path / "images").iterdir():
        picture.rename(picture.with_suffix(".PNG"))
    require_equal(load(tmp_path, split="all"), bricks)


@pytest.mark.parametrize("start", ["", *ELSEWHERE])
@pytest.mark.parametrize("name", ["transforms", "colmap"])
def test_endings_that_changed(tmp_path, bricks, name, start):
    """/home/somebody/capture/images/1.jpeg where images/1.png is there; of several that it may be, none is taken."""
    FORMATS[name][0](tmp_path, bricks)
    listing = tmp_path / {"transforms": "transforms.json", "colmap": "sparse/0/images.txt"}[name]
    plain = {"transforms": "images/view_", "colmap": "view_"}[name]
    written = (
        f"{json.dumps(start)[1:-1]}view_" if start and name == "transforms" else f"{start}view_" if start else plain
    )
    listing.write_text(listing.read_text().replace(plain, written).replace(".png", ".jpeg"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        require_equal(load(tmp_path, split="all"), bricks)
    (message,) = (str(warning.message) for warning in caught)
    assert "3 files with another ending, the first is " in message and (MESSAGES["scene.moved"] in message) == bool(
        start
    )
    (tmp_path / "images" / "view_01.png").with_suffix(".webp").write_bytes(b"")
    refused(lambda: load(tmp_path, split="all"), match=MESSAGES["scene.ending_of_several"])


@pytest.mark.parametrize("name", ["transforms", "colmap"])
def test_pictures_of_rigs_keep_their_folders_in_every_split(tmp_path, name):
    """Where two have one name, all splits have the folders, also those in which no two have: in evaluations and camera
    files, and where a picture's camera is asked for."""
    pictures = brick_pictures(9)
    files = [f"rig{k % 2}/{k // 2:04d}.png" for k in range(8)] + ["rig0/0009.png"]
    FORMATS[name][0](tmp_path / "scene", pictures)
    for old, new in zip(pictures.names, files, strict=True):
        (tmp_path / "scene/images" / new).parent.mkdir(exist_ok=True)
        (tmp_path / f"scene/images/{old}.png").rename(tmp_path / "scene/images" / new)
        rewrite(tmp_path / "scene", lambda text, old=old, new=new: text.replace(f"{old}.png", new).encode())
    expected = sorted(file.removesuffix(".png") for file in files)
    test, train = load(tmp_path / "scene", split="test"), load(tmp_path / "scene")
    assert test.names == expected[::8] and sorted(test.names + train.names) == expected
    field = warpcage.VoxelField.from_dense(
        np.ones((4, 4, 4)), np.zeros((4, 4, 4, 9, 3)), [[-1] * 3, [1] * 3], device="cpu"
    )
    assert [row["view"] for row in warpcage.evaluate(field, test)] == test.names
    again = load(tmp_path / "scene", split="test", cameras=saved(test, tmp_path / "cameras.json"))
    assert again.names == test.names
    if name == "transforms":
        path = tmp_path / "scene/transforms.json"
        for asked, row in {"rig1/0001": 3, "0009": 8, "1": 7}.items():  # of the picture, or the number of the frame
            found = TransformsCameras(path).camera(asked)
            np.testing.assert_allclose(found.camera_to_world, pictures.cameras[row].camera_to_world)
        refused(lambda: TransformsCameras(path).camera("0001"), match=MESSAGES["scene.rig_frames"])
    test.save(tmp_path / "saved")
    assert sorted(load(tmp_path / "saved", split="all").names) == [each.replace("/", "_") for each in test.names]


def saved(scene, path):
    keys = [warpcage.CameraKey(camera, name=name) for name, camera in zip(scene.names, scene.cameras, strict=True)]
    warpcage.CameraFile(keys).save(path)
    return path


@pytest.mark.parametrize(
    "files, expected",
    [
        ("images/a.png images/b.png", "a b"),
        ("a/left/1.png b/left/1.png b/right/1.png", "a/left/1 b/left/1 b/right/1"),
        ("images/1.png images/rig/1.png", "images/1 rig/1"),
        ("images/1.png images/1.jpg images/2.jpg", "1.png 1.jpg 2.jpg"),
        ("r/1.png r/1.jpg s/1.jpg", "r/1.png r/1.jpg s/1.jpg"),
    ],
)
def test_names_tell_pictures_apart_by_as_little_as_it_takes(tmp_path, files, expected):
    pictures, files = brick_pictures(len(files.split())), files.split()
    write_transforms(tmp_path, pictures)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame, file in zip(reversed(content["frames"]), files, strict=True):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / file, np.zeros((20, 24, 3), np.uint8))
        frame["file_path"] = file
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert sorted(load_scene(tmp_path, split="all").names) == sorted(expected.split())


def test_no_file_outside_of_the_folder_is_taken(tmp_path, bricks):
    write_transforms(tmp_path / "scene", bricks)
    path = tmp_path / "scene" / "transforms.json"
    outside = tmp_path / "images" / "outside.png"
    outside.parent.mkdir()
    outside.write_bytes((tmp_path / "scene" / "images" / "view_00.png").read_bytes())
    original = path.read_text()
    for name in (str(outside), "../images/outside.png", "images/../../images/outside.png"):
        path.write_text(original.replace("images/view_00.png", name))
        refused(lambda: load_scene(tmp_path / "scene"), match="leads out of the data folder")
