"""Fits and evaluations of jobs: those of the commands, and the pictures of a scene are read once."""

import json

import imageio.v3 as iio
import numpy as np
import pytest
from runs import run, without

import warpcage
from warpcage import Camera, FieldOptimizer, SplatField, VoxelField, load_scene
from warpcage.fitting import save_progress
from warpcage.studio.jobs import CHECKPOINTS, Item, Worker

CAMERA = Camera.look_at((2.5, -1.2, 1.0), (0, 0, 0), width=40, height=32)
FRAME = {
    "id": "a",
    "field": "ball.npz",
    "camera": {"eye": [2.5, -1.2, 1.0], "target": [0, 0, 0], "width": 40, "height": 32},
}


def test_a_fit_and_an_evaluation_are_those_of_the_commands(files, tmp_path):
    options = {"resolution": 16, "epochs": 0.5}
    fit = Item.from_json({"id": "ball", "kind": "fit", "scene": "scene", "options": options, "output": "f/{id}.npz"})
    with Worker(files, tmp_path / "out", "cpu") as worker:
        assert list(worker.run(fit)) == ["f/ball.npz"]
    argv = ["fit", "@scene", "-o", tmp_path / "f.npz", "--resolution", 16, "--epochs", "0.5", "--quiet"]
    assert run(files, *argv, "--device", "cpu") == 0
    made, expected = (VoxelField.load(path, device="cpu") for path in (tmp_path / "out/f/ball.npz", tmp_path / "f.npz"))
    np.testing.assert_array_equal(made.grid.density.numpy(), expected.grid.density.numpy())
    np.testing.assert_array_equal(made.render(CAMERA).rgb, expected.render(CAMERA).rgb)

    entry = {"id": "psnr", "kind": "evaluate", "field": "out/f/ball.npz", "scene": f"{files}/scene"}
    with Worker(tmp_path, tmp_path / "out", "cpu") as worker:
        worker.run(Item.from_json(entry))
        assert worker.fields.read_count == 1
    argv = ["evaluate", tmp_path / "out/f/ball.npz", "@scene", "--json", tmp_path / "psnr.json", "--quiet"]
    assert run(files, *argv, "--device", "cpu") == 0
    made, expected = (json.loads(path.read_text()) for path in (tmp_path / "out/psnr.json", tmp_path / "psnr.json"))
    assert made["views"] == expected["views"] and len(made["views"]) == 2
    assert without(made, "field") == without(expected, "field")


def test_splats_are_fitted_and_evaluated_as_by_the_commands(files, tmp_path):
    options = {"representation": "splats", "steps": 20, "pixels_per_splat": 4.0, "seed": 3}
    fit = Item.from_json({"id": "ball", "kind": "fit", "scene": "scene", "options": options, "output": "f/{id}.ply"})
    with Worker(files, tmp_path / "out", "cpu") as worker:
        assert list(worker.run(fit)) == ["f/ball.ply"]
    other = Item.from_json({"id": "ball", "kind": "fit", "scene": "scene", "options": options | {"seed": 4}})
    assert other.outputs == {"field": "ball.ply"}
    scene = load_scene(files / "scene")
    expected = warpcage.fit(scene, device="cpu", progress=False, **options)
    made = SplatField.load(tmp_path / "out/f/ball.ply", device="cpu")
    np.testing.assert_array_equal(made.contents.logits, expected.contents.logits)
    argv = ["fit", "@scene", "-o", tmp_path / "ball.ply", "--steps", 20, "--most-splats", 200, "--quiet"]
    assert run(files, *argv, "--device", "cpu") == 0
    assert 0 < SplatField.load(tmp_path / "ball.ply", device="cpu").splat_count <= 200

    entry = {"id": "psnr", "kind": "evaluate", "field": "out/f/ball.ply", "scene": f"{files}/scene"}
    with Worker(tmp_path, tmp_path / "out", "cpu") as worker:
        worker.run(Item.from_json(entry))
    argv = ["evaluate", tmp_path / "out/f/ball.ply", "@scene", "--json", tmp_path / "psnr.json", "--quiet"]
    assert run(files, *argv, "--device", "cpu") == 0
    made, expected = (json.loads(path.read_text()) for path in (tmp_path / "out/psnr.json", tmp_path / "psnr.json"))
    assert made["views"] == expected["views"] and len(made["views"]) == 2


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
