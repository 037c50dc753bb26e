"""The defaults of a fit on objects of several kinds: a quality that is held, and the same anywhere and at any size."""

import functools

import numpy as np
import pytest
import warp as wp
from ground_truth import KINDS, MODELS, synthetic_scene
from refusals import refused

from warpcage import Camera, FieldOptimizer, Scene, evaluate, fit, mean_psnr, turntable
from warpcage.fitting import MAX_SCARCE, RAYS_PER_VOXEL, checked_options, plan_batches, scarcity
from warpcage.kernels.fitting.rmsprop import shrink_view_dependence

SMALL = {"progress": False, "least_steps": 120, "batch_rays": 1024}


@functools.cache
def scenes(kind, device):
    return synthetic_scene(kind, train_views=32, test_views=16, size=32, samples=2, device=device)


@functools.cache
def held_out_psnr(kind, device, **options):
    train, test = scenes(kind, device)
    return mean_psnr(evaluate(fit(train, device=device, **SMALL, **options), test))


@pytest.mark.parametrize(
    "kind, least",
    [
        ("bricks", 24.8),
        ("thin", 24.0),
        ("specular", 27.5),
        pytest.param("textured", 24.4, marks=pytest.mark.nightly),
        pytest.param("aside", 24.6, marks=pytest.mark.nightly),
    ],
)
def test_views_that_were_held_out(device, kind, least):
    """About 0.8 dB below what was measured."""
    assert held_out_psnr(kind, device) > least


@pytest.mark.parametrize("kind", ["off-centre", "ten times larger"])
def test_the_place_and_the_size_of_an_object_do_not_matter(device, kind):
    assert abs(held_out_psnr(kind, device) - held_out_psnr("bricks", device)) < 0.2


@pytest.mark.parametrize(
    "count, kind, gain", [(8, "bricks", 0.8), pytest.param(16, "specular", 0.4, marks=pytest.mark.nightly)]
)
def test_few_views_get_more_of_a_prior(device, count, kind, gain):
    """With the regularisers of many views the same fit matches these views better, and others less well."""
    train, test = scenes(kind, device)
    few = slice(None, None, len(train) // count)
    few = Scene(train.images[few], train.alphas[few], train.cameras[few])
    fields = [fit(few, device=device, scarcity=scarce, **SMALL) for scarce in (None, 1.0)]
    seen, held_out = ([mean_psnr(evaluate(field, views)) for field in fields] for views in (few, test))
    assert seen[0] < seen[1] and held_out[0] > held_out[1] + gain


def test_scarcity_by_hand():
    """Pixels of 0.01 at the centre, voxels of 0.02: each view sees one by four pixels."""
    cameras = [
        Camera.look_at((3, 0, 0), (0, 0, 0), fov_degrees=2 * np.degrees(np.arctan(0.5)), width=300, height=200),
        *turntable((0, 0, 0), 3.0, 10.0, 4, fov_degrees=2 * np.degrees(np.arctan(0.5)), width=300, height=200),
    ]
    assert scarcity(cameras, np.zeros(3), 0.02) == pytest.approx(RAYS_PER_VOXEL / 20)
    assert scarcity(cameras, np.zeros(3), 0.04) == pytest.approx(RAYS_PER_VOXEL / 80)
    assert scarcity(cameras, np.zeros(3), 0.2) == 1.0
    assert scarcity(cameras, np.zeros(3), 0.001) == MAX_SCARCE


def test_shrinking_leaves_the_mean_color(device):
    random = np.random.default_rng(0)
    values = random.normal(size=(5, 24)).astype(np.float32)
    held = wp.array(values, dtype=wp.float32, device=device)
    wp.launch(shrink_view_dependence, dim=values.size, inputs=[0, 0.75, held], device=device)
    values[:, [number for number in range(24) if number not in (0, 16, 20)]] *= np.float32(0.75)
    np.testing.assert_array_equal(held.numpy(), values)


def test_few_pixels_get_steps_enough(device):
    """Small batches first, then more passes; asked for in passes they are what was asked for."""
    train, _ = scenes("bricks", device)
    default, asked = FieldOptimizer(train, device=device), FieldOptimizer(train, device=device, epochs=8.0)
    assert default.total_steps == pytest.approx(600, abs=3) and default.batch_rays == 4096
    assert asked.batch_rays == 4096 and asked.total_steps == pytest.approx(8 * asked.active_tiles * 4 / 4096, abs=3)


@pytest.mark.parametrize(
    ("quality", "millions", "passes", "rays"),
    [("standard", 22, 11, 131072), ("standard", 6, 11, 65536), ("fast", 22, 3.1, 65536), ("high", 11, 22, 131072)],
)
def test_batches_are_large_where_steps_are_many(quality, millions, passes, rays):
    """A step costs much whatever its batch counts."""
    tiles = millions * 1_000_000 // 4
    batch, steps = plan_batches(checked_options({"quality": quality}), 56_000_000, tiles)
    assert 4 * batch == rays and sum(steps) == pytest.approx(passes * tiles / batch, rel=0.01)
    asked = plan_batches(checked_options({"quality": quality, "epochs": 5.0}), 56_000_000, tiles)
    assert sum(asked[1]) == pytest.approx(5 * tiles / asked[0], rel=0.01)


def test_levels_grow_less_beside_an_outer_field():
    """A level takes 2.6 times the steps of the level before, 1.25 times beside an outer field, or what is asked for."""
    for options, has_outer, growth in (({}, False, 2.6), ({}, True, 1.25), ({"level_growth": 2.0}, True, 2.0)):
        _, steps = plan_batches(checked_options(options), 56_000_000, 5_000_000, has_outer)
        np.testing.assert_allclose(np.divide(steps[1:], steps[:-1]), growth, rtol=0.02)


@pytest.mark.parametrize("model", MODELS)
def test_models_are_meshes(model):
    vertices, faces, colors = MODELS[model]()
    assert vertices.shape[1] == 3 and np.abs(vertices).max() < 1.4
    assert faces.shape == colors.shape and faces.min() == 0 and faces.max() == len(vertices) - 1
    assert colors.min() >= 0 and colors.max() <= 1
    area = np.linalg.norm(np.cross(*(vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2))), axis=1)
    assert area.min() > 0


def test_scenes_of_a_kind():
    refused(lambda: synthetic_scene("round"), match="kind 'round' is not known: bricks")
    refused(lambda: synthetic_scene(train_views=0), match="needs views")
    for kind in KINDS:
        train, test = synthetic_scene(kind, train_views=2, test_views=1, size=12, samples=1, alpha=kind != "thin")
        assert len(train) == (20 if "20" in kind else 2) and len(test) == 1
        assert (train.alphas is None) == (kind == "thin")
        if train.alphas is not None:
            assert 0.02 < train.alphas.mean() < 0.9
