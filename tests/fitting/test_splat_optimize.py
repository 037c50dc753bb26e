"""Splats from pictures: what `fit(scene, representation="splats")` makes of scenes that the tests make."""

import dataclasses

import imageio.v3 as imageio
import numpy as np
import pytest
from splat_scenes import held_out_psnr, ring, scene_of, true_field

import warpcage
from warpcage import SplatField
from warpcage.fitting.splats import SplatFit, SplatFitOptions, SplatSchedule
from warpcage.fitting.splats.start import QUICK_FIT

FAST = {"steps": 500, "most_splats": 2500, "pixels_per_splat": 1.0}


@pytest.fixture(scope="module")
def fitted():
    """Truth, scene, and the fit of it, on the CPU."""
    truth = true_field("cpu")
    points = truth.contents.centers + 0.05 * np.random.default_rng(1).normal(size=truth.contents.centers.shape)
    scene = scene_of(truth, ring(12, 20) + ring(12, -10), points=points)
    return truth, scene, warpcage.fit(scene, representation="splats", device="cpu", progress=False, **FAST)


def test_views_that_were_held_out(fitted):
    truth, _, field = fitted
    assert isinstance(field, SplatField) and 1000 < field.splat_count <= 2500
    assert held_out_psnr(field, truth) > 21.5
    assert (field.background == 0).all() and field.opacities.min() >= 0.0039


def test_the_same_seed_gives_the_same_splats(fitted, two_threads):
    _truth, scene, field = fitted
    again = warpcage.fit(scene, representation="splats", device="cpu", progress=False, **FAST)
    for name in ("centers", "log_scales", "quaternions", "logits", "harmonics"):
        assert (getattr(again.contents, name) == getattr(field.contents, name)).all()


@pytest.fixture
def small_quick_fits(monkeypatch):
    """The fits of voxels that starts are taken from, at a size that takes no seconds."""
    for name in ("max_resolution", "max_outer_resolution"):
        monkeypatch.setitem(QUICK_FIT, name, 40)


def test_any_device_and_no_points(device, small_quick_fits):
    """Places that the views see are enough to begin with."""
    truth = true_field(device)
    scene = scene_of(truth, ring(12, 20) + ring(12, -10))
    field = warpcage.fit(scene, representation="splats", device=device, progress=False, **FAST)
    assert held_out_psnr(field, truth) > 20


def test_opacity_is_supervised_where_pictures_have_it(device):
    truth = true_field(device, background="white")
    scene = scene_of(truth, ring(12, 20) + ring(12, -10), alphas=True)
    field = warpcage.fit(scene, representation="splats", device=device, progress=False, **FAST)
    assert (field.background == 1).all() and held_out_psnr(field, truth) > 23
    camera = ring(1, 5)[0]
    assert np.abs(field.render(camera).alpha - truth.render(camera).alpha).mean() < 0.05


def test_sizes_of_scenes_do_not_matter(device):
    """A scene in other units gives the same splats in those."""
    truth = true_field(device)
    scene = scene_of(truth, ring(10, 20), points=truth.contents.centers)
    poses = [camera.camera_to_world.copy() for camera in scene.cameras]
    for pose in poses:
        pose[:3, 3] = 1000.0 * pose[:3, 3]
    cameras = [
        dataclasses.replace(camera, camera_to_world=pose) for camera, pose in zip(scene.cameras, poses, strict=True)
    ]
    large = dataclasses.replace(scene, cameras=cameras, points=1000.0 * scene.points)
    options = {"representation": "splats", "device": device, "progress": False, **FAST, "steps": 60}
    small, large = warpcage.fit(scene, **options), warpcage.fit(large, **options)
    assert abs(small.splat_count - large.splat_count) < 0.02 * small.splat_count
    near = np.median(small.scales) * 1000.0 / np.median(large.scales)
    assert abs(near - 1) < 0.05


def test_bounds_of_scales(device, two_threads):
    """Needles become shorter, and no splat that pictures see is smaller than a part of a pixel."""
    truth = true_field(device, 60)
    scene = scene_of(truth, ring(8, 20, (40, 32)), points=truth.contents.centers)
    options = {"device": device, "steps": 150, "pixels_per_splat": 1.0, "most_splats": 400, "grow_every": 20}
    options |= {"most_elongation": 1.05, "least_scale": 1.5}
    scales = {}
    for name, bounds in (("free", {"most_elongation": None, "least_scale": 0.0}), ("bound", {})):
        field = warpcage.fit(scene, representation="splats", progress=False, **{**options, **bounds})
        scales[name] = np.sort(field.scales, axis=1)
    nearest = 2.2 / scene.cameras[0].fx  # views are 4 from the middle of a cube of side 2
    assert (scales["free"][:, 0] < 1.5 * nearest).mean() > 0.1
    assert (scales["bound"][:, 0] < 1.5 * nearest).mean() < 0.02
    ratios = {name: np.percentile(each[:, 2] / each[:, 1], 90) for name, each in scales.items()}
    assert ratios["bound"] < 1.17 and ratios["free"] > ratios["bound"] + 0.05


