"""Slopes of pictures of splats by their values: against differences of the equations in float64."""

import numpy as np
import pytest
import warp as wp
from splat_scenes import reference_view

from warpcage import Camera, SplatField
from warpcage.splats import SplatGradients, SplatParameters, rotation_matrices, splat_lens

BACKGROUND = (0.9, 0.5, 0.2)
STEP = 1e-6


def values_of(count, scale, degree, seed=0, half=1.0):
    """Centres, logarithms of scales, quaternions, logits and harmonics of splats, float32 numbers."""
    rng = np.random.default_rng(seed)
    parts = (
        rng.uniform(-half, half, (count, 3)),
        np.log(scale) + 0.7 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(size=count),
        0.3 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    return [part.astype(np.float32).astype(np.float64) for part in parts]


def reference(values, camera, near, **options):
    """The picture of the equations."""
    centers, logs, quaternions, logits, harmonics = values
    factors = rotation_matrices(quaternions) * np.exp(logs)[:, None, :]
    covariances = factors @ factors.transpose(0, 2, 1)
    opacities = 1 / (1 + np.exp(-logits))
    return reference_view(centers, covariances, opacities, harmonics, camera, BACKGROUND, near=near, **options)[0]


def slopes_on(device, values, camera, weights, *, antialias=False, blur=0.3):
    """The picture, and slopes of sum(weights * picture) by each kind of values."""
    field = SplatField(*values, device=device)
    parameters, gradients = SplatParameters(field), SplatGradients(device)
    parameters.refresh()
    lens = splat_lens(camera, field.center, field.near, blur, antialias)
    picture = gradients.draw(parameters, camera, lens, wp.vec3(*BACKGROUND)).numpy()
    gradients.take_back(wp.array(weights.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=field.device))
    found = [parameters.slopes[name].numpy().astype(np.float64) for name in parameters.slopes]
    return picture.reshape(camera.height, camera.width, 3), found, field.near


def assert_slopes(device, values, camera, *, antialias=False, blur=0.3, least=3e-3):
    """Slopes are the differences of the equations: of every column of each kind, for a few splats. Colours of a pixel
    do not depend on each other, so that one difference gives the slopes of a harmonic's three."""
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(camera.height, camera.width, 3)).astype(np.float32).astype(np.float64)
    options = {"antialias": antialias, "blur": blur}
    picture, found, near = slopes_on(device, values, camera, weights, **options)
    assert np.abs(picture - reference(values, camera, near, **options)).max() < 2e-3

    def difference(kind, place):
        ends = []
        for side in (1, -1):
            moved = [part.copy() for part in values]
            moved[kind][place] += side * STEP
            ends.append((weights * reference(moved, camera, near, **options)).sum(axis=(0, 1)))
        return (ends[0] - ends[1]) / (2 * STEP)

    for kind, (slopes, held) in enumerate(zip(found, values, strict=True)):
        slopes, greatest = slopes.reshape(held.shape), 0.0
        columns = list(np.ndindex(held.shape[1:2]))
        for column in columns:
            for splat in rng.permutation(len(held))[: max(2, 10 // len(columns))]:
                place = (splat, *column)
                expected = difference(kind, place) if kind == 4 else difference(kind, place).sum()
                wrong = np.abs(slopes[place] - expected)
                assert (wrong < least * (np.abs(slopes).max() + np.abs(expected))).all(), (kind, place)
                greatest = max(greatest, np.abs(expected).max())
        assert greatest > 0


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(("count", "scale", "degree"), [(40, 0.15, 3), (15, 0.4, 1), (30, 0.02, 2), (20, 0.2, 0)])
def test_slopes_are_those_of_the_equations(count, scale, degree, antialias, device):
    values = values_of(count, scale, degree)
    camera = Camera.look_at((2.0, -3.0, 1.0), (0, 0, 0), width=37, height=29)
    assert_slopes(device, values, camera, antialias=antialias, blur=1.2 if degree == 3 else 0.3)


def test_slopes_at_the_rim_and_of_nearly_opaque_splats(device):
    """Centres beyond the picture, where the affine part is held, and alphas that are held at 0.999."""
    values = values_of(30, 0.5, 1, seed=2, half=1.5)
    values[3] = values[3] + 6.0
    pose = Camera.look_at((0.3, -3.0, 0.2), (0, 0, 0)).camera_to_world
    assert_slopes(device, values, Camera(30, 33, 11, 17.5, 26, 21, pose))


def test_splats_that_are_not_seen_have_no_slopes(device):
    values = values_of(20, 0.05, 3)
    values[0][:10, 1] -= 50.0  # behind the camera
    values[3][10:15] = -20.0
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=20, height=20)
    _, found, _ = slopes_on(device, values, camera, np.ones((20, 20, 3)))
    assert all((slopes[:15] == 0).all() for slopes in found) and all(np.abs(slopes[15:]).max() > 0 for slopes in found)


def test_quaternions_of_length_zero_do_not_turn(device):
    values = values_of(6, 0.3, 0)
    values[2][:3] = 0.0
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=20, height=20)
    _, found, _ = slopes_on(device, values, camera, np.random.default_rng(0).normal(size=(20, 20, 3)))
    assert (found[2][:3] == 0).all() and np.abs(found[2][3:]).max() > 0 and np.isfinite(found[1]).all()
