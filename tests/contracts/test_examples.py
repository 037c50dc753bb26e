"""Every example runs to its own checks: all in this process but those that want a clean one."""

import functools
import json
import pathlib
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from fields import two_balls
from runs import write_files
from scene_writers import Pictures, write_transforms
from scenes import write_room
from splat_scenes import splats_in_box

import warpcage
from warpcage import Cage, Camera, Deformer, VoxelField
from warpcage.demo import box, brick_model, cylinder, joined, render_mesh_views
from warpcage.studio.cli import main
from warpcage.view import read_image

EXAMPLES = pathlib.Path(__file__).resolve().parents[2] / "examples"

#: Those that take no words and leave no files. The first one wants to begin without warpcage.
SMALL = ("kernel_alone.py", "analytic_field.py", "deform_in_a_pipeline.py", "deform_mesh.py")

#: How long an example to read is at most.
LINES = dict.fromkeys(SMALL, 75) | {"pipeline_step.py": 80, "nerfacc_render.py": 80, "torch_hash_grid.py": 130}

#: What Warp prints by itself.
NOISE = re.compile("^(Module |Warp [0-9])", re.MULTILINE)

NEEDS = {"pipeline_step.py": "torch", "newton_soft_body.py": "newton", "nerfacc_render.py": "torch nerfacc",
         "torch_hash_grid.py": "torch"}  # fmt: skip

#: The small ones one after another, each as loud as Warp is by itself.
PROGRAM = """\
import runpy, sys
import warp as wp
level, (folder, *names), sys.argv[1:] = wp.config.log_level, sys.argv[1:], []
for name in names:
    wp.config.log_level = level
    sys.argv[0] = name
    runpy.run_path(f"{folder}/{name}", run_name="__main__")
    assert name != "kernel_alone.py" or "warpcage" not in sys.modules
"""