def test_progress_is_kept_and_gone_on_with(tmp_path, monkeypatch):
    truth = true_field("cpu", 60)
    scene = scene_of(truth, ring(8, 20, (40, 32)), points=truth.contents.centers)
    options = {"representation": "splats", "device": "cpu", "progress": False, "steps": 60, "pixels_per_splat": 1.0}
    options |= {"most_splats": 400, "grow_every": 10, "exposure": True}
    whole = warpcage.fit(scene, **options)
    path, steps = tmp_path / "progress.npz", []

    def stop(self):
        steps.append(self.step_count)
        if len(steps) == 41:
            raise KeyboardInterrupt
        step(self)

    step = SplatFit.step
    monkeypatch.setattr(SplatFit, "step", stop)
    with pytest.raises(KeyboardInterrupt):
        warpcage.fit(scene, checkpoint=path, checkpoint_seconds=1e-9, **options)
    assert path.exists()
    monkeypatch.setattr(SplatFit, "step", step)
    with pytest.raises(ValueError, match="another fit"):
        warpcage.fit(scene, checkpoint=path, **{**options, "seed": 1})
    resumed = warpcage.fit(scene, checkpoint=path, **options)
    assert not path.exists()
    for name in ("centers", "log_scales", "quaternions", "logits", "harmonics"):
        assert (getattr(resumed.contents, name) == getattr(whole.contents, name)).all()


@pytest.mark.parametrize("representation", ["splats", "voxels"])
def test_a_preview_grows_beside_a_picture_of_the_scene(tmp_path, representation):
    truth = true_field("cpu", 60)
    scene = scene_of(truth, ring(4, 20, (40, 32)), points=truth.contents.centers)
    options = {"steps": 5} if representation == "splats" else {"epochs": 1, "resolution": 16}
    path = tmp_path / "preview.png"
    options |= {"device": "cpu", "progress": False, "representation": representation}
    warpcage.fit(scene, preview=path, preview_seconds=0.0, **options)
    shown = imageio.imread(path)
    assert shown.shape[0] == 32 and shown.shape[1] > 80
    assert np.abs(shown[:, :40] / 255.0 - scene.images[2]).max() < 0.003
    with pytest.raises(ValueError, match="a picture that ends in .png"):
        warpcage.fit(scene, preview=tmp_path / "preview.jpg", **options)


@pytest.mark.parametrize("damage", ["format", "count", "nan", "exposures"])
def test_damaged_progress_is_refused(tmp_path, damage):
    truth = true_field("cpu", 60)
    scene = scene_of(truth, ring(4, 20, (40, 32)), points=truth.contents.centers)
    options = {"device": "cpu", "steps": 5}
    from warpcage.fitting.splats import checkpoint

    fit, path = SplatFit(scene, **options), tmp_path / "progress.npz"
    fit.step()
    checkpoint.save_progress(fit, path)
    with np.load(path) as held:
        contents = dict(held)
    if damage == "format":
        contents["format"] = np.array("warpcage fit")
    if damage == "count":
        contents["values_logits"] = contents["values_logits"][:-1]
    if damage == "nan":
        contents["means_centers"][3] = np.nan
    if damage == "exposures":
        contents["exposures"] = np.zeros((2, 19))
    np.savez(path, **contents)
    with pytest.raises(ValueError, match="progress.npz is (a damaged|no) "):
        checkpoint.load_progress(SplatFit(scene, **options), path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps must be a whole number from 1"),
        ({"epochs": 3.0}, "no option 'epochs'"),
        ({"background": "layers"}, "background must be one of auto"),
        ({"bounds": [[0, 0, 0], [1, 1, 1]]}, "bounds are for voxels"),
        ({"max_memory": "1MB"}, "max_memory"),
        ({"antialias": 1}, "antialias must be True or False"),
        ({"exposure": "auto"}, "exposure must be True, False or None"),
        ({"representation": "mesh"}, "representation must be one of"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    scene = scene_of(true_field("cpu", 20), ring(4, 20, (40, 32)))
    with pytest.raises(ValueError, match=message):
        warpcage.fit(scene, **{"representation": "splats", "device": "cpu", "progress": False, **options})


def test_the_schedule_grows_to_the_end_and_sees_every_picture_as_often():
    options = SplatFitOptions(steps=1000, grow_every=50)
    schedule = SplatSchedule(options, 7, (800, 600), 1.2, None, seed=0)
    assert np.ptp(np.bincount(schedule.views)) <= 1
    count, counts = 100, []
    for step in range(1000):
        if schedule.revives(step):
            count = schedule.count_after(step, count, 100, 900)
        counts.append(count)
    assert counts[0] == 100 and counts[-1] == 900 and counts[700] == 900 and counts[550] < 900
    assert [schedule.shrinkage(step) for step in (0, 116, 117, 349, 350, 999)] == [4, 4, 2, 2, 1, 1]
    assert [schedule.degree(step) for step in (0, 83, 84, 250, 999)] == [0, 0, 1, 3, 3]
