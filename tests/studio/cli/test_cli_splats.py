"""Commands on files of splats: described, caged, checked, posed, rendered, filmed, and what they refuse."""

import numpy as np
import pytest
from splat_scenes import splats_in_box

import warpcage
from warpcage.studio.cli import main
from warpcage.studio.jobs import JobFile, Worker


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
    assert cage.contains(field.contents.centers).mean() > 0.99
    assert main(["check", "wrapped.obj", "--object", "scene.ply"]) == 0
    assert "the visible object enclosed" in said(capsys)
    assert main(["cage", "scene.ply", "-o", "part.obj", "--box", "--in-box", "0", "-1", "-1", "1", "1", "1"]) == 0
    assert warpcage.Cage.load("part.obj").bounds[0][0] > -0.2
    text = said(capsys)
    assert "visible cells outside the box" in text and "voxel" not in text


@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "splat", "spz"])
def test_a_pose_is_baked(ending, folder, capsys):
    order = ["bake", "scene.ply", "--cage", "cage.obj", "--posed", "twist:40", "--coordinates", "mean_value"]
    assert main([*order, "-o", f"posed.{ending}"]) == 0
    posed = warpcage.SplatField.load(f"posed.{ending}", device="cpu")
    assert f"{posed.splat_count} splats" in said(capsys) and posed.splat_count >= 400
    field = warpcage.SplatField.load("scene.ply", device="cpu")
    cage = warpcage.Cage.load("cage.obj")
    expected = warpcage.Deformer(field, cage, coordinates="mean_value").pose(cage.twist(40)).baked()
    np.testing.assert_allclose(posed.contents.centers, expected.contents.centers, atol=2e-3)


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
    np.testing.assert_allclose(last.contents.centers, expected.contents.centers, atol=1e-6)


def test_a_shorter_sequence_says_what_is_left_of_a_longer_one(folder, capsys):
    order = ["bake", "scene.ply", "--cage", "cage.obj", "--posed", "twist:40", "--coordinates", "mean_value"]
    assert main([*order, "-o", "walk_##.ply", "--frames", "4"]) == 0
    assert "warning" not in said(capsys)
    for name in ("walk_1.ply", "walk_02.ply.bak", "walk_2b.ply", "old_walk_03.ply"):  # of no such sequence
        (folder / name).write_bytes(b"")
    before = (folder / "walk_04.ply").read_bytes()
    assert main([*order, "-o", "walk_##.ply", "--frames", "2"]) == 0
    text = said(capsys)
    assert "beside the 2 files of this sequence are 2 of another one" in text
    assert "walk_03.ply, walk_04.ply" in text and "walk_1" not in text and "walk_2b" not in text
    assert (folder / "walk_04.ply").read_bytes() == before
    assert main([*order, "-o", "walk_##.ply", "--frames", "3", "--cage", "none.obj", "--overwrite"]) == 2
    assert (folder / "walk_04.ply").exists() and said(capsys)  # nothing is removed for a sequence that does not begin
    assert main([*order, "-o", "walk_##.ply", "--frames", "2", "--overwrite"]) == 0
    assert "warning" not in said(capsys)
    left = {path.name for path in folder.glob("*walk_*")}
    assert left == {"walk_01.ply", "walk_02.ply", "walk_1.ply", "walk_02.ply.bak", "walk_2b.ply", "old_walk_03.ply"}


def test_small_splats_can_be_drawn_as_they_were_fitted(folder, capsys):
    """In pictures, flights, films and of each pose: as the library draws them."""
    from warpcage.view import read_image

    size = ["--size", "64", "48"]
    moved = ["--cage", "cage.obj", "--posed", "twist:30", "--coordinates", "mean_value"]
    camera = warpcage.turntable((0, 0, 0), 8.0, 20, 1, width=64, height=48)[0]
    warpcage.CameraFile([camera]).save("eye.json")
    field = warpcage.SplatField.load("scene.ply", device="cpu")
    cage = warpcage.Cage.load("cage.obj")
    deformer = warpcage.Deformer(field, cage, coordinates="mean_value")
    for name, order in {"plain": [], "weak": ["--antialias"]}.items():
        assert main(["render", "scene.ply", "-o", f"{name}.png", "--camera", "eye.json", *order]) == 0
        assert main(["render", "scene.ply", "-o", f"{name}_bent.png", "--camera", "eye.json", *moved, *order]) == 0
        expected = field.render(camera, antialias=bool(order)).rgb
        np.testing.assert_allclose(read_image(f"{name}.png")[..., :3], np.clip(expected, 0, 1), atol=3e-3)
        posed = deformer.pose(cage.twist(30))
        expected = posed.render(camera, antialias=bool(order)).rgb
        np.testing.assert_allclose(read_image(f"{name}_bent.png")[..., :3], np.clip(expected, 0, 1), atol=3e-3)
        own = deformer.posed(cage.twist(30)).render(camera, antialias=bool(order)).rgb
        np.testing.assert_array_equal(own, expected)
    assert np.abs(read_image("weak_bent.png") - read_image("plain_bent.png")).max() > 0.05
    film = ["animate", "scene.ply", "-o", "film", *size, *moved, "--frames", "2", "--quiet"]
    assert main([*film, "--antialias"]) == 0
    assert main(film) == 2 and "antialias" in said(capsys)  # the frames there are of another film
    assert main(["animate", "scene.ply", "-o", "still", *size, "--frames", "1", "--quiet", "--antialias"]) == 0
    assert main([*film[:2], "--jobs", "film.jsonl", *film[4:], "--antialias"]) == 0
    with JobFile("film.jsonl") as job, Worker(job.folder, "made", "cpu") as worker:
        for item in job:
            worker.run(item)
            name = f"{item.id}.png"
            assert (folder / "made" / name).read_bytes() == (folder / "film" / name).read_bytes()
        assert len(job) == 2


