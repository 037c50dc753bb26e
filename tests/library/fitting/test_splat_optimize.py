"""Splats from pictures: what `fit(scene, representation="splats")` makes of scenes that the tests make."""

import dataclasses

import imageio.v3 as imageio
import numpy as np
import pytest
import warp as wp
from refusals import refused
from splat_scenes import VALUES, held_out_psnr, ring, scene_of, true_field

import warpcage
from warpcage import SplatField
from warpcage.core import launch
from warpcage.fitting.splats import SplatFit, SplatFitOptions, SplatSchedule, checkpoint
from warpcage.fitting.splats.start import QUICK_FIT
from warpcage.kernels.fitting import splat_step

FAST = {"steps": 500, "most_splats": 2500, "pixels_per_splat": 1.0}


def fit(scene, device="cpu", **options):
    return warpcage.fit(scene, **{"representation": "splats", "device": device, "progress": False} | options)


def small_scene(views=4, device="cpu"):
    """Few pictures of few splats."""
    truth = true_field(device, 60)
    return scene_of(truth, ring(views, 20, (40, 32)), points=truth.contents.centers)


def require_same(one, other):
    for name in VALUES:
        assert (getattr(one.contents, name) == getattr(other.contents, name)).all(), name


def test_views_that_were_held_out():
    truth = true_field("cpu")
    points = truth.contents.centers + 0.05 * np.random.default_rng(1).normal(size=truth.contents.centers.shape)
    field = fit(scene_of(truth, ring(12, 20) + ring(12, -10), points=points), **FAST)
    assert isinstance(field, SplatField) and 1000 < field.splat_count <= 2500
    assert held_out_psnr(field, truth) > 21.5
    assert (field.background == 0).all() and field.opacities.min() >= 0.0039


def test_any_device_and_no_points(device, monkeypatch):
    """Places that the views see, in a fit of voxels, are enough to begin with."""
    for name in ("max_resolution", "max_outer_resolution"):
        monkeypatch.setitem(QUICK_FIT, name, 24)
    truth = true_field(device)
    scene = scene_of(truth, ring(12, 20) + ring(12, -10))
    assert held_out_psnr(fit(scene, device, **FAST | {"steps": 250}), truth) > 20


def test_opacity_is_supervised_where_pictures_have_it(device):
    truth = true_field(device, background="white")
    scene = scene_of(truth, ring(12, 20) + ring(12, -10), alphas=True)
    field = fit(scene, device, **FAST)
    assert (field.background == 1).all() and held_out_psnr(field, truth) > 23
    camera = ring(1, 5)[0]
    assert np.abs(field.render(camera).alpha - truth.render(camera).alpha).mean() < 0.05


def test_sizes_of_scenes_do_not_matter(device):
    """A scene in other units gives the same splats in those."""
    truth = true_field(device)
    scene = scene_of(truth, ring(10, 20), points=truth.contents.centers)
    farther = np.where(np.arange(4) == 3, 1000.0, 1.0) ** [[1], [1], [1], [0]]
    cameras = [dataclasses.replace(each, camera_to_world=farther * each.camera_to_world) for each in scene.cameras]
    thousand = dataclasses.replace(scene, cameras=cameras, points=1000.0 * scene.points)
    small, large = (fit(each, device, **FAST | {"steps": 60}) for each in (scene, thousand))
    assert abs(small.splat_count - large.splat_count) < 0.02 * small.splat_count
    near = np.median(small.scales) * 1000.0 / np.median(large.scales)
    assert abs(near - 1) < 0.05


def test_bounds_of_scales(device):
    """Needles become shorter, and no splat that pictures see is smaller than a part of a pixel."""
    scene = small_scene(8, device)
    options = {"steps": 150, "pixels_per_splat": 1.0, "most_splats": 400, "grow_every": 20}
    bounds = {"free": {"most_elongation": None, "least_scale": 0.0}}
    bounds["bound"] = {"most_elongation": 1.05, "least_scale": 1.5}
    scales = {name: np.sort(fit(scene, device, **options | each).scales, axis=1) for name, each in bounds.items()}
    nearest = 2.2 / scene.cameras[0].fx  # views are 4 from the middle of a cube of side 2
    assert (scales["free"][:, 0] < 1.5 * nearest).mean() > 0.1
    assert (scales["bound"][:, 0] < 1.5 * nearest).mean() < 0.02
    ratios = {name: np.percentile(each[:, 2] / each[:, 1], 90) for name, each in scales.items()}
    assert ratios["bound"] < 1.17 and ratios["free"] > ratios["bound"] + 0.05


def test_progress_is_kept_and_gone_on_with(tmp_path, monkeypatch, two_threads):
    """To the bit: the same seed gives the same splats."""
    scene, path, steps, step = small_scene(8), tmp_path / "progress.npz", [], SplatFit.step
    options = {"steps": 40, "pixels_per_splat": 1.0, "most_splats": 400, "grow_every": 10, "exposure": True}
    whole = fit(scene, **options)

    def stop(self):
        steps.append(self.step_count)
        if len(steps) == 26:
            raise KeyboardInterrupt
        step(self)

    with monkeypatch.context() as stopping, pytest.raises(KeyboardInterrupt):
        stopping.setattr(SplatFit, "step", stop)
        fit(scene, checkpoint=path, checkpoint_seconds=1e-9, **options)
    assert path.exists()
    refused(lambda: fit(scene, checkpoint=path, **options | {"seed": 1}), match="another fit")
    require_same(fit(scene, checkpoint=path, **options), whole)
    assert not path.exists()


