"""Weights of pixels: kept with the scene, and what has none has no influence on fits and figures."""

import dataclasses
import pickle

import numpy as np
import pytest
from splat_scenes import ring, scene_of, true_field

import warpcage
from warpcage.view.pictures import shrink, shrink_weights

SPLATS = {"representation": "splats", "progress": False, "steps": 40, "most_splats": 200, "pixels_per_splat": 1.0}


@pytest.fixture(scope="module")
def scene():
    truth = true_field("cpu", 60)
    scene = scene_of(truth, ring(6, 20, (64, 48)), points=np.repeat(truth.contents.centers, 2, axis=0))
    weights = np.ones((6, 48, 64))
    weights[:, 11:30, 25:49] = 0.0
    weights[:, :4] = 0.5
    return dataclasses.replace(scene, weights=weights)


def test_weights_stay_with_the_pictures(scene):
    assert scene.weights.dtype == np.float32 and scene.weights.shape == scene.images.shape[:3]
    motion = np.eye(4)
    motion[:3, 3] = [1, 2, 3]
    others = [scene.moved(motion), scene.straightened(), scene.with_cameras(scene.cameras)]
    for other in [*others, pickle.loads(pickle.dumps(scene))]:
        np.testing.assert_array_equal(other.weights, scene.weights)
    assert "weights" in repr(scene) and dataclasses.replace(scene, weights=None).weights is None


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones((6, 48)), r"scene weights must be \(6, 48, 64\)"),
        (np.full((6, 48, 64), -0.5), "from -0.5 to -0.5"),
        (np.full((6, 48, 64), np.nan), r"must lie in \[0, 1\]"),
        ("all", "scene weights must be real numbers"),
    ],
)
def test_other_weights_are_refused(scene, weights, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(scene, weights=weights)


@pytest.mark.parametrize("size", [(8, 12), (9, 13), (7, 11), (1, 2)])
@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_a_smaller_picture_ignores_all_that_ignored_pixels_are_in(size, factor):
    weights = np.random.default_rng(0).uniform(0.1, 1.0, size)
    small = shrink_weights(weights, factor)
    for row in range(size[0]):
        for column in range(size[1]):
            one = np.ones(size)
            one[row, column] = 0.0
            touched = shrink(1.0 - one[..., None], factor)[..., 0] > 1e-9  # of which the pixel is a part
            np.testing.assert_array_equal(shrink_weights(one, factor) == 0.0, touched)
            assert (small[touched] <= weights[row, column]).all()
    assert np.isin(small, weights).all()
    stack = np.stack([weights, 1.0 - weights])
    np.testing.assert_array_equal(shrink_weights(stack, factor)[0], small)


def test_splats_take_the_weights_of_their_scene(scene):
    """And what they say of a pixel that has none changes nothing, to the bit, points without colors neither."""
    garbage = scene.images.copy()
    garbage[scene.weights == 0.0] = np.random.default_rng(0).random((int((scene.weights == 0.0).sum()), 3))
    scene = dataclasses.replace(scene, point_colors=None)
    bare = dataclasses.replace(scene, weights=None)
    fields = [
        warpcage.fit(scene, device="cpu", **SPLATS),
        warpcage.fit(dataclasses.replace(scene, images=garbage), device="cpu", **SPLATS),
        warpcage.fit(bare, device="cpu", weights=scene.weights, **SPLATS),
        warpcage.fit(bare, device="cpu", **SPLATS),
    ]
    values = [np.concatenate([each.contents.centers, each.contents.log_scales], axis=1) for each in fields]
    np.testing.assert_array_equal(values[0], values[1])
    np.testing.assert_array_equal(values[0], values[2])
    assert values[0].shape != values[3].shape or (values[0] != values[3]).any()
