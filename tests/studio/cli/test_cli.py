"""The command line: what it writes, what it says, how it ends."""

import json
import pathlib
import re
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest
import warp as wp
from runs import DEFORMED, run, succeed

from warpcage import VoxelField
from warpcage.core import warn_caller
from warpcage.studio.cli import main
from warpcage.view import read_image

# Help and wrong input


def test_the_package_runs_as_a_module():
    argv = [sys.executable, "-m", "warpcage"]
    helped = subprocess.run([*argv, "--help"], capture_output=True, text=True)
    assert helped.returncode == 0 and helped.stdout.startswith("usage: warpcage ")
    wrong = subprocess.run([*argv, "info", "nowhere.npz"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "nowhere.npz" in wrong.stderr and wrong.stderr.count("\n") == 1


@pytest.mark.filterwarnings("default")
def test_warnings_take_one_line_without_a_place_in_the_source(capsys, monkeypatch):
    monkeypatch.setattr("warpcage.studio.cli.info.run_info", lambda arguments: warn_caller("the gap\n is narrow"))
    assert main(["info"]) == 0
    assert capsys.readouterr().err == "warpcage: warning: the gap is narrow\n"


@pytest.mark.parametrize(
    ("command", "rare"),
    [
        ("render", "--density"), ("animate", "--shutter"), ("fit", "--seed"), ("select", "--clearance"),
        ("clean", "--least-weight"), ("mesh", "--fragments"), ("cage", "--symmetry"), ("pose", "--centre"),
        ("sweep", "--supersampling"), ("bake", "--density"),
    ],
)  # fmt: skip
def test_help_of_long_commands_begins_with_the_usual_options(command, rare, capsys):
    said = {}
    for argv in ("--help", "--help all"):
        with pytest.raises(SystemExit) as leave:
            main([command, *argv.split()])
        assert leave.value.code == 0
        said[argv] = capsys.readouterr().out
    short, whole = said.values()
    options = re.findall(r"^  (-.*)$", short, re.MULTILINE)
    assert len(options) == 11 and rare not in short and rare in whole  # ten and --help
    assert f"warpcage {command} " in short and f"more options: warpcage {command} --help all" in short


HELP = pathlib.Path(__file__).parents[2] / "data" / "help"

#: Words of the code that nobody who meets the commands knows; flags and endings of files keep theirs.
INNER_WORDS = r"(?<![-.\w])(matter|things?|stages?|told|anew|whoever|by lot|of no use|straight colours?)(?![\w])"


@pytest.mark.parametrize("path", sorted(HELP.glob("*.txt")), ids=lambda path: path.stem)
def test_help_has_no_words_of_the_code(path):
    assert re.findall(INNER_WORDS, path.read_text()) == []


def test_a_folder_made_for_an_output_is_reported_and_not_left_by_a_command_that_fails(files, tmp_path, capsys):
    picture = tmp_path / "new" / "one" / "ball.png"
    assert run(files, "render", "@ball.npz", "-o", picture, "--size", 8, "--device", "cpu") == 0
    assert picture.exists() and f"warpcage: made folder {picture.parent}\n" in capsys.readouterr().err
    assert run(files, "render", "@ball.npz", "-o", picture, "--size", 8, "--device", "cpu") == 0
    assert "made folder" not in capsys.readouterr().err
    assert run(files, "render", "@broken.npz", "-o", tmp_path / "other" / "ball.png", "--device", "cpu") == 2
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    "argv",
    [
        ["info", "@picture.png"],
        ["check", "@picture.png"],
        ["check", "@cage.obj", "--object", "@picture.png"],
        ["render", "@ball.npz", "--cage", "@cage.obj", "--posed", "@picture.png", "-o", "@new.png"],
        ["render", "@ball.npz", "--edits", "@picture.png", "-o", "@new.png"],
        ["render", "@ball.npz", "--camera", "@picture.png", "-o", "@new.png"],
        ["animate", "@ball.npz", "--session", "@picture.png", "-o", "@new.mp4"],
        ["fit", "@picture.png", "-o", "@new.npz"],
        ["pose", "@picture.png", "-o", "@new.obj", "--bend", 3],
        ["run", "@picture.png", "-o", "@new"],
        ["render", "@ball.npz", "--add", "@ball.npz:@picture.png", "-o", "@new.png"],
        ["render", "@picture.stage.json", "-o", "@new.png"],
        ["render", "@ball.npz", "--frame", "@picture.stage.json", "-o", "@new.png"],
        ["animate", "@ball.npz", "--cameras", "@picture.stage.json", "-o", "@new.mp4"],
        ["mesh", "@ball.npz", "--selection", "@picture.png", "-o", "@new.obj"],
    ],
    ids=lambda argv: " ".join(map(str, argv[:3])),
)
def test_a_wrong_kind_of_file_is_reported_as_what_it_looks_like(argv, files, tmp_path, capsys):
    for name in ("picture.png", "picture.stage.json"):
        iio.imwrite(files / name, np.zeros((4, 4, 3), np.uint8), extension=".png")
    assert run(files, *argv) == 2
    said = capsys.readouterr().err
    assert "looks like a picture" in said and said.count("\n") == 1


@pytest.mark.parametrize("argv", [["check", "@scene"], ["pose", "@scene", "-o", "@new.obj", "--bend", 3]])
def test_a_folder_in_place_of_a_cage_is_reported(argv, files, capsys):
    assert run(files, *argv) == 2
    assert "must end in .obj" in (said := capsys.readouterr().err) and said.endswith(", this is a folder\n")


def test_folders_that_stayed_empty_go_again(tmp_path, monkeypatch):
    folder = tmp_path / "new" / "one"

    def failing(arguments):
        folder.mkdir(parents=True)
        raise ValueError("the disk is full")

    monkeypatch.setattr("warpcage.studio.cli.render.run_render", failing)
    assert main(["render", "ball.npz", "-o", str(folder / "ball.png")]) == 2
    assert not folder.parent.exists()


def test_version(capsys):
    with pytest.raises(SystemExit) as leave:
        main(["--version"])
    assert leave.value.code == 0 and capsys.readouterr().out.startswith("warpcage ")


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
    "fit: under a file": (["fit", "@scene", "-o", "@text.txt/new.npz"], "not a folder"),
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
    "render: sizes": (["render", "@ball.npz", "-o", "@new.png", "--size", "40", "20", "10"], "a width and a height"),
    "render: no shape": (["render", "@ball.npz", "-o", "@new.png", "--size", "16:0"], "two numbers such as 16:9"),
    "render: widened by nothing": (["render", "@ball.npz", "-o", "@new.png", "--size", "widen"], "or a shape"),
    "animate: ending": (["animate", "@ball.npz", "-o", "@new.avi"], ".mp4, .gif"),
    "animate: rate": (["animate", "@ball.npz", "-o", "@new.mp4", "--fps", "1e30"], "must be from 0.01 to 1000"),
    "animate: slow rate": (["animate", "@ball.npz", "-o", "@new.mp4", "--fps", "0.001"], "must be from 0.01 to 1000"),
    "animate: rate of a GIF": (["animate", "@ball.npz", "-o", "@new.gif", "--fps", "60"], "must be from 0.01 to 50"),
    "animate: rate beyond floats": (["animate", "@ball.npz", "-o", "@new.gif", "--fps", "1e999999999"], "--fps"),
    "animate: no rate": (["animate", "@ball.npz", "-o", "@new.mp4", "--fps", "1/0"], "--fps"),
    "animate: scale": (["animate", "@ball.npz", "-o", "@new.mp4", "--scene-scale", "1e999999999"], "--scene-scale"),
    "animate: frames": (["animate", "@ball.npz", "-o", "@new.mp4", "--frames", "0"], "at least 1"),
    "animate: a preset that is none": (["animate", "@ball.npz", "-o", "@new.mp4", "--cage", "@cage.obj", "--posed",
                                        "bend:wide"], "not a preset"),
    "animate: masks of a plain field": (["animate", "@ball.npz", "-o", "@new.mp4", "--show", "masks"], "--show masks"),
    "animate: two paths": (["animate", "@ball.npz", "-o", "@new.mp4", "--turn", "9", "--cameras", "@scene"], "combine"),
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
    argv, expected = BAD[case]
    before = sorted(files.rglob("*"))
    assert run(files, *argv) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    if expected is not None:
        assert len(lines) == 1 and lines[0].startswith("warpcage: error: "), lines
        assert expected in lines[0]
    assert sorted(files.rglob("*")) == before


def test_interruption_leaves_nothing_and_status_130(files, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("warpcage.studio.cli.scenes.fit", interrupted)
    before = sorted(files.rglob("*"))
    assert run(files, "fit", "@scene", "-o", "@new.npz", "--quiet") == 130
    assert "Traceback" not in capsys.readouterr().err
    assert sorted(files.rglob("*")) == before


# Fields, scenes and files


def test_fit_and_evaluate(files, capsys, tmp_path, device):
    out = tmp_path / "deep" / "field.npz"
    argv = ["--quiet", "--device", device]
    succeed(files, "fit", "@scene", "-o", out, "--resolution", 32, "--epochs", 6, "--seed", 3, *argv)
    capsys.readouterr()
    succeed(files, "evaluate", out, "@scene", "--split", "train", "--json", tmp_path / "psnr.json", *argv)
    table = capsys.readouterr().out.splitlines()
    assert len(table) == 1 + 6 + 1 and table[1].split()[0] == "r_0" and table[-1].startswith("mean")
    report = json.loads((tmp_path / "psnr.json").read_text())
    assert report["mean_psnr"] == pytest.approx(np.mean([row["psnr"] for row in report["views"]]))
    assert report["mean_psnr"] > 15.0
    assert float(table[-1].split()[1]) == pytest.approx(report["mean_psnr"], abs=0.006)


def test_evaluate_says_where_it_errs(files, capsys, tmp_path):
    """A field rendered to a scene and one pixel painted over: that view is the worst, red where it was painted, and the
    untouched ones are right."""
    from warpcage import load_scene

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
    argv = ["--worst", tmp_path / "worst.png", "--json", tmp_path / "psnr.json", "--quiet"]
    succeed(files, "evaluate", "@ball.npz", folder, *argv)
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
