"""Every Python block of the README and of docs runs as it stands, where the files that it names are there."""

import functools
import pathlib
import re
import shutil

import numpy as np
import pytest
from scenes import TableScene
from splat_scenes import splats_in_box

import warpcage
from warpcage.demo import write_brick_scene
from warpcage.studio.cli import main

ROOT = pathlib.Path(__file__).resolve().parents[3]

#: What is made smaller, or put where these files have it.
SMALLER = {
    "README.md": {"downscale=2": "downscale=1", "vertex_count=100": "40"},
    "python.md": {
        "downscale=2": "downscale=1",
        "vertex_count=100": "40",
        "field, 100, ": "field, 40, ",
        "(0.2, 0.1, 0.4)": "(-0.15, 0.1, 0.2)",
        "falloff=0.3": 'falloff=0.3, held="still"',  # a short fit has no solid matter that a wall could cut
    },
    "batch.md": {"10_000": "3"},
    "fit_pose.md": {
        'load_scene("bent")': 'load_scene("bent"), max_pixels=12, restarts=0, parameters="rigid"',
        'load_scene("both", split="all")': 'load_scene("my_capture")',
        "name.startswith(label)": 'k % 2 == (label == "rest")',
        ".save(label)": '.save(label + "_of_both")',
    },
    "films.md": {"size=160": "size=40", "width=640, height=480": "width=64, height=48"},
    "select.md": {'pixel=(486, 518), camera=scene.cameras[12], plane="wall"': "point=(-0.15, 0.1, 0.2)"},
    "splats.md": {"vertex_count=100": "40", "width=640, height=480": "width=64, height=48", "41, 2": "41, 20"},
    "stage.md": {"width=640, height=480": "width=64, height=48"},
    "sweeps.md": {"000099": "000001", "maxcount=1000": "maxcount=2"},
}

#: What needs a GPU or a browser; the editor's tests open it.
ELSEWHERE = ("cuda", "warpcage.edit(")


def blocks():
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text(encoding="utf-8")
        for found in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            yield pytest.param(page.name, found[1], id=f"{page.stem}-{text.count(chr(10), 0, found.start()) + 2}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the blocks name, small."""
    root = tmp_path_factory.mktemp("blocks")
    write_brick_scene(root / "data" / "lego", train_views=8, size=40, device="cpu")
    for name in ("my_capture", "fox", "bent"):
        shutil.copytree(root / "data" / "lego", root / name)
    table = TableScene(count=32, fragments=False).field
    for name in ("room", "lego", "fox", "toy"):
        table.save(root / f"{name}.npz")
    cage = warpcage.Cage.box((-0.9, -0.9, -0.9), (0.9, 0.9, 0.9))
    cage.save(root / "cage.obj")
    cage.twist(20).save(root / "posed_cage.obj")
    warpcage.Cage.icosphere((0, 0, 0), 0.5).save(root / "model.obj")
    warpcage.Cage.box((-0.9, -0.9, -0.9), (-0.1, 0.9, 0.9)).save(root / "arm.obj")
    warpcage.Cage.box((0.1, -0.9, -0.9), (0.9, 0.9, 0.9)).save(root / "cab.obj")
    warpcage.PoseFile(cage, [("bent", cage.twist(20).vertices)]).save(root / "poses.json")
    np.save(root / "poses.npy", np.stack([cage.twist(degrees).vertices for degrees in (0, 10, 20)]))
    camera = warpcage.Camera.look_at((0, -4, 1), (0, 0, 0), width=32, height=24)
    warpcage.CameraFile([warpcage.CameraKey(camera)]).save(root / "cameras.json")
    for name in ("scene", "robot"):
        splats_in_box("cpu", count=30).save(root / f"{name}.ply")
    arguments = "sweep room.npz --cage cage.obj --poses poses.npy --cameras cameras.json -o sweep.jsonl"
    arguments += " --resolution 24"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        assert main(arguments.split()) == 0
    assert warpcage.run_jobs(root / "sweep.jsonl", root / "dataset", device="cpu").made == 3
    return root


@pytest.fixture
def given(folder):
    """Names that a page takes from its reader."""
    cage = warpcage.Cage.load(folder / "cage.obj")
    camera = warpcage.Camera.look_at((0, -4, 1), (0, 0, 0), width=16, height=12)
    deformer = warpcage.Deformer(warpcage.VoxelField.load(folder / "lego.npz"), cage, resolution=24)
    return {"threads.md": {"cage": cage, "camera": camera, "deformer": deformer}}


def test_what_is_made_smaller_is_there():
    for page, smaller in SMALLER.items():
        said = "".join(block.values[1] for block in blocks() if block.values[0] == page)
        assert not [text for text in smaller if text not in said]


@pytest.mark.parametrize("page, code", blocks())
def test_a_block_runs_as_it_stands(folder, given, monkeypatch, page, code):
    compile(code, page, "exec")
    if any(name in code for name in ELSEWHERE):
        return
    for name in ("webdataset", "torch", "jax"):
        if f"import {name}\n" in code:
            pytest.importorskip(name)
    for text, smaller in SMALLER.get(page, {}).items():
        code = code.replace(text, smaller)
    fit = warpcage.fit
    monkeypatch.setattr(warpcage, "fit", lambda scene, **given: fit(scene, resolution=16, epochs=0.3, **given))
    monkeypatch.setattr(warpcage, "Deformer", functools.partial(warpcage.Deformer, resolution=32))
    monkeypatch.chdir(folder)
    exec(compile(code, page, "exec"), dict(given.get(page, {})))
