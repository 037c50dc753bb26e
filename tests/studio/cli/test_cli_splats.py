"""Commands on files of splats: described, caged, checked, posed, rendered, filmed, and what they refuse."""

import numpy as np
import pytest
from splat_scenes import splats_in_box

import warpcage
from warpcage.studio.cli import main

BAKE = ("bake", "scene.ply", "--cage", "cage.obj", "--posed", "twist:40", "--coordinates", "mean_value")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A field of splats and a cage around it."""
    monkeypatch.chdir(tmp_path)
    splats_in_box("cpu", count=400, scales=(-3.5, -2.8), degree=1).save("scene.ply")
    warpcage.Cage.box((-1, -1, -1), (1, 1, 1), segments=2).save("cage.obj")
    return tmp_path


def twisted():
    field, cage = warpcage.SplatField.load("scene.ply", device="cpu"), warpcage.Cage.load("cage.obj")
    return warpcage.Deformer(field, cage, coordinates="mean_value").pose(cage.twist(40)).baked()


def said(capsys):
    captured = capsys.readouterr()
    return captured.out + captured.err


def test_info_distinguishes_splats_from_cages(folder, capsys):
    assert main(["info", "scene.ply"]) == 0
    text = said(capsys)
    assert "kind" in text and "splats" in text and "400" in text and "degree 1" in text and "26 properties" in text
    warpcage.Cage.box((0, 0, 0), (1, 1, 1)).save("cage.ply")
    assert main(["info", "cage.ply"]) == 0
    assert "cage" in said(capsys)


def test_a_cage_is_made_and_checked(folder, capsys):
    assert main(["cage", "scene.ply", "-o", "wrapped.obj", "--vertices", "60", "--method", "voxel"]) == 0
    cage = warpcage.Cage.load("wrapped.obj")
    field = warpcage.SplatField.load("scene.ply", device="cpu")
    assert cage.contains(field.contents.centers).mean() > 0.99
    assert main(["check", "wrapped.obj", "--object", "scene.ply"]) == 0
    assert "the visible object enclosed" in said(capsys)
    assert main(["cage", "scene.ply", "-o", "part.obj", "--box", "--in-box", "0", "-1", "-1", "1", "1", "1"]) == 0
    assert warpcage.Cage.load("part.obj").bounds[0][0] > -0.2
    text = said(capsys)
    assert "visible cells outside the box" in text and "voxel" not in text


@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "splat", "spz"])
def test_a_pose_is_baked(ending, folder, capsys):
    assert main([*BAKE, "-o", f"posed.{ending}"]) == 0
    posed = warpcage.SplatField.load(f"posed.{ending}", device="cpu")
    assert f"{posed.splat_count} splats" in said(capsys) and posed.splat_count >= 400
    np.testing.assert_allclose(posed.contents.centers, twisted().contents.centers, atol=2e-3)


def test_a_sequence_of_files(folder, capsys):
    assert main([*BAKE, "-o", "walk_##.ply", "--frames", "3"]) == 0
    assert "3 files" in said(capsys)
    names = sorted(path.name for path in folder.glob("walk_*"))
    assert names == ["walk_01.ply", "walk_02.ply", "walk_03.ply"]
    assert (folder / "walk_01.ply").read_bytes() == (folder / "scene.ply").read_bytes()  # at rest
    last = warpcage.SplatField.load("walk_03.ply", device="cpu")
    np.testing.assert_allclose(last.contents.centers, twisted().contents.centers, atol=1e-6)


def test_a_shorter_sequence_says_what_is_left_of_a_longer_one(folder, capsys):
    assert main([*BAKE, "-o", "walk_##.ply", "--frames", "4"]) == 0
    assert "warning" not in said(capsys)
    for name in ("walk_1.ply", "walk_02.ply.bak", "walk_2b.ply", "old_walk_03.ply"):  # of no such sequence
        (folder / name).write_bytes(b"")
    before = (folder / "walk_04.ply").read_bytes()
    assert main([*BAKE, "-o", "walk_##.ply", "--frames", "2"]) == 0
    text = said(capsys)
    assert "beside the 2 files of this sequence are 2 of another one" in text
    assert "walk_03.ply, walk_04.ply" in text and "walk_1" not in text and "walk_2b" not in text
    assert (folder / "walk_04.ply").read_bytes() == before
    assert main([*BAKE, "-o", "walk_##.ply", "--frames", "3", "--cage", "none.obj", "--overwrite"]) == 2
    assert (folder / "walk_04.ply").exists() and said(capsys)  # nothing is removed for a sequence that does not begin
    assert main([*BAKE, "-o", "walk_##.ply", "--frames", "2", "--overwrite"]) == 0
    assert "warning" not in said(capsys)
    left = {path.name for path in folder.glob("*walk_*")}
    assert left == {"walk_01.ply", "walk_02.ply", "walk_1.ply", "walk_02.ply.bak", "walk_2b.ply", "old_walk_03.ply"}


def test_a_pose_stands_by_the_splats_axis(folder):
    """--object takes splats as it takes voxels."""
    order = ["pose", "cage.obj", "-o", "posed.obj", "--twist", "40", "--axis", "up", "--object", "scene.ply"]
    assert main(order) == 0
    cage = warpcage.Cage.load("cage.obj")
    up = warpcage.SplatField.load("scene.ply", device="cpu").up
    np.testing.assert_allclose(warpcage.Cage.load("posed.obj").vertices, cage.twist(40, axis=up).vertices, atol=1e-5)
