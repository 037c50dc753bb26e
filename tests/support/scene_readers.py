"""How tests read scenes and compare them with what was written."""

import numpy as np
import pytest

from warpcage import load_scene

#: Points of a reconstruction, with a few wild ones.
CLOUD = np.concatenate([np.full((4, 3), 1000.0), np.random.default_rng(0).uniform(-0.5, 0.8, (396, 3))])
BACKGROUND = (0.1, 0.5, 0.9)


def require_equal(scene, pictures, *, tolerance=1e-5, image_tolerance=1e-6):
    assert len(scene) == len(pictures.cameras)
    for read, written in zip(scene.cameras, pictures.cameras, strict=True):
        assert (read.width, read.height) == (written.width, written.height)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(read, name) == pytest.approx(getattr(written, name), rel=tolerance)
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=tolerance)
    images, alphas = pictures.over(BACKGROUND)
    np.testing.assert_allclose(scene.images, images, atol=image_tolerance)
    np.testing.assert_allclose(scene.alphas, alphas, atol=1e-6)


def load(folder, **options):
    return load_scene(folder, background=BACKGROUND, **options)


def bounds_are_of_points(_folder, scene):
    low, high = scene.bounds
    assert (low > -0.8).all() and (low < -0.45).all() and (high > 0.75).all() and (high < 1.1).all()


def pixel_centers(camera):
    return np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
