"""Commands on files of splats: described, caged, checked, posed, rendered, filmed, and what they refuse."""

import numpy as np
import pytest
from splat_scenes import splats_in_box

import warpcage
from warpcage.cli import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A field of splats and a cage around it."""
    monkeypatch.chdir(tmp_path)
    splats_in_box("cpu", count=400, scales=(-3.5, -2.8), degree=1).save("scene.ply")
    warpcage.Cage.box((-1, -1, -1), (1, 1, 1), segments=2).save("cage.obj")
    return tmp_path


def said(capsys):
    captured = capsys.readouterr()
    return captured.out + captured.err


def test_info_tells_splats_from_cages(folder, capsys):
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
    assert cage.contains(field.contents.centres).mean() > 0.99
    assert main(["check", "wrapped.obj", "--object", "scene.ply"]) == 0
    assert "visible matter enclosed" in said(capsys)
    assert main(["cage", "scene.ply", "-o", "part.obj", "--box", "--in-box", "0", "-1", "-1", "1", "1", "1"]) == 0
    assert warpcage.Cage.load("part.obj").bounds[0][0] > -0.2


@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "splat", "spz"])
def test_a_pose_is_baked(ending, folder, capsys):
    order = ["bake", "scene.ply", "--cage", "cage.obj", "--posed", "twist:40", "--coordinates", "mean_value"]
    assert main([*order, "-o", f"posed.{ending}"]) == 0
    posed = warpcage.SplatField.load(f"posed.{ending}", device="cpu")
    assert f"{posed.splat_count} splats" in said(capsys) and posed.splat_count >= 400
    field = warpcage.SplatField.load("scene.ply", device="cpu")
    cage = warpcage.Cage.load("cage.obj")
    expected = warpcage.Deformer(field, cage, coordinates="mean_value").pose(cage.twist(40)).baked()
    np.testing.assert_allclose(posed.contents.centres, expected.contents.centres, atol=2e-3)


def test_a_sequence_of_files(folder, capsys):
    order = ["bake", "scene.ply", "--cage", "cage.obj", "--posed", "twist:40", "--coordinates", "mean_value"]
    assert main([*order, "-o", "walk_##.ply", "--frames", "3"]) == 0
    assert "3 files" in said(capsys)
    names = sorted(path.name for path in folder.glob("walk_*"))
    assert names == ["walk_01.ply", "walk_02.ply", "walk_03.ply"]
    assert (folder / "walk_01.ply").read_bytes() == (folder / "scene.ply").read_bytes()  # at rest
    cage = warpcage.Cage.load("cage.obj")
    field = warpcage.SplatField.load("scene.ply", device="cpu")
    expected = warpcage.Deformer(field, cage, coordinates="mean_value").pose(cage.twist(40)).baked()
    last = warpcage.SplatField.load("walk_03.ply", device="cpu")
    np.testing.assert_allclose(last.contents.centres, expected.contents.centres, atol=1e-6)


def test_pictures_and_films(folder, capsys):
    size = ["--size", "64", "48"]
    moved = ["--cage", "cage.obj", "--posed", "bend:30:z:x", "--coordinates", "mean_value"]
    assert main(["render", "scene.ply", "-o", "still.png", *size]) == 0
    assert main(["render", "scene.ply", "-o", "bent.png", *size, *moved, "--overlay", "--map", "backward"]) == 0
    assert "% covered" in said(capsys)
    assert main(["animate", "scene.ply", "-o", "film.gif", *size, *moved, "--frames", "3", "--quiet"]) == 0
    assert (folder / "film.gif").stat().st_size > 500


@pytest.mark.parametrize(
    "order, words",
    [
        (["mesh", "scene.ply", "-o", "mesh.obj"], "mesh is for fields of voxels"),
        (
            ["render", "scene.ply", "-o", "a.png", "--masks", "m.png", "--cage", "cage.obj"],
            "--masks is for fields of vox",
        ),
        (["bake", "scene.ply", "-o", "a.npz", "--cage", "cage.obj", "--posed", "twist:9"], "must end in .ply"),
        (["bake", "scene.ply", "-o", "a.ply", "--voxels", "9", "--cage", "cage.obj"], "--voxels and --format"),
        (["bake", "scene.ply", "-o", "a.ply"], "needs a deformation"),
        (["bake", "scene.ply", "-o", "a.ply", "--frames", "3", "--cage", "cage.obj"], "numbered files of splats"),
        (
            ["bake", "scene.ply", "-o", "a_##.ply", "--frames", "1", "--cage", "cage.obj", "--posed", "twist:9"],
            "the pose at rest alone",
        ),
        (["info", "scene.ply", "--scene-scale", "2"], "--scene-scale is for fields"),
        (["info", "cut.splat"], "32 bytes a splat"),
        (
            ["bake", "scene.ply", "-o", "a_##.ply", "--cage", "cage.obj", "--posed", "twist:9"],
            "give --frames, how many",
        ),
        (["check", "scene.ply"], "scene.ply holds splats, without faces, no mesh and no cage"),
        (["check", "scene.compressed.ply"], "holds splats"),
        (["cage", "header.ply", "-o", "a.ply"], "cannot be read as a mesh, it is cut off or damaged"),
        (["render", "cage.obj", "-o", "a.png"], "cage.obj is not an .npz field file: it holds something else"),
        (["render", ".", "-o", "a.png"], "field file '.' is a folder"),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(order, words, folder, capsys):
    (folder / "cut.splat").write_bytes(bytes(33))
    (folder / "header.ply").write_bytes((folder / "scene.ply").read_bytes()[:60])
    warpcage.SplatField.load("scene.ply", device="cpu").save("scene.compressed.ply")
    assert main(order) == 2
    text = said(capsys)
    assert words in text and text.count("\n") == 1
    assert not (folder / "a.ply").exists()


def test_a_pose_stands_by_the_splats_axis(folder):
    """--object takes splats as it takes voxels."""
    order = ["pose", "cage.obj", "-o", "posed.obj", "--twist", "40", "--axis", "up", "--object", "scene.ply"]
    assert main(order) == 0
    cage = warpcage.Cage.load("cage.obj")
    up = warpcage.SplatField.load("scene.ply", device="cpu").up
    np.testing.assert_allclose(warpcage.Cage.load("posed.obj").vertices, cage.twist(40, axis=up).vertices, atol=1e-5)
