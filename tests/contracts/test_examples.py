"""Every example runs to its own checks."""

import json
import pathlib
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
from fields import two_balls
from scene_writers import Pictures, write_transforms
from scenes import write_room

from warpcage import Cage, Camera
from warpcage.reference import box, cylinder, joined, render_mesh_views
from warpcage.view import read_image

EXAMPLES = pathlib.Path(__file__).resolve().parents[2] / "examples"

#: The brick scene, much smaller than by default.
TINY = ("--size", "40", "--views", "24", "--picture", "64", "--film", "48", "--frames", "4", "--lattice", "24",
        "--vertices", "80", "--epochs", "8")  # fmt: skip


def run(name, *words, cwd):
    command = [sys.executable, str(EXAMPLES / name), *map(str, words)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr[-2000:]
    assert not re.search("^(Module |Warp [0-9])", done.stdout + done.stderr, re.MULTILINE)  # as quiet as the commands
    return done.stdout


def run_here(monkeypatch, name, *words, cwd):
    """Once more, in this process: that it starts by itself is shown."""
    monkeypatch.chdir(cwd)
    monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def test_every_example_is_tested():
    names = {path.name for path in EXAMPLES.glob("[a-z]*.py")}
    assert names == {"render_lego.py", "deform_in_a_pipeline.py", "deform_mesh.py", "kernel_alone.py",
                     "analytic_field.py", "cage_contact_sheet.py", "edit_dtu.py", "edit_fox.py",
                     "edit_parts.py", "bend_splats.py", "augment_captures.py", "pipeline_step.py",
                     "newton_soft_body.py"}  # fmt: skip


@pytest.mark.parametrize("name", ["analytic_field.py", "deform_in_a_pipeline.py", "deform_mesh.py", "kernel_alone.py"])
def test_small_examples(name, tmp_path):
    assert len((EXAMPLES / name).read_text().splitlines()) < 75
    run(name, cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_step_of_a_pipeline(tmp_path):
    pytest.importorskip("torch")
    assert len((EXAMPLES / "pipeline_step.py").read_text().splitlines()) < 80
    assert "one fit cancelled, one done" in run("pipeline_step.py", "--out", "out", cwd=tmp_path)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["frame.npz", "frame.png", "pipeline.log"]
    picture = read_image(tmp_path / "out" / "frame.png")
    assert picture.shape == (40, 40, 4) and 0.2 < (picture[..., 3] > 0.5).mean() < 0.5


@pytest.mark.parametrize("name, needed", [("pipeline_step.py", "torch"), ("newton_soft_body.py", "newton")])
def test_an_example_says_what_it_needs(name, needed, tmp_path):
    path = str(EXAMPLES / name)
    begin = f"import runpy, sys; sys.modules[{needed!r}] = None; sys.argv[1:] = []; "
    program = f"{begin}runpy.run_path({path!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 1 and done.stderr == f"{name} needs {needed}: pip install {needed}\n"
    assert not list(tmp_path.iterdir())


def test_a_soft_body_carries_what_it_holds(tmp_path):
    pytest.importorskip("newton")
    two_balls("cpu").save(tmp_path / "balls.npz")
    words = ["--field", "balls.npz", "--out", "drop.mp4", "--size", 32, "--device", "cpu"]
    assert "wrote drop.mp4: 40 pictures" in run("newton_soft_body.py", *words, cwd=tmp_path)


@pytest.mark.parametrize("name", ["analytic_field.py", "deform_in_a_pipeline.py", "deform_mesh.py", "kernel_alone.py"])
def test_help_runs_no_example(name, tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit) as leave:
        run_here(monkeypatch, name, "--help", cwd=tmp_path)
    assert leave.value.code == 0
    said = capsys.readouterr().out
    assert said.startswith("usage: ") and len(said.splitlines()) < 20 and f"python examples/{name}" in said


def test_kernel_alone_imports_nothing_but_its_copy():
    lines = [line.strip() for line in (EXAMPLES / "kernel_alone.py").read_text().splitlines()]
    imports = [line for line in lines if re.match("(import|from) ", line)]
    assert [line for line in imports if "borrowed" not in line] == [
        "import argparse", "import subprocess", "import sys", "import tempfile", "import numpy as np",
        "import warp as wp"]  # fmt: skip
    assert 'assert "warpcage" not in sys.modules' in lines


def test_cage_contact_sheet(tmp_path):
    words = ["--scenes", "ring", "bricks", "--counts", 42, 60, "--resolution", 40, "--size", 48]
    assert "4 cages, 4 enclose" in run("cage_contact_sheet.py", "--out", "out", *words, cwd=tmp_path)
    reports = json.loads((tmp_path / "out" / "reports.json").read_text())
    assert list(reports) == ["ring 42", "ring 60", "bricks 42", "bricks 60"]
    assert reports["ring 60"]["genus"] == 1 and reports["ring 60"]["field_enclosed"] == 1.0
    sheet = read_image(tmp_path / "out" / "cages.png")
    assert sheet.shape[1] == 3 * 48 + 8 and sheet.shape[0] > 2 * 48
    orange = np.abs(sheet[:48] - [1.0, 0.45, 0.0]).max(axis=-1) < 0.1
    assert orange[:, :48].sum() == 0 and orange[:, 52:100].sum() > 50
    assert Cage.load(tmp_path / "out" / "bricks_42.obj").check().usable


def test_edit_parts_of_the_bricks(tmp_path, device):
    """On a field of the brick model's own surface: its boxes are those of the fitted scene."""
    model_field(80, device).save(tmp_path / "bricks.npz")
    words = ["--field", "bricks.npz", "--out", "out", "--size", 48, "--resolution", 24, "--device", device]
    run("edit_parts.py", *words, cwd=tmp_path)
    order = read_image(tmp_path / "out" / "order.png").reshape(48, -1, 3)
    panels = [order[:, 52 * i : 52 * i + 48] for i in range(5)]
    shown = [(panel < 0.95).any(axis=-1).sum() for panel in panels]
    assert shown[1] > shown[0] + 40 and shown[2] < shown[1] - 15  # a second cabin, no bucket
    clean = read_image(tmp_path / "out" / "clean.png")
    assert clean.shape[:2] == (48, 3 * 48 + 2 * 4)
    left = [(clean[:, 52 * i : 52 * i + 48] < 0.95).any(axis=-1).sum() for i in range(3)]
    assert left[2] <= left[1] < left[0]  # snapped walls take more of the bucket along, fragments the rest of it
    carried = read_image(tmp_path / "out" / "carried.png")
    left, taken = ((carried[:, 52 * i : 52 * i + 48] < 0.95).any(axis=-1) for i in range(2))
    assert (left & ~taken).sum() > 10 and (taken & ~left).sum() > 10  # fragments go from here, and come there
    said = succeed_here("edits", tmp_path / "out" / "excavator.edits.json")
    assert said == 0


def model_field(resolution, device):
    """The surface of the brick model as a thin grey shell of voxels."""
    from warpcage import VoxelField
    from warpcage.reference import brick_model

    vertices, faces, _ = brick_model()
    low, high = vertices.min(axis=0) - 0.1, vertices.max(axis=0) + 0.1
    random = np.random.default_rng(0).dirichlet([1, 1, 1], (len(faces), 200))
    points = np.einsum("fkc,fci->fki", random, vertices[faces]).reshape(-1, 3)
    density = np.zeros((resolution,) * 3)
    density[tuple(((points - low) / (high - low) * resolution).astype(int).T)] = 80.0
    return VoxelField.from_dense(density, np.zeros((*density.shape, 9, 3)), [low, high], device=device)


def succeed_here(*words):
    from warpcage.cli import main

    return main([str(word) for word in words])


def test_edit_dtu_on_a_room(tmp_path, device, monkeypatch):
    write_room(tmp_path / "room", 25, 32)
    words = ["--data", "room", "--device", device, "--quality", "fast", "--epochs", "8", "--width", "40"]
    said = run("edit_dtu.py", "--out", "out", *words, cwd=tmp_path)
    assert "dB inside the masks of 4 held-out views" in said
    out = tmp_path / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["masked_psnr"] > 14.0 and summary["psnr"] > 17.0 and summary["unmoved"] < 1e-5
    assert read_image(out / "edits.png").shape == (3 * 40 + 8, 3 * 40 + 8, 3)
    assert read_image(out / "falloff.png").shape == (40, 3 * 40 + 8, 3)
    assert read_image(out / "fill.png").shape == (2 * 40 + 4, 3 * 40 + 8, 3) and summary["filled"] > 0.02
    assert Cage.load(out / "generated.obj").check().usable and Cage.load(out / "box_posed.obj").check().usable
    # once more with that field and cage
    again = ["--out", "again", "--field", out / "field.npz", "--cage", out / "generated.obj"]
    run_here(monkeypatch, "edit_dtu.py", *again, *words, cwd=tmp_path)
    assert read_image(tmp_path / "again" / "edits.png").shape == (3 * 40 + 8, 3 * 40 + 8, 3)


def test_edit_fox_on_a_head_on_a_wall(tmp_path, device, monkeypatch):
    """A block on a pole out of a wall; up is +z, and the wall looks along +x."""
    vertices, faces, colors = joined(
        [
            box((-0.9, -0.9, -0.8), (-0.7, 0.9, 0.8), (0.6, 0.5, 0.3)),
            box((-0.7, 0.5, -0.6), (-0.6, 0.7, -0.3), (0.2, 0.3, 0.8)),
            cylinder((-0.7, 0, 0), (0, 0, 0), 0.14, (0.9, 0.8, 0.2), segments=16),
            box((-0.1, -0.2, -0.2), (0.3, 0.2, 0.25), (0.8, 0.1, 0.5)),
        ]
    )
    random = np.random.default_rng(0)
    eyes = [np.array([1.0, *random.uniform(-0.8, 0.8, 2)]) for _ in range(28)]
    cameras = [Camera.look_at(3 * eye / np.linalg.norm(eye), (-0.3, 0, 0), width=44, height=44) for eye in eyes]
    rgba = render_mesh_views(vertices, faces, colors, cameras, samples=2, device=device)
    (tmp_path / "head").mkdir()
    write_transforms(tmp_path / "head", Pictures(np.round(255 * rgba).astype(np.uint8), cameras))
    pixel = cameras[1].project(np.array([[0.3, 0.0, 0.05]]))[0][0] / 44
    words = ["--data", "head", "--device", device, "--quality", "fast", "--epochs", 6, "--resolution", 48]
    words += ["--downscale", 1, "--vertices", 40, "--lattice", 24, "--views", 0, 1, 2, "--no-video"]
    monkeypatch.chdir(tmp_path)
    run("edit_fox.py", *words, "--click", "view_01", *pixel, "--out", "out", cwd=tmp_path)
    out = tmp_path / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["psnr"] > 20.0 and summary["still"] < 0.02 and summary["enclosed"] == 1.0
    assert "above the wall" in summary["notes"][-1]
    rest, posed = Cage.load(out / "cage.obj"), Cage.load(out / "posed.obj")
    assert -0.7 < rest.bounds[0, 0] < -0.35 and rest.contains([[0.1, 0, 0]]).all()
    assert not rest.contains([[-0.65, 0.6, -0.45], [-0.75, 0, 0], [-0.68, 0.4, 0.4]]).any()  # neither block nor wall
    assert posed.bounds[1, 0] > rest.bounds[1, 0] + 0.1
    assert read_image(out / "edit.png").shape == (3 * 44 + 8, 3 * 44 + 8, 3)


def test_render_lego_on_the_brick_scene(tmp_path, device, monkeypatch):
    run("render_lego.py", "--device", device, "--out", "out", *TINY, cwd=tmp_path)
    out = tmp_path / "out"
    names = ["bend.gif", "bend.mp4", "cage.obj", "deformed.png", "field.npz", "mesh.obj", "posed.obj", "scene",
             "summary.json"]  # fmt: skip
    assert sorted(path.name for path in out.iterdir()) == names
    summary = json.loads((out / "summary.json").read_text())
    assert summary["test_psnr"] > 20.0
    assert set(summary["seconds"]) == {"scene", "fit", "evaluate", "mesh", "cage", "pose", "pictures", "film", "all"}
    cage = Cage.load(out / "cage.obj")
    assert (summary["cage_vertices"], summary["cage_faces"]) == (len(cage.vertices), len(cage.faces))
    assert summary["voxels"] > 1000 and summary["versions"]["warp-lang"] and summary["device"]
    assert read_image(out / "deformed.png").shape == (2 * 64 + 4, 3 * 64 + 8, 3)

    # once more on that folder as data, with that cage, without the film
    words = ["--data", out / "scene", "--cage", out / "cage.obj", "--device", device, "--no-video", *TINY]
    run_here(monkeypatch, "render_lego.py", "--quick", "--out", "again", *words, cwd=tmp_path)
    again = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert again["test_psnr"] == pytest.approx(summary["test_psnr"], abs=1.0)
    assert not (tmp_path / "again" / "bend.mp4").exists()
    assert (tmp_path / "again" / "cage.obj").read_bytes() == (out / "cage.obj").read_bytes()


def test_splats_are_bent(tmp_path, monkeypatch):
    """Of splats made here, so that it runs without data: they move, and the saved file shows the same."""
    from splat_scenes import splats_in_box

    splats_in_box("cpu", count=300, scales=(-3.2, -2.6)).save(tmp_path / "made.ply")
    monkeypatch.chdir(tmp_path)
    words = ["made.ply", "--out", "out", "--vertices", "40", "--size", "64", "--device", "cpu", "--axis", "z"]
    run("bend_splats.py", *words, "--towards", "x", cwd=tmp_path)  # quiet
    found = runpy.run_path(str(EXAMPLES / "bend_splats.py"))["main"]([*words, "--towards", "x"])
    assert found["moved"] < 35.0 and found["saved"] > 60.0 and found["count"] >= 300
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"cage.obj", "bent.ply", "splats.png"}


def test_captures_of_a_pose_fit_as_well_as_those_at_rest(tmp_path, monkeypatch):
    """On a two-coloured ball: its field and cage are given."""
    from runs import write_files

    write_files(tmp_path)
    words = ["--field", "ball.npz", "--cage", "cage.obj", "--out", "out", "--size", 32, "--views", 24, "--poses", 2]
    words += ["--epochs", 20, "--seed", 1, "--lattice", 24, "--coordinates", "mean_value", "--device", "cpu"]
    monkeypatch.chdir(tmp_path)
    found = runpy.run_path(str(EXAMPLES / "augment_captures.py"))["main"]([*map(str, words)])
    rest, of_the_pose, posed = found["psnr"].values()
    assert found["pictures"] == 48 and rest > 22.0 and abs(posed - rest) < 1.5 and of_the_pose < posed - 2.0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "dataset", "poses.png", "refit.png", "summary.json", "sweep.cameras.json", "sweep.jsonl", "sweep.poses.npy"
    }  # fmt: skip
    shards = sorted(path.name for path in (tmp_path / "out/dataset").glob("*.tar"))
    assert shards == ["shard-000000.tar", "shard-000001.tar"]
