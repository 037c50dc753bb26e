"""The command line: what it writes, what it says, how it ends."""

import json
import pathlib
import re
import subprocess

import imageio.v3 as iio
import numpy as np
import pytest
import warp as wp
from runs import command, run, succeed

from warpcage import VoxelField
from warpcage.core import warn_caller
from warpcage.studio.cli import main
from warpcage.view import read_image

# Help and wrong input


def test_the_package_runs_as_a_module():
    helped = subprocess.run(command("--help"), capture_output=True, text=True)
    assert helped.returncode == 0 and helped.stdout.startswith("usage: warpcage ")
    wrong = subprocess.run(command("info", "nowhere.npz"), capture_output=True, text=True)
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
    succeed(files, "info", "@open.obj")
    assert "no: " in capsys.readouterr().out
