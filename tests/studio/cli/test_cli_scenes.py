"""`warpcage info` of everything there is, and pictures from a scene's cameras."""

import imageio.v3 as iio
import numpy as np
import pytest
from runs import DEFORMED, SMALL, succeed, write_files
from scene_writers import brick_pictures, write_colmap, write_dtu, write_nsvf, write_transforms

from warpcage import Cage, PoseFile, VoxelField, load_scene
from warpcage.studio.cli import main
from warpcage.view import read_image


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("info"))
    pictures = brick_pictures(10)
    write_nsvf(folder / "nsvf", pictures, "0" * 8 + "22")
    write_dtu(folder / "dtu", pictures)
    write_transforms(folder / "transforms", pictures)
    write_colmap(folder / "colmap", pictures, binary=True)
    return folder


def info(capsys, *argv):
    assert main(["info", *map(str, argv)]) == 0
    return {line.split("  ")[0]: line.split("  ", 1)[1].strip() for line in capsys.readouterr().out.splitlines()}


@pytest.mark.parametrize("name", ["nsvf", "dtu", "transforms", "colmap"])
def test_info_of_scenes(files, capsys, name):
    rows = info(capsys, files / name)
    assert (rows["kind"], rows["format"]) == ("scene", name)
    assert rows["pictures"] == "8 of 24x20" and rows["split"] == "train"
    assert rows["focal length"] == "29.5 to 31 pixels"
    assert rows["opacity"].startswith("yes, ") and rows["colours"].endswith("to 1 of 1")
    assert rows["bounds"] == {
        "nsvf": "[-1.5, -1.5, -1.5] to [1.5, 1.5, 1.5]",
        "dtu": "[-1.0, -1.0, -1.0] to [1.0, 1.0, 1.0]",
    }.get(name, "not given")
    assert info(capsys, files / name, "--split", "test")["pictures"] == "2 of 24x20"


@pytest.mark.parametrize("name", ["transforms/transforms.json", "colmap/sparse/0/cameras.bin"])
def test_info_of_a_file_of_a_scene_says_which_folder(files, capsys, name):
    assert main(["info", str(files / name)]) == 2
    error = capsys.readouterr().err
    assert f"part of the scene '{files / name.split('/')[0]}': give that" in error


def test_info_of_files(files, capsys):
    rows = info(capsys, files / "ball.npz")
    assert rows["kind"] == "field" and rows["resolution"] == "24x24x24"
    assert rows["density"] == "0 to 40 per world unit" and rows["file"] == "0.1 MB"
    rows = info(capsys, files / "cage.obj")
    assert rows["kind"] == "cage" and rows["vertices"] == "26" and rows["usable"] == "yes"


def test_info_of_poses(files, capsys, tmp_path):
    rest = Cage.load(files / "cage.obj")
    PoseFile(rest, {"up": rest.translate([0, 0, 0.5]), "still": rest}).save(tmp_path / "poses.json")
    rows = info(capsys, tmp_path / "poses.json")
    assert rows["kind"] == "poses" and rows["keyframes"] == "2" and rows["cage vertices"] == "26"
    assert rows["pose 'up'"] == "26 vertices moved by up to 0.5"
    assert rows["pose 'still'"] == "0 vertices moved by up to 0"
    (tmp_path / "other.json").write_text("[]")
    assert main(["info", str(tmp_path / "other.json")]) == 2
    assert "other.json" in capsys.readouterr().err


def test_contact_sheet(files, capsys, tmp_path):
    rows = info(capsys, files / "dtu", "--sheet", tmp_path / "sheet.png")
    assert rows["sheet"] == f"{tmp_path / 'sheet.png'}, 8 of 8 pictures"
    sheet, images = read_image(tmp_path / "sheet.png"), load_scene(files / "dtu").images
    assert sheet.shape == (3 * 20 + 2 * 4, 3 * 24 + 2 * 4, 3)
    np.testing.assert_allclose(sheet[:20, :24], images[0], atol=0.003)
    np.testing.assert_allclose(sheet[24:44, 28:52], images[4], atol=0.003)


def test_info_says_where_the_object_is(files, capsys, tmp_path):
    """How far outlines reach takes a device, and is found for a picture alone."""
    for name in ("transforms", "dtu"):
        assert "object" not in info(capsys, files / name)
        row = info(capsys, files / name, "--box", tmp_path / f"{name}.png", "--device", "cpu")["object"]
        assert row.endswith(f"within the object's outlines in the pictures; see {tmp_path / name}.png"), row
        picture = read_image(tmp_path / f"{name}.png")
        assert (np.ptp(picture.reshape(-1, 3), axis=0) > 0.6).all() and picture.shape[1] > 1000


def test_masks_can_be_left_alone(files, tmp_path, capsys):
    argv = ["--resolution", "16", "--epochs", "0.5", "--quiet"]
    for name, more in (("cut", []), ("whole", ["--no-masks", "--background", "black"])):
        assert main(["fit", str(files / "dtu"), "-o", str(tmp_path / f"{name}.npz"), *argv, *more]) == 0
    cut, whole = (VoxelField.load(tmp_path / f"{name}.npz") for name in ("cut", "whole"))
    np.testing.assert_allclose(whole.bounds, [[-1] * 3, [1] * 3])  # the unit sphere, nothing says more
    assert np.abs(cut.bounds - whole.bounds).max() > 0.01  # the silhouettes
    scores = []
    for more in ([], ["--no-masks"]):
        assert main(["evaluate", str(tmp_path / "whole.npz"), str(files / "dtu"), "--quiet", *more]) == 0
        scores.append(capsys.readouterr().out.splitlines()[-1])
    assert scores[0] != scores[1]


def test_film_of_a_pose_through_the_cameras(files, tmp_path):
    argv = ["--cameras", "interpolate", "--scene", "@colmap:test", *DEFORMED, *SMALL[2:], "--overlay"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "way.gif", *argv)
    assert iio.imread(tmp_path / "way.gif").shape[:3] == (9, 20, 24)
