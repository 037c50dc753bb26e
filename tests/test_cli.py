"""The command line: what it writes, what it says, how it ends."""

import json
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest
import warp as wp

from warpcage.cage import Cage
from warpcage.cli import COMMANDS, main
from warpcage.field import VoxelField
from warpcage.images import read_image
from warpcage.notices import warn_caller
from warpcage.pose_file import PoseFile
from warpcage.synthetic import write_brick_scene

NAMES = [module.NAME for module in COMMANDS]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A ball as field and mesh, a box around it at rest and posed, a small scene."""
    folder = tmp_path_factory.mktemp("cli")
    x, y, z = np.meshgrid(*[(np.arange(24) + 0.5) / 12 - 1] * 3, indexing="ij")
    density = np.where(x**2 + y**2 + z**2 < 0.3, 40.0, 0.0)
    sh = np.zeros((24, 24, 24, 9, 3))
    sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]]).save(folder / "ball.npz")
    cage = Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7), segments=2)
    cage.save(folder / "cage.obj")
    cage.bend(40, axis="x", towards="z").save(folder / "posed.obj")
    Cage(cage.vertices, cage.faces[1:]).save(folder / "open.obj")
    Cage(cage.vertices, cage.faces[:, ::-1]).save(folder / "inward.obj")
    Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7)).save(folder / "other.obj")
    Cage(cage.vertices, np.roll(cage.faces, 1, axis=0)).save(folder / "shuffled.obj")
    (folder / "text.txt").write_text("text")
    (folder / "broken.npz").write_bytes(b"no archive")
    (folder / "broken.obj").write_text("v 0 0 zero\n")
    (folder / "empty").mkdir()
    write_brick_scene(folder / "scene", train_views=6, test_views=2, size=24)
    return folder


def run(files, *words):
    """main with file names of the folder put in for {name}."""
    return main([str(word).replace("@", f"{files}/") for word in words])


def succeed(files, *words):
    assert run(files, *words) == 0


# Help and wrong input


def test_the_package_runs_as_a_module():
    words = [sys.executable, "-m", "warpcage"]
    helped = subprocess.run([*words, "--help"], capture_output=True, text=True)
    assert helped.returncode == 0 and helped.stdout.startswith("usage: warpcage ")
    wrong = subprocess.run([*words, "info", "nowhere.npz"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "nowhere.npz" in wrong.stderr and wrong.stderr.count("\n") == 1


def test_warnings_take_one_line_without_a_place_in_the_source(capsys, monkeypatch):
    monkeypatch.setattr("warpcage.cli.info.run", lambda arguments: warn_caller("the gap\n is narrow"))
    assert main(["info"]) == 0
    assert capsys.readouterr().err == "warpcage: warning: the gap is narrow\n"


@pytest.mark.parametrize("name", NAMES)
def test_help_shows_an_example(name, capsys):
    with pytest.raises(SystemExit) as leave:
        main([name, "--help"])
    assert leave.value.code == 0
    text = capsys.readouterr().out
    assert f"warpcage {name}" in text.split("example:")[1]
    for option in {"fit": ["--device", "--downscale"], "pose": ["--bend"]}.get(name, ["--device"]):
        assert option in text


def test_help_lists_every_command(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert all(name in text for name in ("fit", "mesh", "cage", "pose", "render", "animate", "evaluate", "info"))
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out.startswith("warpcage ")


DEFORMED = ("--cage", "@cage.obj", "--posed", "@posed.obj")
BAD = {
    "no command": ([], None),
    "unknown command": (["dance"], "dance"),
    "unknown option": (["info", "--wrong"], "--wrong"),
    "fit without output": (["fit", "@scene"], "--output"),
    "fit: no scene": (["fit", "@nowhere", "-o", "@new.npz"], "nowhere"),
    "fit: no scene format": (["fit", "@empty", "-o", "@new.npz"], "known format"),
    "fit: no split": (["fit", "@scene", "-o", "@new.npz", "--split", "validation"], "validation"),
    "fit: ending": (["fit", "@scene", "-o", "@new.ckpt"], "must end in .npz"),
    "fit: downscale": (["fit", "@scene", "-o", "@new.npz", "--downscale", "0"], "at least 1"),
    "fit: device": (["fit", "@scene", "-o", "@new.npz", "--device", "cuda:99"], "cuda:99"),
    "fit: background": (["fit", "@scene", "-o", "@new.npz", "--background", "mauve"], "mauve"),
    "fit: memory": (["fit", "@scene", "-o", "@new.npz", "--max-memory", "4 apples"], "4 apples"),
    "fit: memory too short": (["fit", "@scene", "-o", "@new.npz", "--max-memory", "20kB"], "max_memory"),
    "fit: under a file": (["fit", "@scene", "-o", "@text.txt/new.npz"], "no folder"),
    "mesh: missing": (["mesh", "@nowhere.npz", "-o", "@new.obj"], "nowhere.npz"),
    "mesh: no field": (["mesh", "@broken.npz", "-o", "@new.obj"], "broken.npz"),
    "mesh: ending": (["mesh", "@ball.npz", "-o", "@new.txt"], "must end in"),
    "mesh: too dense": (["mesh", "@ball.npz", "-o", "@new.obj", "--threshold", "1e9"], "threshold"),
    "cage: missing": (["cage", "@nowhere.obj", "-o", "@new.obj"], "nowhere.obj"),
    "cage: format": (["cage", "@text.txt", "-o", "@new.obj"], "text.txt"),
    "cage: shapes": (["cage", "@cage.obj", "-o", "@new.obj", "--box", "--sides", "5"], "--sides belongs to --cylinder"),
    "cage: two shapes": (["cage", "@cage.obj", "-o", "@new.obj", "--box", "--cylinder"], "not allowed with"),
    "cage: method": (["cage", "@ball.npz", "-o", "@new.obj", "--method", "best"], "--method"),
    "cage: method of a box": (["cage", "@ball.npz", "-o", "@new.obj", "--box", "--symmetry", "x"], "--symmetry is for"),
    "cage: part of a mesh": (["cage", "@cage.obj", "-o", "@new.obj", "--parts", "1"], "--parts is for fields"),
    "cage: seed": (["cage", "@ball.npz", "-o", "@new.obj", "--seed", "0.9", "0.9", "0.9"], "near the seed point"),
    "cage: masks": (["cage", "@ball.npz", "-o", "@new.obj", "--masks", "@nowhere"], "nowhere"),
    "pose: no step": (["pose", "@cage.obj", "-o", "@new.obj"], "no step"),
    "pose: broken": (["pose", "@broken.obj", "-o", "@new.obj", "--bend", "3"], "broken.obj:1"),
    "pose: open": (["pose", "@open.obj", "-o", "@new.obj", "--bend", "3"], "open.obj"),
    "pose: axes": (["pose", "@cage.obj", "-o", "@new.obj", "--bend", "3", "--axis", "x", "--towards", "x"], "axes"),
    "pose: flattened": (["pose", "@cage.obj", "-o", "@new.obj", "--scale", "0"], "positive"),
    "pose: not a number": (["pose", "@cage.obj", "-o", "@new.obj", "--bend", "nan"], "finite"),
    "render: half a cage": (["render", "@ball.npz", "-o", "@new.png", "--cage", "@cage.obj"], "--cage and --posed"),
    "render: open": (["render", "@ball.npz", "-o", "@new.png", "--cage", "@open.obj", "--posed", "@open.obj"],
                     "open.obj"),
    "render: inward": (["render", "@ball.npz", "-o", "@new.png", "--cage", "@inward.obj", "--posed", "@inward.obj"],
                       "inward.obj"),
    "render: faces": (["render", "@ball.npz", "-o", "@new.png", "--cage", "@cage.obj", "--posed", "@other.obj"],
                      "vertices"),
    "animate: faces": (["animate", "@ball.npz", "-o", "@new.mp4", "--cage", "@cage.obj", "--posed", "@other.obj"],
                       "vertices"),
    "render: precise": (["render", "@ball.npz", "-o", "@new.png", *DEFORMED, "--resolution", "precise"], "closed form"),
    "render: overlay": (["render", "@ball.npz", "-o", "@new.png", "--overlay"], "--overlay"),
    "render: ending": (["render", "@ball.npz", "-o", "@new.jpg"], "must end in .png"),
    "render: camera": (["render", "@ball.npz", "-o", "@new.png", "--camera", "@scene:99"], "0 to 5"),
    "render: camera form": (["render", "@ball.npz", "-o", "@new.png", "--camera", "@scene"], "SCENE:INDEX"),
    "render: squeezed": (["render", "@ball.npz", "-o", "@new.png", "--camera", "@scene:0", "--size", "40", "20"],
                         "squeeze"),
    "animate: ending": (["animate", "@ball.npz", "-o", "@new.avi"], ".mp4 or .gif"),
    "animate: frames": (["animate", "@ball.npz", "-o", "@new.mp4", "--frames", "0"], "at least 1"),
    "animate: a preset that is none": (["animate", "@ball.npz", "-o", "@new.mp4", "--cage", "@cage.obj", "--posed",
                                        "bend:wide"], "no preset"),
    "animate: masks of a plain field": (["animate", "@ball.npz", "-o", "@new.mp4", "--show", "masks"], "--show masks"),
    "animate: two paths": (["animate", "@ball.npz", "-o", "@new.mp4", "--turn", "9", "--cameras", "@scene"], "exclude"),
    "animate: cameras": (["animate", "@ball.npz", "-o", "@new.mp4", "--cameras", "@nowhere"], "nowhere"),
    "render: masks of a plain field": (["render", "@ball.npz", "-o", "@new.png", "--masks", "@m.png"], "--masks"),
    "render: zero size": (["render", "@ball.npz", "-o", "@new.png", "--size", "0"], "at least 1"),
    "bake: no cage": (["bake", "@ball.npz", "-o", "@new.npz"], "--cage and --posed"),
    "bake: ending": (["bake", "@ball.npz", "-o", "@new.obj", *DEFORMED], "must end in .npz"),
    "bake: voxels": (["bake", "@ball.npz", "-o", "@new.npz", *DEFORMED, "--voxels", "1"], "resolution must be"),
    "evaluate: missing": (["evaluate", "@ball.npz", "@nowhere"], "nowhere"),
    "info: missing": (["info", "@nowhere.npz"], "nowhere.npz"),
    "info: format": (["info", "@text.txt"], "text.txt"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_with_one_line_and_status_2(files, case, capsys):
    words, expected = BAD[case]
    before = sorted(files.rglob("*"))
    assert run(files, *words) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    if expected is not None:
        assert len(lines) == 1 and lines[0].startswith("warpcage: error: "), lines
        assert expected in lines[0]
    assert sorted(files.rglob("*")) == before


def test_interruption_leaves_nothing_and_status_130(files, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("warpcage.optimize.fit", interrupted)
    before = sorted(files.rglob("*"))
    assert run(files, "fit", "@scene", "-o", "@new.npz", "--quiet") == 130
    assert "Traceback" not in capsys.readouterr().err
    assert sorted(files.rglob("*")) == before


# What commands do


def test_fit_and_evaluate(files, capsys, tmp_path, device):
    out = tmp_path / "deep" / "field.npz"
    words = ["--quiet", "--device", device]
    succeed(files, "fit", "@scene", "-o", out, "--resolution", 32, "--epochs", 6, "--seed", 3, *words)
    capsys.readouterr()
    succeed(files, "evaluate", out, "@scene", "--split", "train", "--json", tmp_path / "psnr.json", *words)
    table = capsys.readouterr().out.splitlines()
    assert len(table) == 1 + 6 + 1 and table[1].split()[0] == "r_0" and table[-1].startswith("mean")
    report = json.loads((tmp_path / "psnr.json").read_text())
    assert report["mean_psnr"] == pytest.approx(np.mean([row["psnr"] for row in report["views"]]))
    assert report["mean_psnr"] > 15.0
    assert float(table[-1].split()[1]) == pytest.approx(report["mean_psnr"], abs=0.006)


def test_evaluate_says_where_it_errs(files, capsys, tmp_path):
    """A field rendered to a scene and one pixel painted over: that view is the worst, red where it was painted, and the
    untouched ones are right."""
    from warpcage.scene import load_scene

    scene = load_scene(files / "scene", split="test")
    field = VoxelField.load(files / "ball.npz")
    folder = tmp_path / "scene"
    (folder / "test").mkdir(parents=True)
    transforms = json.loads((files / "scene" / "transforms_test.json").read_text())
    for i, camera in enumerate(scene.cameras):
        rgb = np.round(255 * np.clip(field.render(camera).rgb, 0, 1)).astype(np.uint8)
        rgb[3, 4] = 0 if i == 1 else rgb[3, 4]
        iio.imwrite(folder / "test" / f"r_{i}.png", rgb)
    (folder / "transforms_test.json").write_text(json.dumps(transforms))
    words = ["--worst", tmp_path / "worst.png", "--json", tmp_path / "psnr.json", "--quiet"]
    succeed(files, "evaluate", "@ball.npz", folder, *words)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["view", "PSNR", "dB", "SSIM"] and "view r_1" in lines[-1]
    assert float(lines[1].split()[1]) > 50 > float(lines[2].split()[1])
    report = json.loads((tmp_path / "psnr.json").read_text())
    assert report["worst_view"] == "r_1" and [row["view"] for row in report["views"]] == ["r_0", "r_1"]
    assert report["mean_ssim"] == pytest.approx(np.mean([row["ssim"] for row in report["views"]]))
    picture = read_image(tmp_path / "worst.png")
    assert picture.shape[:2] == (24, 3 * 24 + 2 * 4)
    errors = picture[:, 56:80, :3]
    np.testing.assert_allclose(errors[3, 4], [0.85, 0, 0], atol=0.01)
    assert (np.ptp(errors, axis=-1) > 0.1).sum() == 1


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "glb"])
def test_mesh(files, tmp_path, ending):
    import trimesh

    succeed(files, "mesh", "@ball.npz", "-o", tmp_path / f"ball.{ending}")
    mesh = trimesh.load(tmp_path / f"ball.{ending}", force="mesh")
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert 0.4 < radius.min() and radius.max() < 0.7


def test_gltf_meshes_stand_upright(tmp_path, capsys):
    import trimesh

    density = np.zeros((24, 24, 24))
    density[4:8, 6:18, 2:22] = 40.0  # of another size along each axis, off the middle
    field = VoxelField.from_dense(density, np.zeros((24, 24, 24, 9, 3)), [[-1, -1, -1], [1, 1, 1]])
    field.save(tmp_path / "slab.npz")
    bounds = []
    for ending in ("obj", "glb"):
        assert main(["mesh", str(tmp_path / "slab.npz"), "-o", str(tmp_path / f"slab.{ending}")]) == 0
        assert main(["cage", str(tmp_path / f"slab.{ending}"), "-o", str(tmp_path / "box.obj"), "--box"]) == 0
        bounds.append(Cage.load(tmp_path / "box.obj").bounds)
    np.testing.assert_allclose(*bounds, atol=1e-6)
    x, y, z = trimesh.load(tmp_path / "slab.obj", force="mesh").bounds.T
    there = trimesh.load(tmp_path / "slab.glb", force="mesh").bounds
    np.testing.assert_allclose(there, np.stack([x, z, -y[::-1]], axis=1), atol=1e-6)  # glTF: y up, z towards us
    said = [line.split(", from ")[1] for line in capsys.readouterr().out.splitlines() if "slab" in line]
    assert len(said) == 2 and said[0] == said[1]  # world coordinates in both


def test_a_cage_around_a_mesh_says_one_line(files, tmp_path):
    words = ["cage", files / "posed.obj", "-o", tmp_path / "cage.obj", "--vertices", "30", "--method", "shell",
             "--quiet"]
    done = subprocess.run([sys.executable, "-m", "warpcage", *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("wrote ") and done.stdout.count("\n") == 1


@pytest.mark.parametrize("shape", [["--box"], ["--box", "--segments", 2, 3, 1], ["--box", "--margin", 0.2],
                                   ["--cylinder"], ["--cylinder", "--axis", "x", "--sides", 7, "--rings", 2]])
@pytest.mark.parametrize("source", ["@ball.npz", "@posed.obj"])
def test_simple_cages_hold_the_object(files, tmp_path, shape, source):
    succeed(files, "cage", source, "-o", tmp_path / "cage.ply", *shape)
    cage = Cage.load(tmp_path / "cage.ply")
    cage.require_usable()
    ball = np.random.default_rng(0).normal(size=(200, 3))
    points = 0.54 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    points = Cage.load(files / "posed.obj").vertices if source == "@posed.obj" else points
    assert cage.contains(points).all()


def test_wrapped_cage_holds_the_object(files, tmp_path):
    pytest.importorskip("pymeshlab")
    succeed(files, "cage", "@ball.npz", "-o", tmp_path / "cage.obj", "--vertices", 60)
    cage = Cage.load(tmp_path / "cage.obj")
    cage.require_usable()
    assert 30 <= len(cage.vertices) <= 90
    directions = np.random.default_rng(0).normal(size=(200, 3))
    assert cage.contains(0.53 * directions / np.linalg.norm(directions, axis=1, keepdims=True)).all()


def test_cage_of_a_part_of_a_field(files, tmp_path, capsys):
    words = ["--in-box", -1, -1, 0, 1, 1, 1, "--floaters", 0.1, "--method", "voxel", "--symmetry", "x",
             "--vertices", 60]
    succeed(files, "cage", "@ball.npz", "-o", tmp_path / "half.glb", *words)
    assert "left out" in capsys.readouterr().out
    cage = Cage.load(tmp_path / "half.glb")
    cage.require_usable()
    assert cage.bounds[0, 2] > -0.35 and cage.contains([[0, 0, 0.4]])[0]
    succeed(files, "cage", "@ball.npz", "-o", tmp_path / "box.ply", "--box", "--in-box", -1, -1, 0, 1, 1, 1)
    assert Cage.load(tmp_path / "box.ply").bounds[0, 2] > -0.1


def test_pose_takes_steps_in_their_order(files, tmp_path, capsys):
    rest = Cage.load(files / "cage.obj")
    out = tmp_path / "posed.off"
    succeed(files, "pose", "@cage.obj", "-o", out, "--translate", 1, 0, 0, "--scale", 2, "--centre", 0, 0, 0)
    np.testing.assert_allclose(Cage.load(out).vertices, 2 * (rest.vertices + [1, 0, 0]))
    succeed(files, "pose", "@cage.obj", "-o", out, "--scale", 2, "--translate", 1, 0, 0, "--centre", 0, 0, 0)
    np.testing.assert_allclose(Cage.load(out).vertices, 2 * rest.vertices + [1, 0, 0])
    words = ["--bend", -40, "--axis", "x", "--towards=-y", "--limits", 0.2, 0.9]
    succeed(files, "pose", "@cage.obj", "-o", out, *words)
    np.testing.assert_allclose(Cage.load(out).vertices,
                               rest.bend(-40, axis="x", towards="-y", limits=(0.2, 0.9)).vertices)
    succeed(files, "pose", "@cage.obj", "-o", out, "--twist", 30, "--taper", 0.5, "--stretch", 1.5, "--rotate", 20)
    expected = rest.twist(30).taper(0.5).stretch(1.5).rotate(20)
    np.testing.assert_allclose(Cage.load(out).vertices, expected.vertices)
    np.testing.assert_array_equal(Cage.load(out).faces, rest.faces)
    rest.save(tmp_path / "y.obj", up="y")
    succeed(files, "pose", tmp_path / "y.obj", "-o", tmp_path / "y.ply", "--stretch", 2, "--cage-up", "y")
    np.testing.assert_allclose(Cage.load(tmp_path / "y.ply", up="y").vertices, rest.stretch(2.0).vertices)
    assert "twist 30.0, taper 0.5" in capsys.readouterr().out


SMALL = ("--size", "40", "--coordinates", "mean_value", "--resolution", "24")


def test_render_of_a_plain_field(files, tmp_path):
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "ball.png", "--disparity", tmp_path / "disparity.png",
            *SMALL, "--eye", 0, -3, 0, "--target", 0, 0, 0, "--fov", 50, "--background", "black")
    image = read_image(tmp_path / "ball.png")
    assert image.shape == (40, 40, 3)
    assert (image[0] == 0).all() and image[15, 20].argmax() == 0 and image[25, 20].argmax() == 2
    disparity = read_image(tmp_path / "disparity.png")
    assert (disparity[0] == 0).all() and disparity[20, 20].sum() > disparity[20, 11].sum() > 0


def test_render_at_rest_is_the_plain_render_and_a_pose_shows(files, tmp_path):
    view = [*SMALL, "--camera", "@scene:test:1"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "plain.png", *view)
    resting = ["--cage", "@cage.obj", "--posed", "@cage.obj"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "rest.png", *view, *resting)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "posed.png", *view, *DEFORMED)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "over.png", *view, *DEFORMED, "--overlay")
    plain, rest, posed, over = (read_image(tmp_path / f"{name}.png") for name in ("plain", "rest", "posed", "over"))
    assert np.abs(plain - rest).mean() < 0.004
    assert np.abs(plain - posed).mean() > 0.02
    assert 0.02 < (np.abs(over - posed).max(axis=-1) > 0.1).mean() < 0.7


def test_a_posed_cage_in_another_order_is_matched(files, tmp_path, capsys):
    view = [*SMALL, "--camera", "@scene:test:1", "--cage", "@cage.obj"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "plain.png", *view, "--posed", "@cage.obj")
    assert "matched" not in capsys.readouterr().err
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "shuffled.png", *view, "--posed", "@shuffled.obj")
    assert "matched" in capsys.readouterr().err
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "shuffled.png").read_bytes()


def test_camera_of_a_scene_has_its_size(files, tmp_path, device):
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "view.png", "--camera", "@scene:3", "--device", device)
    assert read_image(tmp_path / "view.png").shape == (24, 24, 3)


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_animate_film(files, tmp_path, ending):
    path = tmp_path / f"film.{ending}"
    succeed(files, "animate", "@ball.npz", "-o", path, *DEFORMED, *SMALL, "--frames", 4, "--quiet", "--turn", 0)
    frames = iio.imread(path, plugin="pyav" if ending == "mp4" else None).astype(float)
    assert frames.shape[:3] == (4, 40, 40)
    change = [np.abs(frame - frames[0]).mean() for frame in frames]
    assert change[2] > change[1] > 1.0 and change[1] == pytest.approx(change[3], abs=1.0)  # there and back


def test_animate_goes_through_keyframes_and_cameras(files, tmp_path):
    path = tmp_path / "film.gif"
    words = ["animate", "@ball.npz", "-o", path, "--cage", "@cage.obj", *SMALL, "--quiet", "--motion", "once"]
    succeed(files, *words, "--posed", "@posed.obj", "rest", "--frames", 3, "--turn", 0, "--interpolation", "linear")
    frames = iio.imread(path).astype(float)
    assert len(frames) == 3 and np.abs(frames[0] - frames[2]).mean() < 2.0 < np.abs(frames[0] - frames[1]).mean()
    (path.parent / "cams").mkdir()
    folder = tmp_path / "cams" / "frames"
    words[3] = folder
    succeed(files, *words, "--posed", "rest", "--frames", 3, "--cameras", "@scene:test", "--overlay")
    first = read_image(folder / "frame_0000.png")
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "one.png", "--cage", "@cage.obj", "--posed", "rest",
            "--camera", "@scene:test:0", *SMALL, "--overlay")
    assert np.abs(first - read_image(tmp_path / "one.png")).mean() < 0.01


@pytest.mark.parametrize("kind", ["alpha", "depth", "disparity", "masks"])
def test_animate_shows_other_outputs(files, tmp_path, capsys, kind):
    folder = tmp_path / kind
    words = ["animate", "@ball.npz", "-o", folder, "--cage", "@cage.obj", "--posed", "translate:0:0:1.5", *SMALL,
             "--frames", 4, "--quiet", "--turn", 0, "--show", kind]
    succeed(files, *words)
    said = capsys.readouterr().err
    assert ("uncovered" in said and "% of the film" in said) == (kind == "masks")
    whole = [(folder / f"frame_000{index}.png").read_bytes() for index in range(4)]
    assert read_image(folder / "frame_0001.png").std() > 0.05
    (folder / "frame_0001.png").unlink()
    succeed(files, *words)  # with the same scale of colours
    assert [(folder / f"frame_000{index}.png").read_bytes() for index in range(4)] == whole


def test_render_writes_masks_when_asked_and_warns(files, tmp_path, capsys):
    view = ["render", "@ball.npz", "-o", tmp_path / "a.png", *SMALL, "--cage", "@cage.obj",
            "--posed", "translate:0:0:1"]
    succeed(files, *view)
    assert "warning" not in capsys.readouterr().err
    extra = [word for kind in ("masks", "depth", "alpha") for word in (f"--{kind}", tmp_path / f"{kind}.png")]
    succeed(files, *view, *extra)
    warning = capsys.readouterr().err
    assert warning.startswith("warpcage: warning: ") and "uncovered" in warning
    masks, alpha = read_image(tmp_path / "masks.png"), read_image(tmp_path / "alpha.png")
    blue = masks[..., 2] - masks[..., 0] > 0.3
    assert 0.02 < blue.mean() < 0.6
    assert float(warning.split("warning: ")[1].split()[0]) == pytest.approx(100 * blue.mean(), abs=3.0)
    assert alpha.max() > 0.95 and alpha.min() == 0 and read_image(tmp_path / "depth.png").max() > 0.5


@pytest.mark.parametrize("format", ["warpcage", "svox2"])
def test_bake_then_render(files, tmp_path, format):
    view = ["--eye", 0, -3, 0.5, "--target", 0, 0, 0, *SMALL]
    succeed(files, "bake", "@ball.npz", "-o", tmp_path / "bent.npz", *DEFORMED, "--format", format, "--voxels", 60)
    succeed(files, "render", tmp_path / "bent.npz", "-o", tmp_path / "baked.png", *view)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "live.png", *DEFORMED, *view)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "rest.png", *view)
    baked, live, rest = (read_image(tmp_path / f"{name}.png") for name in ("baked", "live", "rest"))
    assert np.mean((baked - live) ** 2) < 10**-2.5 < np.mean((rest - live) ** 2)


def test_fields_of_scaled_scenes_come_back_to_scale(files, tmp_path, capsys):
    ball = VoxelField.load(files / "ball.npz")
    small = VoxelField(ball.bounds * 2 / 3, ball.grid.links.numpy(), ball.grid.density.numpy() * 1.5,
                       ball.grid.sh.numpy().transpose(0, 2, 1))
    small.save(tmp_path / "small.npz", format="svox2")
    view = [*SMALL, "--camera", "@scene:test:1"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "ball.png", *view)
    succeed(files, "render", tmp_path / "small.npz", "-o", tmp_path / "scaled.png", *view, "--scene-scale", "2/3")
    succeed(files, "render", tmp_path / "small.npz", "-o", tmp_path / "small.png", *view)
    ball, scaled, small = (read_image(tmp_path / f"{name}.png") for name in ("ball", "scaled", "small"))
    assert np.abs(scaled - ball).mean() < 2e-3 < 2e-2 < np.abs(small - ball).mean()
    for words in (["check", "@cage.obj"], ["cage", "@cage.obj", "-o", tmp_path / "c.obj"], ["info", "@scene"]):
        assert run(files, *words, "--scene-scale", "0.5") == 2
        assert "--scene-scale is for fields (.npz), got " in capsys.readouterr().err


def test_poses_come_from_pose_files(files, tmp_path, capsys):
    rest = Cage.load(files / "cage.obj")
    path = tmp_path / "pösen.json"
    PoseFile(rest, {"bent": Cage.load(files / "posed.obj"), "small one": rest.scale(0.8)}).save(path)
    view = [*SMALL, "--camera", "@scene:test:1"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "file.png", *view, *DEFORMED)
    words = ["--cage", "@cage.obj", "--posed"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "named.png", *view, *words, f"{path}:bent")
    assert (tmp_path / "file.png").read_bytes() == (tmp_path / "named.png").read_bytes()

    film = [*view, "--frames", 3, "--motion", "once", "--quiet", *words]
    for folder, poses in (("whole", [path]), ("single", [f"{path}:bent", f"{path}:small one"])):
        succeed(files, "animate", "@ball.npz", "-o", tmp_path / folder, *film, *poses)
    for k in range(3):
        one, two = ((tmp_path / folder / f"frame_000{k}.png").read_bytes() for folder in ("whole", "single"))
        assert one == two
    assert run(files, "animate", "@ball.npz", "-o", tmp_path / "single", *film, f"{path}:bent") == 2  # another film
    assert "other posed" in capsys.readouterr().err

    for pose in (f"{path}:bent", "bend:40:x:z"):
        succeed(files, "check", "@cage.obj", "--posed", pose)
        assert "pose: usable" in capsys.readouterr().out
    for pose, said in ((path, "holds 2 keyframes: name one"), (f"{path}:no", "no keyframe 'no': bent, small one"),
                       (tmp_path / "none.json", "is not there")):
        assert run(files, "render", "@ball.npz", "-o", tmp_path / "x.png", *view, *words, pose) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1


def test_cages_with_y_up_are_turned_by_every_command(files, tmp_path, capsys):
    rest, posed = (Cage.load(files / f"{name}.obj") for name in ("cage", "posed"))
    for name, cage in (("rest", rest), ("posed", posed)):
        cage.save(tmp_path / f"{name}.obj", up="y")
    turned = ["--cage", tmp_path / "rest.obj", "--posed", tmp_path / "posed.obj", "--cage-up", "y"]
    view = ["--eye", 0, -3, 0.5, "--target", 0, 0, 0, *SMALL]
    for deformation, name in ((DEFORMED, "z"), (turned, "y")):
        succeed(files, "render", "@ball.npz", "-o", tmp_path / f"{name}.png", *view, *deformation)
        succeed(files, "animate", "@ball.npz", "-o", tmp_path / name, *view, *deformation, "--frames", 2, "--quiet")
        succeed(files, "bake", "@ball.npz", "-o", tmp_path / f"{name}.npz", *deformation, "--voxels", 16)
    assert "warning" not in capsys.readouterr().err
    assert np.abs(read_image(tmp_path / "y.png") - read_image(tmp_path / "z.png")).max() < 0.02
    one, two = (read_image(tmp_path / name / "frame_0001.png") for name in "yz")
    assert np.abs(one - two).max() < 0.02
    one, two = (VoxelField.load(tmp_path / f"{name}.npz") for name in "yz")
    np.testing.assert_allclose(one.bounds, two.bounds, atol=1e-6)

    succeed(files, "render", "@ball.npz", "-o", tmp_path / "mixed.png", *view, "--cage", "@cage.obj", "--posed",
            tmp_path / "posed.obj")
    assert "with another axis up" in capsys.readouterr().err


def test_animate_takes_a_folder_up_where_it_was_left(files, tmp_path, capsys):
    folder = tmp_path / "frames"
    words = ["animate", "@ball.npz", "-o", folder, *SMALL, "--frames", 3, "--quiet"]
    succeed(files, *words)
    names = sorted(path.name for path in folder.glob("*.png"))
    assert names == ["frame_0000.png", "frame_0001.png", "frame_0002.png"]
    content = (folder / "frame_0001.png").read_bytes()
    (folder / "frame_0001.png").unlink()
    kept = (folder / "frame_0002.png").stat().st_mtime_ns
    capsys.readouterr()
    succeed(files, *words)
    assert "1 frames, 2 were there" in capsys.readouterr().out
    assert (folder / "frame_0001.png").read_bytes() == content
    assert (folder / "frame_0002.png").stat().st_mtime_ns == kept

    assert run(files, *words, "--turn", 90) == 2
    assert "another film (other turn" in capsys.readouterr().err
    (folder / "animation.json").unlink()
    assert run(files, *words) == 2


def test_info(files, capsys):
    succeed(files, "info")
    text = capsys.readouterr().out
    assert "warp " in text and all(device.alias in text for device in wp.get_devices())
    succeed(files, "info", "@ball.npz")
    assert "24x24x24" in capsys.readouterr().out
    succeed(files, "info", "@cage.obj")
    text = capsys.readouterr().out
    assert "26" in text and "usable" in text and "yes" in text
    succeed(files, "info", "@open.obj")
    assert "no: " in capsys.readouterr().out
    succeed(files, "info", "@scene")
    assert "6 of 24x24" in capsys.readouterr().out