@pytest.fixture
def run(tmp_path, monkeypatch, capfd):
    """Starts an example here, in a folder of its own. Gives what it prints, which is as quiet as the commands are."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])

    def run(name, words=""):
        monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
        monkeypatch.setattr(sys, "argv", [name, *words.split()])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        said = capfd.readouterr()
        assert not NOISE.search(said.out + said.err)
        return said.out

    return run


@pytest.fixture
def coarse(monkeypatch, at_night):
    """By day maps are coarser than those of an example that takes no word for it."""
    if not at_night:
        monkeypatch.setattr(warpcage, "Deformer", functools.partial(Deformer, resolution=24))


def summary(out):
    return json.loads((out / "summary.json").read_text())


def test_every_example_is_tested():
    names = {path.name for path in EXAMPLES.glob("[a-z]*.py")}
    text = pathlib.Path(__file__).read_text(encoding="utf-8")
    assert len(names) == 16 and [name for name in names if f'run("{name}"' not in text and name not in SMALL] == []
    for name, most in LINES.items():
        assert len((EXAMPLES / name).read_text().splitlines()) < most


def test_small_examples(tmp_path):
    command = [sys.executable, "-c", PROGRAM, str(EXAMPLES), *SMALL]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr[-2000:]
    assert not NOISE.search(done.stdout + done.stderr) and list(tmp_path.iterdir()) == []
    for said in ("affine map off by ", "turned cage against moved camera: ", "turned cages turn the model"):
        assert said in done.stdout


@pytest.mark.parametrize("name", SMALL)
def test_help_runs_no_example(name, run, capfd):
    with pytest.raises(SystemExit) as leave:
        run(name, "--help")
    said = capfd.readouterr().out
    assert leave.value.code == 0
    assert said.startswith("usage: ") and len(said.splitlines()) < 20 and f"python examples/{name}" in said


@pytest.mark.parametrize("name", NEEDS)
def test_an_example_says_what_it_needs(name, run, tmp_path, monkeypatch):
    missing = NEEDS[name].split()[-1]
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(SystemExit) as leave:
        run(name)
    assert leave.value.code == f"{name} needs {missing}: pip install {NEEDS[name]}"
    assert not list(tmp_path.iterdir())


def test_a_step_of_a_pipeline(run, tmp_path):
    pytest.importorskip("torch")
    assert "one fit cancelled, one done" in run("pipeline_step.py", "--out out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["frame.npz", "frame.png", "pipeline.log"]
    picture = read_image(tmp_path / "out" / "frame.png")
    assert picture.shape == (40, 40, 4) and 0.2 < (picture[..., 3] > 0.5).mean() < 0.5


def test_another_renderer_of_fields(run):
    pytest.importorskip("torch"), pytest.importorskip("nerfacc")
    assert float(re.search(r"within (\S+) dB", run("nerfacc_render.py"))[1]) > 50.0


def test_a_hash_grid_of_torch_is_bent(run, tmp_path):
    pytest.importorskip("torch")
    said = run("torch_hash_grid.py", "--steps 12 --size 24 --out grid.png")
    assert float(re.search(r"within (\S+) dB of warpcage's", said)[1]) > 35.0
    assert read_image(tmp_path / "grid.png").shape[:2] == (24, 72)


def test_a_soft_body_carries_what_it_holds(run, tmp_path):
    pytest.importorskip("newton")
    two_balls("cpu").save(tmp_path / "balls.npz")
    words = "--field balls.npz --out drop.mp4 --size 32 --device cpu"
    assert "wrote drop.mp4: 40 pictures" in run("newton_soft_body.py", words)


def test_compare_coordinates(run, tmp_path):
    said = run("compare_coordinates.py", "--size 60 --out out")
    reach = {line.split()[0]: float(line.rsplit(" ", 1)[1]) for line in said.splitlines() if "other leg" in line}
    assert reach["harmonic"] < reach["biharmonic"] < reach["maximum_likelihood"] < 0.5 * reach["mean_value"]
    assert read_image(tmp_path / "out" / "coordinates.png").shape[1] == 6 * 60 + 5 * 4


@pytest.mark.scaled
def test_cage_contact_sheet(run, tmp_path, at_night):
    """At night also around a mesh, and with another count."""
    scenes, counts, resolution = (["ring", "bricks"], [42, 60], 40) if at_night else (["ring"], [60], 28)
    words = f"--scenes {' '.join(scenes)} --counts {' '.join(map(str, counts))} --resolution {resolution}"
    total = len(scenes) * len(counts)
    assert f"{total} cages, {total} enclose" in run("cage_contact_sheet.py", f"{words} --size 48 --out out")
    reports = json.loads((tmp_path / "out" / "reports.json").read_text())
    assert list(reports) == [f"{name} {count}" for name in scenes for count in counts]
    assert reports["ring 60"]["genus"] == 1 and reports["ring 60"]["field_enclosed"] == 1.0
    sheet = read_image(tmp_path / "out" / "cages.png")
    assert sheet.shape[1] == (1 + len(counts)) * 48 + 4 * len(counts) and sheet.shape[0] > len(scenes) * 48
    orange = np.abs(sheet[:48] - [1.0, 0.45, 0.0]).max(axis=-1) < 0.1
    assert orange[:, :48].sum() == 0 and orange[:, 52:100].sum() > 50
    assert Cage.load(tmp_path / "out" / f"{scenes[-1]}_60.obj").check().usable


def model_field(resolution, device):
    """The surface of the brick model as a thin grey shell of voxels."""
    vertices, faces, _ = brick_model()
    low, high = vertices.min(axis=0) - 0.1, vertices.max(axis=0) + 0.1
    random = np.random.default_rng(0).dirichlet([1, 1, 1], (len(faces), 200))
    points = np.einsum("fkc,fci->fki", random, vertices[faces]).reshape(-1, 3)
    density = np.zeros((resolution,) * 3)
    density[tuple(((points - low) / (high - low) * resolution).astype(int).T)] = 80.0
    return VoxelField.from_dense(density, np.zeros((*density.shape, 9, 3)), [low, high], device=device)


def test_edit_parts_of_the_bricks(run, tmp_path, device):
    """On a field of the brick model's own surface: its boxes are those of the fitted scene."""
    model_field(80, device).save(tmp_path / "bricks.npz")
    run("edit_parts.py", f"--field bricks.npz --out out --size 48 --resolution 24 --device {device}")

    def shown(name, count):
        picture = read_image(tmp_path / "out" / name).reshape(48, -1, 3)
        assert picture.shape[1] == 52 * count - 4
        return [(picture[:, 52 * i : 52 * i + 48] < 0.95).any(axis=-1) for i in range(count)]

    order = [panel.sum() for panel in shown("order.png", 5)]
    assert order[1] > order[0] + 40 and order[2] < order[1] - 15  # a second cabin, no bucket
    clean = [panel.sum() for panel in shown("clean.png", 3)]
    assert clean[2] <= clean[1] < clean[0]  # snapped walls take more of the bucket along, fragments the rest of it
    left, taken, _ = shown("carried.png", 3)
    assert (left & ~taken).sum() > 10 and (taken & ~left).sum() > 10  # fragments go from here, and come there
    assert main(["edits", str(tmp_path / "out" / "excavator.edits.json")]) == 0


@pytest.mark.scaled
def test_edit_dtu_on_a_room(run, tmp_path, device, coarse, at_night):
    write_room(tmp_path / "room", 25, 32)
    words = f"--data room --device {device} --quality fast --epochs {8 if at_night else 4} --width 40"
    assert "dB inside the masks of 4 held-out views" in run("edit_dtu.py", f"--out out {words}")
    out = tmp_path / "out"
    found = summary(out)
    assert found["masked_psnr"] > 14.0 and found["psnr"] > 17.0 and found["unmoved"] < 1e-5 and found["filled"] > 0.02
    assert read_image(out / "edits.png").shape == (3 * 40 + 8, 3 * 40 + 8, 3)
    assert read_image(out / "falloff.png").shape == (40, 3 * 40 + 8, 3)
    assert read_image(out / "fill.png").shape == (2 * 40 + 4, 3 * 40 + 8, 3)
    assert Cage.load(out / "generated.obj").check().usable and Cage.load(out / "box_posed.obj").check().usable
    if at_night:
        run("edit_dtu.py", f"--out again --field out/field.npz --cage out/generated.obj {words}")
        assert read_image(tmp_path / "again" / "edits.png").shape == (3 * 40 + 8, 3 * 40 + 8, 3)


