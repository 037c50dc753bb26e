"""What of the pictures splats are fitted to: pixels that count, and whole pictures where masks split them."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from splat_scenes import ring, scene_of, true_field

import warpcage
from warpcage.core import launch
from warpcage.fitting.splats import SplatFit
from warpcage.kernels.fitting import splat_step

OPTIONS = {"representation": "splats", "progress": False, "steps": 80, "most_splats": 400, "pixels_per_splat": 1.0}
NAMES = ("centers", "log_scales", "quaternions", "logits", "harmonics")


@pytest.fixture
def scene():
    truth = true_field("cpu", 60)
    scene = scene_of(truth, ring(6, 20, (160, 130)), points=np.repeat(truth.contents.centers, 2, axis=0))
    return dataclasses.replace(scene, point_colors=np.full((120, 3), 0.5, np.float32))


def test_what_has_no_weight_has_no_influence(scene):
    """Neither by colors nor by windows, nor in coarse pictures: the same splats to the bit."""
    weights = np.ones((6, 130, 160))
    weights[:, 31:70, 45:99] = 0.0
    changed = scene.images.copy()
    changed[weights == 0.0] = np.random.default_rng(0).random((int((weights == 0.0).sum()), 3))
    other = dataclasses.replace(scene, images=changed)
    fields = [warpcage.fit(each, device="cpu", weights=weights, **OPTIONS) for each in (scene, other)]
    for name in NAMES:
        assert (getattr(fields[0].contents, name) == getattr(fields[1].contents, name)).all(), name
    whole = warpcage.fit(other, device="cpu", **OPTIONS)
    assert (whole.contents.logits[:100] != fields[1].contents.logits[:100]).any()


def test_coarse_weights_are_the_least(device):
    fine = np.random.default_rng(0).integers(0, 256, (2, 9, 14)).astype(np.uint8)
    coarse = wp.zeros((2, 4, 7), dtype=wp.uint8, device=device)
    inputs = [2, wp.array(fine, dtype=wp.uint8, device=device)]
    launch(splat_step.shrink_weights, coarse.size, inputs, [coarse], device=device)
    assert (coarse.numpy() == fine[:, :8].reshape(2, 4, 2, 7, 2).min(axis=(2, 4))).all()


def test_weights_of_other_pictures_are_refused(scene):
    with pytest.raises(ValueError, match=r"pixel of the pictures, got \(6, 130\)"):
        SplatFit(scene, device="cpu", weights=np.ones((6, 130)))


def test_whole_pictures_are_fitted_where_masks_split_them(scene):
    alphas = np.zeros((6, 130, 160), np.float32)
    alphas[:, 40:90, 50:110] = 1.0
    share = 1.0 - alphas[..., None]
    cut = alphas[..., None] * scene.images + share * scene.background
    split = dataclasses.replace(scene, images=cut, alphas=alphas, surroundings=share * scene.images)
    fields = [warpcage.fit(each, device="cpu", **OPTIONS) for each in (scene, split)]
    for name in NAMES:
        assert (getattr(fields[0].contents, name) == getattr(fields[1].contents, name)).all(), name
    rows = [warpcage.evaluate(fields[0], each) for each in (scene, split)]
    assert abs(warpcage.mean_psnr(rows[0]) - warpcage.mean_psnr(rows[1])) < 1e-3