@pytest.mark.parametrize("representation", ["splats", "voxels"])
def test_a_preview_grows_beside_a_picture_of_the_scene(tmp_path, representation):
    scene, path = small_scene(), tmp_path / "preview.png"
    options = {"steps": 5} if representation == "splats" else {"epochs": 1, "resolution": 16}
    options |= {"representation": representation}
    fit(scene, preview=path, preview_seconds=0.0, **options)
    shown = imageio.imread(path)
    assert shown.shape[0] == 32 and shown.shape[1] > 80
    assert np.abs(shown[:, :40] / 255.0 - scene.images[2]).max() < 0.003
    refused(lambda: fit(scene, preview=tmp_path / "preview.jpg", **options), match="a picture that ends in .png")


def test_damaged_progress_is_refused(tmp_path):
    scene, path = small_scene(), tmp_path / "progress.npz"
    one, other = (SplatFit(scene, device="cpu", steps=5) for _ in range(2))
    one.step()
    checkpoint.save_progress(one, path)
    with np.load(path) as held:
        contents = dict(held)
    means = contents["means_centers"].copy()
    means[3] = np.nan
    for change in (
        {"format": np.array("warpcage fit")},
        {"values_logits": contents["values_logits"][:-1]},
        {"means_centers": means},
        {"exposures": np.zeros((2, 19))},
    ):
        np.savez(path, **contents | change)
        refused(lambda: checkpoint.load_progress(other, path), match="progress.npz is (a damaged|not a) ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps must be a whole number from 1"),
        ({"epochs": 3.0}, "no option 'epochs'"),
        ({"background": "layers"}, "background must be one of auto"),
        ({"bounds": [[0, 0, 0], [1, 1, 1]]}, "bounds are for voxels"),
        ({"max_memory": "1MB"}, "max_memory"),
        ({"antialias": 1}, "antialias must be true or false"),
        ({"exposure": "auto"}, "exposure must be True, False or None"),
        ({"representation": "mesh"}, "representation must be one of"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    scene = scene_of(true_field("cpu", 20), ring(4, 20, (40, 32)))
    refused(lambda: fit(scene, **options), match=message)


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


# What of the pictures splats are fitted to: pixels that count, and whole pictures where masks split them

FEW = {"steps": 80, "most_splats": 400, "pixels_per_splat": 1.0}


@pytest.fixture(scope="module")
def larger_scene():
    truth = true_field("cpu", 60)
    scene = scene_of(truth, ring(6, 20, (160, 130)), points=np.repeat(truth.contents.centers, 2, axis=0))
    return dataclasses.replace(scene, point_colors=np.full((120, 3), 0.5, np.float32))


@pytest.fixture(scope="module")
def whole(larger_scene):
    return fit(larger_scene, **FEW)


def test_what_has_no_weight_has_no_influence(larger_scene, whole):
    """Neither by colors nor by windows, nor in coarse pictures: the same splats to the bit."""
    weights = np.ones((6, 130, 160))
    weights[:, 31:70, 45:99] = 0.0
    changed = larger_scene.images.copy()
    changed[weights == 0.0] = np.random.default_rng(0).random((int((weights == 0.0).sum()), 3))
    other = dataclasses.replace(larger_scene, images=changed)
    one, same = (fit(each, weights=weights, **FEW) for each in (larger_scene, other))
    require_same(one, same)
    assert (whole.contents.logits[:100] != one.contents.logits[:100]).any()


def test_coarse_weights_are_the_least(device):
    fine = np.random.default_rng(0).integers(0, 256, (2, 9, 14)).astype(np.uint8)
    coarse = wp.zeros((2, 4, 7), dtype=wp.uint8, device=device)
    inputs = [2, wp.array(fine, dtype=wp.uint8, device=device)]
    launch(splat_step.shrink_weights, coarse.size, inputs, [coarse], device=device)
    assert (coarse.numpy() == fine[:, :8].reshape(2, 4, 2, 7, 2).min(axis=(2, 4))).all()


def test_weights_of_other_pictures_are_refused(larger_scene):
    with pytest.raises(ValueError, match=r"pixel of the pictures, got \(6, 130\)"):
        SplatFit(larger_scene, device="cpu", weights=np.ones((6, 130)))


def test_whole_pictures_are_fitted_where_masks_split_them(larger_scene, whole):
    alphas = np.zeros((6, 130, 160), np.float32)
    alphas[:, 40:90, 50:110] = 1.0
    share = 1.0 - alphas[..., None]
    cut = alphas[..., None] * larger_scene.images + share * larger_scene.background
    split = dataclasses.replace(larger_scene, images=cut, alphas=alphas, surroundings=share * larger_scene.images)
    require_same(fit(split, **FEW), whole)
    one, other = (warpcage.mean_psnr(warpcage.evaluate(whole, each)) for each in (larger_scene, split))
    assert abs(one - other) < 1e-3