@pytest.mark.parametrize("order", [[], ["--antialias"], ["--map", "backward"], ["--map", "backward", "--no-antialias"]])
def test_pictures_of_a_sweep_are_those_of_render(order, folder):
    antialias = {"--antialias": True, "--no-antialias": False}.get((order or [""])[-1])
    camera = warpcage.Camera.look_at((0, -8, 2), (0, 0, 0), width=64, height=48)
    warpcage.CameraFile([camera]).save("eye.json")
    how = ["--cage", "cage.obj", "--coordinates", "mean_value", "--resolution", "24", "--background", "grey"]
    sweep = ["sweep", "scene.ply", "-o", "sweep.jsonl", "--poses", "twist:30", "--cameras", "eye.json", "--quiet"]
    assert main([*sweep, *how, *order]) == 0
    with JobFile("sweep.jsonl") as job, Worker(job.folder, "made", "cpu") as worker:
        (item,) = job
        assert (item.antialias, item.map) == (antialias, "backward" if "--map" in order else None)
        worker.run(item)
    eye = ["--camera", "eye.json", "--posed", "twist:30"]
    assert main(["render", "scene.ply", "-o", "same.png", *eye, *how, *order]) == 0
    made = folder / "made" / item.outputs["rgb"]
    assert made.read_bytes() == (folder / "same.png").read_bytes()
    if order:
        assert main(["render", "scene.ply", "-o", "plain.png", *eye, *how]) == 0
        assert made.read_bytes() != (folder / "plain.png").read_bytes()


def test_pictures_and_films(folder, capsys):
    size = ["--size", "64", "48"]
    moved = ["--cage", "cage.obj", "--posed", "bend:30:z:x", "--coordinates", "mean_value"]
    assert main(["render", "scene.ply", "-o", "still.png", *size]) == 0
    assert main(["render", "scene.ply", "-o", "bent.png", *size, *moved, "--overlay", "--map", "backward"]) == 0
    assert "% covered" in said(capsys)
    assert main(["animate", "scene.ply", "-o", "film.gif", *size, *moved, "--frames", "3", "--quiet"]) == 0
    assert (folder / "film.gif").stat().st_size > 500


@pytest.mark.parametrize(
    "order, argv",
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
        (
            [*"bake scene.ply -o a.ply --overwrite --cage cage.obj --posed twist:9".split()],
            "--overwrite is for numbered files: give --frames",
        ),
        (["info", "scene.ply", "--scene-scale", "2"], "--scene-scale is for fields"),
        (["render", "scene.ply", "-o", "a.png", "--scene-scale", "2"], "--scene-scale is for fields"),
        (["render", "scene.npz", "-o", "a.png", "--antialias"], "--antialias is for files of splats"),
        (["render", "scene.npz", "-o", "a.png", "--map", "forward"], "--map forward is for files of splats"),
        (["sweep", "scene.npz", "-o", "a.jsonl", "--cage", "cage.obj", "--map", "forward"], "--map forward is for fi"),
        (["sweep", "scene.npz", "-o", "a.jsonl", "--cage", "cage.obj", "--antialias"], "--antialias is for files of"),
        (["cage", "scene.ply", "-o", "a.ply", "--vertices", "2"], "--vertices must be a whole number from 8 to 2000"),
        (["cage", "scene.ply", "-o", "a.ply", "--in-box", "7", "7", "7", "8", "8", "8"], "visible cells are outside"),
        (
            [*"bake scene.ply -o a.ply --cage around.obj --posed twist:9 --falloff 0.1".split()],
            "or say which sides are held: still (",
        ),
        (["info", "cut.splat"], "32 bytes a splat"),
        (
            ["bake", "scene.ply", "-o", "a_##.ply", "--cage", "cage.obj", "--posed", "twist:9"],
            "give --frames, how many",
        ),
        (["check", "scene.ply"], "scene.ply holds splats, without faces, no mesh and no cage"),
        (["check", "scene.compressed.ply"], "holds splats"),
        (["cage", "header.ply", "-o", "a.ply"], "cannot be read as a mesh, it is cut off or damaged"),
        (["render", "cage.obj", "-o", "a.png"], "cage.obj is not a field: fields are .npz (voxels) or "),
        (["render", ".", "-o", "a.png"], "field file '.' is a folder"),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(order, argv, folder, capsys):
    (folder / "cut.splat").write_bytes(bytes(33))
    (folder / "scene.npz").write_bytes(b"")
    warpcage.Cage.box((-9, -9, -9), (9, 9, 9)).save("around.obj")
    (folder / "header.ply").write_bytes((folder / "scene.ply").read_bytes()[:60])
    warpcage.SplatField.load("scene.ply", device="cpu").save("scene.compressed.ply")
    assert main(order) == 2
    text = said(capsys)
    assert argv in text and text.count("\n") == 1
    assert not (folder / "a.ply").exists()


def test_a_pose_stands_by_the_splats_axis(folder):
    """--object takes splats as it takes voxels."""
    order = ["pose", "cage.obj", "-o", "posed.obj", "--twist", "40", "--axis", "up", "--object", "scene.ply"]
    assert main(order) == 0
    cage = warpcage.Cage.load("cage.obj")
    up = warpcage.SplatField.load("scene.ply", device="cpu").up
    np.testing.assert_allclose(warpcage.Cage.load("posed.obj").vertices, cage.twist(40, axis=up).vertices, atol=1e-5)
