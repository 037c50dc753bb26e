"""Fits and evaluations of jobs: those of the commands, and the pictures of a scene are read once."""

import json

import imageio.v3 as iio
import numpy as np
import pytest
from runs import run, without

from warpcage import Camera, FieldOptimizer, VoxelField
from warpcage.fitting import save_progress
from warpcage.splats import load_field
from warpcage.studio.jobs import CHECKPOINTS, Item, Worker

CAMERA = Camera.look_at((2.5, -1.2, 1.0), (0, 0, 0), width=40, height=32)
FRAME = {
    "id": "a",
    "field": "ball.npz",
    "camera": {"eye": [2.5, -1.2, 1.0], "target": [0, 0, 0], "width": 40, "height": 32},
}


@pytest.mark.parametrize(
    ("ending", "options", "flags"),
    [
        ("npz", {"resolution": 16, "epochs": 0.5}, "--resolution 16 --epochs 0.5"),
        ("ply", {"representation": "splats", "steps": 20, "most_splats": 200, "seed": 3},
         "--steps 20 --most-splats 200 --seed 3"),
    ],
)  # fmt: skip
def test_a_fit_and_an_evaluation_are_those_of_the_commands(files, tmp_path, ending, options, flags):
    entry = {"id": "ball", "kind": "fit", "scene": "scene", "options": options}
    name = f"f/ball.{ending}"
    with Worker(files, tmp_path / "out", "cpu") as worker:
        assert list(worker.run(Item.from_json(entry | {"output": f"f/{{id}}.{ending}"}))) == [name]
    assert Item.from_json(entry).outputs == {"field": f"ball.{ending}"}
    paths = tmp_path / "out" / name, tmp_path / f"by_command.{ending}"
    assert run(files, "fit", "@scene", "-o", paths[1], *flags.split(), "--quiet", "--device", "cpu") == 0
    made, expected = (load_field(path, device="cpu") for path in paths)
    if ending == "npz":
        np.testing.assert_array_equal(made.grid.density.numpy(), expected.grid.density.numpy())
    else:
        np.testing.assert_array_equal(made.contents.logits, expected.contents.logits)
        assert 0 < made.splat_count <= 200
    np.testing.assert_array_equal(made.render(CAMERA).rgb, expected.render(CAMERA).rgb)

    entry = {"id": "psnr", "kind": "evaluate", "field": f"out/{name}", "scene": f"{files}/scene"}
    with Worker(tmp_path, tmp_path / "out", "cpu") as worker:
        worker.run(Item.from_json(entry))
        assert worker.fields.read_count == 1
    argv = ["evaluate", paths[0], "@scene", "--json", tmp_path / "psnr.json", "--quiet", "--device", "cpu"]
    assert run(files, *argv) == 0
    made, expected = (json.loads(path.read_text()) for path in (tmp_path / "out/psnr.json", tmp_path / "psnr.json"))
    assert made["views"] == expected["views"] and len(made["views"]) == 2
    assert without(made, "field") == without(expected, "field")


def test_fits_of_one_scene_read_its_pictures_once(files, tmp_path):
    """And are those of a worker each, to the bit; a changed picture is read, other options are another scene."""
    entry = {"kind": "fit", "scene": "scene"}
    options = [{"resolution": 16, "epochs": 0.5, "seed": seed} for seed in (0, 1)]
    items = [Item.from_json(entry | {"id": f"fit{k}", "options": each}) for k, each in enumerate(options)]
    with Worker(files, tmp_path / "together", "cpu") as worker:
        for item in items:
            worker.run(item)
        assert worker.fits.read_count == 1
        worker.run(Item.from_json(entry | {"id": "half", "downscale": 2, "options": options[0]}))
        assert worker.fits.read_count == 2
        picture = next((files / "scene").rglob("*.png"))
        pixels = iio.imread(picture)
        iio.imwrite(picture, 255 - pixels)
        worker.run(Item.from_json(entry | {"id": "half", "downscale": 2, "options": options[0]}))
        assert worker.fits.read_count == 3
        iio.imwrite(picture, pixels)
        worker.run(Item.from_json(FRAME))
        worker.run(items[1])
        assert worker.fits.read_count == 4
    for item in items:
        with Worker(files, tmp_path / "alone", "cpu") as worker:
            worker.run(item)
        one, two = (VoxelField.load(tmp_path / place / f"{item.id}.npz") for place in ("together", "alone"))
        np.testing.assert_array_equal(one.grid.density.numpy(), two.grid.density.numpy())


def test_a_fit_that_died_goes_on_from_its_progress(files, tmp_path, monkeypatch):
    entry = {"id": "ball", "kind": "fit", "scene": "scene", "options": {"resolution": 16, "epochs": 0.5}}
    whole = Worker(files, tmp_path / "whole", "cpu")
    whole.run(Item.from_json(entry))
    steps = []

    def step(optimizer):
        steps.append(optimizer.step_count)
        if len(steps) == 3:
            save_progress(optimizer, worker.checkpoint_path(item))
            raise OSError("the node is gone")
        return ordinary(optimizer)

    ordinary, item = FieldOptimizer.step, Item.from_json(entry)
    worker = Worker(files, tmp_path / "out", "cpu")
    monkeypatch.setattr(FieldOptimizer, "step", step)
    with pytest.raises(OSError, match="the node is gone"):
        worker.run(item)
    worker.run(item)
    assert steps[3] == steps[2] == 2
    assert list((tmp_path / "out" / CHECKPOINTS).iterdir()) == []
    one, two = (VoxelField.load(tmp_path / place / "ball.npz", device="cpu") for place in ("whole", "out"))
    np.testing.assert_array_equal(one.grid.density.numpy(), two.grid.density.numpy())