@pytest.mark.scaled
def test_edit_fox_on_a_head_on_a_wall(run, tmp_path, device, at_night):
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
    write_transforms(tmp_path / "head", Pictures(np.round(255 * rgba).astype(np.uint8), cameras))
    pixel = cameras[1].project(np.array([[0.3, 0.0, 0.05]]))[0][0] / 44
    words = (
        f"--data head --device {device} --quality fast --epochs {6 if at_night else 4} --resolution 48 --downscale 1"
    )
    words += f" --vertices 40 --lattice 24 --views 0 1 2 --no-video --click view_01 {pixel[0]} {pixel[1]}"
    run("edit_fox.py", f"{words} --out out")
    out = tmp_path / "out"
    found = summary(out)
    assert found["psnr"] > 20.0 and found["still"] < 0.02 and found["enclosed"] == 1.0
    assert "above the wall" in found["notes"][-1]
    rest, posed = Cage.load(out / "cage.obj"), Cage.load(out / "posed.obj")
    assert -0.7 < rest.bounds[0, 0] < -0.35 and rest.contains([[0.1, 0, 0]]).all()
    assert not rest.contains([[-0.65, 0.6, -0.45], [-0.75, 0, 0], [-0.68, 0.4, 0.4]]).any()  # neither block nor wall
    assert posed.bounds[1, 0] > rest.bounds[1, 0] + 0.1
    assert read_image(out / "edit.png").shape == (3 * 44 + 8, 3 * 44 + 8, 3)


@pytest.mark.scaled
def test_render_lego_on_the_brick_scene(run, tmp_path, device, at_night):
    tiny = "--views 20 --lattice 16 --vertices 50 --epochs 5 --frames 3"
    if at_night:
        tiny = "--views 24 --lattice 24 --vertices 80 --epochs 8 --frames 4"
    tiny += f" --size 40 --picture 64 --film 48 --device {device}"
    run("render_lego.py", f"--out out {tiny}")
    out = tmp_path / "out"
    names = ["bend.gif", "bend.mp4", "cage.obj", "deformed.png", "field.npz", "mesh.obj", "posed.obj", "scene",
             "summary.json"]  # fmt: skip
    assert sorted(path.name for path in out.iterdir()) == names
    found = summary(out)
    assert found["test_psnr"] > 20.0
    assert set(found["seconds"]) == {"scene", "fit", "evaluate", "mesh", "cage", "pose", "pictures", "film", "all"}
    cage = Cage.load(out / "cage.obj")
    assert (found["cage_vertices"], found["cage_faces"]) == (len(cage.vertices), len(cage.faces))
    assert found["voxels"] > 1000 and found["versions"]["warp-lang"] and found["device"]
    assert read_image(out / "deformed.png").shape == (2 * 64 + 4, 3 * 64 + 8, 3)
    if at_night:  # once more on that folder as data, with that cage, without the film
        run("render_lego.py", f"--quick --out again --data out/scene --cage out/cage.obj --no-video {tiny}")
        again = tmp_path / "again"
        assert summary(again)["test_psnr"] == pytest.approx(found["test_psnr"], abs=1.0)
        assert not (again / "bend.mp4").exists()
        assert (again / "cage.obj").read_bytes() == (out / "cage.obj").read_bytes()


def test_splats_are_bent(run, tmp_path):
    """Of splats made here, so that it runs without data: they move, and the saved file shows the same."""
    splats_in_box("cpu", count=300, scales=(-3.2, -2.6)).save(tmp_path / "made.ply")
    said = run("bend_splats.py", "made.ply --out out --vertices 40 --size 64 --device cpu --axis z --towards x")
    assert int(re.search(r", (\d+) bent", said)[1]) >= 300
    sheet = read_image(tmp_path / "out" / "splats.png")
    still, posed, saved = sheet[:64, :64], sheet[68:, :64], sheet[68:, 68:]
    assert warpcage.psnr(posed, still) < 35.0 and warpcage.psnr(saved, posed) > 60.0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"cage.obj", "bent.ply", "splats.png"}


def test_captures_of_a_pose_fit_as_well_as_those_at_rest(run, tmp_path):
    """On a two-coloured ball: its field and cage are given."""
    write_files(tmp_path)
    words = "--field ball.npz --cage cage.obj --size 32 --views 24 --poses 2 --epochs 20 --seed 1 --lattice 24"
    run("augment_captures.py", f"{words} --coordinates mean_value --device cpu --out out")
    found = summary(tmp_path / "out")
    rest, of_the_pose, posed = found["psnr"].values()
    assert found["pictures"] == 48 and rest > 22.0 and abs(posed - rest) < 1.5 and of_the_pose < posed - 2.0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "dataset", "poses.png", "refit.png", "summary.json", "sweep.cameras.json", "sweep.jsonl", "sweep.poses.npy"
    }  # fmt: skip
    poses = sorted(path.name for path in (tmp_path / "out/dataset").glob("pose_*"))
    assert poses == ["pose_000000", "pose_000001"]
